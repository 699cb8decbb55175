"""Regularised fit of one to five runs: near the truth where a run determines it, near the file elsewhere, and how wide."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import VALID
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.few_runs import FewRunsFit, fit_few_runs
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.signals import RunSignals, run_signals

JOINT = Joint(
    name="a1",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.06,
    rotor_inertia_kgm2=7.0e-5,
    stiffness_nm_per_rad=12000.0,
    damping_nms_per_rad=8.0,
    link_inertia_kgm2=0.008,
    rated_torque_nm=40.0,
    friction=Friction(3.0, 2.0),
)
TRUE = {"coulomb": 2.2, "load": 0.09, "viscous": 2.8, "offset": 0.3, "gain": 0.03, "inertia": 0.9}


def columns(
    rate_hz: float = 1000.0, seconds: float = 4.0, way: float = 0.0, phase: float = 0.0
) -> JointColumns:
    """A joint with the losses TRUE; way: 1 or -1 for motion in this direction alone."""
    t = np.arange(round(rate_hz * seconds)) / rate_hz
    w = 2.0 * np.pi * 0.6
    v = np.sin(w * t + phase) if not way else way * (0.6 + 0.3 * np.sin(w * t + phase))
    a = w * np.cos(w * t + phase) * (1.0 if not way else 0.3 * way)
    position = np.cumsum(v) / rate_hz
    raw = 24.0 * np.sin(2.0 * np.pi * 0.37 * t + phase) + 5.0
    s = np.tanh(v / 0.02)
    loss = s * (TRUE["coulomb"] + TRUE["load"] * np.abs(raw)) + TRUE["viscous"] * v
    tau = raw - loss - TRUE["offset"] - TRUE["gain"] * raw
    rng = np.random.default_rng(3)
    return JointColumns(
        current_a=(raw + TRUE["inertia"] * a) / 6.0 + 0.005 * rng.normal(size=len(t)),
        motor_position_rad=100.0 * position,
        motor_velocity_rad_s=100.0 * v,
        link_position_rad=position,
        torque_nm=tau,
    )


def signals(made: JointColumns, rate_hz: float = 1000.0) -> RunSignals:
    assert made.current_a is not None
    t = np.arange(len(made.current_a)) / rate_hz
    return run_signals("run", JOINT, EstimatorSettings(method="tob"), t, made)


def fitted(*runs: JointColumns) -> FewRunsFit:
    return fit_few_runs([signals(run) for run in runs], JOINT)


def judged(fit: FewRunsFit, made: JointColumns) -> tuple[float, float]:
    """RMSE in motion [Nm], and how often the 90 % interval holds the torque."""
    seen = signals(made)
    t = np.arange(len(seen.sensor_nm)) / 1000.0
    found = estimate_columns(fit.joint, EstimatorSettings(method="fused"), None, t, made)
    keep = seen.moving & (found.status == VALID)
    error = (found.torque_nm - seen.sensor_nm)[keep]
    inside = np.abs(error) <= GAUSS * found.sigma_nm[keep]
    return float(np.sqrt(np.mean(error**2))), float(np.mean(inside))


def test_both_directions_determine_everything() -> None:
    fit = fitted(columns(seconds=12.0))
    found = {term.name: term for term in fit.terms}
    assert found["Coulomb friction"].value == pytest.approx(TRUE["coulomb"], abs=0.25)
    assert found["load friction"].value == pytest.approx(TRUE["load"], abs=0.015)
    assert found["viscous friction"].value == pytest.approx(TRUE["viscous"], abs=0.3)
    assert found["gain error"].value == pytest.approx(TRUE["gain"], abs=0.01)
    assert fit.joint.rotor_inertia_kgm2 * 1e4 == pytest.approx(TRUE["inertia"], abs=0.04)
    error, inside = judged(fit, columns(seconds=12.0, phase=1.0))
    assert error < 0.01 * JOINT.rated_torque_nm
    assert inside > 0.85


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_one_direction_is_not_taken_for_both(way: float) -> None:
    """Least squares is off by newton metres in the other direction, where an offset is no Coulomb friction any more."""
    known, other = columns(way=way), columns(way=-way, phase=0.7)
    fit = fitted(known)
    error, inside = judged(fit, other)
    assert error < 0.04 * JOINT.rated_torque_nm
    assert inside > 0.85
    assert any("(before: 0 +- 0.4" in line for line in fit.lines() if line.startswith("offset"))
    terms = {term.name: term for term in fit.terms}
    assert terms["offset"].sigma > 0.9 * terms["offset"].file_sigma, "the run does not show it"
    assert abs(terms["offset"].value) < terms["offset"].file_sigma
    scale = fit.fused.sigma.scale
    seen, unseen = ((0, 2), (1, 3)) if way > 0.0 else ((1, 3), (0, 2))
    assert min(scale[q] for q in unseen) > 1.03 * max(scale[q] for q in seen)


def test_a_second_run_the_other_way_shows_the_offset() -> None:
    one, both = fitted(columns(way=1.0)), fitted(columns(way=1.0), columns(way=-1.0))
    before, after = ({term.name: term.sigma for term in fit.terms}["offset"] for fit in (one, both))
    assert after < 0.9 * before
    assert len(both.fused.loss.load_nodes_nm) == 3
    assert both.effective > one.effective


def test_more_rows_of_the_same_seconds_are_not_more_knowledge() -> None:
    fine, coarse = fitted(columns()), fit_few_runs([signals(columns(250.0), 250.0)], JOINT)
    for a, b in zip(fine.terms, coarse.terms, strict=True):
        assert a.value == pytest.approx(b.value, abs=0.5 * a.sigma + 1e-6), a.name
        assert a.sigma == pytest.approx(b.sigma, rel=0.3), a.name
    assert fine.effective < 0.1 * fine.samples


def test_friction_takes_energy_and_the_file_can_be_read_again() -> None:
    made = columns(way=1.0)
    assert made.current_a is not None
    made = replace(made, current_a=made.current_a - 1.5)  # as if friction drove the joint
    joint = fitted(made).joint
    assert joint.fused is not None
    for side in (joint.fused.loss.positive, joint.fused.loss.negative):
        assert min(side.constant_nm) >= 0.0
        assert min(side.viscous_nms_per_rad) >= 0.0
    assert Joint.from_mapping(joint.to_mapping(), "again") == joint


def test_a_run_at_rest_is_refused() -> None:
    made = columns()
    assert made.motor_velocity_rad_s is not None
    none = 0.0 * made.motor_velocity_rad_s
    still = replace(made, motor_velocity_rad_s=none, motor_position_rad=none, link_position_rad=none)
    with pytest.raises(LossFitError, match=r"found 0 s in motion .* expected at least 0\.5 s"):
        fitted(still)


def test_the_command_fits_one_run_of_one_encoder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The map of this arm makes the motor's position of the joint's: that is no second encoder."""
    files, out = shipped("kinova_gen3/columns.yaml").parent, tmp_path / "joint4.yaml"
    given = [str(files / "RunTrajectory1.csv.gz"), "--columns", str(files / "columns.yaml"), "--number", "4"]
    given = ["fit", "losses", *given, "--joint", str(files / "joint4.yaml")]
    assert jtq([*given, "--out", str(out)]) == 0
    output = capsys.readouterr()
    assert "no torsion is fitted" in output.err
    assert "up to 5 runs" in output.err
    assert "offset" in output.out
    joint = load_joint(out)
    assert joint.fused is not None
    assert joint.fused.torsion is None
    assert joint.provenance["fused"]["few_runs"]
    assert out.read_text().startswith("# Written by jtq fit losses from 1 run.\n")
    assert jtq([*given, "--json"]) == 0
    mapping = json.loads(capsys.readouterr().out)
    assert mapping["schema"] == "jtq.fit_losses/1"
    assert mapping["rotor_inertia_kgm2"] == pytest.approx(joint.rotor_inertia_kgm2)
    assert mapping["effective_samples"] < 0.2 * mapping["samples"]
