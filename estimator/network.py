"""Networks of one joint: files, metadata, and whether they fit the joint and the method.

`TorqueNetwork` is that of the paper's section III (method `network`): six features in, torque out. `PathNetwork` (method
`fused`) gives the torque of the current path from the signals of one encoder (`native_network`). Both are ONNX files whose
metadata say what they were trained on; how far each is trusted is in `native_network`.

Program `python -m jtqd.estimator.network`: checks network files by ONNX Runtime. It reads a JSON line [method, path, SHA-256
or null] per network, and answers each with a line: the fields of a `RuntimeCheck`, or {"refused": why}.

The graph takes "x" [N, n] (named features, SI units, normalisation inside) and gives [N, 1] torque [Nm], float64. The
metadata hold one JSON value per key; the caller names the keys that must be there. Key `perceptron` holds the weights
(`perceptron_content`), so that the graph can be evaluated natively. The package onnx, where it is installed, reads them
from the graph of a file without that key.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import os
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar, Final, NamedTuple, TypeVar

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import FieldError, read
from jtqd.estimator.errors import ConfigError, OneLineError
from jtqd.estimator.files import read_file
from jtqd.estimator.joint import Agreement, DayZeros, Envelope, Fused, FusedSigma, Joint
from jtqd.estimator.native_network import INPUTS, Perceptron
from jtqd.estimator.settings import METHODS, EstimatorSettings, tracking_of
from jtqd.estimator.text import sha256_hex

FEATURES: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "efficiency_torque_nm",
)
Section = TypeVar("Section", Envelope, FusedSigma, DayZeros, Agreement)
NATIVE_LIMIT: Final = 1e-6
"""Largest difference between native evaluation and ONNX Runtime, in rated torques."""

PERCEPTRON: Final = "perceptron"
"""Key of the metadata that holds the weights."""
_OPTIONAL: Final = {PERCEPTRON, "zeros", "agreement"}
_WARM_UP: Final = 50
_LONGEST_S: Final = 5.0
"""Processor time of this process for each step before the first use: a busy machine is no endless loop."""
_TIMES_BY_THE_CLOCK: Final = 6.0
"""Limit by the clock in units of _LONGEST_S: a step that blocks takes no processor time."""
_POLL_S: Final = 0.1
_PROBES: Final = 256
"""Inputs at which native evaluation is compared: in the range of the training data, and a quarter of it beyond."""
_SAME: Final = 1e-9
"""Relative and absolute difference [Nm] up to which weights read from a graph are those that it evaluates."""


def finite(value: object) -> bool:
    """Return whether a value from JSON is a finite number; a bool is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class NetworkError(OneLineError):
    """The network file cannot be used; one line that names file, found and expected."""


class RuntimeCheck(NamedTuple):
    """What ONNX Runtime found in a file that it accepts.

    metadata: with the weights under PERCEPTRON where they are known; native_error_nm: largest difference of native
    evaluation at the probes, None where the weights are not known.
    """

    sha256: str
    metadata: dict[str, Any]
    native_error_nm: float | None


def perceptron_content(layers: Sequence[tuple[FloatArray, FloatArray]]) -> dict[str, Any]:
    """Return the JSON-able value of the metadata key PERCEPTRON; layers: as `Perceptron` takes them.

    numbers: per layer weights [inputs][outputs], then biases [outputs]; little-endian float64 in base64.
    """
    numbers = [np.concatenate((w.ravel(), b)).astype("<f8").tobytes() for w, b in layers]
    return {
        "widths": [layers[0][0].shape[0], *(len(b) for _, b in layers)],
        "numbers": [base64.b64encode(each).decode() for each in numbers],
    }


def perceptron_of(content: Any) -> Perceptron:
    """Return the network of a metadata value as `perceptron_content` writes it. Raises ValueError."""
    try:
        widths, numbers = content["widths"], content["numbers"]
        if len(widths) < 2 or not all(isinstance(each, int) and each > 0 for each in widths):
            raise ValueError(f"found widths {str(widths)[:40]}, expected at least 2 whole numbers > 0")
        if len(numbers) != len(widths) - 1:
            raise ValueError(f"found numbers of {len(numbers)} layers, expected {len(widths) - 1}")
        layers = []
        for text, (inputs, outputs) in zip(numbers, pairwise(widths), strict=True):
            values = np.frombuffer(base64.b64decode(text, validate=True), "<f8").astype(np.float64)
            if not np.isfinite(values).all():
                raise ValueError("found a value that is not finite")
            layers.append((values[:-outputs].reshape(inputs, outputs), values[-outputs:]))
        return Perceptron(layers)
    except (TypeError, KeyError, IndexError, OverflowError, binascii.Error) as error:
        raise ValueError(f"found no layers as 'jtq train' writes them ({error})") from None


class _Graph:
    """A graph loaded and checked by ONNX Runtime; errors as of `Network`.

    name: of the file; features, keys: as of `Network`. perceptron: None where the weights are not known.
    """

    def __init__(self, name: str, data: bytes, features: tuple[str, ...], keys: tuple[str, ...]) -> None:
        self._name: Final = name
        self._width: Final = len(features)
        self._session: Final = self._open(data)
        self._check_graph()
        self.metadata: Final = self._read_metadata(features, keys)
        low, high = (np.array(_numbers(self.metadata, key, self._width, name)) for key in keys[:2])
        for feature, lowest, highest in zip(features, low, high, strict=True):
            if lowest > highest:
                raise self._error(
                    f"metadata range of {feature}: found {keys[0]} {lowest:g} above {keys[1]} {highest:g}"
                )
        weights = None if PERCEPTRON in self.metadata else self._read_weights(data)
        self._x: Final = np.zeros((1, self._width))
        self._x_bytes: Final[Any] = self._x.reshape(-1).view(np.uint8).data
        self._pack: Final = struct.Struct(f"={self._width}d").pack_into
        self._answered(partial(self._warm_up, (low + high) / 2))
        share = np.random.default_rng(0).uniform(-0.25, 1.25, (_PROBES, self._width))
        probes = low + share * (high - low)
        answers = self.run_many(probes)
        with suppress(ValueError):  # weights that do not fit together, or into the block
            if weights is not None and np.allclose(
                perceptron_of(weights).run_many(probes), answers, rtol=_SAME, atol=_SAME
            ):
                self.metadata[PERCEPTRON] = weights
        self.perceptron: Final = _perceptron(self.metadata, name)
        self.native_error_nm: float | None = None
        if self.perceptron is not None:
            inputs = self.metadata[PERCEPTRON]["widths"][0]
            if inputs != self._width:
                raise self._error(f"metadata '{PERCEPTRON}': found {inputs} inputs, expected {self._width}")
            self.native_error_nm = float(np.max(np.abs(self.perceptron.run_many(probes) - answers)))

    def _error(self, text: str) -> NetworkError:
        return NetworkError(f"{self._name}: {text}")

    def run_one(self, *x: float) -> float:
        """Return the answer for one sample [Nm]."""
        self._pack(self._x_bytes, 0, *x)
        return float(self._session.run(None, {"x": self._x})[0][0, 0])

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return the answers [n] for samples [n, features]."""
        if features.ndim != 2 or features.shape[1] != self._width:
            raise ValueError(f"found features of shape {features.shape}, expected [n, {self._width}]")
        if len(features) == 0:
            return np.zeros(0)
        result: FloatArray = self._session.run(None, {"x": np.ascontiguousarray(features, np.float64)})[0]
        return result[:, 0]

    def _answered(self, step: Callable[[], Any]) -> Any:
        """Return what `step` returns; NetworkError when it has not after _LONGEST_S: it may loop for ever, or block.

        ONNX Runtime cannot be interrupted: the thread stays behind until the process, which refuses the network, ends.
        """
        results: list[Any] = []
        errors: list[BaseException] = []

        def run() -> None:
            try:
                results.append(step())
            except BaseException as error:
                errors.append(error)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        end_s = time.process_time() + _LONGEST_S
        latest_s = time.monotonic() + _TIMES_BY_THE_CLOCK * _LONGEST_S
        while thread.is_alive() and time.process_time() < end_s and time.monotonic() < latest_s:
            thread.join(_POLL_S)
        if errors:
            raise errors[0]
        if not results:
            raise self._error(f"found no answer within {_LONGEST_S:g} s, expected one: it is not used")
        return results[0]

    def _open(self, data: bytes) -> Any:
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read once, when the library is loaded
        import onnxruntime as ort

        ort.disable_telemetry_events()  # some builds report usage to their maker
        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # weights in another file, which the SHA-256 is not of, are looked for where no file can be
        options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
        options.log_severity_level = 4  # faults come as exceptions; nothing else on stderr
        try:
            return self._answered(
                partial(ort.InferenceSession, data, options, providers=["CPUExecutionProvider"])
            )
        except NetworkError:
            raise
        except Exception as error:  # onnxruntime raises its own types, without a common base
            raise self._error(f"not a usable ONNX model: {_first_line(error)}") from None

    def _check_graph(self) -> None:
        """NetworkError unless there is one input "x" [N, features] and one output [N, 1]."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [i.name for i in inputs] != ["x"]:
            raise self._error(f"found inputs {[i.name for i in inputs]}, expected one, 'x'")
        if len(outputs) != 1:
            raise self._error(f"found {len(outputs)} outputs, expected one")
        for what, node, width in (("input 'x'", inputs[0], self._width), ("output", outputs[0], 1)):
            if node.type != "tensor(double)":
                raise self._error(f"found {what} of type {node.type}, expected tensor(double)")
            shape = list(node.shape)
            if len(shape) != 2 or isinstance(shape[0], int) or shape[1] != width:
                raise self._error(f"found {what} of shape {shape}, expected ['N', {width}]")

    def _read_metadata(self, features: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Any]:
        try:
            raw = self._session.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError as error:
            raise self._error(f"metadata: found bytes that are not UTF-8 ({error.reason})") from None
        metadata: dict[str, Any] = {}
        for key in ("features", *keys, *(_OPTIONAL & raw.keys())):
            if key not in raw:
                raise self._error(f"metadata '{key}': missing, found only {sorted(raw)}")
            try:
                metadata[key] = json.loads(raw[key])
            except (ValueError, RecursionError):  # the latter: nested a thousand times
                raise self._error(f"metadata '{key}': found {raw[key][:60]!r}, expected JSON") from None
        if metadata["features"] != list(features):
            raise self._error(f"metadata 'features': found {metadata['features']}, expected {list(features)}")
        return metadata

    def _read_weights(self, data: bytes) -> dict[str, Any] | None:
        """Return the weights of a graph as `jtq train` writes it, as `perceptron_content`, read by the package onnx.

        None without the package, or for any other graph. Raises NetworkError for constants that are not finite.
        """
        try:
            import onnx
        except ImportError:
            return None
        try:
            model = onnx.load_model_from_string(data)
            constants = dict(_constants(model.graph))
            for function in model.functions:
                constants |= dict(_constants(function))
        except Exception as error:  # of onnx, numpy and protobuf
            raise self._error(f"found constants that cannot be checked: {_first_line(error)}") from None
        for name, values in constants.items():
            if values.dtype.kind not in "OSU" and not np.isfinite(values.astype(np.complex128)).all():
                raise self._error(f"found weights {ascii(name)[:60]} with a value that is not finite")
        with suppress(ValueError, KeyError, IndexError):
            return _perceptron_in(model.graph, constants)
        return None

    def _warm_up(self, middle: FloatArray) -> None:
        """First calls allocate: they happen here, not in the loop. A network that fails to run is refused."""
        sample = middle.tolist()
        try:
            values = [self.run_one(*sample) for _ in range(_WARM_UP)]
        except Exception as error:  # as in _open
            raise self._error(f"does not run: {_first_line(error)}") from None
        if not math.isfinite(values[-1]):
            raise self._error(f"found {values[-1]} at the centre of its envelope, expected a finite torque")
        if len(set(values)) > 1:
            raise self._error(
                "found different answers to one input, expected the same: a log could not be replayed"
            )


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:160] if lines else type(error).__name__


def _constants(graph: Any) -> Iterator[tuple[str, Any]]:
    """Yield names and values of all constants of a graph or function of onnx, also of those in its loops and branches."""
    from onnx import numpy_helper

    tensors: list[Any] = []
    if hasattr(graph, "initializer"):
        tensors += [*graph.initializer, *(each.values for each in graph.sparse_initializer)]
    for attribute in (each for node in graph.node for each in node.attribute):
        sparse = (attribute.sparse_tensor, *attribute.sparse_tensors)
        tensors += [attribute.t, *attribute.tensors, *(each.values for each in sparse)]
        yield attribute.name, np.array([attribute.f, *attribute.floats])
        for inner in (attribute.g, *attribute.graphs):
            yield from _constants(inner)
    yield from ((each.name, numpy_helper.to_array(each)) for each in tensors if each.data_type)


def _perceptron_in(graph: Any, constants: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return `perceptron_content` of a graph with operators and names as `jtq train` writes them, None for any other.

    Whether the constants are wired as there shows the comparison with ONNX Runtime.
    """
    operators = [node.op_type for node in graph.node]
    count = operators.count("Gemm")
    layers: Any = [(constants.get(f"W{n}"), constants.get(f"b{n}")) for n in range(count)]
    if operators != ["Gemm", "Tanh"] * (count - 1) + ["Gemm"] or not all(
        isinstance(each, np.ndarray) and each.dtype == np.float64 for layer in layers for each in layer
    ):
        return None
    return perceptron_content(layers)


def _numbers(metadata: Mapping[str, Any], key: str, count: int, name: str) -> tuple[float, ...]:
    """Return `count` finite numbers of the metadata. Raises NetworkError."""
    values = metadata[key]
    if not (isinstance(values, list) and len(values) == count and all(map(finite, values))):
        raise NetworkError(f"{name}: metadata '{key}': found {values!r}, expected {count} finite numbers")
    return tuple(float(value) for value in values)


def _perceptron(metadata: Mapping[str, Any], name: str) -> Perceptron | None:
    """Return the network of the metadata; None without key PERCEPTRON. Raises NetworkError."""
    try:
        return perceptron_of(metadata[PERCEPTRON]) if PERCEPTRON in metadata else None
    except ValueError as error:
        raise NetworkError(f"{name}: metadata '{PERCEPTRON}': {error}") from None


class Network:
    """A network file, loaded and checked; base of both kinds.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when None; check: of
    ONNX Runtime in another process on these bytes: a graph with known weights then runs here without the runtime's 40 MB.

    Public: `name`, `sha256`, `joint` (name), `data_sha256` (training data), `metadata`; `run_one(*x)` answer for one sample
    [Nm], `run_many([n, features])` for many; `perceptron`, None where the weights are not known; `check` for another process
    with its `native_error_nm`.

    Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or missing metadata, constants that are
    not finite or stand in another file, no finite answer or several to one input, and a check of other bytes.
    """

    features: ClassVar[tuple[str, ...]]
    """Names and order of the inputs, which the metadata must repeat."""
    keys: ClassVar[tuple[str, ...]]
    """Metadata, each value JSON; the first two are lowest and highest value per feature in the training data."""

    metadata: dict[str, Any]
    perceptron: Perceptron | None
    native_error_nm: float | None
    run_one: Callable[..., float]
    run_many: Callable[[FloatArray], FloatArray]

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        check: RuntimeCheck | None = None,
    ) -> None:
        self.name: Final = "network (bytes)" if isinstance(source, bytes) else os.fspath(source)
        data = source if isinstance(source, bytes) else self._read(source)
        self.sha256: Final = sha256_hex(data)
        if sha256 is not None and sha256.lower() != self.sha256:
            raise self.error(f"found SHA-256 {self.sha256}, expected {sha256}")
        if check is not None and check.native_error_nm is not None:
            if self.sha256 != check.sha256:
                raise self.error(
                    f"was changed while it was checked: found SHA-256 {self.sha256}, checked {check.sha256}"
                )
            self.metadata, self.native_error_nm = check.metadata, check.native_error_nm
            self.perceptron = native = _perceptron(self.metadata, self.name)
            if native is None:
                raise self.error(f"metadata '{PERCEPTRON}': missing, expected the weights of the network")
            self.run_one, self.run_many = native.run_one, native.run_many
        else:
            self._graph = graph = _Graph(self.name, data, self.features, self.keys)
            self.metadata, self.native_error_nm = graph.metadata, graph.native_error_nm
            self.perceptron, self.run_one, self.run_many = graph.perceptron, graph.run_one, graph.run_many
        self.joint: Final = self.text("joint")
        self.data_sha256: Final = self.text("data_sha256")

    @property
    def check(self) -> RuntimeCheck:
        """What another process needs to run these bytes natively."""
        return RuntimeCheck(self.sha256, self.metadata, self.native_error_nm)

    def error(self, text: str) -> NetworkError:
        """Return the error to raise, with the file's name."""
        return NetworkError(f"{self.name}: {text}")

    def text(self, key: str) -> str:
        """Return a text of the metadata."""
        value = self.metadata[key]
        if not isinstance(value, str) or not value.isprintable() or not value:
            raise self.error(f"metadata '{key}': found {value!r}, expected a text of printable characters")
        return value

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return `count` finite numbers of the metadata."""
        return _numbers(self.metadata, key, count, self.name)

    def _read(self, path: str | os.PathLike[str]) -> bytes:
        try:
            return read_file(path)
        except OSError as error:
            raise self.error(f"cannot be read: {error.strerror or error}") from None


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
        self.envelope_low: Final = self.numbers("envelope_low", len(FEATURES))
        self.envelope_high: Final = self.numbers("envelope_high", len(FEATURES))
        sigma = self.metadata["sigma_nm"]
        if not finite(sigma) or sigma <= 0.0:
            raise self.error(f"metadata 'sigma_nm': found {sigma!r}, expected a number in Nm > 0")
        self.sigma_nm: Final = float(sigma)


class PathNetwork(Network):
    """Network of method `fused`: `run_one` gives the torque of the current path less the motor's (`native_network`).

    Metadata besides those of `Network`: input_low and input_high (range of the training data per input), envelope
    (`Envelope`), sigma (`FusedSigma` of the current path, and the factors on sigma of the estimate), rest_nm (half width of
    the interval of one encoder at rest), quick (largest acceleration [rad/s^2], |tau_r at 800 rad/s - tau_r| and
    |tau_r at 50 rad/s - tau_r| [Nm]). Perhaps zeros and agreement (`DayZeros`, `Agreement`) of it and the torsion.
    """

    features = INPUTS
    keys = ("input_low", "input_high", "envelope", "sigma", "rest_nm", "quick", "joint", "data_sha256")

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None = None,
        check: RuntimeCheck | None = None,
    ) -> None:
        super().__init__(source, sha256, check)
        self.envelope: Final = self._section(Envelope, "envelope")
        self.sigma: Final = self._section(FusedSigma, "sigma")
        has = self.metadata.keys()
        self.zeros: Final = self._section(DayZeros, "zeros") if "zeros" in has else None
        self.agreement: Final = self._section(Agreement, "agreement") if "agreement" in has else None
        self.rest_nm, *quick = self.numbers("rest_nm", 1) + self.numbers("quick", 3)
        self.quick: Final = tuple(quick)
        if min(self.rest_nm, *quick) <= 0.0:
            raise self.error(
                f"metadata 'rest_nm', 'quick': found {[self.rest_nm, *quick]}, expected numbers > 0"
            )

    def _section(self, kind: type[Section], key: str) -> Section:
        try:
            return read(kind, self.metadata[key])
        except FieldError as error:
            where = f"{error.key}: " if error.key else ""
            raise self.error(f"metadata '{key}': {where}{error.problem}{error.others}") from None


def path_section(fused: Fused, network: PathNetwork) -> Fused:
    """Return a joint's section with the network's current path in place of its loss: sigma, day's offsets, agreement.

    Of a network whose runs had no torsion, or that does not know them, those of the section, without the waves of its loss.
    """
    own, zeros, agreement = network.sigma, fused.zeros, fused.agreement
    sigma = replace(
        fused.sigma,
        current_nm=own.current_nm,
        viscous_nms_per_rad=own.viscous_nms_per_rad,
        load=own.load,
        scale=own.scale,
    )
    if getattr(network, "agreement", None) is not None:
        zeros, agreement = network.zeros, network.agreement
    else:
        zeros = None if zeros is None else replace(zeros, scale=own.scale)
        agreement = None if agreement is None else replace(agreement, turn=None)
    return replace(fused, sigma=sigma, zeros=zeros, agreement=agreement)


AnyNetwork = TorqueNetwork | PathNetwork
_KINDS: Final[dict[str, type[AnyNetwork]]] = {kind.__name__: kind for kind in (TorqueNetwork, PathNetwork)}


def load_network(
    method: str,
    source: bytes | str | os.PathLike[str],
    sha256: str | None = None,
    check: RuntimeCheck | None = None,
) -> AnyNetwork:
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
    if "efficiency" in method.sections and not method.network and joint.efficiency is None:
        raise error(f"found no efficiency, which method '{settings.method}' needs; 'tob' does not need it")
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
    if isinstance(network, Network) and not isinstance(network, _KINDS[method.network]):
        methods = (
            name for name, each in METHODS.items() if isinstance(network, _KINDS.get(each.network, ()))
        )
        found = next(methods, type(network).__name__)
        raise error(f"found a network of method '{found}', expected one of '{settings.method}'")
    if (name := getattr(network, "joint", "")) != joint.name:
        raise error(f"found a network of joint '{name}', expected one of '{joint.name}'")
    if method.torsion_of(joint) is not None and tracking_of(joint, settings) is None:
        raise error(
            "found a network of the current path, which has no delay, and a torsion with one; expected "
            "estimator.track_torsion and fused.tracking of the joint file"
        )


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
