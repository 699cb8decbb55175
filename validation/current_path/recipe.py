"""The network of the current path: inputs from one encoder's signals, target, training, estimate. Pure.

    tau = tau_r + f(x)          tau_r = G [ r/(s+r) (Kt i + J r w) - J r w ]: motor torque less the rotor's, r = 200 rad/s

f is a perceptron with tanh(x/2) (`sysid.train.network`). It learns what is left of the teacher's torque, unfiltered, so it
gives the torque of the same instant: losses, and what the low pass is behind. x [n, 28], in this order:

    tau_r at 200; at 800, 50, 10 rad/s less that at 200                      Nm, joint side
    current                                                                  A
    velocity v = w/G; low-passed at 50, 10, 2 rad/s less v                   rad/s
    acceleration, 100 (v - low pass of v at 100 rad/s)                       rad/s^2
    tanh(v/0.03)                                                             -
    temperature                                                              degC
    sin, cos of 1, 2, 4 times the motor angle, of 1, 2 times that over G     -
    four stop operators of the motor angle, travels 0.02, 0.07, 0.25, 0.8    -1 .. 1
    the third of them times |tau_r|, times sqrt|v|                           Nm, (rad/s)^(1/2)

Memory: four stop operators and eight first-order states. Stop operators begin in the middle of what is possible.

Training: AdamW, one cycle of the rate, Huber loss, batches of random samples; whole runs are left out, and the weights are
those of the epoch that was best on them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.observer import low_pass, slipped
from jtqd.estimator.run import JointColumns
from jtqd.sysid.train.network import HIDDEN, Layer, Trained, network_output

BASE_RAD_S: Final = 200.0
OTHERS_RAD_S: Final = (800.0, 50.0, 10.0)
VELOCITY_RAD_S: Final = (50.0, 10.0, 2.0)
ACCELERATION_RAD_S: Final = 100.0
DIRECTION_RAD_S: Final = 0.03
MOTOR_ORDERS: Final = (1, 2, 4)
LINK_ORDERS: Final = (1, 2)
TRAVELS_RAD: Final = (0.02, 0.07, 0.25, 0.8)
_OF_PRODUCTS: Final = 2
"""The stop operator that load and speed are multiplied with."""
INPUTS: Final = 28


class Seen(NamedTuple):
    """Of one joint in one run: inputs [n, INPUTS] and tau_r [n]."""

    inputs: FloatArray
    base_nm: FloatArray


def seen(joint: Joint, time_s: FloatArray, columns: JointColumns) -> Seen:
    """Return what the network sees of a run. Raises ValueError for a run without one of the columns."""
    named = {
        name: getattr(columns, name)
        for name in ("current_a", "motor_position_rad", "motor_velocity_rad_s", "temperature_c")
    }
    if missing := [name for name, column in named.items() if column is None]:
        raise ValueError(f"found no {', '.join(missing)}, expected all inputs of the current path")
    current, angle, omega, temperature = named.values()
    dt, ratio = np.diff(time_s, prepend=time_s[0]), joint.gear_ratio
    v = omega / ratio

    def motor_nm(rate: float) -> FloatArray:
        momentum = joint.rotor_inertia_kgm2 * rate * omega
        passed = low_pass(joint.torque_constant_nm_per_a * current + momentum, dt, rate)
        return np.asarray(ratio * (passed - momentum))

    base = motor_nm(BASE_RAD_S)
    stops = [slipped(angle, travel)[0] for travel in TRAVELS_RAD]
    turns = [order * angle for order in MOTOR_ORDERS] + [order * angle / ratio for order in LINK_ORDERS]
    columns_of = [
        base,
        *(motor_nm(rate) - base for rate in OTHERS_RAD_S),
        current,
        v,
        *(low_pass(v, dt, rate) - v for rate in VELOCITY_RAD_S),
        ACCELERATION_RAD_S * (v - low_pass(v, dt, ACCELERATION_RAD_S)),
        np.tanh(v / DIRECTION_RAD_S),
        temperature,
        *(wave(turn) for turn in turns for wave in (np.sin, np.cos)),
        *stops,
        np.abs(base) * stops[_OF_PRODUCTS],
        np.sqrt(np.abs(v)) * stops[_OF_PRODUCTS],
    ]
    return Seen(np.column_stack(columns_of), base)


class Block(NamedTuple):
    """Of one run: inputs [n, INPUTS] and what is to be learned [n], the teacher's torque less tau_r."""

    inputs: FloatArray
    target_nm: FloatArray


EVERY: Final = 12
"""Neighbours at 1 kHz are alike."""


def block(known: Seen, teacher_nm: FloatArray, settled: np.ndarray[Any, np.dtype[np.bool_]]) -> Block:
    """Return every EVERY-th sample that is settled and that the teacher knows; teacher_nm [n], NaN where it does not."""
    keep = np.flatnonzero(settled & np.isfinite(teacher_nm) & np.isfinite(known.inputs).all(axis=1))[::EVERY]
    return Block(known.inputs[keep], (teacher_nm - known.base_nm)[keep])


@dataclass(frozen=True)
class Recipe:
    """How a network is trained. knee: of the Huber loss, in standard deviations of the target; stop: one run of so many is
    left out, beginning with number `member`.
    """

    hidden: tuple[int, ...] = HIDDEN
    epochs: int = 110
    fewest_steps: int = 4000
    batch: int = 1024
    rate: float = 4e-3
    weight_decay: float = 1e-3
    knee: float = 0.15
    stop: int = 6
    member: int = 0
    seed: int = 0


USUAL: Final = Recipe()


def train(blocks: Sequence[Block], recipe: Recipe = USUAL) -> Trained:
    """Return the network of these runs; the same runs and recipe give the same weights. ValueError for fewer than two."""
    import torch

    if len(blocks) < 2:
        raise ValueError(f"found {len(blocks)} runs, expected at least 2")
    torch.set_num_threads(1)
    torch.manual_seed(recipe.seed)
    torch.use_deterministic_algorithms(True)
    out = [k % recipe.stop == recipe.member for k in range(len(blocks))]
    if not any(out):
        out[-1] = True
    parts = {
        held: [each for each, of in zip(blocks, out, strict=True) if of == held] for held in (False, True)
    }
    raw = np.concatenate([each.inputs for each in parts[False]])
    wanted = np.concatenate([each.target_nm for each in parts[False]])
    mean, std = raw.mean(axis=0), np.maximum(raw.std(axis=0), 1e-6)
    centre, spread = float(wanted.mean()), max(float(wanted.std()), 1e-6)

    def tensors(some: Sequence[Block]) -> tuple[Any, Any]:
        x = (np.concatenate([each.inputs for each in some]) - mean) / std
        y = (np.concatenate([each.target_nm for each in some]) - centre) / spread
        return torch.tensor(x, dtype=torch.float32), torch.tensor(y, dtype=torch.float32)[:, None]

    (x, y), (held_x, held_y) = tensors(parts[False]), tensors(parts[True])
    layers = [torch.nn.Linear(a, b) for a, b in pairwise((raw.shape[1], *recipe.hidden, 1))]
    for layer in layers[:-1]:
        torch.nn.init.xavier_uniform_(layer.weight, gain=2.0)  # tanh(x/2) has slope 1/2 at zero
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    optimiser = torch.optim.AdamW(parameters, lr=recipe.rate, weight_decay=recipe.weight_decay)
    batches = max(-(-len(x) // recipe.batch), 1)
    epochs = max(recipe.epochs, -(-recipe.fewest_steps // batches))
    rates = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, recipe.rate, total_steps=epochs * batches, pct_start=0.1, final_div_factor=1e3
    )

    def loss_of(some_x: Any, some_y: Any) -> Any:
        found = some_x
        for layer in layers[:-1]:
            found = torch.tanh(0.5 * layer(found))
        return torch.nn.functional.huber_loss(layers[-1](found), some_y, delta=recipe.knee)

    best, kept, losses = np.inf, _weights(layers), []
    for _ in range(epochs):
        for part in torch.randperm(len(x)).tensor_split(batches):
            optimiser.zero_grad(set_to_none=True)
            loss_of(x[part], y[part]).backward()
            optimiser.step()
            rates.step()
        with torch.no_grad():
            losses.append(float(loss_of(held_x, held_y)))
        if losses[-1] < best:
            best, kept = losses[-1], _weights(layers)
    return Trained(kept, mean, std, centre, spread, losses)


def _weights(layers: Sequence[Any]) -> list[Layer]:
    return [
        (each.weight.detach().numpy().T.astype(np.float64), each.bias.detach().numpy().astype(np.float64))
        for each in layers
    ]


def estimate_nm(trained: Trained, known: Seen) -> FloatArray:
    """Return the torque [n] of the current path."""
    result: FloatArray = known.base_nm + network_output(trained, known.inputs)
    return result


def describe(trained: Trained) -> Mapping[str, Any]:
    """Return sizes and the course of the training, for a report."""
    return {"layers": [w.shape for w, _ in trained.weights], "held_out_loss": list(trained.losses)}
