"""Vectorised twin of `extended_inputs` for whole runs: same numbers to 1e-9, a fraction of the time."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.effects.effect import State
from estimator.effects.functions import Whole
from estimator.extended_inputs import (
    INVERSE_W0,
    Pairs,
    Smoothed,
    acting,
    at_motor,
    hooks_of,
    needs_torque,
    seeming_inertia_a,
    torsion_zero,
)
from estimator.friction import FloatArray
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings

BoolArray = npt.NDArray[np.bool_]


class SmoothedRun(Whole):
    """Twin of `Smoothed` over a run; share [n], 0 where a sample is not used."""

    __slots__ = ("_share",)

    def __init__(self, share: FloatArray) -> None:
        self._share: Final = share.tolist()

    def slip(self, d: FloatArray, travel: float) -> FloatArray:  # type: ignore[override]
        """Return the states [n]."""
        one = Smoothed()
        out: list[float] = []
        for now, share in zip(d.tolist(), self._share, strict=True):
            one.share = share
            out.append(one.slip(now, travel) if share else nan)
        return np.array(out)


def extended_run(  # noqa: PLR0917 - a sample, in arrays
    joint: Joint,
    settings: EstimatorSettings,
    dt_s: FloatArray,
    current_a: FloatArray,
    motor_position_rad: FloatArray,
    motor_velocity_rad_s: FloatArray,
    link_position_rad: FloatArray,
    temperature_c: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return (i', theta_l') of a run, arrays [n]: twin of ExtendedInputs for joints without `needs_torque`."""
    assert not needs_torque(joint)
    pairs = acting(joint)
    plain = replace(joint, effects=())
    with np.errstate(all="ignore"):  # what is not finite is put back below
        good = np.isfinite(current_a + motor_position_rad + motor_velocity_rad_s + link_position_rad)
        runs = good & np.concatenate(([False], good[:-1])) & (dt_s > 0.0) & (dt_s <= settings.max_gap_s)
        share = np.where(runs, -np.expm1(-settings.bandwidth_rad_s * dt_s), 1.0) * good
        v = motor_velocity_rad_s / joint.gear_ratio
        rate = np.zeros_like(v)
        if any(
            effect.name == "channel_delay" for effect, _ in pairs
        ):  # the one that reads the current's past
            rate = _rates(settings.link_bandwidth_rad_s, dt_s, current_a, good, runs)
        s = State(
            current_a=current_a,
            current_rate_a_s=rate,
            direction=np.tanh(v * INVERSE_W0),
            link_position_rad=link_position_rad,
            link_velocity_rad_s=v,
            motor_position_rad=motor_position_rad,
            temperature_c=np.full_like(v, nan) if temperature_c is None else temperature_c,
            velocity_rad_s=v,
        )

        def total(name: str, of: Pairs = pairs) -> Any:
            hooks = hooks_of(of, name, lambda: SmoothedRun(share))
            return sum(call(p, s, plain, x) for call, p, x in hooks)

        seeming = seeming_inertia_a(joint) * total("link_rad", at_motor(pairs)) * motor_velocity_rad_s**2
        s.current_a = current = current_a - total("current_a") + seeming
        link = link_position_rad - total("link_rad")
        s.torsion_rad = motor_position_rad / joint.gear_ratio - link - torsion_zero(joint)
        s.torque_nm = np.full_like(v, nan)  # nobody here needs it
        link = link - total("twist_rad")
        current = current - total("loss_nm") / (joint.gear_ratio * joint.torque_constant_nm_per_a)
    return np.where(good, current, current_a), np.where(good, link, link_position_rad)


def _rates(
    rate_rad_s: float, dt_s: FloatArray, current_a: FloatArray, good: BoolArray, runs: BoolArray
) -> FloatArray:
    """Return the filtered derivative of the current [n]; good: samples used, runs: those that do not start again."""
    out = np.zeros_like(current_a)
    gone = -np.expm1(-rate_rad_s * dt_s)
    slope = np.diff(current_a, prepend=0.0) / dt_s
    rate = 0.0
    rows = zip(gone.tolist(), slope.tolist(), good.tolist(), runs.tolist(), strict=True)
    for k, (share, now, usable, on) in enumerate(rows):
        if usable:
            rate = rate + share * (now - rate) if on else 0.0
            out[k] = rate
    return out
