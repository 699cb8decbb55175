"""Train fully connected networks with the paper's activation on standardised data, and export them as ONNX.

    y = mean_y + std_y (W_n h_n + b_n),  h_(k+1) = sigma(h_k W_k + b_k),  h_0 = (x - mean_x)/std_x
    sigma(x) = (1 - e^-x)/(1 + e^-x) = tanh(x/2), Eq. (9)

The same data and seed give the same weights: one thread, deterministic algorithms, every random choice from the seed.
One thread is also the fastest: the layers are so small that two threads mostly wait for each other.

In the graph (float64, with metadata) the normalisation and the factor 1/2 are folded into the weights of a plain tanh; the
result is tested against `network_output`, which is Eq. (9) itself.

The paper's network (section III): six features, sensor torque as target, 6-20-40-10-1.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import FEATURES, PERCEPTRON, perceptron_content
from jtqd.estimator.observer import low_pass
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
SAMPLES: Final = 200_000
"""More are thinned out: neighbours at 1 kHz differ by noise only."""
OPSET: Final = 17
IR_VERSION: Final = 9  # what the oldest supported onnxruntime reads
_RATE = 0.01


@dataclass(frozen=True)
class Trained:
    """Weights (W [inputs, outputs], b [outputs]) per layer, the standardisation, and the loss of each iteration [Nm^2].

    Raises ValueError for shapes that do not fit, or a standard deviation that is not > 0.
    """

    weights: Sequence[Layer]
    input_mean: FloatArray
    input_std: FloatArray
    output_mean: float
    output_std: float
    losses: Sequence[float] = ()

    def __post_init__(self) -> None:
        width = len(self.input_mean)
        for n, (w, b) in enumerate(self.weights):
            if w.ndim != 2 or w.shape[0] != width or b.shape != (w.shape[1],):
                raise ValueError(
                    f"layer {n}: found W {w.shape} and b {b.shape}, expected W ({width}, m) and b (m,)"
                )
            width = w.shape[1]
        if not self.weights:
            raise ValueError("found no layer, expected at least 1")
        if np.shape(self.input_std) != np.shape(self.input_mean) or not (
            np.all(self.input_std > 0.0) and self.output_std > 0.0
        ):
            raise ValueError("found a standard deviation that is not > 0, or not one per input")


class Schedule(NamedTuple):
    """Of one training. iterations: each BATCHES batches of BATCH samples, or all where there are fewer; seed: of initial
    weights and batches; progress: called with iteration and mean loss [Nm^2].
    """

    iterations: int
    seed: int
    progress: Callable[[int, float], None] = lambda n, loss: None


class Steps(NamedTuple):
    """Of `descend`. used: samples of an epoch, in so many batches; knee: of a Huber loss, None for the mean square; seed: of
    initial weights and batches.
    """

    hidden: tuple[int, ...]
    epochs: int
    used: int
    batches: int
    rate: float
    seed: int
    weight_decay: float = 0.0
    knee: float | None = None


def descend(
    x: FloatArray, y: FloatArray, steps: Steps, after: Callable[[int, float, Any, Any], None]
) -> list[Layer]:
    """Return the weights of standardised inputs [n, inputs] and outputs [n], by AdamW, the rate rising and falling once.

    after(number, mean loss, function of the loss of (x, y), function of the weights so far) is called after every epoch.
    """
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(steps.seed)
    torch.use_deterministic_algorithms(True)

    def tensors(some_x: FloatArray, some_y: FloatArray) -> tuple[Any, Any]:
        return torch.tensor(some_x, dtype=torch.float32), torch.tensor(some_y, dtype=torch.float32)[:, None]

    inputs, outputs = tensors(x, y)
    layers = [torch.nn.Linear(a, b) for a, b in pairwise((x.shape[1], *steps.hidden, 1))]
    for layer in layers[:-1]:
        # tanh(x/2) has slope 1/2 at zero: Xavier's gain doubles (Glorot and Bengio 2010).
        torch.nn.init.xavier_uniform_(layer.weight, gain=2.0)
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    optimiser = torch.optim.AdamW(parameters, lr=steps.rate, weight_decay=steps.weight_decay)
    rates = torch.optim.lr_scheduler.OneCycleLR(
        optimiser,
        max_lr=steps.rate,
        total_steps=steps.epochs * steps.batches,
        pct_start=0.1,
        final_div_factor=1e3,
    )

    def loss_of(some_x: Any, some_y: Any) -> Any:
        for layer in layers[:-1]:
            some_x = torch.tanh(0.5 * layer(some_x))
        found = layers[-1](some_x)
        if steps.knee is None:
            return torch.nn.functional.mse_loss(found, some_y)
        return torch.nn.functional.huber_loss(found, some_y, delta=steps.knee)

    def judged(some_x: FloatArray, some_y: FloatArray) -> float:
        with torch.no_grad():
            return float(loss_of(*tensors(some_x, some_y)))

    def weights() -> list[Layer]:
        parts = [(layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in layers]
        return [(w.astype(np.float64), b.astype(np.float64)) for w, b in parts]

    for n in range(steps.epochs):
        total = 0.0
        for part in torch.randperm(len(inputs))[: steps.used].tensor_split(steps.batches):
            optimiser.zero_grad(set_to_none=True)
            loss = loss_of(inputs[part], outputs[part])
            loss.backward()
            optimiser.step()
            rates.step()
            total += loss.item() * len(part)
        after(n, total / steps.used, judged, weights)
    return weights()


def train(
    features: Sequence[FloatArray],
    target_nm: Sequence[FloatArray],
    schedule: Schedule,
    *,
    hidden: tuple[int, ...] = HIDDEN,
) -> Trained:
    """Fit the sensor's torque, target_nm [n] of each run, by features [n, inputs]; mean square error in random batches."""
    raw, target = thinned(features), thinned(target_nm)
    mean, std = raw.mean(axis=0), np.maximum(raw.std(axis=0), 1e-9)
    output_mean, output_std = float(target.mean()), max(float(target.std()), 1e-9)
    used, losses = min(len(raw), BATCH * BATCHES), []

    def after(n: int, loss: float, *_: Any) -> None:
        losses.append(loss * output_std**2)
        schedule.progress(n, losses[-1])

    steps = Steps(hidden, schedule.iterations, used, -(-used // BATCH), _RATE, schedule.seed)
    weights = descend((raw - mean) / std, (target - output_mean) / output_std, steps, after)
    return Trained(weights, mean, std, output_mean, output_std, losses)


def thinned(arrays: Sequence[FloatArray]) -> FloatArray:
    """Join arrays, every k-th sample so that no more than SAMPLES are left."""
    step = max(1, -(-sum(map(len, arrays)) // SAMPLES))
    return np.concatenate([each[::step] for each in arrays])


def network_output(trained: Trained, x: FloatArray) -> FloatArray:
    """Return the output [n] for x [n, inputs], by Eq. (9): what the exported graph must equal."""
    h: FloatArray = (x - trained.input_mean) / trained.input_std
    for n, (w, b) in enumerate(trained.weights):
        h = h @ w + b
        if n < len(trained.weights) - 1:
            h = (1.0 - np.exp(-h)) / (1.0 + np.exp(-h))
    result: FloatArray = trained.output_mean + trained.output_std * h[:, 0]
    return result


def _folded(trained: Trained) -> list[Layer]:
    """Weights of the same function over plain tanh and raw quantities: the standardisation and the factor 1/2 go in.

    (x - m)/s W + b = x (W/s) + (b - (m/s) W); each node of a graph costs about 1 us per call, whatever its size.
    """
    layers = list(trained.weights)
    w, b = layers[0]
    layers[0] = (
        w / trained.input_std[:, None],
        b - (trained.input_mean / trained.input_std) @ w,
    )
    *hidden, (w, b) = layers
    last = w * trained.output_std, b * trained.output_std + trained.output_mean
    return [*((0.5 * w, 0.5 * b) for w, b in hidden), last]


def export_network(trained: Trained, metadata: Mapping[str, Any]) -> bytes:
    """Return the ONNX file of a network.

    metadata: key to JSON-able value (estimator/network.py); the weights for native evaluation are added. Raises ValueError
    where the last layer has not one output. Needs the package onnx (extra `train`).
    """
    from onnx import TensorProto, helper, numpy_helper

    layers = _folded(trained)
    if len(layers[-1][1]) != 1:
        raise ValueError(f"found {len(layers[-1][1])} outputs, expected 1")
    constants: dict[str, FloatArray] = {}
    nodes, name = [], "x"
    for n, (w, b) in enumerate(layers):
        constants[f"W{n}"], constants[f"b{n}"] = w, b
        last = n == len(layers) - 1
        gemm = "torque_nm" if last else f"g{n}"
        nodes.append(helper.make_node("Gemm", [name, f"W{n}", f"b{n}"], [gemm]))
        if not last:
            name = f"h{n + 1}"
            nodes.append(helper.make_node("Tanh", [gemm], [name]))
    graph = helper.make_graph(
        nodes,
        "joint_torque",
        [helper.make_tensor_value_info("x", TensorProto.DOUBLE, ["N", len(trained.input_mean)])],
        [helper.make_tensor_value_info("torque_nm", TensorProto.DOUBLE, ["N", 1])],
        [numpy_helper.from_array(np.asarray(value, np.float64), key) for key, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="jtqd")
    model.ir_version = IR_VERSION
    values = {**metadata, PERCEPTRON: perceptron_content(layers)}
    helper.set_model_props(model, {key: json.dumps(value) for key, value in values.items()})
    data: bytes = model.SerializeToString()
    return data


@dataclass(frozen=True)
class TrainedNetwork:
    """What training gives: the ONNX file, the curve, scores per held-out run (name: network, physics) in Nm^2."""

    data: bytes
    trained: Trained
    metadata: dict[str, Any]
    held_out: dict[str, tuple[float, float]]


def origin(joint: Joint, runs: Mapping[str, str]) -> dict[str, Any]:
    """Return the part of a network's metadata that names joint and runs; runs: name and SHA-256 of every run."""
    digest = hashlib.sha256("".join(sorted(runs.values())).encode()).hexdigest()
    return {"joint": joint.name, "data_sha256": digest, "runs": dict(runs)}


# The paper's network -----------------------------------------------------------------------------------

_ENVELOPE_SHARE: Final = 1e-4
"""Share of the samples beyond each end of the training envelope: a single outlier must not widen it."""
_HELD_OUT: Final = 5
"""Every fifth run is not trained on and gives the network's sigma."""


class PaperBlock(NamedTuple):
    """Moving samples of one run: features [n, 6], sensor of the same age [n], efficiency estimate [n]."""

    name: str
    features: FloatArray
    sensor_nm: FloatArray
    physics_nm: FloatArray


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


def train_paper(
    blocks: Sequence[PaperBlock], joint: Joint, runs: Mapping[str, str], schedule: Schedule
) -> TrainedNetwork:
    """Train on four of five runs and test on the others; the network that is written is trained on all runs alike.

    runs: name and SHA-256 of every run. Raises ValueError for fewer than 5.
    """
    if len(blocks) < _HELD_OUT:
        raise ValueError(
            f"found {counted(len(blocks), 'run')}, expected at least {_HELD_OUT}: a network is scored on whole runs"
        )

    def trained_on(own: Sequence[PaperBlock]) -> Trained:
        return train([each.features for each in own], [each.sensor_nm for each in own], schedule)

    judged = trained_on([block for n, block in enumerate(blocks) if n % _HELD_OUT != _HELD_OUT - 1])
    scores = {}
    for block in blocks[_HELD_OUT - 1 :: _HELD_OUT]:
        error = network_output(judged, block.features) - block.sensor_nm
        physics = block.physics_nm - block.sensor_nm
        scores[block.name] = float(np.mean(error**2)), float(np.mean(physics**2))
    trained = trained_on(blocks)
    features = thinned([block.features for block in blocks])
    low, high = np.quantile(features, [_ENVELOPE_SHARE, 1.0 - _ENVELOPE_SHARE], axis=0)
    metadata = {
        "features": list(FEATURES),
        "envelope_low": low.tolist(),
        "envelope_high": high.tolist(),
        "sigma_nm": float(np.sqrt(np.mean([network for network, _ in scores.values()]))),
        **origin(joint, runs),
    }
    return TrainedNetwork(export_network(trained, metadata), trained, metadata, scores)


def split_by_sample(blocks: Sequence[PaperBlock], schedule: Schedule) -> float:
    """Return the MSE [Nm^2] that a random split by sample claims: 80 % to train on, the rest of the same runs to test.

    Neighbouring samples and each run's own zeros are then on both sides: for comparison only (docs/fit.md).
    """
    features, target = thinned([b.features for b in blocks]), thinned([b.sensor_nm for b in blocks])
    known = np.random.default_rng(schedule.seed).random(len(target)) < 0.8
    trained = train([features[known]], [target[known]], schedule)
    error = network_output(trained, features[~known]) - target[~known]
    return float(np.mean(error**2))
