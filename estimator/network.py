"""Networks of one joint: files, metadata, and whether they fit the joint and the method.

`TorqueNetwork` is that of the paper's section III (method `network`): six features in, torque out. `FusedNetwork` (method
`fused`) gives a correction to the physics from speed, load, torsion and ripple angles. Both are ONNX files whose metadata
say what they were trained on; how far each is trusted is in `validity`.
"""

from __future__ import annotations

import os
from typing import Final, Protocol

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.envelope import Envelope, finite
from jtqd.estimator.joint import Fused, Joint
from jtqd.estimator.onnx_graph import NetworkError, OnnxGraph, RefereedGraph, Verdict
from jtqd.estimator.perceptron import Perceptron
from jtqd.estimator.settings import EstimatorSettings


class NetworkModel(Protocol):
    """Network as `JointEstimator` uses it: `TorqueNetwork`, or a stand-in."""

    @property
    def joint(self) -> str:
        """Name of the joint it was trained for."""

    @property
    def envelope_low(self) -> tuple[float, ...]:
        """Lower end of the training range per feature."""

    @property
    def envelope_high(self) -> tuple[float, ...]:
        """Upper end of the training range per feature."""

    @property
    def sigma_nm(self) -> float:
        """Held-out standard deviation."""

    def run_one(  # noqa: PLR0917
        self, x0: float, x1: float, x2: float, x3: float, x4: float, x5: float
    ) -> float:
        """Return the torque of one sample."""

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the torques [n] of samples [n, 6]."""


def checked_network(
    joint: Joint, settings: EstimatorSettings, network: NetworkModel | None
) -> NetworkModel | None:
    """Return the network that the method uses, if it uses one; ConfigError when the three do not fit."""
    if settings.method == "fused":
        raise ConfigError(
            f"joint {joint.name}: found method 'fused', which FusedEstimator applies, not this one"
        )
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise ConfigError(
            f"joint {joint.name}: found effects ({names}), which `make_estimator` applies, not this class"
        )
    if settings.method == "efficiency" and joint.efficiency is None:
        raise ConfigError(
            f"joint {joint.name}: found no efficiency, which method 'efficiency' needs; 'tob' does not need it"
        )
    if settings.method != "network":
        return None
    if network is None:
        raise ConfigError(f"joint {joint.name}: found no network, which method 'network' needs")
    if network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return network


def checked_fused(joint: Joint, settings: EstimatorSettings, network: FusedNetworkModel | None) -> Fused:
    """Return section `fused` of the joint; ConfigError when joint, method and network do not fit."""
    if settings.method != "fused":
        raise ConfigError(f"joint {joint.name}: found method '{settings.method}', expected 'fused'")
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise ConfigError(
            f"joint {joint.name}: found effects ({names}), which `make_estimator` applies, not this class"
        )
    if joint.fused is None:
        raise ConfigError(
            f"joint {joint.name}: found no section 'fused', which method 'fused' needs; "
            "'jtq fit losses' makes one, methods 'tob' and 'efficiency' do not need it"
        )
    if network is not None and network.joint != joint.name:
        raise ConfigError(
            f"joint {joint.name}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
        )
    return joint.fused


NATIVE_LIMIT: Final = 1e-6
"""Largest difference between native evaluation and ONNX Runtime, in rated torques."""


def native_of(network: object, joint: Joint) -> Perceptron | None:
    """Return what evaluates a network in the cycle; None: its `run_one` does, as for every graph that is not one of ours.

    Raises NetworkError when it differs from ONNX Runtime by more than NATIVE_LIMIT of the joint's rated torque.
    """
    if not isinstance(network, TorqueNetwork | FusedNetwork) or network.perceptron is None:
        return None
    found, limit = network.native_error_nm(), NATIVE_LIMIT * joint.rated_torque_nm
    if not found <= limit:  # NaN included
        raise NetworkError(
            f"{network.name}: found native evaluation and ONNX Runtime {found:.3g} Nm apart, expected at most {limit:.3g} Nm"
        )
    return network.perceptron


FEATURES: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "efficiency_torque_nm",
)
_KEYS: Final = ("envelope_low", "envelope_high", "sigma_nm", "joint", "data_sha256")


def _graph(
    source: bytes | str | os.PathLike[str],
    sha256: str | None,
    features: tuple[str, ...],
    keys: tuple[str, ...],
    verdict: Verdict | None,
) -> OnnxGraph | RefereedGraph:
    """Open a graph: in ONNX Runtime, unless it is one of ours and judged already."""
    if verdict is None or verdict.native_error_nm is None:
        return OnnxGraph(source, sha256, features, keys)
    return RefereedGraph(source, sha256, verdict)


class TorqueNetwork:
    """Network of the paper, loaded and checked.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when None; verdict:
    of ONNX Runtime in another process on these bytes: a graph of ours then runs without it here. Metadata, each value
    JSON: features, envelope_low and envelope_high (range of the training data per feature), sigma_nm (held-out standard
    deviation), joint (name), data_sha256 (training data).

    Public: `name`, `sha256`, `envelope_low`, `envelope_high` (6 floats each), `sigma_nm`, `joint`, `data_sha256`,
    `bound` (samples go through a binding, see `OnnxGraph`); `run_one(x0..x5)` torque of one sample [Nm],
    `run_many([n, 6])` of many; `verdict()`.

    Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or missing metadata.
    """

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        verdict: Verdict | None = None,
    ) -> None:
        graph = _graph(source, sha256, FEATURES, _KEYS, verdict)
        self._graph: Final = graph
        self.verdict: Final = graph.verdict
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
        self.perceptron: Final = graph.perceptron
        self.native_error_nm: Final = graph.native_error_nm

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return torques [n] of samples [n, 6]; equal to run_one to rounding."""
        return self._graph.run_many(features)


FUSED_FEATURES: Final = (
    "joint_velocity_rad_s",
    "motor_torque_nm",
    "torsion_minus_current_nm",
    "cos_2_motor_filtered",
    "sin_2_motor_filtered",
    "cos_4_motor_filtered",
    "sin_4_motor_filtered",
)
"""The last four are waves: an absolute angle, or one that turns as slowly as the link, would identify the run."""

_ZERO_PROBES: Final = 8
"""Samples that tell a network whose last layer is zero from one that corrects something."""
_FUSED_KEYS: Final = ("envelope", "sigma_scale", "input_low", "input_high", "joint", "data_sha256")


class FusedNetworkModel(Protocol):
    """Network as `FusedEstimator` uses it: `FusedNetwork`, or a stand-in."""

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
    """Network of method `fused`, loaded and checked; arguments and errors as `TorqueNetwork`.

    Metadata, each value JSON: features, envelope (`validity.Envelope`), sigma_scale (4, quadrants in QUADRANTS' order,
    factor on the physics' standard deviation where the network is in charge), input_low and input_high (range of the
    training data per feature), joint, data_sha256.

    Public: `name`, `sha256`, `envelope`, `sigma_scale`, `joint`, `data_sha256`, `bound`; `run_one(x0..x6)` correction
    of one sample [Nm], `run_many([n, 7])` of many; `corrects`: False where the correction is 0 everywhere (share 0: the
    file holds envelope and calibration only).
    """

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        verdict: Verdict | None = None,
    ) -> None:
        graph = _graph(source, sha256, FUSED_FEATURES, _FUSED_KEYS, verdict)
        self._graph: Final = graph
        self.verdict: Final = graph.verdict
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
        self.perceptron: Final = graph.perceptron
        self.native_error_nm: Final = graph.native_error_nm
        shares = np.linspace(0.05, 0.95, _ZERO_PROBES)[:, None]
        probes = np.array(lows) + shares * (np.array(highs) - np.array(lows))
        self.corrects: Final = any(self.run_one(*probe) != 0.0 for probe in probes.tolist())

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the corrections [n] of samples [n, 7]; equal to run_one to rounding."""
        return self._graph.run_many(features)
