"""The network of section III, run by ONNX Runtime: one thread, float64, checked before its first use.

The graph takes "x" [N, 6] (FEATURES, SI units, normalisation inside) and gives [N, 1] torque [Nm]. What
belongs to it travels in its metadata, each value JSON: features, envelope_low and envelope_high (range of
the training data per feature), sigma_nm (held-out standard deviation), joint (name), data_sha256 (training
data).

A single sample goes through an I/O binding on two preallocated numpy buffers: no array is made per call.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any, Final

import numpy as np

from estimator.friction import FloatArray

FEATURES: Final = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "link_velocity_rad_s",
    "efficiency_torque_nm",
)
_PROBES: Final = (0.25, -0.5)  # two different inputs: the binding must see the second one
_WARM_UP: Final = 50


class NetworkError(ValueError):
    """The network file cannot be used; one line that names file, found and expected."""


class TorqueNetwork:
    """A loaded and checked network.

    source: path of an ONNX file, or its bytes; sha256: expected hash of the bytes (hex), not checked when
    None. Raises NetworkError for an unreadable or corrupt file, another hash, shape, type or missing
    metadata. Public: `name`, `sha256`, `envelope_low`, `envelope_high` (6 floats each), `sigma_nm`,
    `joint`, `data_sha256`.
    """

    def __init__(self, source: bytes | str | os.PathLike[str], sha256: str | None = None) -> None:
        self.name: Final = "network (bytes)" if isinstance(source, bytes) else os.fspath(source)
        data = source if isinstance(source, bytes) else self._read(source)
        self.sha256: Final = hashlib.sha256(data).hexdigest()
        if sha256 is not None and sha256.lower() != self.sha256:
            raise self._error(f"found SHA-256 {self.sha256}, expected {sha256}")
        self._session: Final = self._open(data)
        self._output: Final = self._check_graph()
        metadata = self._metadata()
        self.envelope_low: Final = self._six(metadata, "envelope_low")
        self.envelope_high: Final = self._six(metadata, "envelope_high")
        for name, low, high in zip(FEATURES, self.envelope_low, self.envelope_high, strict=True):
            if low > high:
                raise self._error(f"metadata envelope of {name}: found low {low:g} above high {high:g}")
        self.sigma_nm: Final = self._sigma(metadata)
        self.joint: Final = self._text(metadata, "joint")
        self.data_sha256: Final = self._text(metadata, "data_sha256")
        self._x: Final = np.zeros((1, len(FEATURES)))
        self._y: Final = np.zeros((1, 1))
        self._x_view: Final[Any] = self._x.reshape(
            -1
        ).data  # a memoryview: 3 times faster than numpy indexing
        self._y_view: Final[Any] = self._y.reshape(-1).data
        self._bind()
        self._warm_up()

    def run_one(  # noqa: PLR0917 - the six features, positional for speed
        self, x0: float, x1: float, x2: float, x3: float, x4: float, x5: float
    ) -> float:
        """Return the torque [Nm] of one sample; the arguments are FEATURES in their order."""
        view = self._x_view
        view[0] = x0
        view[1] = x1
        view[2] = x2
        view[3] = x3
        view[4] = x4
        view[5] = x5
        if self._bound:
            self._call(self._binding, None)
            return self._y_view[0]  # type: ignore[no-any-return]
        return float(self._session.run(None, {"x": self._x})[0][0, 0])

    def run_many(self, features: FloatArray) -> FloatArray:
        """Return torques [n] of samples [n, 6]; equal to run_one to rounding."""
        if features.ndim != 2 or features.shape[1] != len(FEATURES):
            raise ValueError(f"found features of shape {features.shape}, expected [n, {len(FEATURES)}]")
        if len(features) == 0:
            return np.zeros(0)
        result: FloatArray = self._session.run(None, {"x": np.ascontiguousarray(features, np.float64)})[0]
        return result[:, 0]

    def _error(self, text: str) -> NetworkError:
        return NetworkError(f"{self.name}: {text}")

    def _read(self, path: str | os.PathLike[str]) -> bytes:
        try:
            return Path(path).read_bytes()
        except OSError as error:
            raise self._error(f"cannot be read: {error.strerror or error}") from None

    def _open(self, data: bytes) -> Any:
        import onnxruntime as ort

        options = ort.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # what is wrong comes as an exception; nothing else on stderr
        try:
            return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises its own types, without a common base
            lines = str(error).strip().splitlines()
            reason = lines[0][:160] if lines else type(error).__name__
            raise self._error(f"not a usable ONNX model: {reason}") from None

    def _check_graph(self) -> str:
        """Return the output's name when inputs and outputs are what this file says."""
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [i.name for i in inputs] != ["x"]:
            raise self._error(f"found inputs {[i.name for i in inputs]}, expected one, 'x'")
        if len(outputs) != 1:
            raise self._error(f"found {len(outputs)} outputs, expected one")
        for what, node, width in (("input 'x'", inputs[0], len(FEATURES)), ("output", outputs[0], 1)):
            if node.type != "tensor(double)":
                raise self._error(f"found {what} of type {node.type}, expected tensor(double)")
            shape = list(node.shape)
            if len(shape) != 2 or isinstance(shape[0], int) or shape[1] != width:
                raise self._error(f"found {what} of shape {shape}, expected ['N', {width}]")
        return str(outputs[0].name)

    def _metadata(self) -> dict[str, Any]:
        try:
            raw = self._session.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError as error:
            raise self._error(f"metadata: found bytes that are not UTF-8 ({error.reason})") from None
        found: dict[str, Any] = {}
        for key in ("features", "envelope_low", "envelope_high", "sigma_nm", "joint", "data_sha256"):
            if key not in raw:
                raise self._error(f"metadata '{key}': missing, found only {sorted(raw)}")
            try:
                found[key] = json.loads(raw[key])
            except ValueError:
                raise self._error(f"metadata '{key}': found {raw[key][:60]!r}, expected JSON") from None
        if found["features"] != list(FEATURES):
            raise self._error(f"metadata 'features': found {found['features']}, expected {list(FEATURES)}")
        return found

    def _six(self, metadata: dict[str, Any], key: str) -> tuple[float, ...]:
        values = metadata[key]
        good = isinstance(values, list) and len(values) == len(FEATURES) and all(map(_finite, values))
        if not good:
            raise self._error(f"metadata '{key}': found {values!r}, expected {len(FEATURES)} finite numbers")
        return tuple(float(value) for value in values)

    def _sigma(self, metadata: dict[str, Any]) -> float:
        value = metadata["sigma_nm"]
        if not _finite(value) or value <= 0.0:
            raise self._error(f"metadata 'sigma_nm': found {value!r}, expected a number in Nm > 0")
        return float(value)

    def _text(self, metadata: dict[str, Any], key: str) -> str:
        value = metadata[key]
        if not isinstance(value, str) or not value:
            raise self._error(f"metadata '{key}': found {value!r}, expected a text")
        return value

    def _bind(self) -> None:
        """Bind the buffers and prove that they are used in place; otherwise plain run() serves."""
        self._bound = False
        try:
            import onnxruntime as ort

            self._held = ort.OrtValue.ortvalue_from_numpy(self._x), ort.OrtValue.ortvalue_from_numpy(self._y)
            self._io = self._session.io_binding()
            self._io.bind_ortvalue_input("x", self._held[0])
            self._io.bind_ortvalue_output(self._output, self._held[1])
            # the session's own method: the Python wrapper around it costs as much as a layer of the network
            self._call = self._session._sess.run_with_iobinding
            self._binding = self._io._iobinding
            self._bound = all(self._aliases(probe) for probe in _PROBES)
        except (AttributeError, TypeError, RuntimeError):
            self._bound = False

    def _aliases(self, probe: float) -> bool:
        low, high = np.array(self.envelope_low), np.array(self.envelope_high)
        self._x[0] = (low + high) / 2 + probe * np.maximum(high - low, 1.0)
        self._y[0, 0] = math.nan
        self._call(self._binding, None)
        expected = self._session.run(None, {"x": self._x.copy()})[0][0, 0]
        return bool(self._y[0, 0] == expected or (math.isnan(expected) and math.isnan(self._y[0, 0])))

    def _warm_up(self) -> None:
        """First calls allocate: they happen here, not in the loop. A network that fails to run is refused."""
        middle = [(low + high) / 2 for low, high in zip(self.envelope_low, self.envelope_high, strict=True)]
        try:
            values = [self.run_one(*middle) for _ in range(_WARM_UP)]
        except Exception as error:  # as in _open
            raise self._error(f"does not run: {str(error).strip().splitlines()[0][:160]}") from None
        if not math.isfinite(values[-1]):
            raise self._error(f"found {values[-1]} in the middle of its envelope, expected a finite torque")


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
