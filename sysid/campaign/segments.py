"""From the segments of a run to set-points at 1 kHz, and whether they keep the plan's limits. Pure."""

from __future__ import annotations

import numpy as np

from estimator.checked import ConfigError
from estimator.friction import FloatArray
from sysid.campaign.plan import Fourier, Off, Plan, Plateau, Run
from sysid.motion.limits import Limits, check_setpoints
from sysid.motion.result import MotionError
from sysid.motion.setpoints import PERIOD_S, Mark, Setpoints


def smooth_step(x: FloatArray) -> FloatArray:
    """10 x^3 - 15 x^4 + 6 x^5: from 0 to 1 over x in 0..1 with first and second derivative zero at both ends."""
    result: FloatArray = x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
    return result


def expand(run: Run) -> Setpoints:
    """Set-points of a run at 1 kHz, from rest.

    A plateau or rest begins where the segment before it ended: both targets go to their new values on one smooth step
    (velocity and acceleration continuous) and then hold. Ramp, hold, Fourier series and time
    without power are a mark each; "ramp" marks have no values.
    """
    velocities: list[FloatArray] = []
    currents: list[FloatArray] = []
    marks: list[Mark] = []
    off: list[tuple[int, int]] = []
    velocity = current = 0.0
    count = 0
    for segment in run.segments:
        if isinstance(segment, Fourier):
            n = samples(segment.duration_s)
            time_s = np.arange(n) * PERIOD_S
            velocities.append(segment.velocity.velocity(time_s))
            currents.append(segment.current.value(time_s))
            marks.append(Mark("fourier", count * PERIOD_S, (count + n) * PERIOD_S))
            count += n
            continue  # from rest to rest
        if isinstance(segment, Off):
            n = samples(segment.duration_s)
            velocities.append(np.full(n, velocity))  # at rest, or Setpoints refuses it
            currents.append(np.full(n, current))
            marks.append(Mark("power_off", count * PERIOD_S, (count + n) * PERIOD_S))
            off.append((count, count + n))
            count += n
            continue
        target = (segment.velocity_rad_s, segment.current_a) if isinstance(segment, Plateau) else (0.0, 0.0)
        ramp, hold = samples(segment.ramp_s), samples(segment.hold_s)
        if (velocity, current) == target:  # nothing to ramp: all of it is held
            ramp, hold = 0, ramp + hold
        share = np.concatenate((smooth_step(np.arange(1, ramp + 1) / max(ramp, 1)), np.ones(hold)))
        velocities.append(velocity + (target[0] - velocity) * share)
        currents.append(current + (target[1] - current) * share)
        middle, end = (count + ramp) * PERIOD_S, (count + ramp + hold) * PERIOD_S
        if ramp:
            marks.append(Mark("ramp", count * PERIOD_S, middle))
        if hold:
            kind = "plateau" if isinstance(segment, Plateau) else "rest"
            marks.append(Mark(kind, middle, end, *target))
        velocity, current = target
        count += ramp + hold
    return Setpoints(
        run.velocity_joint, np.concatenate(velocities), np.concatenate(currents), tuple(marks), tuple(off)
    )


def samples(duration_s: float) -> int:
    """Number of set-points in a time, to the nearest one."""
    return round(duration_s / PERIOD_S)


def travel_rad(setpoints: Setpoints) -> float:
    """Largest distance of the velocity joint from where the run begins [rad], joint side, either way."""
    position = np.cumsum(setpoints.velocity_rad_s) * PERIOD_S
    return float(np.abs(position).max())


def check_run(run: Run, limits: Limits) -> Setpoints:
    """Set-points of a run that keeps the limits, does not jump, and ends at rest.

    Raises:
        ConfigError: naming the run, the quantity, when, what was found and the limit.
    """
    last = run.segments[-1]
    if isinstance(last, Plateau) and last.moving:
        raise ConfigError(
            f"run '{run.name}': found a plateau as last segment, expected rest or fourier: a run ends at rest"
        )
    if not any(samples(segment.duration_s) for segment in run.segments):
        raise ConfigError(f"run '{run.name}': found no time in its segments, expected some")
    setpoints = expand(run)
    try:
        check_setpoints(setpoints, limits)
    except MotionError as error:
        raise ConfigError(f"run '{run.name}': {error}") from None
    return setpoints


def check_plan(plan: Plan) -> dict[str, Setpoints]:
    """Set-points of every run by its name. Raises ConfigError as check_run."""
    return {run.name: check_run(run, plan.limits) for run in plan.runs}
