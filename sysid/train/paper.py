"""Train the paper's network (section III) on runs: its six features, sensor torque as target, 6-20-40-10-1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.network import FEATURES
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import VALID
from jtqd.estimator.text import counted
from jtqd.sysid.train.network import Trained, export_network, forward, train

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
