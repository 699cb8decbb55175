"""Networks of one joint: files, metadata, and whether they fit the joint and the method.

`TorqueNetwork` is that of the paper's section III (method `network`): six features in, torque out. `FusedNetwork` (method
`fused`) gives a correction to the physics from speed, load, torsion and ripple angles. Both are ONNX files whose metadata
say what they were trained on; how far each is trusted is in `validity`.

Program `python -m jtqd.estimator.network`: checks network files by ONNX Runtime. It reads a JSON line [method, path, SHA-256
or null] per network, and answers each with a line: the fields of a `RuntimeCheck`, or {"refused": why}.
"""

from __future__ import annotations

import json
import os
import sys
from typing import ClassVar, Final

import numpy as np

from jtqd.estimator.decoder import FieldError, read
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Envelope, Joint
from jtqd.estimator.onnx_graph import (
    GraphFile,
    NativeGraph,
    NetworkError,
    OnnxGraph,
    RuntimeCheck,
    finite,
)
from jtqd.estimator.perceptron import Perceptron
from jtqd.estimator.settings import METHODS, EstimatorSettings

FEATURES: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "efficiency_torque_nm",
)
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
NATIVE_LIMIT: Final = 1e-6
"""Largest difference between native evaluation and ONNX Runtime, in rated torques."""
_ZERO_PROBES: Final = 8
"""Samples that distinguish a network whose last layer is zero from one that corrects something."""


class Network:
    """A network file, loaded and checked; base of both kinds.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when None; check: of
    ONNX Runtime in another process on these bytes: a graph with known weights then runs without it here.

    Public: `name`, `sha256`, `joint` (name), `data_sha256` (training data); `run_one(*x)` answer for one sample [Nm],
    `run_many([n, features])` for many; `perceptron`, `native_error_nm` and `check` as `GraphFile` has them.

    Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or missing metadata.
    """

    features: ClassVar[tuple[str, ...]]
    keys: ClassVar[tuple[str, ...]]
    """Metadata, each value JSON; the first two are lowest and highest value per feature in the training data."""

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        check: RuntimeCheck | None = None,
    ) -> None:
        graph: GraphFile
        if check is None or check.native_error_nm is None:
            graph = OnnxGraph(source, sha256, self.features, self.keys)
        else:
            graph = NativeGraph(source, sha256, check)
        self._graph: Final = graph
        self.check: Final = graph.check
        self.name: Final = graph.name
        self.sha256: Final = graph.sha256
        self.joint: Final = graph.text("joint")
        self.data_sha256: Final = graph.text("data_sha256")
        self.run_one: Final = graph.run_one
        self.run_many: Final = graph.run_many
        self.perceptron: Final = graph.perceptron
        self.native_error_nm: Final = graph.native_error_nm


class TorqueNetwork(Network):
    """Network of the paper: `run_one` gives the torque.

    Metadata besides those of `Network`: envelope_low and envelope_high (range of the training data per feature), sigma_nm
    (held-out standard deviation).
    """

    features = FEATURES
    keys = ("envelope_low", "envelope_high", "sigma_nm", "joint", "data_sha256")

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        check: RuntimeCheck | None = None,
    ) -> None:
        super().__init__(source, sha256, check)
        self.envelope_low: Final = self._graph.numbers("envelope_low", len(FEATURES))
        self.envelope_high: Final = self._graph.numbers("envelope_high", len(FEATURES))
        sigma = self._graph.metadata["sigma_nm"]
        if not finite(sigma) or sigma <= 0.0:
            raise self._graph.error(f"metadata 'sigma_nm': found {sigma!r}, expected a number in Nm > 0")
        self.sigma_nm: Final = float(sigma)


class FusedNetwork(Network):
    """Network of method `fused`: `run_one` gives the correction of the physics.

    Metadata besides those of `Network`: input_low and input_high (range of the training data per feature), envelope
    (`Envelope`), sigma_scale (4, quadrants in QUADRANTS' order, factor on the physics' standard deviation where the network
    is in charge). `corrects`: False where the correction is 0 everywhere (share 0: the file holds envelope and calibration
    only).
    """

    features = FUSED_FEATURES
    keys = ("input_low", "input_high", "envelope", "sigma_scale", "joint", "data_sha256")

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        check: RuntimeCheck | None = None,
    ) -> None:
        super().__init__(source, sha256, check)
        graph = self._graph
        try:
            self.envelope: Final = read(Envelope, graph.metadata["envelope"])
        except FieldError as error:
            raise graph.error(
                f"metadata 'envelope': {f'{error.key}: ' if error.key else ''}{error.problem}"
            ) from None
        a, b, c, d = graph.numbers("sigma_scale", 4)
        if min(a, b, c, d) <= 0.0:
            raise graph.error(f"metadata 'sigma_scale': found {[a, b, c, d]}, expected numbers > 0")
        self.sigma_scale: Final = (a, b, c, d)
        low, high = (np.array(graph.numbers(key, len(FUSED_FEATURES))) for key in self.keys[:2])
        probes = low + np.linspace(0.05, 0.95, _ZERO_PROBES)[:, None] * (high - low)
        self.corrects: Final = any(self.run_one(*probe) != 0.0 for probe in probes.tolist())


Networks = TorqueNetwork | FusedNetwork
_KINDS: Final[dict[str, type[Networks]]] = {kind.__name__: kind for kind in (TorqueNetwork, FusedNetwork)}


def load_network(
    method: str,
    source: bytes | str | os.PathLike[str],
    sha256: str | None = None,
    check: RuntimeCheck | None = None,
) -> Networks:
    """Return the network of a method that uses one, from a file or bytes; arguments and errors as `Network`."""
    return _KINDS[METHODS[method].network](source, sha256, check)


def native_of(network: object, joint: Joint) -> Perceptron | None:
    """Return what evaluates a network in the cycle; None: its `run_one` does, as for every graph without known weights.

    Raises NetworkError when it differs from ONNX Runtime by more than NATIVE_LIMIT of the joint's rated torque.
    """
    if not isinstance(network, Network) or network.native_error_nm is None:
        return None
    found, limit = network.native_error_nm, NATIVE_LIMIT * joint.rated_torque_nm
    if not found <= limit:  # NaN included
        raise NetworkError(
            f"{network.name}: found native evaluation and ONNX Runtime {found:.3g} Nm apart, expected at most {limit:.3g} Nm"
        )
    return network.perceptron


def check_fit(joint: Joint, settings: EstimatorSettings, network: object, estimator: str) -> None:
    """Raise ConfigError where joint, settings and network do not fit together in an estimator of this class name.

    network: a `Network` or a stand-in, None for none; not looked at where the method uses none.
    """
    method = METHODS[settings.method]

    def error(text: str) -> ConfigError:
        return ConfigError(f"joint {joint.name}: {text}")

    if method.estimator != estimator:
        raise error(f"found method '{settings.method}', which {method.estimator} applies, not {estimator}")
    if joint.effects:
        names = ", ".join(effect.name for effect in joint.effects)
        raise error(f"found effects ({names}), which `make_estimator` applies, not this class")
    if settings.method == "efficiency" and joint.efficiency is None:
        raise error("found no efficiency, which method 'efficiency' needs; 'tob' does not need it")
    if "fused" in method.sections and joint.fused is None:
        raise error(
            f"found no section 'fused', which method '{settings.method}' needs; 'jtq fit losses' makes one, "
            "methods 'tob' and 'efficiency' do not need it"
        )
    if not method.network:
        return
    if network is None:
        if method.network_required:
            raise error(f"found no network, which method '{settings.method}' needs")
        return
    if isinstance(network, Network) and type(network).__name__ != method.network:
        found = next(name for name, each in METHODS.items() if each.network == type(network).__name__)
        raise error(f"found a network of method '{found}', expected one of '{settings.method}'")
    if (name := getattr(network, "joint", "")) != joint.name:
        raise error(f"found a network of joint '{name}', expected one of '{joint.name}'")


def main() -> int:
    """Check networks until the end of input. Returns 0."""
    for line in sys.stdin:
        method, path, sha256 = json.loads(line)
        try:
            answer = load_network(method, path, sha256).check._asdict()
        except NetworkError as error:
            answer = {"refused": str(error)}
        print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
