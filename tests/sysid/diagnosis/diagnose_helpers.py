"""Small consistent runs and made-up findings for the tests of `jtq diagnose`."""

from __future__ import annotations

import math
import sys
import types
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.command import main
from jtqd.sysid.diagnosis.findings import EVERYTHING, Cause, Findings, Gain, Gap, Place, Present, Scope, Value
from jtqd.sysid.diagnosis.report import terminal_lines
from jtqd.sysid.runs.tables import write_run

JOINT_FILE = shipped("joint1.yaml")
JOINT = load_joint(JOINT_FILE)


def bench_run(
    joint: Joint = JOINT, seconds: float = 4.0, phase: float = 0.0, numbers: tuple[int, ...] = (1, 2)
) -> RunTable:
    """A run by the equations, without noise: both joints turn against each other and carry the one sensor."""
    time_s = np.arange(0.0, seconds, 0.002)
    turned = 0.6 * np.sin(2.0 * time_s + phase)
    speed = 1.2 * np.cos(2.0 * time_s + phase)
    torque = 0.3 * joint.rated_torque_nm * np.sin(3.1 * time_s + 0.5 + phase)
    loss = FrictionModel(joint.friction)
    columns = {}
    for number in numbers:
        sign = 1.0 if number == 1 else -1.0
        current = (torque + loss.torque_many(sign * speed)) / (
            joint.gear_ratio * joint.torque_constant_nm_per_a
        )
        columns[number] = JointColumns(
            current_a=current,
            motor_position_rad=joint.gear_ratio * (sign * turned + torque / joint.stiffness_nm_per_rad),
            link_position_rad=sign * turned,
            torque_nm=torque,
        )
    return RunTable(time_s, columns)


def write_runs(folder: Path, count: int = 3, **kinds: Any) -> list[Path]:
    paths = []
    for k in range(count):
        path = folder / f"{'abcdefgh'[k]}.csv{'.gz' if k % 2 else ''}"
        write_run(path, bench_run(phase=0.7 * k, **kinds))
        paths.append(path)
    return paths


def value(number: float, half: float = 0.1, unit: str = "Nm") -> Value:
    return Value(number, (number - half, number + half), unit)


def cause(name: str, joint: int | str, parameters: Mapping[str, Value], *rivals: str) -> Cause:
    return Cause(name, joint, parameters, 120.0, 0.5, "motor", rivals=rivals)


def findings(verdict: str = "cause", causes: tuple[Cause, ...] = (), **parts: Any) -> Findings:
    """Findings with a gap in joint 2 and a gain."""
    place = Place("velocity", "0.1 to 0.2 rad/s", 0.4, 0.1, 0.2, "rad/s", 0.9)
    given: dict[str, Any] = {
        "verdict": verdict,
        "reasons": ("made up",),
        "runs": ("a.csv", "b.csv.gz"),
        "joints": (1, 2),
        "gaps": (Gap(2, "motor", 0.8, 0.2, (place,)),),
        "causes": causes,
        "predicts": tuple(
            Present(c.name, c.joint, {name: v.value for name, v in c.parameters.items()}) for c in causes
        ),
        "gain": Gain(0.8, 0.2, "leave one run out", (0.6, 0.8)),
    }
    return Findings(**(given | parts))


OFFSET = cause("sensor_offset", "sensor", {"offset_nm": value(0.31)})
COULOMB = cause("coulomb_friction", 2, {"coulomb_nm": value(4.4)})
RIPPLE = cause(
    "torque_ripple",
    1,
    {
        "amplitude_nm": value(0.5, 0.02),
        "order_per_motor_rev": Value(2.0, (math.nan, math.nan), "1"),
        "phase_rad": Value(0.3, (-math.inf, math.inf), "rad"),
    },
)


class Core:
    """Stands in for the statistics: keeps what it was asked, answers with `answer`."""

    def __init__(self) -> None:
        self.answer: Findings = findings(causes=(COULOMB,))
        self.scopes: list[Scope] = []
        self.asked: list[tuple[list[tuple[str, RunTable]], dict[int, Joint]]] = []
        self.options: list[dict[str, Any]] = []

    def diagnose(
        self,
        runs: Sequence[tuple[str, RunTable]],
        joints: Mapping[int, Joint],
        scope: Scope = EVERYTHING,
        **options: Any,
    ) -> Findings:
        self.options.append(options)
        self.scopes.append(scope)
        self.asked.append((list(runs), dict(joints)))
        return replace(self.answer, runs=tuple(name for name, _ in runs), joints=tuple(joints))


def stand_in(monkeypatch: pytest.MonkeyPatch) -> Core:
    """Put a Core in place of the statistics and one line in place of the report's page."""
    one = Core()
    statistics: Any = types.ModuleType("jtqd.sysid.diagnosis.diagnose")
    statistics.diagnose = one.diagnose
    page: Any = types.ModuleType("jtqd.sysid.diagnosis.report")
    page.render, page.terminal_lines = lambda made: f"<html>{made.verdict}</html>", terminal_lines
    monkeypatch.setitem(sys.modules, "jtqd.sysid.diagnosis.diagnose", statistics)
    monkeypatch.setitem(sys.modules, "jtqd.sysid.diagnosis.report", page)
    return one


def run(*arguments: object) -> int:
    return main([str(each) for each in arguments])


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on standard error; nothing on standard output."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("jtq diagnose: ")
    assert err.count("\n") == 1, err
    return err
