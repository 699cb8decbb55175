"""Any estimator of a joint whose file has effects: inputs corrected (`extended_inputs`), then the estimator as it is."""

from __future__ import annotations

from math import nan
from typing import Final

import numpy as np

from estimator.estimate import Estimate
from estimator.extended_inputs import ExtendedInputs
from estimator.friction import FloatArray
from estimator.fused_estimator import FusedEstimator
from estimator.joint_estimator import JointEstimator
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings


class ExtendedEstimator:
    """An estimator of the plain joint behind the corrections of the extended one; used as the estimator itself."""

    __slots__ = ("_inner", "_inner_step", "_inputs", "_torque", "corrected", "joint", "settings")

    def __init__(
        self, joint: Joint, settings: EstimatorSettings, inner: JointEstimator | FusedEstimator
    ) -> None:
        self.joint: Final = joint
        self.settings: Final = settings
        self.corrected = (nan, nan)
        self._inner: Final = inner
        self._inner_step: Final = inner.step
        self._inputs: Final = ExtendedInputs(joint, settings)
        self._torque = nan

    @property
    def with_network(self) -> bool:
        """Whether a network is used."""
        return self._inner.with_network

    def reset(self) -> None:
        """Forget the past: the next step starts."""
        self._inner.reset()
        self._inputs.restart()
        self._torque = nan

    def step(  # noqa: PLR0917 - a sample, positional for speed
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        temperature_c: float = nan,
        network_wanted: bool = True,
    ) -> Estimate:
        """Return the estimate at this sample, dt_s [s] after the one before; never raises on any float.

        `corrected` then holds the current and the link position that the estimator was given.
        """
        self.corrected = current, link = self._inputs.step(
            dt_s,
            current_a,
            motor_position_rad,
            motor_velocity_rad_s,
            link_position_rad,
            temperature_c,
            self._torque,
        )
        estimate = self._inner_step(
            dt_s, current, motor_position_rad, motor_velocity_rad_s, link, temperature_c, network_wanted
        )
        self._torque = estimate.torque_nm
        return estimate


def corrected_by_steps(
    estimator: ExtendedEstimator,
    dt_s: FloatArray,
    columns: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    temperature_c: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the corrected current and link position [n] where they depend on the estimates: one sample after another.

    columns: current, motor position, motor velocity, link position, each [n].
    """
    temperature = np.full(len(dt_s), nan) if temperature_c is None else temperature_c
    out = np.empty((2, len(dt_s)))
    samples = zip(*(column.tolist() for column in (dt_s, *columns, temperature)), strict=True)
    for k, sample in enumerate(samples):
        estimator.step(*sample)
        out[:, k] = estimator.corrected
    return out[0], out[1]
