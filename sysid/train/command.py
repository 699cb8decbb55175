"""`jtq train`: train a network per joint on runs; write it as ONNX with metadata, a model card and a figure."""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.estimator.command_line import check_installed, count, make_directory, natural
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTableError
from jtqd.models.files import load_joint
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.signals import signals_of_runs, two_encoders
from jtqd.sysid.fit.torsion import TorsionError
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.checks import channel_findings
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.options import add_columns, add_number, add_runs, joint_number, only
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.train.network import TrainedNetwork, paper_block, split_by_sample, train_paper
from jtqd.sysid.train.ours import Gate, judge, train_fused

_WHAT = {
    "paper": "The paper's network (section III): current, angles and velocities of both sides and the efficiency "
    "estimate in, torque out; sigma(x) = tanh(x/2). Its absolute angles can identify single runs; for comparison only.",
    "ours": "Correction to the fused physics from speed, motor torque, torsion against current, and filtered ripple "
    "angles. Outside its envelope it fades to zero and the status is 3.",
}


def write_card(
    path: Path, joint: Joint, kind: str, result: TrainedNetwork, digest: str, *, gate: Gate | None = None
) -> None:
    """Write path.md and path.png beside the ONNX file `path`."""
    picture = path.with_suffix(".png")
    _draw(picture, joint, kind, result)
    trained = result.trained
    shape = "-".join(str(len(b)) for _, b in trained.weights)
    inputs = len(trained.input_mean)
    lines = [
        f"# {path.name}",
        "",
        _WHAT[kind],
        "",
        f"- Joint: {joint.name}. File: sha256 {digest}",
        f"- Layers: {inputs}-{shape}, float64, normalisation folded into the weights",
        f"- Trained: {len(trained.losses)} iterations, last loss {trained.losses[-1]:.4f} Nm^2; Python "
        f"{platform.python_version()}, one thread, so that the same runs and seed give the same file",
        f"- Data: {len(result.metadata['runs'])} runs, digest {result.metadata['data_sha256']}",
        *_share(result),
        *([f"- Gate: {gate.text}"] if gate else []),
        "",
        "## On runs it was not trained on",
        "",
        "| run | network, MSE Nm^2 | physics without network, MSE Nm^2 |",
        "|---|---|---|",
        *(f"| {name} | {net:.3f} | {physics:.3f} |" for name, (net, physics) in result.held_out.items()),
        f"| mean | {_mean(result, 0):.3f} | {_mean(result, 1):.3f} |",
        "",
        f"![loss curve and scores]({picture.name})",
        "",
        "## Training envelope",
        "",
        *_envelope(result),
        "",
        "## Files of the data",
        "",
        *(f"- {name} {sha}" for name, sha in result.metadata["runs"].items()),
        "",
    ]
    path.with_suffix(".md").write_text("\n".join(lines), encoding="utf-8")


def _share(result: TrainedNetwork) -> list[str]:
    """A line where only part of the correction is used, because all of it would harm runs it was not trained on."""
    share = float(result.metadata.get("share", 1.0))
    if share >= 1.0:
        return []
    return [f"- Share of the correction that improves held-out runs and worsens none: {share:.2f}"]


def _mean(result: TrainedNetwork, which: int) -> float:
    return float(np.mean([score[which] for score in result.held_out.values()]))


def _envelope(result: TrainedNetwork) -> list[str]:
    metadata = result.metadata
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
        f"{envelope['torque_step_nm']} Nm of motor torque (the figure's right side)",
        f"- torsion against current at most {envelope['distance_nm']:.2f} Nm",
        "- temperature: not used" if t is None else f"- temperature from {t[0]:.1f} to {t[1]:.1f} degC",
        f"- factor on sigma per quadrant: {', '.join(f'{s:.2f}' for s in metadata['sigma_scale'])}",
    ]


def _draw(picture: Path, joint: Joint, kind: str, result: TrainedNetwork) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3 if kind == "ours" else 2, figsize=(11, 3.2), layout="constrained")
    axes[0].semilogy(np.arange(1, len(result.trained.losses) + 1), result.trained.losses, lw=1.2)
    axes[0].set(xlabel="iteration", ylabel="training loss, Nm²", title=f"{joint.name}: loss")
    scores = np.array(list(result.held_out.values()))
    top = 1.05 * float(scores.max())
    axes[1].plot([0, top], [0, top], color="0.6", lw=0.8)
    axes[1].plot(scores[:, 1], scores[:, 0], "o", ms=4)
    axes[1].set(xlabel="physics, MSE Nm²", ylabel="network, MSE Nm²", title="held-out runs")
    if kind == "ours":
        envelope = result.metadata["envelope"]
        known = np.array(envelope["known"], float)
        v = envelope["velocity_step_rad_s"] * (len(known) // 2 + 0.5)
        t = envelope["torque_step_nm"] * (len(known[0]) // 2 + 0.5)
        axes[2].imshow(known, origin="lower", aspect="auto", extent=(-t, t, -v, v), cmap="Greys", vmax=2.0)
        axes[2].set(xlabel="motor torque at the joint, Nm", ylabel="joint velocity, rad/s", title="envelope")
    for axis in axes[:2]:
        axis.grid(alpha=0.3)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


_ITERATIONS = {"paper": 1000, "ours": 200}
_EXAMPLES = """examples:
  jtq train campaigns/excitation --joint joint1.yaml --joint joint2.yaml --network paper --out models
  jtq train campaigns/excitation --joint joint1.fused.yaml --network ours --out models

exit status: 0 done, 1 failure, 2 usage, 3 findings in the runs, or (ours) a network that does not take at least 30 % off the
error of physics on held-out runs, or is worse in more than 2 % of them: then it is not written"""


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
    except (ConfigError, RunError, RunTableError, LossFitError, TorsionError, ValueError, OSError) as error:
        print(f"jtq train: {error}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(result, indent=1))
    return 3 if any(each["path"] is None for each in result.values()) else 0


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq train`."""
    parser = argparse.ArgumentParser(
        prog="jtq train",
        description="Train one network per joint on recorded runs, with a split by run.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
        help="paper: section III, absolute angles, 6-20-40-10-1; ours: correction to the fused physics, 3-16-16-4",
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory of networks and cards; created if missing",
    )
    parser.add_argument(
        "--iterations", type=count, help="default 1000 for the paper's (as in the paper), 200 for ours"
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
    iterations = options.iterations or _ITERATIONS[options.network]
    claimed = None
    hashes = {run.name: run.sha256 for run in runs}

    def say(n: int, loss: float) -> None:
        if (n + 1) % 100 == 0:
            print(f"{joint.name}: iteration {n + 1} of {iterations}, mse {loss:.4f} Nm^2", file=sys.stderr)

    if not two_encoders(runs, number, joint):
        raise ConfigError(
            f"{joint.name}: the runs have one encoder of this joint, expected both: "
            "jtqd uses no network without a link position"
        )
    settings = {"iterations": iterations, "seed": options.seed, "progress": say}
    if options.network == "ours":
        result = train_fused(signals_of_runs(runs, number, joint), joint, hashes, **settings)
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
    gate = judge(result.held_out.values(), result.metadata["share"]) if options.network == "ours" else None
    if gate is not None and not gate.passed:
        left = f"; {path} is of an earlier training" if path.exists() else ""
        print(
            f"{joint.name}: no network is written: {gate.text}; jtqd runs on physics alone{left}",
            file=sys.stderr if options.json else sys.stdout,
        )
        return {"path": None, "sha256": None, **_scores(result, claimed), "gate": gate.to_mapping()}
    path.write_bytes(result.data)
    digest = hashlib.sha256(result.data).hexdigest()
    write_card(path, joint, options.network, result, digest, gate=gate)
    network, physics = (_mean_of(result, k) for k in (0, 1))
    print(
        f"{path}  sha256 {digest}\n  on {len(result.held_out)} held-out runs: MSE {network:.3f} Nm^2, "
        f"the physics without network {physics:.3f} Nm^2",
        file=sys.stderr if options.json else sys.stdout,
    )
    share = result.metadata.get("share", 1.0)
    if share < 1.0:
        print(
            f"  share of its correction that improves them and worsens none: {share:.2f}",
            file=sys.stderr if options.json else sys.stdout,
        )
    if claimed is not None:
        print(
            f"  split by sample, the same data gives an MSE of {claimed:.3f} Nm^2",
            file=sys.stderr if options.json else sys.stdout,
        )
    return {
        "path": str(path),
        "sha256": digest,
        **_scores(result, claimed),
        "gate": None if gate is None else gate.to_mapping(),
    }


def _scores(result: TrainedNetwork, claimed: float | None) -> dict[str, Any]:
    return {
        "split_by_sample_mse_nm2": claimed,
        "network_mse_nm2": _mean_of(result, 0),
        "physics_mse_nm2": _mean_of(result, 1),
        "share": result.metadata.get("share", 1.0),
        "runs": len(result.held_out),
    }


def _mean_of(result: TrainedNetwork, which: int) -> float:
    return sum(score[which] for score in result.held_out.values()) / max(len(result.held_out), 1)
