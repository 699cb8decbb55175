"""Predict torque and limits of an excitation run from the joint files, and scale it radially into the limits.

Everything takes many candidates at once: a genome [4 H + 1] holds amplitudes a, b of the velocity, a, b of the current
and its offset, H harmonics each; only their direction counts, their size follows from the limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import LossModel
from jtqd.sysid.excitation.fourier import FourierSeries, FourierTrajectory

FUNDAMENTAL_HZ: Final = 0.1
GOLDEN: Final = 0.5 * (1.0 + math.sqrt(5.0))
REVERSAL_S: Final = 0.1
REVERSAL_RAD_S: Final = 0.2
REVERSAL_OVERSHOOT: Final = 0.2
"""How far from a reversal in time the torque rings, the velocity from which Table I counts, and the overshoot as a part
of the torque; time and overshoot as the emulated bench shows them at 5 A."""
_BISECTIONS: Final = 12


@dataclass(frozen=True)
class ExcitationLimits:
    """What no designed run may exceed; joint side, each > 0 (ConfigError otherwise).

    Attributes:
        velocity_rad_s, acceleration_rad_s2: peaks of the velocity joint.
        travel_rad: largest distance from the start, either way.
        current_a: peak of the driving joint's commanded current.
        joint_current_a: peak of the current that the velocity joint needs, by the joint files.
        torque_nm: peak of the torque between the joints, by the joint files.
    """

    velocity_rad_s: float = 3.0
    acceleration_rad_s2: float = 12.0
    travel_rad: float = 60.0
    current_a: float = 5.0
    joint_current_a: float = 8.0
    torque_nm: float = 50.0

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"limits: {one.name}: found {value!r}, expected a finite number > 0")


class Motion(NamedTuple):
    """Scaled candidates over the grid: every array [m, n].

    velocity, acceleration of the velocity joint [rad/s, rad/s^2]; current of the driving joint [A]; torque between the
    joints [Nm], positive along the positive current of either; `velocity_scale`, `current_scale` [m, 1] are what the
    genome's amplitudes were multiplied with.
    """

    velocity: FloatArray
    acceleration: FloatArray
    current: FloatArray
    torque: FloatArray
    velocity_scale: FloatArray
    current_scale: FloatArray


class Bench:
    """Static model of two coupled joints: the first moves by velocity, the second drives it by current.

    In steady state the second joint, at i_2 and v_2 = -v_1, gives tau = G Kt i_2 - loss_2(i_2, v_2) (estimator/losses.pyx);
    rotor and link inertia are added, stiffness and control are left out.
    """

    def __init__(self, velocity_joint: Joint, driving_joint: Joint) -> None:
        self._losses: Final = (LossModel(velocity_joint), LossModel(driving_joint))
        self._rotor: Final = tuple(
            j.gear_ratio**2 * j.rotor_inertia_kgm2 for j in (velocity_joint, driving_joint)
        )
        self._links: Final = tuple(j.link_inertia_kgm2 for j in (velocity_joint, driving_joint))

    def torque(self, current: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Torque between the joints [Nm] from the driving joint's current [A] and the velocity joint's motion.

        The loss belongs to the current less the part that accelerates the rotor, as in the estimator.
        """
        loss = self._losses[1]
        effective = current + self._rotor[1] / loss.torque_per_ampere * acceleration  # v_2' = -v_1'
        joint = loss.torque_per_ampere * effective - loss.loss_many(effective, -velocity)
        return joint + self._links[1] * acceleration

    def torque_range(
        self, own_current_a: float, velocity: FloatArray, acceleration: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Least and largest torque [Nm] at which the velocity joint needs at most own_current_a for its motion.

        Its torque grows with its current, so the range of currents maps onto the range of torques by its ends.
        """
        loss = self._losses[0]
        rotor = self._rotor[0] / loss.torque_per_ampere * acceleration
        low, high = (
            loss.torque_per_ampere * i - loss.loss_many(i, velocity) - self._links[0] * acceleration
            for i in (-own_current_a - rotor, own_current_a - rotor)
        )
        return low, high


class Candidates:
    """Turns genomes into motions that keep the limits, on one time grid.

    duration_s: length of a run; rate_hz: grid. The motion is linear in its amplitudes, so it is a product with matrices
    that are made once.

    Raises ConfigError for limits that leave no motion at all.
    """

    def __init__(
        self,
        bench: Bench,
        limits: ExcitationLimits,
        *,
        duration_s: float,
        harmonics: int,
        rate_hz: float,
    ) -> None:
        self.bench: Final = bench
        self.limits: Final = limits
        self.harmonics: Final = harmonics
        self.duration_s: Final = duration_s
        self.dimension: Final = 4 * harmonics + 1
        self.omega_velocity, self.omega_current = fundamentals(duration_s)
        time_s = np.linspace(0.0, duration_s, round(duration_s * rate_hz) + 1)

        pair = 2 * harmonics
        trajectories = [self._trajectory(c).motion(time_s) for c in _unit_vectors(pair)]
        self._position, self._velocity, self._acceleration = (
            np.array([one[order] for one in trajectories]) for order in range(3)
        )
        self._current: Final = np.array([self._series(c).value(time_s) for c in _unit_vectors(pair + 1)])

        self._refuse_too_weak()

    def _refuse_too_weak(self) -> None:
        """The least that every motion needs: to drag the idle driving joint slowly either way, with its overshoot."""
        slow = min(REVERSAL_RAD_S, self.limits.velocity_rad_s)
        velocity, acceleration = np.array([[slow, -slow]]), np.zeros((1, 2))
        torque = self.bench.torque(np.zeros((1, 2)), velocity, acceleration) * (1.0 + REVERSAL_OVERSHOOT)
        low, high = self._torque_range(velocity, acceleration)
        if not _between(low, torque, high).all():
            raise ConfigError(
                f"limits: found joint_current_a {self.limits.joint_current_a:g} and torque_nm "
                f"{self.limits.torque_nm:g}, expected more, because turning the idle driving joint takes "
                f"{float(np.abs(torque).max()):.1f} Nm"
            )

    def _trajectory(self, c: tuple[float, ...]) -> FourierTrajectory:
        H = self.harmonics
        return FourierTrajectory(self.omega_velocity, c[:H], c[H:], self.duration_s)

    def _series(self, c: tuple[float, ...]) -> FourierSeries:
        H = self.harmonics
        return FourierSeries(self.omega_current, c[:H], c[H:-1], self.duration_s, c[-1])

    def motion(self, genomes: FloatArray) -> Motion:
        """Scale every genome [m, 4 H + 1] radially until a limit is active for the velocity and one for the current.

        The velocity alone is scaled to its own three limits; it is made smaller still where the velocity joint could not
        even drag the idle driving joint so. Then the current is scaled to its peak, or, where that asks too much of the
        velocity joint or too much torque, to the largest scale found by bisection that does not. Both bisections keep
        to the side of the limits.
        """
        limits, pair = self.limits, 2 * self.harmonics
        velocity, acceleration = genomes[:, :pair] @ self._velocity, genomes[:, :pair] @ self._acceleration
        position, current = genomes[:, :pair] @ self._position, genomes[:, pair:] @ self._current
        v_scale = 1.0 / np.maximum.reduce(
            [
                _peak(velocity) / limits.velocity_rad_s,
                _peak(acceleration) / limits.acceleration_rad_s2,
                _peak(position) / limits.travel_rad,
            ]
        )
        i_scale = limits.current_a / _peak(current)
        v_scale = _largest(v_scale, lambda s, k: self._idle_allowed(s * velocity[k], s * acceleration[k]))
        velocity, acceleration = v_scale * velocity, v_scale * acceleration
        hardest, margin = _at_reversal(velocity, acceleration, current)
        low, high = self._torque_range(hardest, acceleration)
        low, high = low / margin, high / margin

        def allowed(scale: FloatArray, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
            torque = self.bench.torque(scale * current[rows], hardest[rows], acceleration[rows])
            return _between(low[rows], torque, high[rows])

        i_scale = _largest(i_scale, allowed)
        current = i_scale * current
        torque = self.bench.torque(current, velocity, acceleration)
        return Motion(velocity, acceleration, current, torque, v_scale, i_scale)

    def _torque_range(self, velocity: FloatArray, acceleration: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least and largest torque [Nm] that keeps both the torque's limit and that of the velocity joint's current."""
        low, high = self.bench.torque_range(self.limits.joint_current_a, velocity, acceleration)
        limit = self.limits.torque_nm
        return np.maximum(low, -limit), np.minimum(high, limit)

    def _idle_allowed(self, velocity: FloatArray, acceleration: FloatArray) -> NDArray[np.bool_]:
        """Return whether the motion is allowed while the driving joint has no current, [m] of arrays [m, n]."""
        torque = self.bench.torque(np.zeros_like(velocity), velocity, acceleration)
        low, high = self._torque_range(velocity, acceleration)
        return _between(low, torque, high)

    def series(self, genome: FloatArray) -> tuple[FourierTrajectory, FourierSeries, Motion]:
        """Return the scaled run of one genome [4 H + 1], as series and over the grid ([1, n])."""
        motion = self.motion(genome[None, :])
        H = self.harmonics
        v = tuple((float(motion.velocity_scale[0, 0]) * genome[: 2 * H]).tolist())
        i = tuple((float(motion.current_scale[0, 0]) * genome[2 * H :]).tolist())
        return self._trajectory(v), self._series(i), motion


_STEPS: Final = 200
_OVER: Final = 3.0
"""Largest current tried, in torques over G Kt."""


def current_at(joint: Joint, torque_nm: float, velocity_rad_s: float) -> float:
    """Current [A] at which the joint, driving at this velocity, gives this torque; of the loss, the largest on the way."""
    loss = LossModel(joint)
    highest = _OVER * torque_nm / loss.torque_per_ampere
    currents = np.linspace(0.0, highest, _STEPS)
    speeds = np.full_like(currents, velocity_rad_s)
    given = loss.torque_per_ampere * currents - loss.loss_many(currents, speeds)
    enough = np.flatnonzero(given >= torque_nm)
    return float(currents[enough[0]] if len(enough) else highest)


def rounded_down(value: float) -> float:
    """Two significant digits after rounding down: limits are read by people."""
    place = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(round(math.floor(value / place + 1e-9) * place, 6))


def fundamentals(duration_s: float) -> tuple[float, float]:
    """Angular frequencies [rad/s] of velocity and current: whole periods of about 10 s, and that over the golden ratio.

    The golden ratio is the number that fractions approach worst: harmonics of the two never stay in step, so that all
    four quadrants of velocity and torque fill.
    """
    velocity = 2.0 * math.pi * max(1.0, round(FUNDAMENTAL_HZ * duration_s)) / duration_s
    return velocity, velocity / GOLDEN


def _at_reversal(
    velocity: FloatArray, acceleration: FloatArray, current: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Velocity to check the limits with, and the factor by which the torque must keep away from them; [m, n] each.

    When the driving joint turns from driving to being driven under load, its loss changes sides: the torque leaps by a
    half and rings, since the velocity loop has to follow. Within REVERSAL_S of a reversal the check therefore takes the
    side with the larger torque and leaves REVERSAL_OVERSHOOT for the ringing.
    """
    close = np.abs(velocity) < np.maximum(REVERSAL_RAD_S, REVERSAL_S * np.abs(acceleration))
    driven = np.where(current >= 0.0, REVERSAL_RAD_S, -REVERSAL_RAD_S)  # v_2 = -v_1 against its current
    return np.where(close, driven, velocity), np.where(close, 1.0 + REVERSAL_OVERSHOOT, 1.0)


def _unit_vectors(count: int) -> list[tuple[float, ...]]:
    return [tuple(row) for row in np.eye(count).tolist()]


def _peak(values: FloatArray) -> FloatArray:
    """Return the largest size of each row, [m, 1], never zero: a genome of zeros stays at rest."""
    return np.asarray(np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-12))


def _between(low: FloatArray, value: FloatArray, high: FloatArray) -> NDArray[np.bool_]:
    """Return whether a row lies within its range at every instant, [m] of arrays [m, n]."""
    return np.asarray(((low <= value) & (value <= high)).all(axis=1))


def _largest(
    scale: FloatArray, allowed: Callable[[FloatArray, NDArray[np.intp]], NDArray[np.bool_]]
) -> FloatArray:
    """Return each row's scale [m, 1], or where it is not allowed the largest that bisection finds below.

    allowed(scale [k, 1], rows [k]) tells whether these rows may have this scale; scale 0 must be allowed. The result
    has been asked and allowed, unless it is 0.
    """
    rows = np.flatnonzero(~allowed(scale, np.arange(len(scale))))
    if not len(rows):
        return scale
    low, high = np.zeros((len(rows), 1)), scale[rows]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        good = allowed(middle, rows)[:, None]
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    result = scale.copy()
    result[rows] = low
    return result
