"""Train our network on runs: a correction to the fused physics, its envelope, and its calibrated sigma.

    y = std_y sum_m g_m wave_m,   g = gains of a fully connected network over the first inputs, sigma(x) = tanh(x/2)

The outputs are gains of waves of the motor angle: over a turn the waves average to zero, so no offset, friction or drift
of a training run can hide in the network. The slow part of a run's residual is removed from its target too (a running
mean over half a second), because it is only noise to these gains. sigma_scale comes from runs that neither the physics
nor the network of their fold had seen.

A network is accepted by its gain on held-out runs, with a share of its correction chosen without the run it is scored on.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import quadrants
from jtqd.estimator.fusion import Fusion
from jtqd.estimator.joint import AdditiveLoss, Envelope, FusedSigma, Joint, Torsion
from jtqd.estimator.native_network import network_shares
from jtqd.estimator.network import FUSED_FEATURES
from jtqd.estimator.text import counted
from jtqd.sysid.fit.calibration import conformal_scale, loss_and_width
from jtqd.sysid.fit.fused import envelope_of, folds
from jtqd.sysid.fit.losses import fit_loss
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import fit_torsion, torsion_torque
from jtqd.sysid.train.network import (
    Schedule,
    Trained,
    TrainedNetwork,
    export_network,
    network_output,
    origin,
    train,
)

LEAST_GAIN: Final = 0.30
"""Of the error (RMSE) of physics that a network takes off."""
MOST_WORSE: Final = 0.02
"""Of the runs that are worse with it than by physics alone."""


@dataclass(frozen=True)
class Gate:
    """Scores of a network on held-out runs, and whether it is accepted.

    Attributes:
        gain: part of the error of physics that the network takes off; below 0: it adds to it.
        network_rmse_nm, physics_rmse_nm: over all runs, each of the same weight.
        runs, worse: how many there were, and how many were worse with it.
        share: of its correction that the network is written with; 0 is no network, and is never accepted.
    """

    gain: float
    network_rmse_nm: float
    physics_rmse_nm: float
    runs: int
    worse: int
    share: float = 1.0

    @property
    def _earned(self) -> bool:
        return self.gain >= LEAST_GAIN and self.worse <= MOST_WORSE * self.runs

    @property
    def passed(self) -> bool:
        """Return whether it may be used."""
        return self._earned and self.share > 0.0

    @property
    def text(self) -> str:
        """Return the verdict with its numbers, and what is expected."""
        harm = self._earned and not self.passed
        return (
            f"on {self.runs} held-out runs it takes {100 * self.gain:.1f} % off the error of physics "
            f"(RMSE {self.physics_rmse_nm:.3f} -> {self.network_rmse_nm:.3f} Nm; "
            f"expected at least {100 * LEAST_GAIN:.0f} %) "
            f"and is worse in {self.worse} (expected at most {100 * MOST_WORSE:.0f} %)"
            + ("; but no share of it is without harm to all of them" if harm else "")
        )

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for JSON and for the metadata of a network."""
        return {
            "passed": self.passed,
            "gain": self.gain,
            "network_rmse_nm": self.network_rmse_nm,
            "physics_rmse_nm": self.physics_rmse_nm,
            "runs": self.runs,
            "worse": self.worse,
        }


def judge(scores: Collection[tuple[float, float]], share: float = 1.0) -> Gate:
    """Return the verdict on the MSE [Nm²] of each held-out run: (with the network, physics alone).

    share: of its correction that the network is to be written with; a run is judged with one that it had no say in.
    Raises ValueError without a run.
    """
    if not scores:
        raise ValueError("found no held-out run, expected at least one")
    table = np.array(list(scores), np.float64)
    network, physics = np.sqrt(table.mean(axis=0)).tolist()
    gain = 1.0 - network / physics if physics > 0.0 else 0.0
    return Gate(gain, network, physics, len(table), int((table[:, 0] > table[:, 1]).sum()), share)


HIDDEN: Final = (16, 16)
_CORE: Final = 3
"""Features that set the gains (speed, motor torque, torsion less current); the others are the waves."""
_WEIGHT_DECAY: Final = 0.05
_SLOW_SAMPLES: Final = 501
"""Half a second at 1 kHz: at 0.1 rad/s the ripple at 2 per motor revolution has turned 1.6 times."""
_LEAST_SHARE: Final = 0.05


class Seen:
    """A run through physics with given parameters: features [n, 7], physics and sigma [n], all of moving samples."""

    def __init__(self, run: RunSignals, loss: AdditiveLoss, torsion: Torsion, sigma: FusedSigma) -> None:
        keep = run.moving
        torque, open_nm = torsion_torque(torsion, run)
        seen = replace(run.seen, torsion_nm=torque, open_nm=open_nm)
        value, wide = loss_and_width(run, loss)
        _, physics, spread, _ = Fusion(sigma, True).fuse(
            seen.raw_nm, wide, seen.velocity_rad_s, seen.torsion_nm, seen.open_nm, loss_nm=value
        )
        self.name = run.name
        apart = seen.torsion_nm - (seen.raw_nm - value)
        features = np.column_stack((seen.velocity_rad_s, seen.raw_nm, apart, seen.waves))
        self.features: FloatArray = features[keep]
        self.waves: FloatArray = self.features[:, _CORE:] * network_shares(seen.velocity_rad_s[keep])[:, None]
        self.residual_nm: FloatArray = (run.sensor_nm - physics)[keep]
        self.sigma_nm: FloatArray = spread[keep]
        self.quadrant = quadrants(seen.raw_nm[keep], seen.velocity_rad_s[keep])


def train_fused(
    runs: Sequence[RunSignals],
    joint: Joint,
    hashes: Mapping[str, str],
    schedule: Schedule,
) -> TrainedNetwork:
    """Train our network of a joint that has section `fused` with torsion; at least 8 runs (ValueError)."""
    fused = joint.fused
    if fused is None or fused.torsion is None:
        raise ValueError(
            f"joint {joint.name}: found no section 'fused' with torsion; 'jtq fit losses' makes one"
        )
    if len(runs) < 8:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least 8: standard deviations need held-out runs"
        )
    unseen: list[tuple[Seen, FloatArray]] = []
    fold_of: list[int] = []
    for fold, (known, judged) in enumerate(folds(runs)):
        loss, torsion = fit_loss(known, joint.friction).loss, fit_torsion(known)
        trained = _train([Seen(run, loss, torsion, fused.sigma) for run in known], schedule)
        for n in judged:
            one = Seen(runs[n], loss, torsion, fused.sigma)
            unseen.append((one, network_output(trained, one.features[:, :_CORE], one.waves)))
            fold_of.append(fold)
    pairs = [(one.residual_nm, correction) for one, correction in unseen]
    share = safe_share(pairs)
    errors = [residual - share * correction for residual, correction in pairs]
    scores = {one.name: score for (one, _), score in zip(unseen, judged_scores(pairs, fold_of), strict=True)}
    blocks = [Seen(run, fused.loss, fused.torsion, fused.sigma) for run in runs]
    trained = scaled(_train(blocks, schedule), share)
    features = np.concatenate([block.features for block in blocks])
    low, high = np.quantile(features, [1e-4, 1.0 - 1e-4], axis=0)
    metadata = {
        "features": list(FUSED_FEATURES),
        "envelope": training_envelope(blocks, runs).to_mapping(),
        "sigma_scale": list(
            conformal_scale(errors, [one.sigma_nm for one, _ in unseen], [one.quadrant for one, _ in unseen])
        ),
        "share": share,
        "gate": judge(scores.values(), share).to_mapping(),
        "input_low": low.tolist(),
        "input_high": high.tolist(),
        **origin(joint, hashes),
    }
    data = export_network(trained, metadata, len(FUSED_FEATURES) - _CORE)
    return TrainedNetwork(data, trained, metadata, scores)


def scaled(trained: Trained, share: float) -> Trained:
    """Return the network whose answer is `share` of this one's: its last layer is linear, and 0 is allowed."""
    *hidden, (weight, bias) = trained.weights
    return replace(trained, weights=[*hidden, (share * weight, share * bias)])


def safe_share(unseen: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Return the part of the correction that helps on unseen runs: (residual [n], correction [n]) of each.

    With share s the MSE of a run changes by s^2 E[c^2] - 2 s E[c r]: best at E[c r]/E[c^2], harmful beyond twice that.
    Taken is the best over all runs, but no more than what would harm a single one. 0 when even a twentieth would: then
    the network has learned nothing that lasts, and the physics alone is the better estimate.
    """
    products = np.array([float(np.mean(r * c)) for r, c in unseen])
    squares = np.array([float(np.mean(c * c)) for _, c in unseen])
    squares = np.maximum(squares, 1e-12)
    share = min(1.0, float(products.sum() / squares.sum()), float(np.min(1.8 * products / squares)))
    return share if share >= _LEAST_SHARE else 0.0


def judged_scores(
    unseen: Sequence[tuple[FloatArray, FloatArray]], fold_of: Sequence[int]
) -> list[tuple[float, float]]:
    """Return the MSE of each run left out, with and without its correction: (residual [n], correction [n]) and fold of each.

    The share of a run is that of the other folds alone. One that is chosen to harm no run cannot be judged on these runs.
    """
    shares = {
        fold: safe_share([pair for pair, other in zip(unseen, fold_of, strict=True) if other != fold])
        for fold in set(fold_of)
    }
    return [
        (float(np.mean((residual - shares[fold] * correction) ** 2)), float(np.mean(residual**2)))
        for (residual, correction), fold in zip(unseen, fold_of, strict=True)
    ]


def quick_part(residual_nm: FloatArray) -> FloatArray:
    """Return residual [n] less its running mean over _SLOW_SAMPLES, shorter at both ends."""
    width = min(_SLOW_SAMPLES, max(1, len(residual_nm) // 2))
    total = np.concatenate(([0.0], np.cumsum(residual_nm)))
    index = np.arange(len(residual_nm))
    low, high = np.maximum(index - width // 2, 0), np.minimum(index + width // 2 + 1, len(residual_nm))
    result: FloatArray = residual_nm - (total[high] - total[low]) / (high - low)
    return result


def _train(blocks: Sequence[Seen], schedule: Schedule) -> Trained:
    return train(
        [block.features[:, :_CORE] for block in blocks],
        [quick_part(block.residual_nm) for block in blocks],
        schedule,
        hidden=HIDDEN,
        waves=[block.waves for block in blocks],
        weight_decay=_WEIGHT_DECAY,
    )


def training_envelope(blocks: Sequence[Seen], runs: Sequence[RunSignals]) -> Envelope:
    """Return what the training data covered."""
    features = np.concatenate([block.features[:, :_CORE] for block in blocks])
    return envelope_of(features[:, 0], features[:, 1], features[:, 2], [run.temperature_c for run in runs])
