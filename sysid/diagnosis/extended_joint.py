"""The extended joint file: a joint with the effects found and their values, intervals in its provenance.

An effect that the joint file has already is replaced by the cause of the same name, so that diagnosing with the extended
file again does not add the same thing twice. Effects of the torque sensor go into every joint's file. All of it is pure but
`write_extended`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.joint import Effect, Joint
from jtqd.sysid.diagnosis.findings import Cause, Findings, shows_at
from jtqd.sysid.fit.joint_writer import write_joint

FILE: Final = "extended.joint.yaml"
_DIGITS: Final = 7
"""Significant digits of a written value; no interval is a millionth of it."""


def extended(joint: Joint, number: int, findings: Findings, *, sha256: Mapping[str, str], date: str) -> Joint:
    """Return the joint with what predicts: values of the file replaced, effects of joint `number` and of the sensor among
    its effects, which are relative to the values replaced.

    sha256: hash of each run's file by name, those that were used are kept; date: ISO 8601. What an effect of a whole
    class is written as is the first of its class, and the provenance states it: on these runs all of the class fit alike,
    elsewhere they may not. What only makes the prediction better, and is no entry found, is listed by name.

    Raises ConfigError for an effect or a value that joint files do not allow.
    """
    causes = [c for c in (*findings.causes, *findings.too_small) if shows_at(c.joint, number)]
    found = [p for p in findings.predicts if shows_at(p.joint, number)]
    replaced = {p.name for p in found}
    effects = [effect for effect in joint.effects if effect.name not in replaced]
    effects += [Effect(p.name, {name: _rounded(value) for name, value in p.values.items()}) for p in found]
    record: dict[str, Any] = {"by": "jtq diagnose", "date": date, "verdict": findings.verdict}
    if causes:
        record["effects"] = [_record(cause) for cause in causes]
    only = replaced - {cause.name for cause in causes}
    if only:
        record["better_prediction_only"] = sorted(only)
    gain = findings.gain
    if causes and gain is not None and math.isfinite(gain.rmse_before_nm + gain.rmse_after_nm):
        before, after = _rounded(gain.rmse_before_nm), _rounded(gain.rmse_after_nm)
        record["gain"] = {"rmse_before_nm": before, "rmse_after_nm": after, "split": gain.split}
    record["sha256"] = {name: sha256[name] for name in findings.used_runs if name in sha256}
    whole = replace(joint, effects=tuple(effects), provenance={**joint.provenance, "diagnosis": record})
    return with_effects_applied(whole)


def joint_file(number: int) -> str:
    """Return the name of the extended file of a joint where there are several."""
    return f"extended.joint{number}.yaml"


def files(joints: Mapping[int, Joint], findings: Findings) -> dict[str, int]:
    """Return names of the files to write and the joint that each holds.

    extended.joint.yaml is the joint of the largest cause (a cause of the sensor is in every file, so the next one
    decides; then the joint of the largest gap, then the first). With more joints than one each has its own file as well.
    """
    largest_first = [*(c.joint for c in findings.causes), *(g.joint for g in findings.gaps), *sorted(joints)]
    first = next(int(number) for number in largest_first if number in joints)
    return {FILE: first} | {joint_file(number): number for number in sorted(joints) if len(joints) > 1}


def title(number: int, findings: Findings) -> str:
    """First line of an extended joint file."""
    names = [cause.name for cause in findings.causes if shows_at(cause.joint, number)]
    what = f"found {', '.join(names)}" if names else "found no effect of this joint to add"
    return f"Written by jtq diagnose from {findings.runs_text}: {what} (verdict {findings.verdict})."


def write_extended(
    directory: Path, joints: Mapping[int, Joint], findings: Findings, **origin: Any
) -> list[str]:
    """Write all extended joint files into `directory`, each whole or not at all; returns their names.

    origin: sha256 and date of `extended`. Raises ConfigError.
    """
    names = files(joints, findings)
    for name, number in names.items():
        joint = extended(joints[number], number, findings, **origin)
        write_joint(directory / name, joint, title(number, findings))
    return list(names)


def _record(cause: Cause) -> dict[str, Any]:
    """Return a cause for the provenance; an end of an interval that is none is None: NaN would not read back as itself."""
    record: dict[str, Any] = {"name": cause.name, "joint": cause.joint, "grade": cause.grade}
    if len(cause.names) > 1:
        record["cannot_be_told_from"] = [name for name in cause.names if name != cause.name]
    record["ci95"] = {
        name: [_rounded(end) if math.isfinite(end) else None for end in value.ci95]
        for name, value in cause.parameters.items()
    }
    return record


def _rounded(value: float) -> float:
    return float(f"{float(value):.{_DIGITS}g}")
