"""Summarise a batch: summary.json and index.html, one line per group."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from jtqd.sysid.batch.run import DONE, FAILED, KEPT, Row
from jtqd.sysid.diagnosis.report.words import BADGES, effect_title, place
from jtqd.sysid.report import page

SCHEMA: Final = "jtq.batch/1"
DIAGNOSE, REPLAY = "diagnose", "replay"
REPORT: Final = "report.html"
FAILED_BADGE: Final = ("ink", "failed")
HEADINGS: Final = {
    DIAGNOSE: ("gap, Nm", "noise, Nm", "after, Nm", "causes"),
    REPLAY: ("difference, Nm", "length", "identical cycles", "to the sensor, Nm"),
}
"""Of the columns beside name, badge and time; the first is also drawn as a bar."""
GAP: Final = {
    DIAGNOSE: "error of the joint file's simulation, RMSE",
    REPLAY: "largest difference between replay and log",
}


@dataclass(frozen=True)
class Figures:
    """Of one result: badge as (colour role, text), cells under `HEADINGS`, size of the gap [Nm], causes to count over all
    groups, and the values for summary.json.
    """

    badge: tuple[str, str]
    cells: tuple[str, ...]
    gap_nm: float | None
    causes: tuple[str, ...]
    values: Mapping[str, Any]


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Return state -> number of groups, and the number of all."""
    states = Counter(row.state for row in rows)
    return {"groups": len(rows), **{state: states[state] for state in (DONE, KEPT, FAILED)}}


def to_mapping(
    command: str, parameters: Mapping[str, Any], tool: str, rows: Sequence[Row], where: str
) -> dict[str, Any]:
    """Return the content of summary.json."""
    return {
        "schema": SCHEMA,
        "command": command,
        "tool": tool,
        "parameters": dict(parameters),
        "where": where,
        "counts": counts(rows),
        "groups": [
            {
                "name": row.group.name,
                "logs": [str(path) for path in row.group.files],
                "state": row.state,
                "key": row.key,
                "exit_status": None if row.content is None else row.content["exit_status"],
                "error": row.error or None,
                "seconds": row.seconds,
                "figures": None if (figures := figures_of(command, row)) is None else dict(figures.values),
            }
            for row in rows
        ],
    }


def render(command: str, rows: Sequence[Row], where: str, made: str) -> str:
    """Return index.html, self-contained but for the links to the reports of the groups.

    Args:
        made: when, by what and with which options: the foot of the page.

    Raises:
        ImportError: jinja2 is not installed.
    """
    every = [(row, figures_of(command, row)) for row in rows]
    largest = max((each.gap_nm or 0.0 for _, each in every if each is not None), default=0.0)
    lines = [_line(row, each, largest) for row, each in every]
    content = {
        "command": command,
        "where": where,
        "made": made,
        "counts": counts(rows),
        "headings": HEADINGS[command],
        "gap": GAP[command],
        "lines": sorted(lines, key=lambda line: (not line["error"], -(line["bar"] or 0.0), line["name"])),
        "badges": Counter(line["badge"] for line in lines).most_common(),
        "causes": Counter(
            name for _, each in every if each is not None for name in each.causes
        ).most_common(),
        "logs": sum(len(row.group.files) for row in rows),
        "seconds": sum(row.seconds for row in rows),
    }
    return page.render("jtqd.sysid.batch", "summary.html.j2", content)


def _line(row: Row, figures: Figures | None, largest: float) -> dict[str, Any]:
    """Return one row of the table; bar: share of the largest gap, None where there is none."""
    gap = None if figures is None else figures.gap_nm
    reported = row.content is not None and REPORT in row.content["files"]
    return {
        "name": row.group.name,
        "logs": [path.name for path in row.group.files],
        "badge": FAILED_BADGE if figures is None else figures.badge,
        "cells": () if figures is None else figures.cells,
        "bar": None if gap is None or largest <= 0.0 else gap / largest,
        "link": f"results/{row.key}/{REPORT}" if reported else "",
        "kept": row.state == KEPT,
        "error": row.error,
        "seconds": row.seconds,
    }


def figures_of(command: str, row: Row) -> Figures | None:
    """Return the figures of what `jtq COMMAND --json` printed, None for a failed group."""
    if row.content is None:
        return None
    return (_diagnosis if command == DIAGNOSE else _replay)(row.content["result"])


def _nm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _diagnosis(result: Mapping[str, Any]) -> Figures:
    gap, gain, verdict = result["gap"], result["gain"], str(result["verdict"])
    causes = [
        f"{' or '.join(effect_title(name) for name in each['class'])} ({place(each['joint'])})"
        for each in result["causes"]
    ]
    cells = (_nm(gap["rmse_nm"]), _nm(gap["noise_floor_nm"]), _nm(gain["rmse_after_nm"]))
    values = {
        "verdict": verdict,
        "joint": gap["joint"],
        "rmse_nm": gap["rmse_nm"],
        "noise_floor_nm": gap["noise_floor_nm"],
        "rmse_after_nm": gain["rmse_after_nm"],
        "causes": [
            {key: each[key] for key in ("name", "joint", "class", "parameters")} for each in result["causes"]
        ],
    }
    badge = BADGES.get(verdict, ("warn", verdict))
    return Figures(
        badge, (*cells, "; ".join(causes) or "–"), gap["rmse_nm"], tuple(dict.fromkeys(causes)), values
    )


def _replay(result: Mapping[str, Any]) -> Figures:
    runs: Sequence[Mapping[str, Any]] = result["runs"]
    joints = [joint for run in runs for joint in run["joints"]]
    same = [run["identity"] for run in runs if run["identity"] is not None]
    values = {
        "runs": len(runs),
        "cycles": sum(run["cycles"] for run in runs),
        "seconds": sum(run["seconds"] for run in runs),
        "identical": sum(each["identical"] for each in same) if len(same) == len(runs) else None,
        "max_nm": _largest(joint["max_nm"] for joint in joints),
        "sensor_logged_nm": _largest(joint["sensor_logged_nm"] for joint in joints),
        "sensor_replayed_nm": _largest(joint["sensor_replayed_nm"] for joint in joints),
    }
    cells = (
        _nm(values["max_nm"]),
        f"{values['seconds']:.0f} s",
        "–" if values["identical"] is None else f"{values['identical']} of {values['cycles']}",
        f"{_nm(values['sensor_logged_nm'])} → {_nm(values['sensor_replayed_nm'])}",
    )
    return Figures(_sameness(same, len(runs)), cells, values["max_nm"], (), values)


def _sameness(same: Sequence[Mapping[str, Any]], runs: int) -> tuple[str, str]:
    if len(same) < runs:
        return "after", "other models"
    if all(each["bit_identical"] for each in same):
        return "good", "identical"
    if all(each["explained"] for each in same):
        return "good", "identical, differences explained"
    return "warn", "differs"


def _largest(values: Iterable[Any]) -> float | None:
    return max((float(value) for value in values if value is not None), default=None)
