"""An ONNX graph run by ONNX Runtime: one thread, float64, checked before its first use. The only file that imports it.

The graph takes "x" [N, n] (named features, SI units, normalisation inside) and gives [N, 1] torque [Nm]. Its
metadata hold one JSON value per key; the caller names the keys that must be there.

    OnnxGraph       opened here: the referee of every graph, and what runs one that is not ours
    RefereedGraph   one of ours that ONNX Runtime has judged in another process (`Verdict`): runs natively, without the
                    40 MB of the runtime

A single sample goes through an I/O binding on two preallocated numpy buffers: no array is made per call.
"""

from __future__ import annotations

import json
import math
import os
import stat
import struct
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.envelope import finite
from jtqd.estimator.onnx_weights import fault_of, read_perceptron
from jtqd.estimator.sha256 import sha256_hex

_PROBES: Final = (0.25, -0.5)  # two different inputs: the binding must see the second one
_WARM_UP: Final = 50
_LONGEST_S: Final = 5.0
"""Of this process's own processor time for each step before the first use: a busy machine is no endless loop."""
_TIMES_BY_THE_CLOCK: Final = 6.0
"""So many times as long by the clock: a step that waits for ever takes no processor time."""
_POLL_S: Final = 0.1
_NATIVE_PROBES: Final = 256
"""Inputs at which native evaluation is compared: in the range of the training data, and a quarter of it beyond."""


class NetworkError(ValueError):
    """The network file cannot be used; one line that names file, found and expected."""


class Verdict(NamedTuple):
    """What ONNX Runtime has found in a file that it accepts.

    native_error_nm: largest difference of native evaluation at the probes; None for a graph that is not one of ours.
    """

    sha256: str
    metadata: dict[str, Any]
    native_error_nm: float | None


class GraphFile:
    """Bytes of a network file with their hash, and what the metadata say.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when None.
    Raises NetworkError for an unreadable file or another hash. Public: `name`, `sha256`, `metadata`.
    """

    metadata: dict[str, Any]

    def __init__(self, source: bytes | str | os.PathLike[str], sha256: str | None) -> None:
        self.name: Final = "network (bytes)" if isinstance(source, bytes) else os.fspath(source)
        self._data: Final = source if isinstance(source, bytes) else self._read(source)
        self.sha256: Final = sha256_hex(self._data)
        if sha256 is not None and sha256.lower() != self.sha256:
            raise self.error(f"found SHA-256 {self.sha256}, expected {sha256}")

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
        values = self.metadata[key]
        if not (isinstance(values, list) and len(values) == count and all(map(finite, values))):
            raise self.error(f"metadata '{key}': found {values!r}, expected {count} finite numbers")
        return tuple(float(value) for value in values)

    def _read(self, path: str | os.PathLike[str]) -> bytes:
        try:
            if stat.S_ISREG(os.stat(path).st_mode):  # a pipe would be waited for
                return Path(path).read_bytes()
            reason = "not a regular file"
        except OSError as error:
            reason = error.strerror or str(error)
        except ValueError as error:  # a NUL in the name
            reason = str(error)
        raise self.error(f"cannot be read: {reason}")


class RefereedGraph(GraphFile):
    """A graph of ours that ONNX Runtime has judged in another process; runs natively.

    source, sha256, errors: as `GraphFile`; verdict: on the very bytes that are read here. NetworkError for a verdict on
    other bytes, or on a graph that is not one of ours.
    """

    def __init__(self, source: bytes | str | os.PathLike[str], sha256: str | None, verdict: Verdict) -> None:
        super().__init__(source, sha256)
        if self.sha256 != verdict.sha256:
            raise self.error(
                f"was changed while it was checked: found SHA-256 {self.sha256}, checked {verdict.sha256}"
            )
        perceptron = read_perceptron(self._data)
        if perceptron is None or verdict.native_error_nm is None:
            raise self.error("found a graph that needs ONNX Runtime, expected one of ours")
        self.metadata = verdict.metadata
        self.perceptron: Final = perceptron
        self.bound: Final = False
        self.run_one: Final = perceptron.run_one
        self.run_many: Final = perceptron.run_many
        self._verdict: Final = verdict

    def prepare(self, low: FloatArray, high: FloatArray) -> None:
        """Return at once: what needs preparation is the runtime."""

    def verdict(self) -> Verdict:
        """Return the verdict."""
        return self._verdict

    def native_error_nm(self) -> float:
        """Return the largest difference [Nm] between native evaluation and ONNX Runtime over the probes."""
        assert self._verdict.native_error_nm is not None
        return self._verdict.native_error_nm


class OnnxGraph(GraphFile):
    """A loaded graph with `features` inputs.

    source, sha256: as `GraphFile`; features: names and order of the inputs, which the metadata must repeat; keys:
    metadata that must be there. Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or
    missing metadata, weights that are not finite or stand in another file, and no answer or several to one input. Public:
    `run_one`, `bound` (after `prepare`: samples go through the binding, not through run()), `perceptron` (the same graph for
    native evaluation, None for a graph that is not one of ours).
    """

    def __init__(
        self,
        source: bytes | str | os.PathLike[str],
        sha256: str | None,
        features: tuple[str, ...],
        keys: tuple[str, ...],
    ) -> None:
        super().__init__(source, sha256)
        self._width: Final = len(features)
        readable = self._check_weights()
        self._session: Final = self._open(self._data)
        if not readable:
            raise self.error("found a file whose weights cannot be checked")
        self.perceptron: Final = read_perceptron(self._data)
        self._output: Final = self._check_graph()
        self.metadata = self._read_metadata(features, keys)
        self._x: Final = np.zeros((1, self._width))
        self._y: Final = np.zeros((1, 1))
        self._x_bytes: Final[Any] = self._x.reshape(-1).view(np.uint8).data
        self._y_view: Final[Any] = self._y.reshape(-1).data  # 3 times faster than numpy indexing
        self._pack: Final = struct.Struct(f"={self._width}d").pack_into
        self.bound = False
        self.run_one: Callable[..., float] = self._run_plain
        """Torque [Nm] of one sample; the arguments are the features in their order. Take it after `prepare`."""

    def _run_plain(self, *x: float) -> float:
        self._pack(self._x_bytes, 0, *x)
        return float(self._session.run(None, {"x": self._x})[0][0, 0])

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return torques [n] of samples [n, features]; equal to run_one to rounding."""
        if features.ndim != 2 or features.shape[1] != self._width:
            raise ValueError(f"found features of shape {features.shape}, expected [n, {self._width}]")
        if len(features) == 0:
            return np.zeros(0)
        result: FloatArray = self._session.run(None, {"x": np.ascontiguousarray(features, np.float64)})[0]
        return result[:, 0]

    def verdict(self) -> Verdict:
        """Return what a `RefereedGraph` of the same bytes needs; after `prepare`."""
        return Verdict(
            self.sha256, self.metadata, None if self.perceptron is None else self.native_error_nm()
        )

    def native_error_nm(self) -> float:
        """Return the largest difference [Nm] between native evaluation and ONNX Runtime over the probes."""
        assert self.perceptron is not None
        return float(np.max(np.abs(self.perceptron.run_many(self._probes) - self.run_many(self._probes))))

    def prepare(self, low: FloatArray, high: FloatArray) -> None:
        """Bind and warm up between `low` and `high` [features], where the graph must give finite torques."""
        self._answered(partial(self._bind, low, high))
        self._answered(partial(self._warm_up, (low + high) / 2))
        share = np.random.default_rng(0).uniform(-0.25, 1.25, (_NATIVE_PROBES, self._width))
        self._probes = low + share * (high - low)

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
            raise self.error(f"found no answer within {_LONGEST_S:g} s, expected one: it is not used")
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
        options.log_severity_level = 4  # what is wrong comes as an exception; nothing else on stderr
        try:
            return self._answered(
                partial(ort.InferenceSession, data, options, providers=["CPUExecutionProvider"])
            )
        except NetworkError:
            raise
        except Exception as error:  # onnxruntime raises its own types, without a common base
            lines = str(error).strip().splitlines()
            reason = lines[0][:160] if lines else type(error).__name__
            raise self.error(f"not a usable ONNX model: {reason}") from None

    def _check_weights(self) -> bool:
        """Raises NetworkError for weights not finite or in another file. False where only the runtime can tell."""
        try:
            fault = fault_of(self._data)
        except ValueError:
            return False
        if fault is not None:
            raise self.error(fault)
        return True

    def _check_graph(self) -> str:
        """Return the output's name; NetworkError unless there is one input "x" [N, features] and one output [N, 1]."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [i.name for i in inputs] != ["x"]:
            raise self.error(f"found inputs {[i.name for i in inputs]}, expected one, 'x'")
        if len(outputs) != 1:
            raise self.error(f"found {len(outputs)} outputs, expected one")
        for what, node, width in (("input 'x'", inputs[0], self._width), ("output", outputs[0], 1)):
            if node.type != "tensor(double)":
                raise self.error(f"found {what} of type {node.type}, expected tensor(double)")
            shape = list(node.shape)
            if len(shape) != 2 or isinstance(shape[0], int) or shape[1] != width:
                raise self.error(f"found {what} of shape {shape}, expected ['N', {width}]")
        return str(outputs[0].name)

    def _read_metadata(self, features: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Any]:
        try:
            raw = self._session.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError as error:
            raise self.error(f"metadata: found bytes that are not UTF-8 ({error.reason})") from None
        metadata: dict[str, Any] = {}
        for key in ("features", *keys):
            if key not in raw:
                raise self.error(f"metadata '{key}': missing, found only {sorted(raw)}")
            try:
                metadata[key] = json.loads(raw[key])
            except (ValueError, RecursionError):  # the latter: nested a thousand times
                raise self.error(f"metadata '{key}': found {raw[key][:60]!r}, expected JSON") from None
        if metadata["features"] != list(features):
            raise self.error(f"metadata 'features': found {metadata['features']}, expected {list(features)}")
        return metadata

    def _bind(self, low: FloatArray, high: FloatArray) -> None:
        """Bind the buffers and prove that they are used in place; otherwise plain run() serves."""
        import onnxruntime as ort

        try:
            self._held = ort.OrtValue.ortvalue_from_numpy(self._x), ort.OrtValue.ortvalue_from_numpy(self._y)
            self._io = self._session.io_binding()
            self._io.bind_ortvalue_input("x", self._held[0])
            self._io.bind_ortvalue_output(self._output, self._held[1])
            # the session's own method: the Python wrapper around it costs as much as a layer of the network
            call, binding = self._session._sess.run_with_iobinding, self._io._iobinding
            options = ort.RunOptions()  # None would make new ones for each sample, 0.7 us
            options.log_severity_level = 4
            self.bound = all(self._aliases(partial(call, binding, options), p, low, high) for p in _PROBES)
        except (AttributeError, TypeError, RuntimeError):
            self.bound = False
        if self.bound:
            self.run_one = self._bound_call(call, binding, options)

    def _bound_call(self, call: Callable[..., None], binding: Any, options: Any) -> Callable[..., float]:
        """Return `run_one` over the bound buffers; a closure, as each attribute costs time in the loop."""
        pack, x_bytes, y = self._pack, self._x_bytes, self._y_view

        def run_one(*x: float) -> float:
            pack(x_bytes, 0, *x)
            call(binding, options)
            return y[0]  # type: ignore[no-any-return]

        return run_one

    def _aliases(self, run: Callable[[], None], probe: float, low: FloatArray, high: FloatArray) -> bool:
        self._x[0] = (low + high) / 2 + probe * np.maximum(high - low, 1.0)
        self._y[0, 0] = math.nan
        run()
        expected = self._session.run(None, {"x": self._x.copy()})[0][0, 0]
        return bool(self._y[0, 0] == expected or (math.isnan(expected) and math.isnan(self._y[0, 0])))

    def _warm_up(self, middle: FloatArray) -> None:
        """First calls allocate: they happen here, not in the loop. A network that fails to run is refused."""
        sample = middle.tolist()
        try:
            values = [self.run_one(*sample) for _ in range(_WARM_UP)]
        except Exception as error:  # as in _open
            raise self.error(f"does not run: {str(error).strip().splitlines()[0][:160]}") from None
        if not math.isfinite(values[-1]):
            raise self.error(f"found {values[-1]} at the centre of its envelope, expected a finite torque")
        if len(set(values)) > 1:
            raise self.error(
                "found different answers to one input, expected the same: a log could not be replayed"
            )
