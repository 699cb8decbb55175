"""Stored outputs of the golden logs: text, one row per cycle, and what a person needs to know when they differ."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.daemon.replay.session import Result, replay
from jtqd.estimator.status import NAMES

HERE = Path(__file__).resolve().parent
TOLERANCE_NM = 2e-6
"""Stored with six digits; ONNX Runtime and libm choose their code by processor, and round differently by less than this."""
COLUMNS = ("torque_nm", "sigma_nm", "status")
_LAGS = range(-5, 6)
_LAG_EXPLAINS = 0.2


@dataclass(frozen=True)
class Output:
    """Torque, sigma [Nm] and status of both joints, cycle by cycle: `values["j1.torque_nm"]` [n]."""

    cycle: Any
    values: dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A golden log, and another method that is given its inputs; None: the one it was recorded with."""

    log: str
    method: str | None = None


CASES = {
    "faults": Case("faults"),
    "network": Case("network"),
    "network_efficiency": Case("network", "efficiency"),
    "network_tob": Case("network", "tob"),
}
"""Name of a stored output -> what gives it: every method, two of them as recorded."""


def replayed(case: Case) -> tuple[Output, Result]:
    """Output of the estimator as it is now."""
    (result,) = replay([HERE / f"{case.log}.mcap"], method=case.method)
    values = {
        f"j{n}.{name}": np.asarray(records[name], np.float64)
        for n, records in enumerate(result.joints, start=1)
        for name in COLUMNS
    }
    return Output(result.run.joints[0]["cycle"].astype(np.int64), values), result


def stored(name: str, directory: Path = HERE) -> Output:
    """What is stored under a name."""
    with (directory / f"{name}.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    columns = dict(zip(head, np.array(rows, np.float64).T, strict=True))
    return Output(columns.pop("cycle").astype(np.int64), columns)


def store(name: str, output: Output, directory: Path = HERE) -> None:
    """Write an output under a name."""
    with (directory / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["cycle", *output.values])
        columns = [
            [f"{value:.0f}" if name.endswith("status") else f"{value:.6f}" for value in column]
            for name, column in output.values.items()
        ]
        writer.writerows(zip(output.cycle.tolist(), *columns, strict=True))


def difference(before: Output, now: Output) -> list[str]:
    """One line for each thing that differs by more than the tolerance; empty when nothing does."""
    if not np.array_equal(before.cycle, now.cycle):
        return [f"{len(before.cycle)} cycles are stored, {len(now.cycle)} were replayed"]
    lines = []
    for name, old in before.values.items():
        joint, _, what = name.partition(".")
        who = f"joint {joint[1:]}"
        new = now.values[name]
        lines += (
            _statuses(who, before.cycle, old, new)
            if what == "status"
            else _numbers(f"{who} {what}", before.cycle, old, new)
        )
    return lines


def _numbers(what: str, cycle: Any, old: Any, new: Any) -> list[str]:
    """Where a number begins to differ, how far, and whether it is only early or late."""
    both = np.isfinite(old) & np.isfinite(new)
    apart = np.abs(new - old)
    wrong = np.flatnonzero((both & ~(apart <= TOLERANCE_NM)) | (np.isfinite(old) != np.isfinite(new)))
    if not len(wrong):
        return []
    first = wrong[0]
    size = f", {float(apart[both].max()):.3g} Nm at most" if both.any() else ""
    return [
        f"{what} differs from cycle {cycle[first]} on, in {len(wrong)} cycles: "
        f"{old[first]:.3f} -> {new[first]:.3f} Nm{size}{_lag(old, new)}"
    ]


def _lag(old: Any, new: Any) -> str:
    """ "lags by 3 cycles" where that explains the difference."""
    errors = {}
    for lag in _LAGS:
        a = old[max(0, -lag) : len(old) - max(0, lag)]
        b = new[max(0, lag) : len(new) - max(0, -lag)]
        both = np.isfinite(a) & np.isfinite(b)
        if both.any():
            errors[lag] = float(np.sqrt(np.mean(np.square(a[both] - b[both]))))
    if not errors:
        return ""
    best = min(errors, key=errors.__getitem__)
    if best == 0 or errors[best] > _LAG_EXPLAINS * errors.get(0, 0.0):
        return ""
    return f", {'lags' if best > 0 else 'leads'} by {abs(best)} cycle{'s' if abs(best) > 1 else ''}"


def _statuses(who: str, cycle: Any, old: Any, new: Any) -> list[str]:
    """Transitions that moved, came or went."""
    if np.array_equal(old, new):
        return []
    lines = []
    before, after = _transitions(cycle, old), _transitions(cycle, new)
    for kind in dict.fromkeys((*before, *after)):
        here, there = before.get(kind, []), after.get(kind, [])
        named = f"{who} status {NAMES[kind[0]]} -> {NAMES[kind[1]]}"
        if len(here) == len(there):
            lines += [
                f"{named} moved from cycle {a} to {b}" for a, b in zip(here, there, strict=True) if a != b
            ]
        else:
            lines.append(
                f"{named}: {len(here)} times before (cycles {_few(here)}), {len(there)} now ({_few(there)})"
            )
    if old[0] != new[0]:
        lines.append(f"{who} status begins with {NAMES[int(new[0])]} instead of {NAMES[int(old[0])]}")
    return lines


def _transitions(cycle: Any, status: Any) -> dict[tuple[int, int], list[int]]:
    found: dict[tuple[int, int], list[int]] = {}
    for row in np.flatnonzero(np.diff(status)) + 1:
        found.setdefault((int(status[row - 1]), int(status[row])), []).append(int(cycle[row]))
    return found


def _few(cycles: list[int]) -> str:
    return ", ".join(map(str, cycles[:4])) + (", ..." if len(cycles) > 4 else "") or "none"
