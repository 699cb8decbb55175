"""`jtq train`: train a network per joint on runs; write it as ONNX with metadata, a model card and a figure."""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.estimator.command_line import check_installed, command_parser, count, make_directory, natural
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import whole_file, write_whole
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint
from jtqd.sysid.fit.signals import two_encoders
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.checks import channel_findings
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.options import add_columns, add_number, add_runs, joint_number, only
from jtqd.sysid.runs.run_file import RunFile
from jtqd.sysid.train.current_path import USUAL, Gate, PathRun, gate_of, train_path
from jtqd.sysid.train.network import Schedule, TrainedNetwork, paper_block, split_by_sample, train_paper

_WHAT = {
    "paper": "The paper's network (section III): current, angles and velocities of both sides and the efficiency "
    "estimate in, torque out; sigma(x) = tanh(x/2). Its absolute angles can identify single runs; for comparison only.",
    "ours": "Torque of the current path from the signals of one encoder (docs/estimator.md); sigma(x) = tanh(x/2). Outside "
    "of the runs below its sigma grows and its share falls.",
}


def write_card(
    path: Path, joint: Joint, kind: str, result: TrainedNetwork, digest: str, *, gate: Gate | None = None
) -> None:
    """Write path.md and path.png beside the ONNX file `path`."""
    picture, trained, metadata = path.with_suffix(".png"), result.trained, result.metadata
    _draw(picture, joint, result)
    shape = "-".join(str(len(b)) for _, b in trained.weights)
    means = np.mean(list(result.held_out.values()), axis=0)
    lines = [
        f"# {path.name}",
        "",
        _WHAT[kind],
        "",
        f"- Joint: {joint.name}. File: sha256 {digest}",
        f"- Layers: {len(trained.input_mean)}-{shape}, float64, normalisation folded into the weights",
        f"- Trained: {len(trained.losses)} iterations, last loss {trained.losses[-1]:.4f}; Python "
        f"{platform.python_version()}, one thread, so that the same runs and seed give the same file",
        f"- Data: {len(metadata['runs'])} runs, digest {metadata['data_sha256']}",
    ]
    if gate is not None:
        lines.append(f"- Gate: {gate.text}")
    lines += [
        "",
        "## On runs it was not trained on",
        "",
        "| run | network, MSE Nm^2 | physics without network, MSE Nm^2 |",
        "|---|---|---|",
        *(f"| {name} | {net:.3f} | {physics:.3f} |" for name, (net, physics) in result.held_out.items()),
        f"| mean | {means[0]:.3f} | {means[1]:.3f} |",
        "",
        f"![loss curve and scores]({picture.name})",
        "",
        "## Training envelope",
        "",
        *_envelope(metadata),
        "",
        "## Files of the data",
        "",
        *(f"- {name} {sha}" for name, sha in metadata["runs"].items()),
        "",
    ]
    write_whole(path.with_suffix(".md"), "\n".join(lines).encode())


def _envelope(metadata: Mapping[str, Any]) -> list[str]:
    if "envelope" not in metadata:
        rows = zip(metadata["features"], metadata["envelope_low"], metadata["envelope_high"], strict=True)
        return [
            "| feature | from | to |",
            "|---|---|---|",
            *(f"| {n} | {a:.4g} | {b:.4g} |" for n, a, b in rows),
        ]
    envelope = metadata["envelope"]
    known = np.array(envelope["known"])
    t = envelope["temperature_c"]
    return [
        f"- {int(known.sum())} of {known.size} cells of {envelope['velocity_step_rad_s']} rad/s by "
        f"{envelope['torque_step_nm']} Nm of motor torque",
        "- temperature: not used" if t is None else f"- temperature from {t[0]:.1f} to {t[1]:.1f} degC",
        f"- half width of the interval at rest {metadata['rest_nm'][0]:.2f} Nm; at most {metadata['quick'][0]:.3g} rad/s^2",
        f"- factor on sigma per quadrant: {', '.join(f'{s:.2f}' for s in metadata['sigma']['scale'])}",
    ]


def _draw(picture: Path, joint: Joint, result: TrainedNetwork) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    axes[0].semilogy(np.arange(1, len(result.trained.losses) + 1), result.trained.losses, lw=1.2)
    axes[0].set(xlabel="iteration", ylabel="loss", title=f"{joint.name}: training")
    scores = np.array(list(result.held_out.values()))
    top = 1.05 * float(scores.max())
    axes[1].plot([0, top], [0, top], color="0.6", lw=0.8)
    axes[1].plot(scores[:, 1], scores[:, 0], "o", ms=4)
    axes[1].set(xlabel="without network, MSE Nm²", ylabel="network, MSE Nm²", title="held-out runs")
    for axis in axes:
        axis.grid(alpha=0.3)
    with whole_file(picture) as file:
        figure.savefig(file, format="png", dpi=110)
    plt.close(figure)


_ITERATIONS = {"paper": 1000, "ours": USUAL.epochs}
_EXAMPLES = """examples:
  jtq train campaigns/excitation --joint joint1.yaml --joint joint2.yaml --network paper --out models
  jtq train campaigns/excitation --joint joint1.fused.yaml --network ours --out models

exit status: 0 done, 1 failure, 2 usage, 3 findings in the runs, or (ours) a network that does not take at least 5 % off the
error of the estimate on held-out runs: then it is not written"""


def main(argv: list[str]) -> int:
    """Train and write; exit status 0 done, 1 failure, 2 usage, 3 findings in the data or a network that its gate refuses.

    What has findings is not written.
    """
    options = parser().parse_args(argv)
    try:
        joints = [load_joint(path) for path in options.joint]
        make_directory(options.out)  # training takes minutes, and its result must not be lost for it
        check_installed("train", "torch", "onnx", "matplotlib")
        runs = read_runs(options.runs, options.columns, joints=only(options.number))
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
    except (ValueError, OSError) as error:
        print(f"jtq train: {error}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(result, indent=1))
    return 3 if any(each["path"] is None for each in result.values()) else 0


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq train`."""
    parser = command_parser(
        "jtq train", "Train one network per joint on recorded runs, with a split by run.", _EXAMPLES
    )
    add_runs(parser)
    parser.add_argument(
        "--joint",
        type=Path,
        action="append",
        required=True,
        metavar="FILE",
        help="joint file; may be repeated",
    )
    add_number(parser)
    parser.add_argument(
        "--network",
        choices=sorted(_ITERATIONS),
        required=True,
        help="paper: section III, absolute angles, 6-20-40-10-1; ours: torque of the current path, 28-20-40-10-1",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory of networks and cards; created if missing",
    )
    parser.add_argument(
        "--iterations", type=count, help="default 1000 for the paper's (as in the paper), 110 for ours"
    )
    parser.add_argument(
        "--show-leakage",
        action="store_true",
        help="paper's network: also print the MSE of a split by sample",
    )
    parser.add_argument("--seed", type=natural, default=0, help="of weights and batches (default 0)")
    add_columns(parser)
    parser.add_argument("--json", action="store_true", help="print paths, hashes and scores as JSON")
    return parser


def _train_joint(
    joint: Joint, number: int, runs: list[RunFile], options: argparse.Namespace
) -> dict[str, Any]:
    ours = options.network == "ours"
    iterations = options.iterations or _ITERATIONS[options.network]
    hashes = {run.name: run.sha256 for run in runs}
    report = partial(print, file=sys.stderr if options.json else sys.stdout)

    def advance(n: int, loss: float) -> None:
        if (n + 1) % 100 == 0:
            print(f"{joint.name}: iteration {n + 1} of {iterations}, mse {loss:.4f} Nm^2", file=sys.stderr)

    if not ours and not two_encoders(runs, number, joint):
        raise ConfigError(
            f"{joint.name}: the runs have one encoder of this joint, expected both: "
            "the paper's network has the link position"
        )
    schedule, claimed, gate = Schedule(iterations, options.seed, advance), None, None
    if ours:
        tables = [
            PathRun(run.name, run.table.time_s, run.table.joint(number, joint.gear_ratio))
            for run in progress(runs, f"reading {joint.name}")
        ]
        result = train_path(tables, joint, hashes, replace(USUAL, epochs=iterations, seed=options.seed))
        gate = gate_of(result.held_out)
    else:
        blocks = [
            paper_block(run.name, joint, run.table.time_s, run.table.joint(number, joint.gear_ratio))
            for run in progress(runs, f"observing {joint.name}")
        ]
        result = train_paper(blocks, joint, hashes, schedule)
        claimed = split_by_sample(blocks, schedule) if options.show_leakage else None
    count = len(result.held_out)
    network = sum(score for score, _ in result.held_out.values()) / max(count, 1)
    physics = sum(score for _, score in result.held_out.values()) / max(count, 1)
    path = options.out / f"{joint.name}{'.fused' if ours else ''}.onnx"
    digest = None
    if gate is not None and not gate.passed:
        left = f"; {path} is of an earlier training" if path.exists() else ""
        report(f"{joint.name}: no network is written: {gate.text}; jtqd runs without one{left}")
    else:
        write_whole(path, result.data)
        digest = hashlib.sha256(result.data).hexdigest()
        write_card(path, joint, options.network, result, digest, gate=gate)
        report(
            f"{path}  sha256 {digest}\n  on {count} held-out runs: MSE {network:.3f} Nm^2, "
            f"the physics without network {physics:.3f} Nm^2"
        )
        if claimed is not None:
            report(f"  split by sample, the same data gives an MSE of {claimed:.3f} Nm^2")
    return {
        "path": None if digest is None else str(path),
        "sha256": digest,
        "split_by_sample_mse_nm2": claimed,
        "network_mse_nm2": network,
        "physics_mse_nm2": physics,
        "runs": count,
        "gate": None if gate is None else gate.to_mapping(),
    }


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
