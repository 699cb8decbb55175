"""`jtq train`: networks of both joints from emulated runs, as ONNX with metadata and a model card."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.arguments import count, natural, seconds
from estimator.checked import ConfigError
from estimator.network import FEATURES
from estimator.parameters import Joint
from models.files import load_joint, shipped
from sim_can.plant_parameters import load_plant
from sysid.onnx_export import export_network, forward
from sysid.training import Trained, train
from sysid.training_data import RunBlock, data_hash, emulated_blocks

_KEEP_EVERY = 5
"""Samples 5 ms apart: neighbours at 1 kHz differ by noise only."""
_ENVELOPE_SHARE = 1e-4
"""Share of the samples beyond each end of the training envelope: a single outlier must not widen it."""


@dataclass(frozen=True)
class Score:
    """Root mean square errors on runs that were not trained on [Nm]."""

    network_nm: float
    physics_nm: float
    runs: int


def main(argv: list[str]) -> int:
    """Train and write; exit status 0 done, 1 failure, 2 usage."""
    arguments = _parser().parse_args(argv)
    try:
        plant = load_plant(arguments.plant or shipped("plant.yaml"))
        joints = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
        _require_writable(arguments.out)
    except ConfigError as error:
        print(f"jtq train: {error}", file=sys.stderr)
        return 1
    try:
        import torch
    except ImportError:
        print("jtq train: torch is not installed: pip install 'jtqd[train]'", file=sys.stderr)
        return 1
    torch.set_num_threads(2)
    trained_on, held = arguments.runs, arguments.held_out
    pairs = []
    for pair in emulated_blocks(
        plant, joints, range(trained_on + held), arguments.seconds, viscous_drift=0.05
    ):
        pairs.append(pair)
        print(f"emulated run {len(pairs)} of {trained_on + held}", file=sys.stderr)
        if not all(len(block.features) for block in pair):
            print(
                f"jtq train: --seconds: found {arguments.seconds:g}, expected runs long enough for motion: "
                f"run {len(pairs)} has none",
                file=sys.stderr,
            )
            return 1
    result = {}
    for number, joint in enumerate(joints):
        blocks = [pair[number] for pair in pairs]
        result[joint.name] = _train_joint(
            joint, number + 1, blocks[:trained_on], blocks[trained_on:], arguments
        )
    if arguments.json:
        print(json.dumps(result))
    return 0


def _require_writable(directory: Path) -> None:
    """Make the directory and a file in it now: training takes minutes, and its result must not be lost for it.

    Raises:
        ConfigError: files cannot be made there.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        reason = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"--out {directory}: files cannot be made there: {reason}") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jtq train",
        description="Train the network of the paper's section III for both joints on emulated runs.",
        epilog="example: jtq train --out models",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="where joint1.onnx, joint2.onnx and cards go; made if missing",
    )
    parser.add_argument(
        "--plant", type=Path, metavar="FILE", help="bench to emulate (default: the one that ships)"
    )
    parser.add_argument("--runs", type=count, default=16, help="runs to train on (default 16)")
    parser.add_argument("--held-out", type=count, default=4, help="further runs to score on (default 4)")
    parser.add_argument("--seconds", type=seconds, default=30.0, help="length of a run (default 30)")
    parser.add_argument(
        "--iterations", type=count, default=1000, help="full-batch steps (default 1000, as in the paper)"
    )
    parser.add_argument("--seed", type=natural, default=0, help="of the initial weights")
    parser.add_argument("--json", action="store_true", help="print the scores as JSON")
    return parser


def _train_joint(
    joint: Joint, number: int, blocks: list[RunBlock], held_out: list[RunBlock], arguments: argparse.Namespace
) -> dict[str, Any]:
    features = np.concatenate([block.features[::_KEEP_EVERY] for block in blocks])
    sensor = np.concatenate([block.sensor_nm[::_KEEP_EVERY] for block in blocks])

    def progress(n: int, loss: float) -> None:
        if n % 100 == 99:
            print(f"{joint.name}: iteration {n + 1}, mse {loss:.4f} Nm^2", file=sys.stderr)

    trained = train(features, sensor, iterations=arguments.iterations, seed=arguments.seed, progress=progress)
    score = _score(trained, held_out)
    low, high = np.quantile(features, [_ENVELOPE_SHARE, 1.0 - _ENVELOPE_SHARE], axis=0)
    metadata = {
        "features": list(FEATURES),
        "envelope_low": low.tolist(),
        "envelope_high": high.tolist(),
        "sigma_nm": score.network_nm,
        "joint": joint.name,
        "data_sha256": data_hash(blocks),
    }
    data = export_network(
        trained.weights,
        trained.input_mean,
        trained.input_std,
        trained.output_mean,
        trained.output_std,
        metadata,
    )
    path = arguments.out / f"joint{number}.onnx"
    path.write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    card = _card(joint, score, trained, metadata, digest, len(blocks), len(features), arguments)
    path.with_suffix(".md").write_text(card, encoding="utf-8")
    print(
        f"{path}  sha256 {digest}\n  held-out RMSE {score.network_nm:.3f} Nm on {score.runs} runs, "
        f"physics alone {score.physics_nm:.3f} Nm",
        file=sys.stderr if arguments.json else sys.stdout,
    )
    return {
        "path": str(path),
        "sha256": digest,
        "rmse_nm": score.network_nm,
        "physics_rmse_nm": score.physics_nm,
    }


def _score(trained: Trained, held_out: list[RunBlock]) -> Score:
    features = np.concatenate([block.features for block in held_out])
    sensor = np.concatenate([block.sensor_nm for block in held_out])
    physics = np.concatenate([block.physics_nm for block in held_out])
    predicted = forward(
        trained.weights,
        trained.input_mean,
        trained.input_std,
        trained.output_mean,
        trained.output_std,
        features,
    )
    return Score(_rms(predicted - sensor), _rms(physics - sensor), len(held_out))


def _rms(error: np.ndarray[Any, Any]) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _card(  # noqa: PLR0917 - what the card shows, in its order
    joint: Joint,
    score: Score,
    trained: Trained,
    metadata: dict[str, Any],
    digest: str,
    runs: int,
    samples: int,
    arguments: argparse.Namespace,
) -> str:
    rows = "\n".join(
        f"| {name} | {low:.4g} | {high:.4g} |"
        for name, low, high in zip(FEATURES, metadata["envelope_low"], metadata["envelope_high"], strict=True)
    )
    return f"""# Network of {joint.name}

Input 6, hidden 20-40-10 with sigma(x) = tanh(x/2), one output: joint torque in Nm (paper, section III). Normalisation is
inside the graph; float64.

| | |
|---|---|
| sha256 | `{digest}` |
| trained on | {runs} emulated runs of {arguments.seconds:g} s, {samples} samples, sha256 `{metadata["data_sha256"]}` |
| iterations, last loss | {arguments.iterations}, {trained.losses[-1]:.4f} Nm^2 |
| held-out RMSE | {score.network_nm:.3f} Nm on {score.runs} other runs (this is its sigma) |
| physics alone, same runs | {score.physics_nm:.3f} Nm |

Emulated runs: random Fourier bursts with rests, viscous friction off by 5 % (standard deviation) from run to run, moving
samples only. It knows no other bench than the emulated one: on real joints it must be trained again.

Made by `jtq train --runs {arguments.runs} --held-out {arguments.held_out} --seconds {arguments.seconds:g} \
--iterations {arguments.iterations} --seed {arguments.seed}`.

| feature | low | high |
|---|---|---|
{rows}

Outside this envelope the estimate fades to physics and its status is 3 (degraded).
"""
