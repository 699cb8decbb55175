"""Model card of a network: what it is, what it saw, how it did on runs it did not see; one page of text, one figure."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np

from estimator.parameters import Joint
from sysid.paper_network import TrainedNetwork

_WHAT = {
    "paper": "The paper's network (section III): current, angles and velocities of both sides and the efficiency "
    "estimate in, torque out; sigma(x) = tanh(x/2). Its absolute angles can tell runs apart; a comparison is its only use.",
    "ours": "Correction to the fused physics from speed, motor torque, torsion against current, and filtered ripple "
    "angles. Outside its envelope it fades to nothing and the status says 3.",
}


def write_card(path: Path, joint: Joint, kind: str, result: TrainedNetwork, digest: str) -> None:
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
        "",
        "## On runs it was not trained on",
        "",
        "| run | network, MSE Nm^2 | physics it builds on, MSE Nm^2 |",
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
    nothing = "" if share else ": none of it, the estimate is the physics alone"
    return [f"- Share of the correction that helps on unseen runs and harms none: {share:.2f}{nothing}"]


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
    axes[1].set(xlabel="physics, MSE Nm²", ylabel="network, MSE Nm²", title="runs not trained on")
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
