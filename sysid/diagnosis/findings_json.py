"""Findings as plain values for findings.json, schema jtq.findings/1. Pure.

The keys of the schema are always there, whatever the verdict: a program that reads `gap.rmse_nm` need not ask first. What
has no value is null; NaN and infinity, which JSON does not have, are null as well (an unlimited interval, an effect that
no size would make visible). Keys beside those of the schema say more and may be ignored.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from sysid.diagnosis.findings import SCHEMA, Candidate, Cause, Findings, Gain, Gap, Place, Value

_NO_GAP_MEASURED: Final[dict[str, Any]] = {
    "joint": None,
    "rmse_nm": None,
    "noise_floor_nm": None,
    "localisation": [],
}
_NO_GAIN_MEASURED: Final = {"rmse_before_nm": None, "rmse_after_nm": None, "split": None, "ci95": None}


def to_mapping(
    findings: Findings, *, sha256: Mapping[str, str] | None = None, files: Sequence[str] = ()
) -> dict[str, Any]:
    """Return dicts, lists, texts and finite numbers only.

    sha256: hash of each run's file by the run's name; files: names of what was written beside findings.json.
    """
    mapping = {
        "schema": SCHEMA,
        "verdict": findings.verdict,
        "gap": _gap(findings.gaps[0]) if findings.gaps else _NO_GAP_MEASURED,
        "causes": [_cause(each) for each in findings.causes],
        "gain": _NO_GAIN_MEASURED if findings.gain is None else _gain(findings.gain),
        "next_experiment": findings.next_experiment,
        "reasons": findings.reasons,
        "joints": findings.joints,
        "runs": [{"name": name, "sha256": (sha256 or {}).get(name)} for name in findings.runs],
        "gaps": [_gap(each) for each in findings.gaps],
        "candidates": [_candidate(each) for each in findings.candidates],
        "channel_notes": findings.channel_notes,
        "files": list(files),
    }
    result: dict[str, Any] = plain(mapping)
    return result


def plain(value: Any) -> Any:
    """The same value with what JSON knows: numpy's numbers and arrays become plain, NaN and infinity None.

    Raises TypeError for anything else.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Iterable):
        return [plain(item) for item in value]
    raise TypeError(f"found {type(value).__name__} in findings, expected plain values")


def _gap(gap: Gap) -> dict[str, Any]:
    return {
        "joint": gap.joint,
        "rmse_nm": gap.rmse_nm,
        "noise_floor_nm": gap.noise_floor_nm,
        "localisation": [_place(each) for each in gap.localisation],
        "balance": gap.balance,
        "floor_from": gap.floor_from,
    }


def _place(place: Place) -> dict[str, Any]:
    return {
        "axis": place.axis,
        "bin": place.bin,
        "share": place.share,
        "low": place.low,
        "high": place.high,
        "unit": place.unit,
        "rms_nm": place.rms_nm,
    }


def _cause(cause: Cause) -> dict[str, Any]:
    return {
        "name": cause.name,
        "joint": cause.joint,
        "class": list(cause.names),
        "parameters": _values(cause.parameters),
        "evidence": {"delta_bic": cause.delta_bic, "held_out_gain": cause.held_out_gain},
        "rms_nm": cause.rms_nm,
        "balance": cause.balance,
    }


def _values(values: Mapping[str, Value]) -> dict[str, Any]:
    return {
        name: {"value": each.value, "ci95": each.ci95, "unit": each.unit} for name, each in values.items()
    }


def _candidate(candidate: Candidate) -> dict[str, Any]:
    return {
        "name": candidate.name,
        "joint": candidate.joint,
        "evidence": {"delta_bic": candidate.delta_bic, "held_out_gain": candidate.held_out_gain},
        "shared": candidate.shared,
        "minimum": {
            name: {"value": each.value, "unit": each.unit} for name, each in candidate.minimum.items()
        },
        "reason": candidate.reason,
    }


def _gain(gain: Gain) -> dict[str, Any]:
    return {
        "rmse_before_nm": gain.rmse_before_nm,
        "rmse_after_nm": gain.rmse_after_nm,
        "split": gain.split,
        "ci95": gain.ci95,
        "free_run_before_rad_s": gain.free_run_before,
        "free_run_after_rad_s": gain.free_run_after,
        "runs": [each._asdict() for each in gain.runs],
    }
