"""Writes a trained network as ONNX: normalisation inside the graph (folded into its weights), float64, with metadata.

    y = mean_y + std_y (W_n h_n + b_n),  h_(k+1) = sigma(h_k W_k + b_k),  h_0 = (x - mean_x)/std_x

with the paper's activation sigma(x) = (1 - e^-x)/(1 + e^-x) = tanh(x/2), Eq. (9). Exporting the weights to
a plain tanh would change the output without any error, so the factor 1/2 is folded in by this file, and the result is
tested against `forward`, which knows nothing of that.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Layer = tuple[FloatArray, FloatArray]

OPSET: Final = 17
IR_VERSION: Final = 9  # what the oldest supported onnxruntime reads


def _checked(
    weights: Sequence[Layer],
    input_mean: FloatArray,
    input_std: FloatArray,
    output_std: float,
    last_is_one: bool = True,
) -> list[Layer]:
    layers = [(np.asarray(w, np.float64), np.asarray(b, np.float64)) for w, b in weights]
    width = len(input_mean)
    for n, (w, b) in enumerate(layers):
        if w.ndim != 2 or w.shape[0] != width or b.shape != (w.shape[1],):
            raise ValueError(
                f"layer {n}: found W {w.shape} and b {b.shape}, expected W ({width}, m) and b (m,)"
            )
        width = w.shape[1]
    if not layers or (last_is_one and width != 1):
        raise ValueError(f"found {width} outputs, expected 1")
    if len(input_std) != len(input_mean) or not (np.all(np.asarray(input_std) > 0.0) and output_std > 0.0):
        raise ValueError("found a standard deviation that is not > 0, or not one per input")
    return layers


def export_network(  # noqa: PLR0917 - the quantities of the equation, in its order
    weights: Sequence[Layer],
    input_mean: FloatArray,
    input_std: FloatArray,
    output_mean: float,
    output_std: float,
    metadata: Mapping[str, Any],
) -> bytes:
    """Return the ONNX file of a fully connected network.

    weights: (W [inputs, outputs], b [outputs]) per layer, the last one without activation; means and standard
    deviations of the inputs [n] and of the output; metadata: key to JSON-able value (see
    estimator/network.py). Raises ValueError when shapes do not fit. Needs the package onnx (extra `train`).
    """
    from onnx import TensorProto, helper, numpy_helper

    layers = _checked(weights, input_mean, input_std, output_std)
    folded = _folded(layers, input_mean, input_std, output_mean, output_std)
    constants, nodes = {}, []
    names = ["x", *(f"h{n}" for n in range(1, len(folded)))]
    for n, (w, b) in enumerate(folded):
        last = n == len(folded) - 1
        constants[f"W{n}"], constants[f"b{n}"] = w, b
        nodes.append(
            helper.make_node("Gemm", [names[n], f"W{n}", f"b{n}"], ["torque_nm" if last else f"g{n}"])
        )
        if not last:
            nodes.append(helper.make_node("Tanh", [f"g{n}"], [names[n + 1]]))
    graph = helper.make_graph(
        nodes,
        "joint_torque",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, ["N", len(input_mean)])],
        [helper.make_tensor_value_info("torque_nm", TensorProto.DOUBLE, ["N", 1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="jtqd")
    model.ir_version = IR_VERSION
    helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    data: bytes = model.SerializeToString()
    return data


def _folded(
    layers: list[Layer], input_mean: FloatArray, input_std: FloatArray, output_mean: float, output_std: float
) -> list[Layer]:
    """Weights of the same function over plain tanh and raw quantities: the standardisation and the factor 1/2 go in.

    (x - m)/s W + b = x (W/s) + (b - (m/s) W); each node of a graph costs about 1 us per call, whatever its size.
    """
    result = []
    for n, (w, b) in enumerate(layers):
        first, last = n == 0, n == len(layers) - 1
        if first:
            b = b - (np.asarray(input_mean) / input_std) @ w  # noqa: PLW2901
            w = w / np.asarray(input_std)[:, None]  # noqa: PLW2901
        if last:
            w, b = w * output_std, b * output_std + output_mean  # noqa: PLW2901
        else:
            w, b = 0.5 * w, 0.5 * b  # noqa: PLW2901
        result.append((w, b))
    return result


def folded_layers(  # noqa: PLR0917
    weights: Sequence[Layer],
    input_mean: FloatArray,
    input_std: FloatArray,
    output_mean: float,
    output_std: float,
    last_is_one: bool = True,
) -> list[Layer]:
    """Return weights over plain tanh and raw quantities; last_is_one: the network must have one output. ValueError."""
    layers = _checked(weights, input_mean, input_std, output_std, last_is_one)
    return _folded(layers, input_mean, input_std, output_mean, output_std)


def hidden_output(
    weights: Sequence[Layer], input_mean: FloatArray, input_std: FloatArray, x: FloatArray
) -> FloatArray:
    """Return the last layer's standardised outputs [n, m] for x [n, inputs] in numpy, by Eq. (9) itself."""
    h: FloatArray = (x - input_mean) / input_std
    for n, (w, b) in enumerate(weights):
        h = h @ w + b
        if n < len(weights) - 1:
            h = (1.0 - np.exp(-h)) / (1.0 + np.exp(-h))
    return h


def forward(  # noqa: PLR0917 - twin of export_network
    weights: Sequence[Layer],
    input_mean: FloatArray,
    input_std: FloatArray,
    output_mean: float,
    output_std: float,
    x: FloatArray,
) -> FloatArray:
    """Return the output [n] for x [n, inputs] in numpy: what the exported graph must equal."""
    layers = _checked(weights, input_mean, input_std, output_std)
    result: FloatArray = output_mean + output_std * hidden_output(layers, input_mean, input_std, x)[:, 0]
    return result
