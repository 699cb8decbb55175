"""Runs of the emulated bench as a drive tells them, sample by sample, with faults put in between plant and checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from math import pi, sin
from typing import NamedTuple

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.status import JointSafety
from jtqd.estimator.detection import Plausibility
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.drives import demo_current, demo_velocity
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant

PERIOD_S = 0.001


class Sample(NamedTuple):
    """What one joint's PDOs say [SI]."""

    motor_position: float
    motor_velocity: float
    link_position: float
    current: float


Fault = Callable[[int, Sample], Sample]


@cache
def run(name: str) -> tuple[tuple[Sample, ...], tuple[Sample, ...]]:
    """Samples of joint 1 and 2 of a run of the shipped plant."""
    commands, duration_s = RUNS[name]
    table = emulate_run(load_plant(shipped("plant.yaml")), commands, duration_s, seed=3)
    joints = []
    for number in (1, 2):
        columns = table.joints[number]
        quantities = (
            columns.motor_position_rad,
            columns.motor_velocity_rad_s,
            columns.link_position_rad,
            columns.current_a,
        )
        lists = [each.tolist() for each in quantities if each is not None]
        joints.append(tuple(map(Sample._make, zip(*lists, strict=True))))
    return joints[0], joints[1]


def _steps(time_s: float) -> float:
    """Velocity steps, as hard as the drive's limit of acceleration lets them be [rad/s]."""
    return (0.0, 2.5, -2.5, 0.0, 0.3, -0.05, 3.0, 0.0)[int(time_s / 0.5) % 8]


RUNS = {
    "demo": ((JointCommand.velocity(demo_velocity), JointCommand.current(demo_current)), 12.0),
    "steps": ((JointCommand.velocity(_steps), JointCommand.current(lambda t: 1.5)), 4.0),
    "current steps": (
        (
            JointCommand.current(lambda t: 2.0 if t % 1.0 < 0.5 else -2.0),
            JointCommand.velocity(lambda t: 0.0),
        ),
        4.0,
    ),
    "sine": (
        (JointCommand.velocity(lambda t: 1.5 * sin(2.0 * pi * t)), JointCommand.current(lambda t: 1.0)),
        3.0,
    ),
    "rest": ((JointCommand.velocity(lambda t: 0.0), JointCommand.current(lambda t: 0.0)), 3.0),
    "off": ((JointCommand.off(), JointCommand.off()), 2.0),
}


def checks(number: int = 1, settings: SafetySettings | None = None) -> Plausibility:
    """Of a shipped joint, as the loop makes them."""
    joint = load_joint(shipped(f"joint{number}.yaml"))
    made = JointSafety(settings, EstimatorSettings(method="efficiency"), joint).plausibility
    assert made is not None
    return made


def faults(
    samples: tuple[Sample, ...], check: Plausibility, fault: Fault = lambda n, sample: sample
) -> Iterator[int]:
    """Faults that the checks find in each sample, after `fault` has changed it."""
    for n, sample in enumerate(samples):
        seen = fault(n, sample)
        yield check.step(
            PERIOD_S if n else 0.0, seen.motor_position, seen.motor_velocity, seen.link_position, seen.current
        )
