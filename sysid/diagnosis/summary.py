"""Findings in a few lines for a terminal. Pure."""

from __future__ import annotations

import math
from typing import Final

from sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Cause,
    Findings,
    Value,
)

_SAID: Final = {
    NO_GAP: "the simulation explains these runs down to their noise",
    CAUSE: "the gap has a cause that these runs name",
    AMBIGUOUS: "the gap has a cause, but these runs cannot tell which of a class",
    UNEXPLAINED: "there is a gap that no effect of the library explains",
    INSUFFICIENT: "these runs cannot be judged",
}


def summary_lines(findings: Findings) -> list[str]:
    """Return verdict, gap, causes with intervals, gain, next experiment: one line each."""
    lines = [f"{findings.verdict}: {_SAID.get(findings.verdict, '')}"]
    lines += [f"  {reason}" for reason in findings.reasons]
    for gap in findings.gaps[:1]:
        lines.append(
            f"gap: joint {gap.joint}, {gap.balance} balance: {gap.rmse_nm:.3g} Nm rms, "
            f"noise {gap.noise_floor_nm:.3g} Nm ({gap.floor_from})"
        )
        if findings.verdict != NO_GAP:
            lines += [f"  {each.share:4.0%} of it at {each.axis} {each.bin}" for each in gap.localisation[:3]]
    lines += [_cause(each) for each in findings.causes]
    gain = findings.gain
    if gain is not None and math.isfinite(gain.rmse_before_nm):
        low, high = gain.ci95
        lines.append(
            f"gain on runs left out: {gain.rmse_before_nm:.3g} -> {gain.rmse_after_nm:.3g} Nm rms "
            f"(less by {low:.3g} to {high:.3g} Nm)"
        )
    if findings.next_experiment:
        lines.append(f"next experiment: {findings.next_experiment['why']}")
    return lines


def _cause(cause: Cause) -> str:
    at = "sensor" if cause.joint == "sensor" else f"joint {cause.joint}"
    values = ", ".join(_value(name, each) for name, each in cause.parameters.items())
    others = [name for name in cause.names if name != cause.name]
    either = f"; cannot be told from {', '.join(others)}" if others else ""
    return f"cause: {cause.name} of {at}: {values} ({cause.rms_nm:.3g} Nm rms){either}"


def _value(name: str, value: Value) -> str:
    low, high = value.ci95
    unit = f" {value.unit}" if value.unit else ""
    if not math.isfinite(low + high) or low == high:
        return f"{name} {value.value:.4g}{unit}"
    return f"{name} {value.value:.4g} [{low:.4g}, {high:.4g}]{unit}"
