"""Training of the paper's network (section III): 6-20-40-10-1, sigma(x) = tanh(x/2), on standardised data, with torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Layer = tuple[FloatArray, FloatArray]

HIDDEN = (20, 40, 10)


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
    progress: Callable[[int, float], None] = lambda n, loss: None,
) -> Trained:
    """Fit by Adam with a cosine schedule on the whole set; the same seed gives the same weights.

    Args:
        features: [n, 6], the estimator's features.
        target_nm: [n], sensor torque.
        iterations: full-batch steps.
        seed: of the initial weights.
        progress: called with iteration and loss [Nm^2].
    """
    import torch

    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True)
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
    output_mean, output_std = float(target_nm.mean()), float(target_nm.std())
    x = torch.tensor((features - mean) / std, dtype=torch.float32)
    y = torch.tensor((target_nm - output_mean) / output_std, dtype=torch.float32)[:, None]
    layers = _layers(features.shape[1])
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, eta_min=1e-4)
    losses = []
    for n in range(iterations):
        optimiser.zero_grad()
        loss = torch.mean((_forward(layers, x) - y) ** 2)
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()) * output_std**2)
        progress(n, losses[-1])
    weights = [
        (layer.weight.detach().numpy().T.astype(np.float64), layer.bias.detach().numpy().astype(np.float64))
        for layer in layers
    ]
    return Trained(weights, mean, std, output_mean, output_std, losses)


def _layers(inputs: int) -> list:  # type: ignore[type-arg]  # torch is optional and untyped here
    import torch

    sizes = (inputs, *HIDDEN, 1)
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
