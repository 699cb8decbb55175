"""Training of fully connected networks with the paper's activation sigma(x) = tanh(x/2), on standardised data, with torch.

The same data and seed give the same weights: one thread, deterministic algorithms, every random choice from the seed.
One thread is also the fastest way: the layers are so small that two threads mostly wait for each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
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
