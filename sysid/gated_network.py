"""A network whose outputs are gains of waves: sum over m of gain_m(x) wave_m, in numpy and as ONNX.

    y = std_y sum_m g_m wave_m,   g = gains of a fully connected network over the first inputs, sigma(x) = tanh(x/2)

What turns with the motor is corrected, and nothing else can be: over a turn of the angle the waves average to zero, so
no offset, friction or drift of a training run can hide in the network.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from estimator.friction import FloatArray
from sysid.onnx_export import IR_VERSION, OPSET, folded_layers, hidden_output
from sysid.training import Trained


def gated_output(trained: Trained, core: FloatArray, waves: FloatArray) -> FloatArray:
    """Return the output [n] for core inputs [n, k] and waves [n, m]: what the exported graph must equal."""
    gains = hidden_output(trained.weights, trained.input_mean, trained.input_std, core)
    result: FloatArray = trained.output_std * (gains * waves).sum(axis=1)
    return result


def export_gated(trained: Trained, waves: int, metadata: Mapping[str, Any]) -> bytes:
    """Return the ONNX file; its input x is core inputs and waves side by side, [N, k + waves]."""
    from onnx import TensorProto, helper, numpy_helper

    layers = folded_layers(
        trained.weights, trained.input_mean, trained.input_std, 0.0, trained.output_std, last_is_one=False
    )
    core = len(trained.input_mean)
    first, bias = layers[0]
    layers[0] = (
        np.vstack((first, np.zeros((waves, first.shape[1])))),
        bias,
    )  # the waves do not enter the gains
    constants = {"pick": np.vstack((np.zeros((core, waves)), np.eye(waves))), "sum": np.ones((waves, 1))}
    nodes, name = [], "x"
    for n, (w, b) in enumerate(layers):
        constants[f"W{n}"], constants[f"b{n}"] = w, b
        nodes.append(helper.make_node("Gemm", [name, f"W{n}", f"b{n}"], [f"g{n}"]))
        name = f"g{n}"
        if n < len(layers) - 1:
            nodes.append(helper.make_node("Tanh", [name], [f"h{n}"]))
            name = f"h{n}"
    nodes += [
        helper.make_node("MatMul", ["x", "pick"], ["waves"]),
        helper.make_node("Mul", [name, "waves"], ["parts"]),
        helper.make_node("MatMul", ["parts", "sum"], ["torque_nm"]),
    ]
    graph = helper.make_graph(
        nodes,
        "ripple_correction",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, ["N", core + waves])],
        [helper.make_tensor_value_info("torque_nm", TensorProto.DOUBLE, ["N", 1])],
        [numpy_helper.from_array(np.asarray(value, np.float64), key) for key, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="jtqd")
    model.ir_version = IR_VERSION
    helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    data: bytes = model.SerializeToString()
    return data
