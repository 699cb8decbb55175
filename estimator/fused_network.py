"""The fused estimator's network: a correction to the physics from speed, load, torsion and ripple angles.

Metadata, each value JSON: features, envelope (`fused_trust.Envelope`), sigma_scale (4, quadrants in QUADRANTS'
order, factor on the physics' standard deviation where the network is in charge), input_low and input_high (range of
the training data per feature), joint, data_sha256.
"""

from __future__ import annotations

import os
from typing import Final, Protocol

import numpy as np

from estimator.friction import FloatArray
from estimator.fused_trust import Envelope
from estimator.onnx_graph import OnnxGraph

FUSED_FEATURES: Final = (
    "joint_velocity_rad_s",
    "motor_torque_nm",
    "torsion_minus_current_nm",
    "cos_2_motor_filtered",
    "sin_2_motor_filtered",
    "cos_4_motor_filtered",
    "sin_4_motor_filtered",
)
"""The last four are waves: an absolute angle, or one that turns as slowly as the link, would tell which run it is."""

_KEYS: Final = ("envelope", "sigma_scale", "input_low", "input_high", "joint", "data_sha256")


class FusedNetworkModel(Protocol):
    """What the estimator needs of a network; FusedNetwork has it."""

    @property
    def joint(self) -> str:
        """Name of the joint it was trained for."""

    @property
    def envelope(self) -> Envelope:
        """Where it was trained."""

    @property
    def sigma_scale(self) -> tuple[float, float, float, float]:
        """Factor on the physics' standard deviation per quadrant."""

    def run_one(self, *x: float) -> float:
        """Return the correction of one sample [Nm]."""

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the corrections [n] of samples [n, 7]."""


class FusedNetwork:
    """A loaded and checked network; arguments and errors as `estimator.network.TorqueNetwork`.

    Public: `name`, `sha256`, `envelope`, `sigma_scale`, `joint`, `data_sha256`, `bound`; `run_one(x0..x6)` correction
    of one sample [Nm], `run_many([n, 7])` of many.
    """

    def __init__(self, source: bytes | str | os.PathLike[str], sha256: str | None = None) -> None:
        graph = OnnxGraph(source, sha256, FUSED_FEATURES, _KEYS)
        self._graph: Final = graph
        self.name: Final = graph.name
        self.sha256: Final = graph.sha256
        try:
            self.envelope: Final = Envelope.from_mapping(graph.metadata["envelope"])
        except ValueError as error:
            raise graph.error(f"metadata 'envelope': {error}") from None
        a, b, c, d = graph.numbers("sigma_scale", 4)
        if min(a, b, c, d) <= 0.0:
            raise graph.error(f"metadata 'sigma_scale': found {[a, b, c, d]}, expected numbers > 0")
        self.sigma_scale: Final = (a, b, c, d)
        self.joint: Final = graph.text("joint")
        self.data_sha256: Final = graph.text("data_sha256")
        width = len(FUSED_FEATURES)
        lows, highs = graph.numbers("input_low", width), graph.numbers("input_high", width)
        for name, low, high in zip(FUSED_FEATURES, lows, highs, strict=True):
            if low > high:
                raise graph.error(
                    f"metadata range of {name}: found input_low {low:g} above input_high {high:g}"
                )
        graph.prepare(np.array(lows), np.array(highs))
        self.bound: Final = graph.bound
        self.run_one: Final = graph.run_one

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the corrections [n] of samples [n, 7]; equal to run_one to rounding."""
        return self._graph.run_many(features)
