"""Train the network of the current path on runs: `estimator/native_network.pyx` has its inputs, spread and trust.

Target: what the teacher's torque, not filtered, has more than tau_r: losses, and what the low pass is behind. Teacher: the
torque sensor, or the fused estimate of a joint file. The inputs are those of the estimator in service, with one encoder.

Training: AdamW, one cycle of the rate, Huber loss, batches of random samples; whole runs are held out (one of `stop`), and
the weights are those of the epoch that was best on them. The same runs give the spread, the interval at rest, the scale of
sigma of the estimate in service, and the gate: its RMSE must be lower than without the network by WORTH.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.estimator import SLOPE_NM, estimate_columns, observe_run, quadrants
from jtqd.estimator.fusion import faded
from jtqd.estimator.joint import Envelope, FusedSigma, Joint
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.native_network import INPUTS
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.run import INPUTS as COLUMNS
from jtqd.estimator.run import JointColumns, ObservedRun
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.estimator.text import counted
from jtqd.sysid.fit.calibration import FEWEST, PathResiduals, calibrated, conformal_scale, fit_sigma
from jtqd.sysid.fit.fused import fit_agreement, fit_zeros, map_of
from jtqd.sysid.fit.torsion import local_stiffness
from jtqd.sysid.train.network import (
    HIDDEN,
    Layer,
    Steps,
    Trained,
    TrainedNetwork,
    descend,
    export_network,
    network_output,
    origin,
)

EVERY: Final = 12
"""Neighbours at 1 kHz are alike: one sample of so many is trained on."""
WORTH: Final = 0.05
"""Part of the RMSE on held-out runs that a network must take off."""
FEWEST_RUNS: Final = 12
SETTLE_S: Final = 0.5
MARGIN_K: Final = 4.5
"""Beyond the temperatures of the runs; 5 K with the margin of the trust."""
QUICK_SHARE: Final = 0.999
QUICK_MARGIN: Final = 1.1
REST_COVERAGE: Final = 0.95
_SETTINGS: Final = recommended("fused")
_BASE, _VELOCITY = INPUTS.index("torque_nm"), INPUTS.index("velocity_rad_s")
_TURN: Final = tuple(INPUTS.index(f"{part}_{order}_motor") for order in (1, 2, 4) for part in ("cos", "sin"))
_QUICK: Final = tuple(map(INPUTS.index, ("acceleration_rad_s2", "torque_800_nm", "torque_50_nm")))


class _Probe:
    """In place of a network: the estimator then has its inputs."""

    sigma = FusedSigma(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, (1.0, 1.0, 1.0, 1.0))
    rest_nm, quick = 1.0, (1.0, 1.0, 1.0)

    def __init__(self, joint: str, range_c: tuple[float, float] | None) -> None:
        self.joint, self.envelope = joint, Envelope(1.0, 1.0, ((1,),), 1.0, range_c)

    def run_one(self, *_: float) -> float:
        return 0.0


def seen(
    joint: Joint,
    time_s: FloatArray,
    columns: JointColumns,
    range_c: tuple[float, float] | None = (20.0, 30.0),
) -> FloatArray:
    """Return the inputs [n, INPUTS] of a run, NaN where the observer was not running; the first of them is tau_r.

    range_c: of temperatures, in its middle is one that is not known. Raises ConfigError for a joint without section `fused`,
    ValueError for a run without one of the columns.
    """
    if joint.fused is not None:
        joint = replace(joint, fused=replace(joint.fused, torsion=None, zeros=None, agreement=None))
    probe: Any = _Probe(joint.name, range_c)
    return estimate_columns(joint, _SETTINGS, probe, time_s, columns).features


class Block(NamedTuple):
    """Of one run: inputs [n, INPUTS] and what is to be learned [n], the teacher's torque less tau_r."""

    inputs: FloatArray
    target_nm: FloatArray


def block(inputs: FloatArray, teacher_nm: FloatArray, settled: BoolArray) -> Block:
    """Return every EVERY-th sample that is settled and that the teacher knows; teacher_nm [n], NaN where it does not."""
    keep = np.flatnonzero(settled & np.isfinite(teacher_nm) & np.isfinite(inputs).all(axis=1))[::EVERY]
    return Block(inputs[keep], teacher_nm[keep] - inputs[keep, _BASE])


@dataclass(frozen=True)
class Recipe:
    """How a network is trained. knee: of the Huber loss, in standard deviations of the target; stop: one run of so many is
    held out, three at least.
    """

    hidden: tuple[int, ...] = HIDDEN
    epochs: int = 110
    fewest_steps: int = 4000
    batch: int = 1024
    rate: float = 4e-3
    weight_decay: float = 1e-3
    knee: float = 0.15
    stop: int = 6
    seed: int = 0

    def held_out(self, count: int) -> list[bool]:
        """Return which of so many runs are held out."""
        most = min(max(3, -(-count // self.stop)), count - 1)
        return [int(k) < most for k in np.random.default_rng(self.seed).permutation(count)]


USUAL: Final = Recipe()


def train(blocks: Sequence[Block], recipe: Recipe = USUAL) -> Trained:
    """Return the network of these runs; the same runs and recipe give the same weights. ValueError for fewer than two."""
    if len(blocks) < 2:
        raise ValueError(f"found {counted(len(blocks), 'run')}, expected at least 2")
    parts: dict[bool, list[Block]] = {False: [], True: []}
    for each, out in zip(blocks, recipe.held_out(len(blocks)), strict=True):
        parts[out].append(each)
    raw, wanted = (np.concatenate(part) for part in zip(*parts[False], strict=True))
    mean, std = raw.mean(axis=0), raw.std(axis=0)
    std = np.where(std > 1e-6, std, 1.0)  # an input that never changed has no weight to learn
    centre, spread = float(wanted.mean()), max(float(wanted.std()), 1e-6)
    held_x, held_y = (np.concatenate(part) for part in zip(*parts[True], strict=True))
    held = (held_x - mean) / std, (held_y - centre) / spread
    kept: list[Layer] = []
    losses: list[float] = []

    def after(_: int, __: float, judged: Any, weights: Any) -> None:
        losses.append(judged(*held))
        if losses[-1] == min(losses):
            kept[:] = weights()

    batches = max(-(-len(raw) // recipe.batch), 1)
    epochs = max(recipe.epochs, -(-recipe.fewest_steps // batches))
    steps = Steps(
        recipe.hidden, epochs, len(raw), batches, recipe.rate, recipe.seed, recipe.weight_decay, recipe.knee
    )
    descend((raw - mean) / std, (wanted - centre) / spread, steps, after)
    return Trained(kept, mean, std, centre, spread, losses)


def estimate_nm(trained: Trained, inputs: FloatArray) -> FloatArray:
    """Return the torque [n] of the current path."""
    result: FloatArray = inputs[:, _BASE] + network_output(trained, inputs)
    return result


# A network for service -----------------------------------------------------------------------------------------------


class PathRun(NamedTuple):
    """One joint in one run: name, time [n], columns with the sensor."""

    name: str
    time_s: FloatArray
    columns: JointColumns


class Gate(NamedTuple):
    """RMSE [Nm] to the sensor of the same instant, held-out runs of the same weight: with the network, and without."""

    network_rmse_nm: float
    physics_rmse_nm: float
    runs: int

    @property
    def gain(self) -> float:
        """Part of the error without the network that it takes off; below 0: it adds to it."""
        return 1.0 - self.network_rmse_nm / self.physics_rmse_nm if self.physics_rmse_nm > 0.0 else 0.0

    @property
    def passed(self) -> bool:
        """Return whether it may be used."""
        return self.gain >= WORTH

    @property
    def text(self) -> str:
        """Return the verdict with its numbers, and what is expected."""
        return (
            f"on {self.runs} held-out runs it takes {100 * self.gain:.1f} % off the error without it "
            f"(RMSE {self.physics_rmse_nm:.3f} -> {self.network_rmse_nm:.3f} Nm; expected at least {100 * WORTH:.0f} %)"
        )

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for JSON and for the metadata of a network."""
        return {"passed": self.passed, "gain": self.gain, **self._asdict()}


def gate_of(held_out: Mapping[str, tuple[float, float]]) -> Gate:
    """Return the gate of the MSE [Nm^2] of held-out runs: (with the network, without). ValueError without a run."""
    if not held_out:
        raise ValueError("found no held-out run with motion, expected at least one")
    network, physics = np.sqrt(np.mean(list(held_out.values()), axis=0)).tolist()
    return Gate(network, physics, len(held_out))


def train_path(
    runs: Sequence[PathRun], joint: Joint, hashes: Mapping[str, str], recipe: Recipe = USUAL
) -> TrainedNetwork:
    """Train the network of a joint that has section `fused`; hashes: name and SHA-256 of every run.

    Raises ValueError for fewer than FEWEST_RUNS, runs without a sensor or without motion, and a joint without the section.
    """
    if joint.fused is None:
        raise ValueError(f"joint {joint.name}: found no section 'fused'; 'jtq fit losses' makes one")
    if len(runs) < FEWEST_RUNS:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least {FEWEST_RUNS}: standard deviations need held-out runs"
        )
    known_c = [run.columns.temperature_c for run in runs if run.columns.temperature_c is not None]
    ends = np.array([(each.min(), each.max()) for each in known_c])
    range_c = (float(ends.min()) - MARGIN_K, float(ends.max()) + MARGIN_K) if known_c else None
    views = [seen(joint, run.time_s, run.columns, range_c) for run in runs]
    settled = [run.time_s - run.time_s[0] >= SETTLE_S for run in runs]
    trained = train([block(*each) for each in zip(views, map(_sensor, runs), settled, strict=True)], recipe)
    settled = [keep & np.isfinite(view).all(axis=1) for keep, view in zip(settled, views, strict=True)]
    inputs = [view[keep] for view, keep in zip(views, settled, strict=True)]
    moving = [each[_moving(each)][:, (_VELOCITY, _BASE)] for each in inputs]
    motor_nm = np.concatenate([each[:, 1] for each in moving])
    if not len(motor_nm):
        raise ValueError(f"joint {joint.name}: found no motion in the runs")
    envelope = map_of([(each[:, 0], each[:, 1]) for each in moving], motor_nm, [], joint.rated_torque_nm)
    if envelope is None:
        found = f"{np.abs(motor_nm).max():.3g} Nm"
        raise ValueError(
            f"joint {joint.name}: found motor torques of {found}, beyond any map of the rated one"
        )
    every = np.concatenate(inputs)
    low, high = np.quantile(every, [1e-4, 1.0 - 1e-4], axis=0)
    held = [n for n, out in enumerate(recipe.held_out(len(runs))) if out]
    residuals = [_residuals(*each, trained) for each in zip(runs, views, settled, strict=True)]
    # of all runs, the worst one: what steps of current leave at rest is in few of them
    resting = [float(np.quantile(rest, REST_COVERAGE)) for _, rest in residuals if len(rest) >= FEWEST]
    metadata = {
        "features": list(INPUTS),
        "input_low": low.tolist(),
        "input_high": high.tolist(),
        "envelope": replace(envelope, temperature_c=range_c).to_mapping(),
        "sigma": plain_values(fit_sigma([residuals[n][0] for n in held], with_torsion=False)),
        "rest_nm": [max(resting, default=0.1 * joint.rated_torque_nm)],
        "quick": (QUICK_MARGIN * np.quantile(np.abs(every[:, _QUICK]), QUICK_SHARE, axis=0)).tolist(),
        **origin(joint, hashes),
    }
    if joint.fused.torsion is not None:
        metadata |= _section(
            [_paths(runs[n], views[n], trained, joint) for n in held], joint, metadata["sigma"]
        )
    network = PathNetwork(export_network(trained, metadata))
    scores, scale = _in_service([runs[n] for n in held], joint, network)
    if joint.fused.torsion is None:
        metadata["sigma"]["scale"] = list(scale)
    metadata["gate"] = gate_of(scores).to_mapping()
    return TrainedNetwork(export_network(trained, metadata), trained, metadata, scores)


def _paths(run: PathRun, inputs: FloatArray, trained: Trained, joint: Joint) -> PathResiduals:
    """Return the errors of the network's current path and of the torsion, both of now, on all observed samples of a run."""
    assert joint.fused is not None
    assert joint.fused.torsion is not None
    columns, sensor, time_s = run.columns, _sensor(run), run.time_s
    dt = np.diff(time_s, prepend=time_s[0])
    current, motor, velocity, link = (np.asarray(getattr(columns, name)) for name in COLUMNS)
    seen = observe_run(
        joint, _SETTINGS, joint.fused.torsion, dt, current, motor, velocity, link, columns.temperature_c
    )
    keep = ~np.isnan(seen.raw_nm) & np.isfinite(inputs).all(axis=1)
    inputs, seen = inputs[keep], ObservedRun(*(getattr(seen, each.name)[keep] for each in fields(seen)))
    torsion, base, error = (
        seen.torsion_nm + seen.ahead_nm,
        inputs[:, _BASE],
        estimate_nm(trained, inputs) - sensor[keep],
    )
    loss = AdditiveLossModel(joint.fused.loss)
    now, half = loss.loss_many(base, seen.velocity_rad_s, seen.temperature_c, seen.direction)
    more, _ = loss.loss_many(base + SLOPE_NM, seen.velocity_rad_s, seen.temperature_c, seen.direction)
    off = torsion - sensor[keep]
    none = np.zeros(len(base))
    return PathResiduals(
        base,
        seen.velocity_rad_s,
        faded(half, seen.dt_s, none == 0.0),
        torsion,
        seen.open_nm,
        error,
        off,
        dt_s=seen.dt_s,
        direction=seen.direction,
        slope=(more - now) / SLOPE_NM,
        tracked_nm=off,
        delayed_nm=off,
        stiffness_nm_per_rad=local_stiffness(
            joint.fused.torsion, torsion / joint.fused.torsion.stiffness_nm_per_rad
        ),
        loss_nm=base - error - sensor[keep],
        turn=inputs[:, _TURN],
        teacher_nm=none,
        ahead_nm=none,
        behind_nm2=none,
        resting=seen.status == STANDSTILL,
        now=none == 0.0,
        counted=(seen.status == VALID) & (time_s[keep] - time_s[0] >= SETTLE_S),
    )


def _section(runs: Sequence[PathResiduals], joint: Joint, sigma: Mapping[str, Any]) -> dict[str, Any]:
    """Return metadata of held-out runs: sigma with its scale, zeros and agreement of the current path and the torsion."""
    assert joint.fused is not None
    runs = [run for run in runs if np.count_nonzero(run.counted) >= FEWEST]
    moving, rated_nm = [run.in_motion for run in runs], joint.rated_torque_nm
    known = {key: sigma[key] for key in ("current_nm", "viscous_nms_per_rad", "load", "scale")}
    fused = replace(joint.fused, sigma=replace(joint.fused.sigma, **known), zeros=None, agreement=None)
    fused = replace(fused, zeros=fit_zeros(moving, fused, rated_nm))
    fused = calibrated(runs, replace(fused, agreement=fit_agreement(moving, fused, rated_nm)), rated_nm)
    parts = {"sigma": fused.sigma, "zeros": fused.zeros, "agreement": fused.agreement}
    return {key: plain_values(part) for key, part in parts.items() if part is not None}


def _sensor(run: PathRun) -> FloatArray:
    if run.columns.torque_nm is None:
        raise ValueError(f"{run.name}: found no torque_nm, expected the torque sensor")
    return run.columns.torque_nm


def _moving(inputs: FloatArray) -> BoolArray:
    result: BoolArray = np.abs(inputs[:, _VELOCITY]) > 2.0 * _SETTINGS.standstill_velocity_rad_s
    return result


def _residuals(
    run: PathRun, inputs: FloatArray, settled: BoolArray, trained: Trained
) -> tuple[PathResiduals, FloatArray]:
    """Return the errors against the sensor, whose own offset is in them: in motion, and their magnitudes at rest."""
    error, moves = estimate_nm(trained, inputs) - _sensor(run), _moving(inputs)
    x, none = inputs[settled & moves], np.zeros(np.count_nonzero(settled & moves))
    in_motion = PathResiduals(x[:, _BASE], x[:, _VELOCITY], none, none, none, error[settled & moves], none)
    return in_motion, np.abs(error[settled & ~moves])


def _in_service(
    held: Sequence[PathRun], joint: Joint, network: PathNetwork
) -> tuple[dict[str, tuple[float, float]], tuple[float, float, float, float]]:
    """Return the MSE [Nm^2] of each held-out run in motion, with and without the network, and the scale of sigma with it."""
    scores, errors, sigmas, kinds = {}, [], [], []
    for run in held:
        settled = run.time_s - run.time_s[0] >= SETTLE_S
        parts = []
        for each in (network, None):
            found = estimate_columns(joint, _SETTINGS, each, run.time_s, run.columns)
            error = found.torque_nm - _sensor(run)  # of the same instant: a delay counts as error
            parts.append((found, error, settled & np.isin(found.status, (VALID, DEGRADED))))
        (found, error, use), (_, before, also) = parts
        both = use & also & (found.status != STANDSTILL)
        if np.count_nonzero(both) < FEWEST:
            continue
        scores[run.name] = float(np.mean(error[both] ** 2)), float(np.mean(before[both] ** 2))
        errors.append(error[both])
        sigmas.append(found.sigma_nm[both])
        kinds.append(quadrants(found.features[both, _BASE], found.features[both, _VELOCITY]))
    return scores, conformal_scale(errors, sigmas, kinds)
