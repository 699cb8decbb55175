"""What a batch leaves: summary.json and index.html, one line per group. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from jtqd.sysid.batch.figures import FAILED_BADGE, GAP, HEADINGS, Figures, figures_of
from jtqd.sysid.batch.run import FAILED, Job, Row
from jtqd.sysid.diagnosis.report import theme

SCHEMA: Final = "jtq.batch/1"
TEMPLATE: Final = "page.html.j2"


@dataclass(frozen=True)
class Line:
    """One row of the page; bar: share of the largest gap, None where there is none; link: of its report, or empty."""

    name: str
    logs: tuple[str, ...]
    badge: tuple[str, str]
    cells: tuple[str, ...]
    bar: float | None
    link: str
    state: str
    error: str
    seconds: float


@dataclass(frozen=True)
class Count:
    """How often something was found; share: of all groups."""

    text: str
    colour: str
    number: int
    share: float


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """State -> number of groups, and all of them."""
    found = Counter(row.state for row in rows)
    return {"groups": len(rows), **{state: found[state] for state in ("done", "kept", "failed")}}


def to_mapping(job: Job, rows: Sequence[Row], where: str) -> dict[str, Any]:
    """Content of summary.json."""
    return {
        "schema": SCHEMA,
        "command": job.command,
        "tool": job.tool,
        "parameters": dict(job.parameters),
        "where": where,
        "counts": counts(rows),
        "groups": [_plain(job.command, row) for row in rows],
    }


def _plain(command: str, row: Row) -> dict[str, Any]:
    figures = _figures(command, row)
    return {
        "name": row.group.name,
        "logs": [str(path) for path in row.group.files],
        "state": row.state,
        "key": row.key,
        "exit_status": None if row.content is None else row.content["exit_status"],
        "error": row.error or None,
        "seconds": row.seconds,
        "figures": None if figures is None else dict(figures.values),
    }


def _figures(command: str, row: Row) -> Figures | None:
    return None if row.content is None else figures_of(command, row.content["result"])


def render(job: Job, rows: Sequence[Row], where: str, made: str, links: Mapping[str, str]) -> str:
    """The page: self-contained but for the links to the reports.

    Args:
        made: when, one line for the foot of the page.
        links: key of a result -> where its report is, seen from the page.

    Needs jinja2 (ImportError without it).
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader(
            [PackageLoader("jtqd.sysid.batch", "."), PackageLoader("jtqd.sysid.diagnosis.report", ".")]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    figures = [_figures(job.command, row) for row in rows]
    return environment.get_template(TEMPLATE).render(
        command=job.command,
        arguments=" ".join(job.arguments),
        tool=job.tool,
        where=where,
        made=made,
        light=theme.variables(theme.LIGHT),
        dark=theme.variables(theme.DARK),
        counts=counts(rows),
        headings=HEADINGS[job.command],
        gap=GAP[job.command],
        lines=_lines(rows, figures, links),
        badges=_badges(figures),
        names=_names(figures),
        logs=sum(len(row.group.files) for row in rows),
        seconds=sum(row.seconds for row in rows),
    )


def _lines(rows: Sequence[Row], figures: Sequence[Figures | None], links: Mapping[str, str]) -> list[Line]:
    """Failed groups first, then the largest gap."""
    largest = max((each.gap_nm or 0.0 for each in figures if each is not None), default=0.0)
    made = []
    for row, each in zip(rows, figures, strict=True):
        gap = None if each is None else each.gap_nm
        made.append(
            Line(
                row.group.name,
                tuple(path.name for path in row.group.files),
                FAILED_BADGE if each is None else each.badge,
                () if each is None else each.cells,
                None if gap is None or largest <= 0.0 else gap / largest,
                links.get(row.key or "", ""),
                row.state,
                row.error,
                row.seconds,
            )
        )
    return sorted(made, key=lambda line: (line.state != FAILED, -(line.bar or 0.0), line.name))


def _badges(figures: Sequence[Figures | None]) -> list[Count]:
    found = Counter(FAILED_BADGE if each is None else each.badge for each in figures)
    return [
        Count(text, colour, number, number / len(figures)) for (colour, text), number in found.most_common()
    ]


def _names(figures: Sequence[Figures | None]) -> list[Count]:
    found = Counter(name for each in figures if each is not None for name in each.names)
    return [Count(name, "after", number, number / len(figures)) for name, number in found.most_common()]
