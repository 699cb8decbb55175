"""What a next experiment may ask of two coupled joints: limits from the joint files, and the loads that keep them. Pure.

A joint file gives the rated torque and no rated current. The current limit is what the joint needs to give its rated
torque against its own losses; the planned motion stays well below both, because the file may be wrong in the very
thing that the experiment is to settle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.losses import LossModel
from estimator.parameters import Joint
from sysid.excitation_model import Bench as StaticBench
from sysid.motion.limits import Limits

VELOCITY_RAD_S: Final = 2.0
"""Fastest motion where nothing else is said; joint files have no rated velocity."""
TEMPERATURE_C: Final = 70.0
_TORQUE_SHARE: Final = 0.7
"""Planned torque as a part of the rated one: it rings at a reversal under load (docs/excitation.md)."""
_CURRENT_SHARE: Final = 0.85
_INERTIA_SHARE: Final = 0.25
"""Part of the rated torque that goes into accelerating both rotors."""
_STEPS: Final = 200
_OVER: Final = 3.0
"""Largest current tried, in rated torques over G Kt."""


@dataclass(frozen=True)
class Reach:
    """What the runs of an experiment may use.

    joints: of the bench; limits: of the plan but for travel, which each plan adds; velocity_rad_s: fastest plateau;
    acceleration_rad_s2: steepest change of it; own_current_a: largest planned current of joint 1 and of joint 2.
    """

    joints: tuple[Joint, Joint]
    limits: Limits
    velocity_rad_s: float
    acceleration_rad_s2: float
    own_current_a: tuple[float, float]

    def load_of(self, velocity_joint: int, velocity_rad_s: float | None = None) -> float:
        """Largest current [A] of the other joint, for any velocity up to this one (None: the fastest; 0: held still).

        Torque and the velocity joint's own current stay within their bounds in both directions: driven back, the driving
        joint's losses add to its torque. Held still, its torque is at most what its current gives.
        """
        speed = self.velocity_rad_s if velocity_rad_s is None else velocity_rad_s
        mover, driver = self.joints[velocity_joint - 1], self.joints[2 - velocity_joint]
        bound = _TORQUE_SHARE * self.limits.torque_nm
        nm_per_a = LossModel(driver).torque_per_ampere
        most = min(self.own_current_a[2 - velocity_joint], _OVER * bound / nm_per_a)
        if speed == 0.0:
            return min(most, bound / nm_per_a)
        bench = StaticBench(mover, driver)
        currents = np.linspace(0.0, most, _STEPS)
        good = np.ones(_STEPS, bool)
        for share in (-1.0, -0.1, 0.1, 1.0):
            velocity, still = np.full(_STEPS, share * speed), np.zeros(_STEPS)
            low, high = bench.torque_range(self.own_current_a[velocity_joint - 1], velocity, still)
            torque = bench.torque(currents, velocity, still)
            good &= (np.abs(torque) <= bound) & (low <= torque) & (torque <= high)
        return float(currents[max(int(np.argmin(good)) - 1, 0)] if not good.all() else most)


def reach_of(
    joints: Mapping[int, Joint],
    *,
    velocity_rad_s: float = VELOCITY_RAD_S,
    temperature: bool = True,
) -> Reach:
    """Return what two coupled joints can do; one joint alone is taken to face one like itself.

    joints: by number, at least one; the first two count. temperature: whether the drives tell theirs (a plan with a
    limit for it is refused otherwise).

    Raises ValueError without a joint.
    """
    if not joints:
        raise ValueError("joints: found none, expected one or two")
    files = [joints[number] for number in sorted(joints)][:2]
    pair = (files[0], files[-1])
    rated = min(j.rated_torque_nm for j in pair)
    currents = [_current_at(j, rated, velocity_rad_s) for j in pair]
    limits = Limits(
        current_a=_down(max(currents)),
        velocity_rad_s=_down(1.15 * velocity_rad_s),
        torque_nm=rated,
        travel_rad=1.0,
        temperature_c=TEMPERATURE_C if temperature else math.inf,
    )
    rotors = sum(j.gear_ratio**2 * j.rotor_inertia_kgm2 + j.link_inertia_kgm2 for j in pair)
    acceleration = min(20.0, _INERTIA_SHARE * rated / (0.5 * rotors))
    own = [_CURRENT_SHARE * min(current, limits.current_a) for current in currents]
    return Reach(pair, limits, velocity_rad_s, acceleration, (own[0], own[1]))


def _current_at(joint: Joint, torque_nm: float, velocity_rad_s: float) -> float:
    """Current [A] at which the joint, driving at this velocity, gives this torque; of the loss, the largest on the way."""
    loss = LossModel(joint)
    highest = _OVER * torque_nm / loss.torque_per_ampere
    currents = np.linspace(0.0, highest, _STEPS)
    speeds = np.full_like(currents, velocity_rad_s)
    given = loss.torque_per_ampere * currents - loss.loss_many(currents, speeds)
    enough = np.flatnonzero(given >= torque_nm)
    return float(currents[enough[0]] if len(enough) else highest)


def _down(value: float) -> float:
    """Two significant digits after rounding down: limits are read by people."""
    place = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(round(math.floor(value / place + 1e-9) * place, 6))
