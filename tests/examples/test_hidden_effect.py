"""An effect hidden in the emulated bench is found, and with the extended joint files jtqd estimates better on fresh runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from examples.hidden_effect import NAMES, main, nominal_file, plans, secrets, write_secret
from jtqd.models.files import load_joint
from jtqd.sim_can.plant_file import Deviations, load_plant

KEPT = 0.75
"""Part of the promised reduction that an estimate shows: it has errors of its own beside the simulation's."""


def check(result: dict[str, Any]) -> None:
    hidden = result["hidden"]
    (cause,) = result["causes"]
    assert result["verdict"] == "cause"
    assert (cause["name"], cause["joint"], cause["class"]) == (hidden["name"], 1, [hidden["name"]])
    for name, value in hidden["parameters"].items():
        found = cause["parameters"][name]
        assert found["value"] == pytest.approx(value, rel=0.05, abs=0.1)
    gain = result["gain"]
    promised = gain["rmse_before_nm"] ** 2 - gain["rmse_after_nm"] ** 2
    before, after = result["jtqd"]["1"]
    assert before**2 - after**2 > KEPT**2 * promised
    other = result["jtqd"]["2"]
    assert other[1] <= 1.15 * other[0]
    assert result["extended_on_the_same_runs"] == "no_gap"


@pytest.mark.parametrize(
    "bus", ["none", pytest.param("sim:vcan0", marks=(pytest.mark.campaign, pytest.mark.socketcan))]
)
def test_found_and_gained(
    bus: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    options = ["--runs", "3", "--fresh-runs", "2", "--seconds", "8", "--json"]
    assert main(["--effect", "torque_constant", "--bus", bus, "--out", str(tmp_path / "demo"), *options]) == 0
    check(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize("name", NAMES)
def test_the_secret_bench_has_the_effect_and_nothing_else(name: str, tmp_path: Path) -> None:
    one, two = load_plant(write_secret(tmp_path, name)).joints
    nominal = load_joint(nominal_file(1))
    assert [effect.name for effect in one.joint.effects] == [name]
    assert one.joint.effects[0] == secrets(nominal)[name]
    assert not two.joint.effects
    assert one.deviations.stribeck.torque_nm == nominal.friction.stribeck_nm
    assert one.deviations == Deviations(stribeck=one.deviations.stribeck)
    assert one.thermal.viscous_per_k == 0.0


def test_fresh_motions_are_none_of_the_diagnosed_ones() -> None:
    diagnosed, fresh = plans(3, 3, 8.0, 0)
    assert not {run.segments for run in diagnosed.runs} & {run.segments for run in fresh.runs}
