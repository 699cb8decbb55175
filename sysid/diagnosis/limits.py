"""Priors and limits that decide between sets: what data sheets and calibrations are off by, and which evidence suffices.

Priors are physical sizes: the standard deviation of what a value of a joint file, a calibration or an effect may be off by.
They are shown in the report, and the user may set them (`--trust`). Limits of events and structure, and steps of the
search, are defined where they are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from jtqd.estimator.joint import Joint


@dataclass(frozen=True)
class Usage:
    """What the runs of a joint are like: rms speed [rad/s, joint side], range of temperature [K], highest order of the motor
    that is slow enough to be seen in SEEN of the motion.
    """

    speed_rad_s: float
    warming_k: float
    order: float = math.inf


@dataclass(frozen=True)
class Prior:
    """Prior of the leading parameter of an entry.

    size: standard deviation [SI] for a joint as it is used; text: the same for people; file: a value of the joint file or a
    zero, which is usually a little wrong, and no structural effect; calibration: of an instrument, which is never exact.
    """

    size: Callable[[Joint, Usage], float]
    text: str
    file: bool = False
    calibration: bool = False


def _rated_a(joint: Joint) -> float:
    return joint.rated_torque_nm / (joint.gear_ratio * joint.torque_constant_nm_per_a)


def _coulomb(joint: Joint) -> float:
    return max(joint.friction.coulomb_nm, 0.0125 * joint.rated_torque_nm)


def _viscous(joint: Joint, use: Usage) -> float:
    return max(joint.friction.viscous_nms_per_rad, 0.01 * joint.rated_torque_nm / max(use.speed_rad_s, 0.03))


def _reflected(joint: Joint) -> float:
    return joint.gear_ratio**2 * joint.rotor_inertia_kgm2


def _twist(joint: Joint) -> float:
    return joint.rated_torque_nm / joint.stiffness_nm_per_rad


PRIORS: Final[Mapping[str, Prior]] = {
    "torque_constant": Prior(lambda j, u: 0.10 * j.torque_constant_nm_per_a, "10 %", file=True),
    "coulomb_friction": Prior(lambda j, u: _coulomb(j), "100 %", file=True),
    "viscous_friction": Prior(_viscous, "100 %", file=True),
    "load_dependent_friction": Prior(lambda j, u: 0.10, "10 % of the load", file=True),
    "rotor_inertia": Prior(lambda j, u: 0.20 * j.rotor_inertia_kgm2, "20 %", file=True),
    "link_inertia": Prior(
        lambda j, u: max(0.2 * j.link_inertia_kgm2, 0.05 * _reflected(j)), "20 %", file=True
    ),
    "stiffness": Prior(lambda j, u: 0.30 * j.stiffness_nm_per_rad, "30 %", file=True),
    "gear_damping": Prior(
        lambda j, u: max(j.damping_nms_per_rad, 1e-3 * j.stiffness_nm_per_rad), "100 %", file=True
    ),
    "sensor_offset": Prior(
        lambda j, u: 0.01 * j.rated_torque_nm, "1 % of rated", file=True, calibration=True
    ),
    "current_offset": Prior(lambda j, u: 0.01 * _rated_a(j), "1 % of rated", file=True, calibration=True),
    "sensor_gain": Prior(lambda j, u: 0.01, "1 %", calibration=True),
    "sensor_crosstalk": Prior(lambda j, u: 0.01 * j.rated_torque_nm, "1 % of rated", calibration=True),
    "sensor_crosstalk.share": Prior(lambda j, u: 0.01, "1 %", calibration=True),
    "sensor_drift": Prior(lambda j, u: 1e-4 * j.rated_torque_nm, "0.01 % of rated per second"),
    "sensor_drift.per_k_nm": Prior(lambda j, u: 1e-3 * j.rated_torque_nm, "0.1 % of rated per kelvin"),
    "stribeck_friction": Prior(lambda j, u: 0.5 * _coulomb(j), "50 % of Coulomb friction"),
    "friction_asymmetry": Prior(lambda j, u: 0.2 * _coulomb(j), "20 % of Coulomb friction"),
    "temperature_dependent_friction": Prior(lambda j, u: 0.02, "2 % per kelvin"),
    "torque_constant_temperature": Prior(lambda j, u: 0.002, "0.2 % per kelvin"),
    "torque_constant_saturation": Prior(lambda j, u: 0.05 / _rated_a(j), "5 % at rated current"),
    "torque_ripple": Prior(lambda j, u: 0.01 * j.rated_torque_nm, "1 % of rated"),
    "cogging": Prior(lambda j, u: 0.01 * j.rated_torque_nm, "1 % of rated"),
    "kinematic_error": Prior(lambda j, u: 2e-4, "0.2 mrad"),
    "encoder_eccentricity": Prior(lambda j, u: 3e-4, "0.3 mrad"),
    "encoder_eccentricity.motor": Prior(lambda j, u: 5e-3, "5 mrad"),
    "nonlinear_stiffness": Prior(
        lambda j, u: 0.3 * j.stiffness_nm_per_rad / _twist(j) ** 2, "30 % at rated torque"
    ),
    "hysteresis": Prior(lambda j, u: 0.05 * j.rated_torque_nm, "5 % of rated"),
    "lost_motion": Prior(lambda j, u: 3e-4, "0.3 mrad"),
    "channel_delay": Prior(lambda j, u: 3e-3, "3 ms"),
    "unbalance": Prior(lambda j, u: 0.02 * j.rated_torque_nm, "2 % of rated"),
}
"""By effect; with a suffix for a kind of it that is another value of the file or of another size."""
OTHER: Final = Prior(lambda j, u: 0.01 * j.rated_torque_nm, "1 % of rated")
"""Of an effect that has no row: by the torque that its columns make."""

SCALES: Final = (0.5, 2.0)
"""Factors within which what scales a balance may be off: more is another unit."""
P_FILE: Final = 0.3
"""Prior probability that a value of the file is off by more than does not matter."""
P_EFFECT: Final = 0.05
"""Prior probability that a structural effect is there, shared by its terms."""
SHAPE: Final = 0.4
"""Prior standard deviation of a shape (travel, Stribeck speed), as part of it: half of the distance of the grid."""
REFERENCE_K: Final = 3.0
"""The same of the temperature at which the file's values hold."""
FEATURES: Final = 12
"""Eigenfunctions of a balance's discrepancy, plain; as many in the direction of motion."""
LENGTH: Final = 1.0
"""Its length scale, in standard deviations of the operating conditions."""
FLOOR: Final = 1e-3
"""What the equations are exact to, part of the rated torque; prior size of the discrepancy, worth FLOOR_COUNT features."""
FLOOR_COUNT: Final = 2.0
RUNS_COUNT: Final = 4.0
"""Runs that the prior of a run-to-run variation is worth."""
CAP: Final = 0.3
"""Largest part of the gap (rms) that may be discrepancy."""
RIVAL: Final = 6.0
"""Twice the log evidence within which another set is a rival."""
SURE: Final = 3.0
"""Standard deviations by which a certain entry differs from none."""
AGREE: Final = 0.06
"""Standard error of the mean size of a certain entry over the runs, part of it; runs are what is independent."""
SEEN: Final = 0.05
"""Part of the motion in which a wave must be slow enough to be seen; what few moments show of one, anything may be."""
UNTOLD: Final = 0.7
"""Posterior over prior deviation above which these runs cannot tell a value."""
LISTED: Final = 0.2
"""Part of the relevance from which an entry is listed as a cause; smaller ones are listed as too small to matter."""
RELEVANCE: Final = 0.005
"""Part of the rated torque, rms, from which an entry or an unexplained residual matters; the user may set another."""
INACCURATE: Final = 0.03
"""Half width of a 95 % interval, as part of an effect's size, for what the equations simplify: no interval is narrower."""
