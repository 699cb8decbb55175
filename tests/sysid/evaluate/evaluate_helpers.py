"""Samples with known errors, and a small directory of models and runs, for the tests of `jtq evaluate`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.estimator import quadrants
from jtqd.estimator.joint import AdditiveLoss, Envelope, Fused, FusedSigma, Joint, LossSide, Torsion, Tracking
from jtqd.estimator.native_network import INPUTS
from jtqd.estimator.run import RunTable
from jtqd.estimator.status import VALID
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.evaluate.command import main
from jtqd.sysid.evaluate.inputs import Samples
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.runs.tables import write_run
from jtqd.sysid.train.network import Trained, export_network
from tests.estimator.estimator_helpers import small_network

T = TypeVar("T")


def samples(
    errors_nm: Mapping[str, FloatArray],
    *,
    run: str = "run",
    number: int = 1,
    rated_nm: float = 40.0,
    sensor_nm: FloatArray | None = None,
    velocity_rad_s: FloatArray | None = None,
    raw_nm: FloatArray | None = None,
    sigma_nm: float = 1.0,
    status: int = VALID,
    scored: np.ndarray[Any, Any] | None = None,
    temperature_c: float = np.nan,
    bare_nm: FloatArray | None = None,
) -> Samples:
    """One joint of one run at 1 kHz whose methods are wrong by `errors_nm` [n]."""
    n = len(next(iter(errors_nm.values())))
    sensor = np.zeros(n) if sensor_nm is None else sensor_nm
    velocity = np.ones(n) if velocity_rad_s is None else velocity_rad_s
    raw = np.ones(n) if raw_nm is None else raw_nm
    return Samples(
        run=run,
        number=number,
        rated_nm=rated_nm,
        time_s=np.arange(n) * 1e-3,
        sensor_nm=sensor,
        raw_nm=raw,
        velocity_rad_s=velocity,
        temperature_c=np.full(n, temperature_c),
        quadrant=quadrants(raw, velocity),
        estimate_nm={method: sensor + error for method, error in errors_nm.items()},
        sigma_nm={method: np.full(n, sigma_nm) for method in errors_nm},
        status={method: np.full(n, status, np.uint8) for method in errors_nm},
        scored=np.ones(n, bool) if scored is None else scored,
        standing=np.zeros(n, bool) if scored is None else ~scored,
        missing=np.zeros(n, bool),
        bare_nm=np.full(n, np.nan) if bare_nm is None else bare_nm,
    )


def known(value: T | None) -> T:
    """The value, which must be there."""
    assert value is not None
    return value


def simple_fused() -> Fused:
    """A section `fused` that roughly fits the shipped joints: constant and viscous loss, plain stiffness."""
    side = LossSide((3.0, 3.0, 5.0, 9.0), (2.0,) * 4, (0.0,) * 4, 0.5)
    loss = AdditiveLoss((-40.0, 0.0, 20.0, 50.0), side, side, 0.05, 3.0, 25.0, 2.0, 0.0)
    torsion = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (0.0, 0.0), (0.0, 0.0))
    sigma = FusedSigma(1.0, 0.0, 0.0, 0.5, 0.0, 0.1, (1.0, 1.0, 1.0, 1.0))
    known = Envelope(0.25, 5.0, ((1,) * 17,) * 23, 20.0, (20.0, 30.0), 60.0)
    return Fused(loss, torsion, sigma, envelope=known, tracking=Tracking(400.0, 0.08, 0.17, 160.0, 0.2))


def fused_network(joint: str, correction_nm: float = 0.0, **metadata: Any) -> bytes:
    """A network that always adds the same; known up to 2.875 rad/s, 42.5 Nm of motor torque, 20 to 30 degC."""
    width = len(INPUTS)
    known = [[1] * 17 for _ in range(23)]
    envelope = {
        "velocity_step_rad_s": 0.25,
        "torque_step_nm": 5.0,
        "known": known,
        "distance_nm": 20.0,
        "temperature_c": [20.0, 30.0],
    }
    content = {
        "features": list(INPUTS),
        "envelope": envelope,
        "sigma": plain_values(FusedSigma(0.5, 0.0, 0.0, 1.0, 0.0, 0.0, (1.0, 1.0, 1.0, 1.0))),
        "rest_nm": [1.0],
        "quick": [1e6] * 3,
        "input_low": [-1.0] * width,
        "input_high": [1.0] * width,
        "joint": joint,
        "data_sha256": "0" * 64,
        "runs": {"elsewhere.csv": "e" * 64},
    } | metadata
    layers = [(np.zeros((width, 2)), np.zeros(2)), (np.zeros((2, 1)), np.zeros(1))]
    kept = {key: value for key, value in content.items() if value is not None}
    return export_network(Trained(layers, np.zeros(width), np.ones(width), correction_nm, 1.0), kept)


def paper_network(joint: str, **metadata: Any) -> bytes:
    """A network that returns about its last input, the efficiency estimate; known everywhere."""
    known = {"envelope_low": [-1e3] * 6, "envelope_high": [1e3] * 6, "runs": {"elsewhere.csv": "e" * 64}}
    changes = {key: ... if value is None else value for key, value in (known | metadata).items()}
    return small_network(noise=1e-9).with_metadata(joint=joint, **changes).data


def nominal(number: int) -> Joint:
    """The shipped joint with a section `fused`."""
    return replace(load_joint(shipped(f"joint{number}.yaml")), fused=simple_fused())


def write_models(directory: Path) -> Path:
    """Joint files and both networks of both joints."""
    directory.mkdir(exist_ok=True)
    for number in (1, 2):
        joint = nominal(number)
        write_joint(directory / f"joint{number}.yaml", joint, "of a test")
        (directory / f"joint{number}.onnx").write_bytes(paper_network(joint.name))
        (directory / f"joint{number}.fused.onnx").write_bytes(fused_network(joint.name, 0.1))
    return directory


def emulated(velocity_joint: int, kind: str, seconds: float, day: int = 0) -> RunTable:
    """A run of the campaign's bench: "variable", or "constant" with two plateaus at 2.5 and -1.5 rad/s under load."""
    plant = load_plant(shipped("campaign_plant.yaml"))

    def wave(time_s: float) -> float:
        rise = min(1.0, time_s / 0.5)
        return float(rise * (1.2 * np.sin(2.2 * time_s) + 0.5 * np.sin(5.1 * time_s)))

    def load(time_s: float) -> float:
        return float(min(1.0, time_s / 0.5) * (1.0 + 2.5 * np.sin(1.3 * time_s)))

    def steps(first: float, second: float) -> Any:
        """First value, then the second one, with ramps of 0.5 s; at rest for 0.3 s before."""
        times = (0.3, 0.8, 0.5 * seconds - 0.25, 0.5 * seconds + 0.25)
        return lambda time_s: float(np.interp(time_s, times, (0.0, first, first, second)))

    if kind == "variable":
        velocity, current = JointCommand.velocity(wave), JointCommand.current(load)
    else:
        velocity, current = JointCommand.velocity(steps(2.5, -1.5)), JointCommand.current(steps(4.5, -2.0))
    commands = (velocity, current) if velocity_joint == 1 else (current, velocity)
    return emulate_run(plant, commands, seconds, 3, day=day)


def make_bench(base: Path) -> Path:
    """base/models, and base/runs with two runs at variable velocity, of either joint, and one at constant velocity."""
    write_models(base / "models")
    (base / "runs").mkdir()
    plans = ((1, "variable", 3.0), (2, "variable", 3.0), (1, "constant", 5.0))
    for number, (joint, kind, seconds) in enumerate(plans):
        write_run(base / "runs" / f"{kind}_{joint}.csv.gz", emulated(joint, kind, seconds, day=number))
    return base


NO_PICTURES: Final = {
    "constant": {},
    "run": None,
    "paper": None,
    "runs": {},
    "velocities": {},
    "calibration": None,
}
"""In place of `jtqd.sysid.evaluate.report.pictures`, which takes most of the time."""


def evaluate(base: Path, runs: list[Path], *options: str, models: Path | None = None) -> int:
    """Exit status of `jtq evaluate` on runs with base/models, or other ones, into base/out, or as the options say."""
    where = models or base / "models"
    return main([*map(str, runs), "--models", str(where), "--out", str(base / "out"), *options])


def report(directory: Path) -> dict[str, Any]:
    """The written evaluation.json."""
    content: dict[str, Any] = json.loads((directory / "evaluation.json").read_text())
    return content
