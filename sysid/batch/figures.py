"""What the summary takes from a result: a few figures of a diagnosis or a replay, with a badge. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

DIAGNOSE, REPLAY = "diagnose", "replay"
_VERDICTS: Final = {
    "no_gap": ("good", "no gap"),
    "cause": ("after", "cause found"),
    "ambiguous": ("warn", "ambiguous"),
    "unexplained": ("bad", "unexplained"),
    "insufficient_data": ("warn", "insufficient data"),
}
FAILED_BADGE: Final = ("ink", "failed")
REPORT: Final = "report.html"

HEADINGS: Final = {
    DIAGNOSE: ("gap, Nm", "noise, Nm", "after, Nm", "causes"),
    REPLAY: ("gap, Nm", "length", "identical cycles", "to the sensor, Nm"),
}
"""Of the columns beside name, badge and time; the first is also drawn as a bar."""
GAP: Final = {
    DIAGNOSE: "what the joint file leaves over, RMSE",
    REPLAY: "largest difference between replay and log",
}


@dataclass(frozen=True)
class Figures:
    """Of one result: badge as (colour role, text), cells under `HEADINGS`, size of the gap [Nm], names to count over the
    fleet, and the same as plain values for summary.json.
    """

    badge: tuple[str, str]
    cells: tuple[str, ...]
    gap_nm: float | None
    names: tuple[str, ...]
    values: Mapping[str, Any]


def figures_of(command: str, result: Mapping[str, Any]) -> Figures:
    """Figures of what `jtq COMMAND --json` printed."""
    return _diagnosis(result) if command == DIAGNOSE else _replay(result)


def nm(value: float | None) -> str:
    """Three digits, a dash where there is no value."""
    return "–" if value is None else f"{value:.3g}"


def _diagnosis(result: Mapping[str, Any]) -> Figures:
    gap, gain, verdict = result["gap"], result["gain"], str(result["verdict"])
    causes = [_cause(each) for each in result["causes"]]
    return Figures(
        _VERDICTS.get(verdict, ("warn", verdict)),
        (nm(gap["rmse_nm"]), nm(gap["noise_floor_nm"]), nm(gain["rmse_after_nm"]), "; ".join(causes) or "–"),
        gap["rmse_nm"],
        tuple(dict.fromkeys(causes)),
        {
            "verdict": verdict,
            "joint": gap["joint"],
            "rmse_nm": gap["rmse_nm"],
            "noise_floor_nm": gap["noise_floor_nm"],
            "rmse_after_nm": gain["rmse_after_nm"],
            "causes": [
                {key: each[key] for key in ("name", "joint", "class", "parameters")}
                for each in result["causes"]
            ],
        },
    )


def _cause(cause: Mapping[str, Any]) -> str:
    """Its name, or the names that these runs cannot tell apart, and where."""
    where = cause["joint"] if isinstance(cause["joint"], str) else f"joint {cause['joint']}"
    names = " or ".join(str(name).replace("_", " ") for name in cause["class"])
    return f"{names} ({where})"


def _replay(result: Mapping[str, Any]) -> Figures:
    runs: Sequence[Mapping[str, Any]] = result["runs"]
    joints = [joint for run in runs for joint in run["joints"]]
    seconds, cycles = sum(run["seconds"] for run in runs), sum(run["cycles"] for run in runs)
    same = [run["identity"] for run in runs if run["identity"] is not None]
    identical = sum(each["identical"] for each in same) if len(same) == len(runs) else None
    gap = _largest(joint["max_nm"] for joint in joints)
    logged, replayed = (
        _largest(joint[f"sensor_{which}_nm"] for joint in joints) for which in ("logged", "replayed")
    )
    return Figures(
        _sameness(same, len(runs)),
        (
            nm(gap),
            f"{seconds:.0f} s",
            "–" if identical is None else f"{identical} of {cycles}",
            f"{nm(logged)} → {nm(replayed)}",
        ),
        gap,
        (),
        {
            "runs": len(runs),
            "cycles": cycles,
            "seconds": seconds,
            "identical": identical,
            "max_nm": gap,
            "sensor_logged_nm": logged,
            "sensor_replayed_nm": replayed,
        },
    )


def _sameness(same: Sequence[Mapping[str, Any]], runs: int) -> tuple[str, str]:
    if len(same) < runs:
        return "after", "other models"
    if all(each["bit_identical"] for each in same):
        return "good", "identical"
    if all(each["explained"] for each in same):
        return "good", "identical once known"
    return "warn", "differs"


def _largest(values: Any) -> float | None:
    known = [float(value) for value in values if value is not None]
    return max(known, default=None)
