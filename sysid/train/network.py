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
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.network import FEATURES
from jtqd.estimator.observer import low_pass
from jtqd.estimator.onnx_graph import PERCEPTRON, perceptron_content
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import VALID
from jtqd.estimator.text import counted

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


SAMPLES: Final = 200_000
"""More are thinned out: neighbours at 1 kHz differ by noise only."""

_ENVELOPE_SHARE: Final = 1e-4
"""Share of the samples beyond each end of the training envelope: a single outlier must not widen it."""
_HELD_OUT: Final = 5
"""Every fifth run is not trained on and gives the network's sigma."""


@dataclass(frozen=True)
class PaperBlock:
    """Moving samples of one run: features [n, 6], sensor of the same age [n], efficiency estimate [n]."""

    name: str
    features: FloatArray
    sensor_nm: FloatArray
    physics_nm: FloatArray


@dataclass(frozen=True)
class TrainedNetwork:
    """What training gives: the ONNX file, the curve, scores per held-out run (name: network, physics) in Nm^2."""

    data: bytes
    trained: Trained
    metadata: dict[str, Any]
    held_out: dict[str, tuple[float, float]]


def paper_block(name: str, joint: Joint, time_s: FloatArray, columns: JointColumns) -> PaperBlock:
    """Return what the paper's network sees of a run. Raises ValueError for a missing column."""
    if columns.torque_nm is None:
        raise ValueError(f"{name}: joint {joint.name}: the run has no torque_nm")
    settings = EstimatorSettings(method="efficiency")
    run = estimate_columns(joint, settings, None, time_s, columns)
    dt = np.diff(time_s, prepend=time_s[0])
    sensor = low_pass(columns.torque_nm, dt, settings.bandwidth_rad_s)
    keep = (run.status == VALID) & (time_s - time_s[0] > 0.1)
    return PaperBlock(name, run.features[keep], sensor[keep], run.torque_nm[keep])


def thinned(arrays: Sequence[FloatArray]) -> FloatArray:
    """Join arrays, every k-th sample so that no more than SAMPLES are left."""
    step = max(1, -(-sum(len(a) for a in arrays) // SAMPLES))
    return np.concatenate([a[::step] for a in arrays])


def train_paper(
    blocks: Sequence[PaperBlock],
    joint: Joint,
    runs: dict[str, str],
    *,
    iterations: int,
    seed: int,
    progress: Callable[[int, float], None],
) -> TrainedNetwork:
    """Train on four of five runs and test on the others; the network that is written is trained on all runs alike.

    runs: name and SHA-256 of every run. Raises ValueError for fewer than 5.
    """
    if len(blocks) < _HELD_OUT:
        raise ValueError(
            f"found {counted(len(blocks), 'run')}, expected at least {_HELD_OUT}: a network is scored on whole runs"
        )
    held = blocks[_HELD_OUT - 1 :: _HELD_OUT]
    known = [block for n, block in enumerate(blocks) if n % _HELD_OUT != _HELD_OUT - 1]
    judged = _train(known, iterations, seed, progress)
    scores = {}
    for block in held:
        error = network_output(judged, block.features) - block.sensor_nm
        scores[block.name] = (
            float(np.mean(error**2)),
            float(np.mean((block.physics_nm - block.sensor_nm) ** 2)),
        )
    trained = _train(blocks, iterations, seed, progress)
    features = thinned([block.features for block in blocks])
    low, high = np.quantile(features, [_ENVELOPE_SHARE, 1.0 - _ENVELOPE_SHARE], axis=0)
    metadata = {
        "features": list(FEATURES),
        "envelope_low": low.tolist(),
        "envelope_high": high.tolist(),
        "sigma_nm": float(np.sqrt(np.mean([network for network, _ in scores.values()]))),
        "joint": joint.name,
        "data_sha256": digest_of(runs),
        "runs": runs,
    }
    return TrainedNetwork(exported(trained, metadata), trained, metadata, scores)


def split_by_sample(
    blocks: Sequence[PaperBlock], *, iterations: int, seed: int, progress: Callable[[int, float], None]
) -> float:
    """Return the MSE [Nm^2] that a random split by sample claims: 80 % to train on, the rest of the same runs to test.

    Neighbouring samples and each run's own zeros are then on both sides: for comparison only (docs/fit.md).
    """
    features, target = thinned([b.features for b in blocks]), thinned([b.sensor_nm for b in blocks])
    known = np.random.default_rng(seed).random(len(target)) < 0.8
    trained = train(features[known], target[known], iterations=iterations, seed=seed, progress=progress)
    error = network_output(trained, features[~known]) - target[~known]
    return float(np.mean(error**2))


def _train(
    blocks: Sequence[PaperBlock], iterations: int, seed: int, progress: Callable[[int, float], None]
) -> Trained:
    return train(
        thinned([block.features for block in blocks]),
        thinned([block.sensor_nm for block in blocks]),
        iterations=iterations,
        seed=seed,
        progress=progress,
    )


def network_output(trained: Trained, features: FloatArray) -> FloatArray:
    """Return the network's output [n]."""
    return forward(
        trained.weights,
        trained.input_mean,
        trained.input_std,
        trained.output_mean,
        trained.output_std,
        features,
    )


def exported(trained: Trained, metadata: dict[str, Any]) -> bytes:
    """Return the ONNX file."""
    return export_network(
        trained.weights,
        trained.input_mean,
        trained.input_std,
        trained.output_mean,
        trained.output_std,
        metadata,
    )


def digest_of(runs: dict[str, str]) -> str:
    """Return one SHA-256 for a set of run files."""
    import hashlib

    return hashlib.sha256("".join(sorted(runs.values())).encode()).hexdigest()
