"""The network of the paper's section III: six features in, torque out.

Its metadata, each value JSON: features, envelope_low and envelope_high (range of the training data per
feature), sigma_nm (held-out standard deviation), joint (name), data_sha256 (training data).
"""

from __future__ import annotations

import os
from typing import Final

import numpy as np

from estimator.friction import FloatArray
from estimator.onnx_graph import NetworkError, OnnxGraph, finite

__all__ = ["FEATURES", "NetworkError", "TorqueNetwork"]

FEATURES: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "efficiency_torque_nm",
)
_KEYS: Final = ("envelope_low", "envelope_high", "sigma_nm", "joint", "data_sha256")


class TorqueNetwork:
    """A loaded and checked network.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when
    None. Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or missing
    metadata. Public: `name`, `sha256`, `envelope_low`, `envelope_high` (6 floats each), `sigma_nm`,
    `joint`, `data_sha256`; `run_one(x0..x5)` torque of one sample [Nm], `run_many([n, 6])` of many.
    """

    def __init__(self, source: bytes | str | os.PathLike[str], sha256: str | None = None) -> None:
        graph = OnnxGraph(source, sha256, FEATURES, _KEYS)
        self._graph: Final = graph
        self.name: Final = graph.name
        self.sha256: Final = graph.sha256
        self.envelope_low: Final = graph.numbers("envelope_low", len(FEATURES))
        self.envelope_high: Final = graph.numbers("envelope_high", len(FEATURES))
        for name, low, high in zip(FEATURES, self.envelope_low, self.envelope_high, strict=True):
            if low > high:
                raise graph.error(f"metadata envelope of {name}: found low {low:g} above high {high:g}")
        sigma = graph.metadata["sigma_nm"]
        if not finite(sigma) or sigma <= 0.0:
            raise graph.error(f"metadata 'sigma_nm': found {sigma!r}, expected a number in Nm > 0")
        self.sigma_nm: Final = float(sigma)
        self.joint: Final = graph.text("joint")
        self.data_sha256: Final = graph.text("data_sha256")
        graph.prepare(np.array(self.envelope_low), np.array(self.envelope_high))
        self.bound: Final = graph.bound
        self.run_one: Final = graph.run_one

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return torques [n] of samples [n, 6]; equal to run_one to rounding."""
        return self._graph.run_many(features)
