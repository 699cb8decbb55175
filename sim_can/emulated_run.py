"""Emulated runs without a bus, for training and tests: plant, drives and quantised measurement at 1 kHz. Pure.

A run holds exactly what a controller would have read from the PDOs, in SI units: the same `PlantSource`, rounded to the
drives' and the sensor's units as the nodes round it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sim_can.effect_plant import EffectPlant
from jtqd.sim_can.plant_source import AnyPlant, PlantSource
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY, Day, DriveRatings

SENSOR_NM_PER_UNIT = 0.001  # 6132h:1 = 3 decimal digits
TEMPERATURE_C_PER_UNIT = 0.1  # 3001h
_SIGNALS = 5

TimeFunction = Callable[[float], float]


class JointCommand(NamedTuple):
    """Command of one drive: mode OFF, VELOCITY (rad/s, joint side) or CURRENT (A), and its target over time in seconds."""

    mode: int
    target: TimeFunction

    @classmethod
    def velocity(cls, target: TimeFunction) -> JointCommand:
        """Return a command in velocity mode; target(t) in rad/s of the joint side."""
        return cls(VELOCITY, target)

    @classmethod
    def current(cls, target: TimeFunction) -> JointCommand:
        """Return a command in current mode; target(t) in A."""
        return cls(CURRENT, target)

    @classmethod
    def off(cls) -> JointCommand:
        """Return a command that leaves the power stage off."""
        return cls(OFF, _zero)


def _zero(_time_s: float) -> float:
    return 0.0


class Push(NamedTuple):
    """From time_s on [s], at any phase of a period, the links are pushed with torque_nm [Nm, joint 1's frame]."""

    time_s: float
    torque_nm: float


class EmulatedRun(NamedTuple):
    """A run and what no instrument knows: the true torque of each gear, [n, 2] in Nm, own frames."""

    table: RunTable
    joint_torque_nm: FloatArray


def emulate_run(
    plant: AnyPlant,
    commands: tuple[JointCommand, JointCommand],
    duration_s: float,
    seed: int = 0,
    period_s: float = 0.001,
    *,
    day: int | Day | None = None,
) -> RunTable:
    """Return the table of `emulate`: what was measured, and nothing else."""
    return emulate(plant, commands, duration_s, seed, period_s, day=day).table


def emulate(
    plant: AnyPlant,
    commands: tuple[JointCommand, JointCommand],
    duration_s: float,
    seed: int = 0,
    period_s: float = 0.001,
    *,
    day: int | Day | None = None,
    pushes: Sequence[Push] = (),
) -> EmulatedRun:
    """Run both joints from rest for duration_s; return what was measured every period_s, and the true torques beside it.

    Args:
        commands: of joint 1 and joint 2; targets are evaluated once per period, at its beginning.
        seed: of the measurement noise and of the days; the same arguments give the same table bit by bit.
        day: number of the day of this seed (0, 1, 2, ...; each has noise of its own), whose values lie within the plant's
            `run_to_run`; or the values themselves; None: the nominal day, without any drift.
        pushes: on the links between the joints, at least one period apart; each lasts until the next.

    Returns:
        A table with joints 1 and 2, n = round(duration_s / period_s) rows from time 0; link_velocity is None (a drive does
        not measure it), torque_nm is the one sensor's in both joints; and the true torques at the same times.

    Raises:
        ValueError: duration or period not positive and finite; pushes on joints with effects.
    """
    if not (0.0 < period_s < math.inf and period_s <= duration_s < math.inf):
        raise ValueError(f"a run of {duration_s} s in steps of {period_s} s")
    count = round(duration_s / period_s)
    if isinstance(day, int):
        source = PlantSource(plant, seed, noise_seed=f"{seed} day {day}")
        source.begin_day(plant.run_to_run.day(seed, day))
    else:
        source = PlantSource(plant, seed)
        source.begin_day(day or Day())
    rows, truth = np.empty((count, 2 * _SIGNALS + 1)), np.empty((count, 2))
    # velocity targets are joint side here, motor side in the drives
    ratios = [rating.gear_ratio for rating in source.ratings]
    scales = [ratio if c.mode == VELOCITY else 1.0 for ratio, c in zip(ratios, commands, strict=True)]
    one, two = source.drives
    channel = source.channels[0]
    pushed = {math.floor(each.time_s / period_s): each for each in pushes}
    if pushes and isinstance(source.plant, EffectPlant):
        raise ValueError("found pushes on joints with effects, expected none")
    source.advance(0.0)
    for k in range(count):
        rows[k] = (
            one.current_a,
            one.motor_position_rad,
            one.motor_velocity_rad_s,
            one.link_position_rad,
            one.temperature_c,
            two.current_a,
            two.motor_position_rad,
            two.motor_velocity_rad_s,
            two.link_position_rad,
            two.temperature_c,
            channel.torque_nm,
        )
        truth[k] = source.plant.joint_torques()
        time_s = k * period_s
        for drive, (command, scale) in enumerate(zip(commands, scales, strict=True)):
            source.command(drive, command.mode, scale * command.target(time_s))
        if k in pushed:
            source.plant.push(pushed[k].torque_nm, pushed[k].time_s - time_s)
        source.advance(period_s)
    torque = np.round(rows[:, -1] / SENSOR_NM_PER_UNIT) * SENSOR_NM_PER_UNIT
    halves = rows[:, :_SIGNALS], rows[:, _SIGNALS : 2 * _SIGNALS]
    joints = {
        number: _columns(half, torque, rating)
        for number, half, rating in zip((1, 2), halves, source.ratings, strict=True)
    }
    time: FloatArray = np.arange(count, dtype=np.float64) * period_s
    return EmulatedRun(RunTable(time_s=time, joints=joints), truth)


def _columns(signals: FloatArray, torque: FloatArray, ratings: DriveRatings) -> JointColumns:
    """Return the signals [n, 5] rounded to the units of 6078h, 6064h, 606Ch, 60E4h and 3001h, and the torque [n]."""
    motor = 2.0 * math.pi / ratings.motor_counts_per_rev
    link = 2.0 * math.pi / ratings.link_counts_per_rev
    current = ratings.rated_current_a / 1000.0
    units = (current, motor, motor, link, TEMPERATURE_C_PER_UNIT)
    i, motor_rad, motor_rad_s, link_rad, celsius = (
        np.round(signals[:, k] / unit) * unit for k, unit in enumerate(units)
    )
    return JointColumns(
        current_a=i,
        motor_position_rad=motor_rad,
        motor_velocity_rad_s=motor_rad_s,
        link_position_rad=link_rad,
        link_velocity_rad_s=None,
        torque_nm=torque,
        temperature_c=celsius,
    )
