"""How old an estimate is, and with what it is compared.

Every path of an estimator passes g/(s+g): its group delay at low frequency is 1/g (`observer`). An estimate of method
`fused` is as old as its torsion path, whose bandwidth is g_t, or of now where the torsion is tracked: its bandwidth is then
infinite, and its age 0. Every other one is as old as the motor path.

Like is compared with like: the sensor through the same filter (`aligned`, and `reference_of` where samples may be
missing). Against the sensor as it is, the age counts as error: that is what a controller meets.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from jtqd.estimator.joint import Joint, Tracking
from jtqd.estimator.settings import EstimatorSettings

if TYPE_CHECKING:
    from jtqd.estimator.arrays import FloatArray


def tracking_of(joint: Joint, settings: EstimatorSettings) -> Tracking | None:
    """Return how a joint's torsion is tracked; None: it is not, and has a low pass.

    It is where the settings want it and the joint file says what it adds to sigma.
    """
    fused = joint.fused if settings.method == "fused" and settings.track_torsion else None
    if fused is None or fused.torsion is None or fused.tracking is None or fused.tracking.wave_rad_s is None:
        return None
    return fused.tracking


def bandwidth_of(joint: Joint, settings: EstimatorSettings) -> float:
    """Return the bandwidth of a joint's estimate [rad/s]; infinite for an estimate of now."""
    if tracking_of(joint, settings) is not None:
        return inf
    if settings.method == "fused" and joint.fused is not None and joint.fused.torsion is not None:
        return settings.own_torsion_bandwidth_rad_s
    return settings.bandwidth_rad_s


def age_ms(joint: Joint, settings: EstimatorSettings) -> float:
    """Return the group delay of a joint's estimate at low frequency [ms]."""
    return 1e3 / bandwidth_of(joint, settings)


def aligned(values: FloatArray, dt_s: FloatArray, joint: Joint, settings: EstimatorSettings) -> FloatArray:
    """Return values [n] as old as the joint's estimate; dt_s [n] as of `low_pass`, which this is."""
    from jtqd.estimator.observer import low_pass  # numpy: the supervisor, which tells the age, needs none

    return low_pass(values, dt_s, bandwidth_of(joint, settings))
