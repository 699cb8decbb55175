"""Train fully connected networks with the paper's activation on standardised data, and export them as ONNX.

    y = mean_y + std_y (W_n h_n + b_n),  h_(k+1) = sigma(h_k W_k + b_k),  h_0 = (x - mean_x)/std_x
    sigma(x) = (1 - e^-x)/(1 + e^-x) = tanh(x/2), Eq. (9)

The same data and seed give the same weights: one thread, deterministic algorithms, every random choice from the seed.
One thread is also the fastest: the layers are so small that two threads mostly wait for each other.

In the graph (float64, with metadata) the normalisation is folded into the weights. Exporting them to a plain tanh would
change the output without any error, so the factor 1/2 is folded in here, and the result is tested against `forward`,
which knows nothing of that.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.onnx_graph import PERCEPTRON, perceptron_content

Layer = tuple[FloatArray, FloatArray]

HIDDEN = (20, 40, 10)
"""Hidden layers of the paper's network (section III)."""

BATCH = 2048
BATCHES = 12
"""Batches of an iteration: random samples without repetition, the whole set where it is smaller."""

_RATE = 0.01


@dataclass(frozen=True)
class Trained:
    """Weights (W [inputs, outputs], b [outputs]) per layer, the standardisation, and the loss of each iteration [Nm^2]."""

    weights: list[Layer]
    input_mean: FloatArray
    input_std: FloatArray
    output_mean: float
    output_std: float
    losses: list[float]


def train(
    features: FloatArray,
    target_nm: FloatArray,
    *,
    iterations: int,
    seed: int,
    hidden: tuple[int, ...] = HIDDEN,
    waves: FloatArray | None = None,
    weight_decay: float = 0.0,
    progress: Callable[[int, float], None] = lambda n, loss: None,
) -> Trained:
    """Fit by AdamW in random batches, the rate rising and falling once over all iterations.

    Args:
        features: [n, inputs].
        target_nm: [n], sensor torque, or what the network is to add to a physics estimate.
        iterations: each BATCHES batches of BATCH samples, or all samples where there are fewer.
        seed: of initial weights and batches.
        hidden: widths of the hidden layers.
        waves: [n, m]; when given, the network has m outputs, each the gain of one wave, and their sum is the result:
            it has no part that does not turn with the waves, and no mean.
        weight_decay: of AdamW; 0 is Adam.
        progress: called with iteration and mean loss [Nm^2].
    """
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True)
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
    output_mean, output_std = float(target_nm.mean()), max(float(target_nm.std()), 1e-9)
    outputs, wave = 1, None
    if waves is not None:
        output_mean, outputs, wave = 0.0, waves.shape[1], torch.tensor(waves, dtype=torch.float32)
    x = torch.tensor((features - mean) / std, dtype=torch.float32)
    y = torch.tensor((target_nm - output_mean) / output_std, dtype=torch.float32)[:, None]
    layers = _layers((features.shape[1], *hidden, outputs))
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    optimiser = torch.optim.AdamW(parameters, lr=_RATE, weight_decay=weight_decay)
    used = min(len(x), BATCH * BATCHES)
    batches = -(-used // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=_RATE, total_steps=iterations * batches, pct_start=0.1, final_div_factor=1e3
    )
    losses = []
    for n in range(iterations):
        total = 0.0
        for part in torch.randperm(len(x))[:used].tensor_split(batches):
            optimiser.zero_grad(set_to_none=True)
            out = _forward(layers, x[part])
            if wave is not None:
                out = (out * wave[part]).sum(dim=1, keepdim=True)
            loss = torch.nn.functional.mse_loss(out, y[part])
            loss.backward()
            optimiser.step()
            schedule.step()
            total += loss.item() * len(part)
        losses.append(total / used * output_std**2)
        progress(n, losses[-1])
    weights = [
        (layer.weight.detach().numpy().T.astype(np.float64), layer.bias.detach().numpy().astype(np.float64))
        for layer in layers
    ]
    return Trained(weights, mean, std, output_mean, output_std, losses)


def _layers(sizes: tuple[int, ...]) -> list:  # type: ignore[type-arg]  # torch is optional and untyped here
    import torch

    layers = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    for layer in layers[:-1]:
        # tanh(x/2) has slope 1/2 at zero: Xavier's gain doubles (Glorot and Bengio 2010).
        torch.nn.init.xavier_uniform_(layer.weight, gain=2.0)
    return layers


def _forward(layers: list, x):  # type: ignore[no-untyped-def, type-arg]
    import torch

    for layer in layers[:-1]:
        x = torch.tanh(0.5 * layer(x))
    return layers[-1](x)


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
    return serialised(model, metadata, perceptron_content(folded))


def serialised(model: Any, metadata: Mapping[str, Any], perceptron: Mapping[str, Any]) -> bytes:
    """Return the ONNX file of a model with its metadata, the weights for native evaluation among them."""
    from onnx import helper

    values = {**metadata, PERCEPTRON: perceptron}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in values.items()})
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
