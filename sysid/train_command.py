"""`jtq train`: a network per joint from runs, as ONNX with its metadata and a model card in words and figures."""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from estimator.arguments import count, natural
from estimator.checked import ConfigError
from estimator.parameters import Joint
from estimator.run import RunTableError
from models.files import load_joint
from sim_can.run_files import RunError
from sysid.fit_inputs import InputRun, channel_findings, joint_number, progress, read_runs
from sysid.fused_training import train_fused
from sysid.loss_fit import LossFitError
from sysid.loss_fit_command import signals_of
from sysid.model_card import write_card
from sysid.paper_network import TrainedNetwork, paper_block, split_by_sample, train_paper
from sysid.torsion_fit import TorsionError

_ITERATIONS = {"paper": 1000, "ours": 200}
_EXAMPLES = """examples:
  jtq train campaigns/excitation --joint joint1.yaml --joint joint2.yaml --network paper --out models
  jtq train campaigns/excitation --joint joint1.fused.yaml --network ours --out models
"""


def main(argv: list[str]) -> int:
    """Train and write; exit status 0 done, 1 failure, 2 usage, 3 findings in the data (then nothing is written)."""
    options = _parser().parse_args(argv)
    try:
        joints = [load_joint(path) for path in options.joint]
        _require_writable(options.out)
        missing = [name for name in ("torch", "onnx", "matplotlib") if importlib.util.find_spec(name) is None]
        if missing:
            raise ConfigError(f"{', '.join(missing)}: not installed: pip install 'jtqd[train]'")
        runs = read_runs(options.runs, options.columns)
        numbers = [joint_number(options.number, joint, runs) for joint in joints]
        findings = [
            finding
            for joint, number in zip(joints, numbers, strict=True)
            for finding in channel_findings(runs, number, joint)
        ]
        if findings:
            for finding in findings:
                print(f"jtq train: {finding.text}", file=sys.stderr)
            return 3
        result = {
            joint.name: _train_joint(joint, number, runs, options)
            for joint, number in zip(joints, numbers, strict=True)
        }
    except (ConfigError, RunError, RunTableError, LossFitError, TorsionError, ValueError, OSError) as error:
        print(f"jtq train: {error}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(result, indent=1))
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
        description="Train a network per joint on recorded runs; split by run, never by sample.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUNS", help="run files (.csv, .csv.gz) or directories of them"
    )
    parser.add_argument(
        "--joint",
        type=Path,
        action="append",
        required=True,
        metavar="FILE",
        help="joint file; may be repeated",
    )
    parser.add_argument(
        "--number",
        type=int,
        choices=range(1, 8),
        metavar="N",
        help="which joint of the runs it is (default: the number its name ends in)",
    )
    parser.add_argument(
        "--network",
        choices=sorted(_ITERATIONS),
        required=True,
        help="paper: section III, absolute angles, 6-20-40-10-1; ours: correction to the fused physics, 7-16-16-4",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="where networks and cards go; made if missing"
    )
    parser.add_argument(
        "--iterations", type=count, help="default 1000 for the paper's (as in the paper), 200 for ours"
    )
    parser.add_argument(
        "--show-leakage",
        action="store_true",
        help="paper's network: also print what a split by sample would have claimed",
    )
    parser.add_argument("--seed", type=natural, default=0, help="of weights and batches (default 0)")
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )
    parser.add_argument("--json", action="store_true", help="print paths, hashes and scores as JSON")
    return parser


def _train_joint(
    joint: Joint, number: int, runs: list[InputRun], options: argparse.Namespace
) -> dict[str, Any]:
    iterations = options.iterations or _ITERATIONS[options.network]
    claimed = None
    hashes = {Path(run.name).name: run.sha256 for run in runs}

    def say(n: int, loss: float) -> None:
        if (n + 1) % 100 == 0:
            print(f"{joint.name}: iteration {n + 1} of {iterations}, mse {loss:.4f} Nm^2", file=sys.stderr)

    settings = {"iterations": iterations, "seed": options.seed, "progress": say}
    if options.network == "ours":
        result = train_fused(signals_of(runs, number, joint), joint, hashes, **settings)
        name = f"{joint.name}.fused"
    else:
        blocks = [
            paper_block(run.name, joint, run.table.time_s, run.table.joint(number, joint.gear_ratio))
            for run in progress(runs, f"observing {joint.name}")
        ]
        result = train_paper(blocks, joint, hashes, **settings)
        name = joint.name
        if options.show_leakage:
            claimed = split_by_sample(blocks, **settings)
    path = options.out / f"{name}.onnx"
    path.write_bytes(result.data)
    digest = hashlib.sha256(result.data).hexdigest()
    write_card(path, joint, options.network, result, digest)
    network, physics = (_mean(result, k) for k in (0, 1))
    print(
        f"{path}  sha256 {digest}\n  on {len(result.held_out)} runs it was not trained on: MSE {network:.3f} Nm^2, "
        f"the physics it builds on {physics:.3f} Nm^2",
        file=sys.stderr if options.json else sys.stdout,
    )
    share = result.metadata.get("share", 1.0)
    if share < 1.0:
        nothing = "" if share else ": it harms some of them, and what is estimated is the physics"
        print(
            f"  share of its correction that helps on them and harms none: {share:.2f}{nothing}",
            file=sys.stderr if options.json else sys.stdout,
        )
    if claimed is not None:
        print(
            f"  split by sample, the same data would claim an MSE of {claimed:.3f} Nm^2",
            file=sys.stderr if options.json else sys.stdout,
        )
    return {
        "path": str(path),
        "split_by_sample_mse_nm2": claimed,
        "sha256": digest,
        "network_mse_nm2": network,
        "physics_mse_nm2": physics,
        "share": share,
        "runs": len(result.held_out),
    }


def _mean(result: TrainedNetwork, which: int) -> float:
    return sum(score[which] for score in result.held_out.values()) / max(len(result.held_out), 1)
