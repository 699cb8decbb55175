"""The teacher of runs with known payloads on an arm that nobody has weighed, and what such runs tell of the stiffness.

    torque = known + A c          A = (sin q, cos q, d2q/dt2), c: weight of the arm on its two axes, and its inertia

Two balances share c, linear in all that is unknown. Motor, x = torque of the last repetition, s the direction:

    tau_raw - known = A c + g x + h x^3 + s (F + l |x| + k x^2 + Stribeck + waves of q) + f v + p v |v| + o + a |x| + J dv/dt
                      + day's offset, Coulomb and viscous friction

and, with two encoders, the torsion d against the file's stiffness K:

    known - K d = - A c + spring (knots), damping, slip, waves of motor and link + day's offset

A payload that differs by a known weight tells gains of current and torsion from the arm; an error of the link encoder looks
like an arm, but not to the motor. Each unknown has a Gaussian prior about the joint file. Runs count by their
effective samples (`few_runs.py`): the covariance of c is the standard deviation of the teacher, which sigma has to hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.observer import slipped
from jtqd.sysid.fit.few_runs import Before, Block, solve, weights_of
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import beyond_knot, deflection_rate

WINDOW_S: Final = 0.1
"""Ripple of gear and encoders is faster than the acceleration of a link encoder shows; errors of a law last longer."""
_SLOW_RAD_S: Final = 0.05
_LEAST_WINDOWS: Final = 50
_LEAST_RATED: Final = 0.005
"""No law is better than that."""
_REPETITIONS: Final = 4
_KNOTS: Final = (0.2, 0.45, 0.7)
_TRAVELS_RAD: Final = (4e-5, 1.2e-4, 3e-4, 8e-4)
_LINK_ORDERS: Final = (1.0, 2.0, 3.0)

# Standard deviations of the prior, in parts of rated torque, or of the file's value
_ARM: Final = slice(0, 3)
_ARM_SIGMA: Final = (1.0, 1.0, 0.1)
_MOTOR: Final = slice(3, 19)
_MOTOR_SIGMA: Final = (*(0.1, 0.05, 0.1, 0.1, 0.1, 0.02, 0.02), 0.05, 0.02, 0.05, 0.02, 0.1, *(4 * (0.02,)))
"""Of load: gain, saturation, Coulomb, load friction, offset either way; of motion: viscous, Stribeck, rotor; waves."""
_SPRING: Final = slice(19, 23)
_TORSION: Final = slice(19, 39)
_TORSION_SIGMA: Final = (*(4 * (0.5,)), 3.0, 10.0, *(14 * (0.05,)))
"""Spring, damping, zero, waves and slips."""
_COMMON: Final = 39
_DAY_SIGMA: Final = (0.01, 0.01, 0.02)
"""Offset, Coulomb and viscous friction (at 1 rad/s) of a day."""
WEIGHT: Final = 0.25
"""Load, of rated torque, by which a payload tells load friction and stiffness."""
STIFFNESS_KNOWN: Final = 0.05
TEACHER_KNOWN: Final = 0.015
"""Largest standard deviation of stiffness (of itself) and teacher (of rated torque) of runs that tell them."""


class Teacher(NamedTuple):
    """Arm c [3] and its covariance; standard deviation of the spring at the largest deflection, as a share; largest load and
    standard deviation of the teacher [Nm], over all runs.
    """

    arm: FloatArray
    covariance: FloatArray
    stiffness_share: float
    load_nm: float = 0.0
    sigma_nm: float = 0.0

    def lines(self, joint: Joint, *, two_encoders: bool) -> list[str]:
        """Return the report: what is the teacher, and what it cannot tell."""
        c, s, weight = self.arm, 1.96 * np.sqrt(np.diag(self.covariance)), WEIGHT * joint.rated_torque_nm
        arm = f"arm {c[0]:.2f} +- {s[0]:.2f} Nm sin q, {c[1]:.2f} +- {s[1]:.2f} Nm cos q, {c[2]:.2f} +- {s[2]:.2f} kg m2; "
        known = f"{arm if self.sigma_nm else ''}known to {1.96 * self.sigma_nm:.2f} Nm"
        lines = [f"known loads up to {self.load_nm:.1f} Nm; {known}"]
        needed = f"needed: a known weight of {weight:.0f} Nm, moved both ways through the horizontal"
        if two_encoders and self.stiffness_share > STIFFNESS_KNOWN:
            share = f"known to {196.0 * self.stiffness_share:.0f} %"
            lines.append(f"not determined: stiffness ({share}), so no torsion is fitted; {needed}")
        if self.load_nm < weight:
            lines.append(f"not determined: load friction, so sigma has its prior; {needed}")
        return lines

    def refusal(self, joint: Joint) -> str:
        """Return what is missing where the load is not known well enough, and the motion that would tell it; else ""."""
        most, weight = TEACHER_KNOWN * joint.rated_torque_nm, WEIGHT * joint.rated_torque_nm
        needed = f"payloads that differ by {weight:.0f} Nm, each moved both ways through the horizontal"
        known = f"known to {1.96 * self.sigma_nm:.2g} Nm, expected {1.96 * most:.2g} Nm"
        return f"found loads on an unknown arm {known}; needed: {needed}" if self.sigma_nm > most else ""

    def complete(self, run: RunSignals) -> RunSignals:
        """Return a run whose teacher has the arm, and the standard deviation of that."""
        if run.arm is None:
            return run
        arm = run.filtered_arm
        return replace(
            run,
            sensor_nm=run.sensor_nm + arm @ self.arm,
            raw_sensor_nm=run.raw_sensor_nm + run.arm @ self.arm,
            teacher_nm=np.sqrt(np.einsum("ij,jk,ik->i", arm, self.covariance, arm)),
            arm=None,
        )


def fit_teacher(runs: Sequence[RunSignals], joint: Joint, *, two_encoders: bool) -> Teacher:
    """Return what the runs tell of arm and stiffness. Raises LossFitError for too little motion."""
    largest = max(float(np.abs(run.seen.torsion_nm[run.moving]).max(initial=0.0)) for run in runs)
    rated, w = joint.rated_torque_nm, np.zeros(_COMMON)
    sigmas = np.concatenate((rated * np.array(_ARM_SIGMA), _MOTOR_SIGMA, _TORSION_SIGMA))
    before = Before(np.zeros(_COMMON), np.diag(sigmas**2), _DAY_SIGMA)
    weights: list[float] = []
    for _ in range(_REPETITIONS):
        blocks = [b for run in runs for b in _blocks(run, joint, w[_ARM], largest if two_encoders else 0.0)]
        if sum(len(block.y) for block in blocks) < _LEAST_WINDOWS:
            raise LossFitError(f"found less than {_LEAST_WINDOWS * WINDOW_S:g} s in motion, expected more")
        weights = weights or [(0.02 * rated) ** -2] * len(blocks)
        w, covariance = solve(blocks, weights, before)
        weights = weights_of(blocks, w, _LEAST_RATED * rated)
    secant = np.array((1.0, *(1.0 - knot for knot in _KNOTS)))
    spread = float(np.sqrt(secant @ covariance[_SPRING, _SPRING] @ secant))
    stiffness = max(1.0 + float(secant @ w[_SPRING]), spread)
    found = Teacher(w[_ARM], covariance[_ARM, _ARM], spread / stiffness)
    done = [found.complete(run) for run in runs]
    load = max(float(np.abs(run.sensor_nm[run.moving]).max(initial=0.0)) for run in done)
    squares = [np.square(run.teacher_nm[run.moving]) for run in done if run.teacher_nm is not None]
    sigma = float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0
    return found._replace(load_nm=load, sigma_nm=sigma)


def _blocks(run: RunSignals, joint: Joint, arm: FloatArray, largest_rad: float) -> Iterator[Block]:
    """Yield the equations of a run: of the motor, and of a torsion. A row is the mean of a window of motion."""
    seen, rated, friction = run.seen, joint.rated_torque_nm, joint.friction
    length = max(1, round(WINDOW_S / float(np.median(seen.dt_s[1:]))))
    count = len(seen.dt_s) // length
    turning = run.moving & (np.abs(np.nan_to_num(seen.velocity_rad_s)) > _SLOW_RAD_S)
    kept = turning[: count * length].reshape(count, length).all(axis=1)
    if not kept.any():
        return

    def means(*columns: FloatArray) -> FloatArray:
        rows = np.column_stack(columns)[: count * length]
        result: FloatArray = rows.reshape(count, length, -1).mean(axis=1)[kept]
        return result

    of_arm, known, d = run.filtered_arm, run.sensor_nm, seen.torsion_nm
    v, s, raw = (np.nan_to_num(each) for each in (seen.velocity_rad_s, seen.direction, seen.raw_nm))
    x, speed, one = (known + of_arm @ arm) / rated, np.abs(v), np.ones_like(v)
    link = np.hstack([run.waves(run.link_position_rad, order) for order in _LINK_ORDERS])
    inertia = joint.rotor_inertia_kgm2 * joint.gear_ratio**2 / rated
    alpha = np.gradient(v, np.cumsum(np.maximum(seen.dt_s, 1e-9)))
    peak = np.exp(-((v / friction.stribeck_velocity_rad_s) ** 2)) * s
    load = (x, x**3, s, s * np.abs(x), s * x * x, one, np.abs(x))
    motion = (v, v * speed, np.sign(v) * np.sqrt(speed), peak, inertia * alpha)
    columns = np.zeros((len(means(v)), _COMMON))
    columns[:, _ARM] = means(of_arm)
    columns[:, _MOTOR] = rated * means(*load, *motion, s[:, None] * link[:, :4])
    target = raw - known - friction.coulomb_nm * s - friction.viscous_nms_per_rad * v
    speeds, motion_s = means(v)[:, 0], WINDOW_S * float(np.count_nonzero(kept))
    yield Block(columns, means(target)[:, 0], speeds, motion_s, rated * means(one, s, v))
    if largest_rad <= 0.0:
        return
    stiffness, slips = joint.stiffness_nm_per_rad, [slipped(d, travel)[0] for travel in _TRAVELS_RAD]
    spring = [stiffness * d, *(stiffness * beyond_knot(d, knot * largest_rad) for knot in _KNOTS)]
    damping = joint.damping_nms_per_rad * deflection_rate(d, run)
    columns = np.zeros_like(columns)
    columns[:, _ARM] = -means(of_arm)
    columns[:, _TORSION] = means(
        *spring, damping, rated * one, rated * seen.waves, rated * link, *(rated * slip for slip in slips)
    )
    yield Block(columns, means(known - stiffness * d)[:, 0], speeds, motion_s, rated * means(one))
