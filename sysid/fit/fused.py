"""Fit section `fused` of a joint file: torsion, loss, operating envelope, and an uncertainty calibrated on held-out runs.

The runs are split into folds. Each run is compared with a fit on the other folds, which gives the residuals of the
uncertainty; the parameters that are written are those of all runs together.

    loss         additive loss (`losses.py`)                    torsion      spring and angle errors (`torsion.py`)
    envelope     what the runs covered          sigma        standard deviations (`calibration.py`)
    tracking     of an estimate without delay (`calibration.py`)
    standstill   interval of a standing joint (`calibration.py`)
    zeros        day-to-day offset         agreement    of the two paths
    scale        last, with all of these (`calibration.py`)

A joint with one encoder has the current path alone: loss and sigma.

Operating envelope of a fit: speeds, motor torques, temperatures, and the largest difference of torsion and current.

Day-to-day repeatability of a joint: sections `fused.zeros` and `fused.agreement`, from held-out runs.

Offset of the link encoder (`fused.zeros`): how far it differs from day to day.

    spread_nm^2 = variance of the torsion's run means - reference^2
    spread_rad  = spread_nm over the mean stiffness of the spring
    correlation_s = long-run variance / assumed, of the residual of a day's states in the difference of the paths

The mean error of a run is its offset and the sensor's; reference^2 is the sensor's (`calibration.py`). The
long-run variance is that of means over WINDOW_S, times WINDOW_S, after least squares with the states of
`fusion.pyx` in each run; assumed is that of both paths, less that of the offset. The same runs are then estimated
as in service, each from its start, with offsets tracked. The section is written where that reduces the mean square error by
at least WORTH; `calibration.py` sets its scale.

Agreement of the paths (`fused.agreement`): quantiles over samples of how far they differ on ordinary days. A difference
beyond is doubt that grows from zero, so a run slightly beyond costs little (estimator/fusion.pyx).

Waves of the difference over the motor's turn, in contrast, are the same on every day. Least squares finds what all runs have
in common, with the slow part of each second removed on both sides. The residual waves of a run count by their covariance
over all runs, and the limit is beyond that of ordinary blocks, not of the worst one, which a changed gear would hide behind.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.fusion import (
    CORRELATION_S,
    EVERY,
    MOVING_RAD_S,
    ONE_WAY,
    TURNING_RAD_S,
    Fusion,
    levels,
    turn_waves,
)
from jtqd.estimator.joint import (
    MAX_CELLS,
    TURN_WAVES,
    AdditiveLoss,
    Agreement,
    DayZeros,
    Envelope,
    Friction,
    Fused,
    FusedSigma,
    Joint,
    Torsion,
    Turn,
)
from jtqd.estimator.native_network import envelope_weights
from jtqd.estimator.text import counted
from jtqd.sysid.fit.calibration import (
    PathResiduals,
    calibrated,
    fit_sigma,
    fit_standstill,
    fit_tracking,
    fused_errors,
    low_pass_advance,
    observed_run,
    path_residuals,
    standing_errors,
)
from jtqd.sysid.fit.losses import LossFit, fit_loss
from jtqd.sysid.fit.signals import RunSignals
from jtqd.sysid.fit.torsion import fit_torsion

# Operating envelope ----------------------------------------------------------------------------------

VELOCITY_STEP_SHARE: Final = 1.0 / 12.0
"""Of the largest speed of the runs: 0.25 rad/s on the shipped joints (3 rad/s)."""
_ROUND: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Steps of speed, times a power of ten: readable, and independent of the noise of the fastest sample."""
TORQUE_STEP_SHARE: Final = 0.075
"""Of rated torque: 3 Nm on the shipped joints."""
FIT_MARGIN_K: Final = 3.0
"""A friction that is known over some days is known 3 K beyond the warmest: 2 to 3 % per kelvin of its viscous part."""
_VISITS: Final = 20
"""Samples at 1 kHz in a cell that make it known."""
BEYOND_SHARE: Final = 0.01
"""Share of a held-out run's samples that may lie beyond the map of the other runs."""
MOST_WIDER: Final = 2
"""Cells of load added on either side, 15 % of rated torque: runs that need more do not show what they cover."""

Table = np.ndarray[tuple[int, int], np.dtype[np.bool_]]
Counts = np.ndarray[tuple[int, int], np.dtype[np.int64]]


def envelope_of(
    velocity_rad_s: FloatArray,
    raw_nm: FloatArray,
    apart_nm: FloatArray,
    temperatures_c: Sequence[float],
    *,
    velocity_step_rad_s: float,
    torque_step_nm: float,
) -> Envelope:
    """Return what moving samples [n] covered: cells of velocity and motor torque with enough of them, and cells between.

    apart_nm: torsion less current path [n]. temperatures_c: of the runs, NaN where unknown.
    """
    rows = int(np.ceil(np.abs(velocity_rad_s).max() / velocity_step_rad_s)) + 1
    columns = int(np.ceil(np.abs(raw_nm).max() / torque_step_nm)) + 1
    steps = velocity_step_rad_s, torque_step_nm
    known = filled(_visits(velocity_rad_s, raw_nm, steps, (2 * rows + 1, 2 * columns + 1)) >= _VISITS)
    temperatures = [each for each in temperatures_c if np.isfinite(each)]
    return Envelope(
        *steps,
        _as_rows(known),
        1.25 * float(np.quantile(np.abs(apart_nm), 0.999)),
        (min(temperatures) - FIT_MARGIN_K, max(temperatures) + FIT_MARGIN_K) if temperatures else None,
    )


def _visits(
    velocity_rad_s: FloatArray, raw_nm: FloatArray, steps: tuple[float, float], shape: tuple[int, int]
) -> Counts:
    """Return the samples in each cell of a map of this shape."""
    counts = np.zeros(shape, np.int64)
    at = (
        np.rint(velocity_rad_s / steps[0]).astype(int) + shape[0] // 2,
        np.rint(raw_nm / steps[1]).astype(int) + shape[1] // 2,
    )
    np.add.at(counts, at, 1)
    return counts


def widened(made: Envelope, runs: Sequence[tuple[FloatArray, FloatArray]]) -> Envelope:
    """Return the envelope of runs, each (velocity, motor torque) [n] in motion, with as many more cells of load as needed.

    Needed: on average at most BEYOND_SHARE of the samples of a run lie beyond the map of the other runs. In speed nothing is
    added: the map ends where the runs end, as the load does by `load_nm`.
    """
    steps = made.velocity_step_rad_s, made.torque_step_nm
    counts = [_visits(v, raw, steps, (len(made.known), len(made.known[0]))) for v, raw in runs]
    others = [filled(sum(counts) - own >= _VISITS) for own in counts]
    for cells in range(MOST_WIDER + 1):
        beyond = [
            envelope_weights(replace(made, known=_as_rows(_wider(known, cells))), v, raw) < 0.5
            for known, (v, raw) in zip(others, runs, strict=True)
        ]
        if np.mean([each.mean() for each in beyond]) <= BEYOND_SHARE:
            break
    return replace(made, known=_as_rows(_wider(np.array(made.known, np.bool_), cells)))


def _wider(known: Table, cells: int) -> Table:
    """Add so many cells of load on either side of known ones, on a map as much wider."""
    padded = np.pad(known, ((0, 0), (2 * cells, 2 * cells)))
    width = known.shape[1] + 2 * cells
    result: Table = np.logical_or.reduce([padded[:, k : k + width] for k in range(2 * cells + 1)])
    return result


def _as_rows(known: Table) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(cell) for cell in row) for row in known)


def velocity_step(velocity_rad_s: FloatArray) -> float:
    """Return the step of speed for moving samples [n]: a round number near VELOCITY_STEP_SHARE of the largest speed."""
    wanted = VELOCITY_STEP_SHARE * float(np.quantile(np.abs(velocity_rad_s), 0.999))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(f"{power * min(_ROUND, key=lambda each: abs(np.log(each * power / wanted))):.6g}")


def filled(known: Table) -> Table:
    """Add cells that lie between known ones in both directions: holes, not edges."""

    def between(axis: int) -> Table:
        before = np.maximum.accumulate(known, axis=axis)
        after = np.flip(np.maximum.accumulate(np.flip(known, axis), axis=axis), axis)
        return np.logical_and(before, after)

    result: Table = known | (between(0) & between(1))
    return result


def map_of(
    runs: Sequence[tuple[FloatArray, FloatArray]],
    apart_nm: FloatArray,
    temperatures_c: Sequence[float],
    rated_nm: float,
) -> Envelope | None:
    """Return what runs covered, each (velocity, motor torque) [n] in motion, others as `envelope_of`.

    None where that takes a larger map than an envelope may have.
    """
    velocity, raw = (np.concatenate(part) for part in zip(*runs, strict=True))
    steps = {"velocity_step_rad_s": velocity_step(velocity), "torque_step_nm": TORQUE_STEP_SHARE * rated_nm}
    made = envelope_of(velocity, raw, apart_nm, temperatures_c, **steps)
    large = max(len(made.known), len(made.known[0])) > MAX_CELLS - 2 * MOST_WIDER
    return None if large else widened(made, runs)


def fit_envelope(
    runs: Sequence[RunSignals], loss: AdditiveLoss, torsion: Torsion, rated_nm: float
) -> Envelope | None:
    """Return what the runs covered; None as `map_of`."""
    seen = [path_residuals(run, loss, torsion) for run in runs if run.moving.any()]
    pairs = [(run.velocity_rad_s, run.raw_nm) for run in seen]
    apart = np.concatenate([run.apart_nm for run in seen])
    made = map_of(pairs, apart, [run.temperature_c for run in runs], rated_nm)
    load = max(float(np.abs(run.torsion_nm).max()) for run in seen)
    return None if made is None else replace(made, load_nm=load)


# Day-to-day offsets ----------------------------------------------------------------------------------

WORTH: Final = 0.05
"""Share of the held-out mean square error that tracked offsets must remove."""
_MOST: Final = 0.9
"""Share of the torsion's variance that the day's offset has at most."""
WINDOW_S: Final = 0.5
"""Longer than ripple and encoders' errors last; a run has to have two windows for each state."""
_SHORTEST_S: Final = 1e-3
"""A sample at 1 kHz."""
_FEWEST_DAYS: Final = 8
"""Runs, each of another day, that give a spread."""


def fit_zeros(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> DayZeros | None:
    """Return the section of held-out runs, scale 1; None where tracking is not worth it, or for too few runs."""
    if len(runs) < _FEWEST_DAYS or not all(len(run.dt_s) for run in runs):
        return None
    sigma = fused.sigma
    means = np.array([run.torsion_error_nm.mean() for run in runs])
    variance = min(float(np.var(means)) - sigma.reference_nm**2, _MOST * sigma.torsion_nm**2)
    if not variance > 0.0:
        return None
    stiffness = float(np.mean([run.stiffness_nm_per_rad.mean() for run in runs]))
    spread = float(np.sqrt(variance))
    found = DayZeros(spread / stiffness, spread, (1.0, 1.0, 1.0, 1.0), correlation(runs, sigma, spread))

    def square(section: Fused) -> float:
        errors = [fused_errors(run, section, rated_nm, track_zeros=True).error_nm for run in runs]
        return float(np.mean([np.mean(error**2) for error in errors]))

    return found if square(replace(fused, zeros=found)) < (1.0 - WORTH) * square(fused) else None


def correlation(runs: Sequence[PathResiduals], sigma: FusedSigma, spread_nm: float) -> float | None:
    """Return the correlation time [s] of what no state of the day explains of the paths' difference; None if unknown.

    For the variance that the filter assumes: of both paths less that of the day's offset.
    """
    found, assumed = [], []
    for run in runs:
        keep = (np.abs(run.velocity_rad_s) > MOVING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        states = (
            run.stiffness_nm_per_rad,
            1.0 - run.slope,
            run.direction,
            run.velocity_rad_s,
            run.torsion_nm,
        )
        variance = Fusion(sigma, True).fuse(*run.fusion_inputs).variance_nm2 - spread_nm**2
        rows = np.column_stack((*states, run.apart_nm, variance))[keep]
        length = max(round(WINDOW_S / float(np.mean(run.dt_s))), 1)
        windows = len(rows) // length
        if windows < 2 * len(states):
            continue
        means = rows[: windows * length].reshape(windows, length, -1).mean(axis=1)
        x, y = means[:, :-2] / np.abs(means[:, :-2]).max(axis=0).clip(1e-12), means[:, -2]
        weights, _, rank, _ = np.linalg.lstsq(x, y, rcond=1e-6)
        residual = y - x @ weights
        found.append(float(residual @ residual) / (windows - int(rank)))
        assumed.append(float(means[:, -1].mean()))
    if not found:
        return None
    return float(np.clip(WINDOW_S * np.mean(found) / np.mean(assumed), _SHORTEST_S, CORRELATION_S))


# Agreement of the paths ------------------------------------------------------------------------------

QUANTILE: Final = 0.75
"""Of the blocks of all runs: the rest of ordinary days has a little doubt. Chosen on runs that no figure is reported on."""
LOWERED: Final = 0.99
"""Of the blocks of all runs: a doubt beyond it is not that of ordinary days. The rest, and as much by the envelope
(`BEYOND_SHARE`), is the 2 % that may be flagged without need."""
LEVEL_FACTOR: Final = 2.8
GAIN_FACTOR: Final = 4.0
"""Of `fusion.pyx`, chosen with QUANTILE: larger ones cover changed joints no better."""
ZERO_FACTOR: Final = 1.3
"""Of `fusion.pyx`: chosen on runs that no figure is reported on. Until the joint has moved both ways, the filter
finds less of an offset than there is: friction takes a part."""
GAIN_SIGMAS: Final = 1.0
"""Of `fusion.pyx`: chosen on runs that no figure is reported on. More hold a softer spring less; without, sigma is
wider where a joint is always driven."""
_START: Final = Agreement(1.0, 1.0, 0.0, 0.0, gain_sigmas=GAIN_SIGMAS)
_FEWEST_BLOCKS: Final = 200
"""3 s of motion at 1 kHz."""
_FLOOR_NM: Final = 1e-3


def fit_agreement(runs: Sequence[PathResiduals], fused: Fused, rated_nm: float) -> Agreement | None:
    """Return how far the two paths differ on held-out runs; None for too little motion."""
    fusion = Fusion(fused.sigma, True)
    moving = [run for run in runs if len(run.dt_s)]

    def levels_of(agreement: Agreement) -> list[tuple[FloatArray, ...]]:
        usual = replace(fused, agreement=agreement)
        return [
            levels(usual, rated_nm, *run.difference, fusion.fuse(*run.fusion_inputs).variance_nm2, run.slope)
            for run in moving
        ]

    slow, fast, gain, offset, _ = (np.concatenate(parts) for parts in zip(*levels_of(_START), strict=True))
    if len(slow) < _FEWEST_BLOCKS:
        return None

    def level(values: FloatArray) -> float:
        return float(np.quantile(values, QUANTILE))

    turn = fit_turn(moving)
    found = Agreement(
        slow_nm=max(level(np.sqrt(slow)), _FLOOR_NM),
        # errors over the motor's turn show in its waves
        fast_nm=max(float(np.quantile(np.sqrt(fast), QUANTILE if turn is None else LOWERED)), _FLOOR_NM),
        gain=level(gain),
        zero_nm=level(offset),
        level_factor=LEVEL_FACTOR,
        gain_factor=GAIN_FACTOR,
        zero_factor=ZERO_FACTOR,
        gain_sigmas=GAIN_SIGMAS,
    )
    doubt = np.concatenate([run[-1] for run in levels_of(found)])
    found = replace(found, lowered_nm=max(float(np.quantile(doubt, LOWERED)), _FLOOR_NM))
    return replace(found, turn=turn)


# Waves of the turn -----------------------------------------------------------------------------------

TURN_BEYOND: Final = 2.0
"""The limit in parts of what LOWERED of the blocks of all runs have. Chosen on runs that no figure is reported on."""
_FEWEST_RUNS: Final = 16
"""With motion, for a covariance of the six waves."""
_TURN_FLOOR_NM: Final = 1e-2
_PART_S: Final = 1.0
"""The slow part is removed from pieces of this length."""


def fit_turn(runs: Sequence[PathResiduals]) -> Turn | None:
    """Return what runs have in common over the motor's turn, and how far they differ; None for too few runs."""
    constant, loss, viscous, quadratic = (tuple(map(float, part)) for part in _common_waves(runs))
    found = Turn(constant, loss, viscous, quadratic, _lower(np.eye(TURN_WAVES)), limit=1.0)
    each = [waves for waves in (_turn_waves(found, run)[0] for run in runs) if len(waves)]
    if len(each) < _FEWEST_RUNS:
        return None
    residual = np.concatenate(each)
    covariance = residual.T @ residual / len(residual) + _TURN_FLOOR_NM**2 * np.eye(TURN_WAVES)
    found = replace(found, covariance_nm2=_lower(covariance))
    squares = np.concatenate([_turn_waves(found, run)[1] for run in runs])
    return replace(found, limit=TURN_BEYOND * float(np.quantile(squares, LOWERED)))


def _turn_waves(turn: Turn, run: PathResiduals) -> tuple[FloatArray, FloatArray]:
    return turn_waves(turn, run.dt_s, run.apart_nm, run.direction, run.velocity_rad_s, run.loss_nm, run.turn)


def _lower(matrix: FloatArray) -> tuple[float, ...]:
    return tuple(map(float, matrix[np.tril_indices(len(matrix))]))


def _common_waves(runs: Sequence[PathResiduals]) -> FloatArray:
    """Return the parts [4, 6] of the waves that all runs have: constant, by loss, by speed, by its square."""
    products: FloatArray = np.zeros(4 * TURN_WAVES)
    squares: FloatArray = np.zeros((4 * TURN_WAVES, 4 * TURN_WAVES))
    for run in runs:
        turning = (np.abs(run.velocity_rad_s) > TURNING_RAD_S) & (np.abs(run.direction) > ONE_WAY)
        keep = np.flatnonzero(turning)[::EVERY]
        if not len(keep):
            continue
        v, loss, waves = run.velocity_rad_s[keep], run.loss_nm[keep], run.turn[keep]
        columns = np.column_stack([waves * part[:, None] for part in (np.ones_like(v), loss, v, v * v)])
        both = np.column_stack((columns, run.apart_nm[keep]))
        slow = np.column_stack((np.ones_like(v), run.direction[keep], v, loss))
        count = max(1, round(float(run.dt_s[keep].sum()) * EVERY / _PART_S))
        for at in np.array_split(np.arange(len(keep)), count):
            rest = both[at] - slow[at] @ np.linalg.lstsq(slow[at], both[at], rcond=None)[0]
            squares += rest[:, :-1].T @ rest[:, :-1]
            products += rest[:, :-1].T @ rest[:, -1]
    return np.asarray(np.linalg.lstsq(squares, products, rcond=None)[0], np.float64).reshape(4, TURN_WAVES)


# The whole section -----------------------------------------------------------------------------------

FOLDS: Final = 4
_LEAST_RUNS: Final = 6


@dataclass(frozen=True)
class FusedFit:
    """fused: the section; loss: details of its fit; held_out_rmse_nm: of the physics, one per run with motion."""

    fused: Fused
    loss: LossFit
    held_out_rmse_nm: tuple[float, ...]


def folds(runs: Sequence[RunSignals]) -> Iterator[tuple[list[RunSignals], list[int]]]:
    """Yield (runs to fit, indices of the held-out runs); whole runs, each held out exactly once."""
    for k in range(min(FOLDS, len(runs))):
        held_out = [n for n in range(len(runs)) if n % FOLDS == k]
        yield [run for n, run in enumerate(runs) if n not in held_out], held_out


def fit_fused(runs: Sequence[RunSignals], joint: Joint, *, two_encoders: bool = True) -> FusedFit:
    """Fit section `fused` of one joint.

    joint: friction and rated torque of its file are used.

    Raises:
        ValueError: fewer than 6 runs. LossFitError, TorsionError: the runs do not give a loss or a torsion.
    """
    if len(runs) < _LEAST_RUNS:
        raise ValueError(
            f"found {counted(len(runs), 'run')}, expected at least {_LEAST_RUNS}: standard deviations need held-out runs"
        )
    rated_nm = joint.rated_torque_nm
    observed, standing = _held_out(runs, joint.friction, two_encoders=two_encoders)
    moving = [run.in_motion for run in observed]
    fit = fit_loss(runs, joint.friction)
    fused = Fused(fit.loss, None, fit_sigma(moving, with_torsion=two_encoders))
    if two_encoders:
        torsion = fit_torsion(runs)
        fused = replace(fused, torsion=torsion, envelope=fit_envelope(runs, fit.loss, torsion, rated_nm))
    rmse = tuple(float(np.sqrt(np.mean(fused_errors(run, fused).error_nm ** 2))) for run in moving)
    if two_encoders:
        at_rest = [standing_errors(*run, fused) for run in standing]
        fused = replace(
            fused,
            tracking=fit_tracking(moving, fused),
            standstill=fit_standstill(at_rest, fused.sigma.reference_nm),
        )
        if fused.tracking is not None:
            moving, observed = ([run.with_tracked_torsion() for run in part] for part in (moving, observed))
        fused = replace(fused, zeros=fit_zeros(moving, fused, rated_nm))
        fused = replace(fused, agreement=fit_agreement(moving, fused, rated_nm))
    return FusedFit(calibrated(observed, fused, rated_nm), fit, rmse)


def _held_out(
    runs: Sequence[RunSignals], friction: Friction, *, two_encoders: bool
) -> tuple[list[PathResiduals], list[tuple[PathResiduals, FloatArray]]]:
    """Return the residuals of every run with motion, in order, from fits on the other folds: all samples; at rest.

    With one encoder those in motion alone. At rest: each with the `low_pass_advance` of its samples.
    """
    observed: dict[int, PathResiduals] = {}
    standing: dict[int, tuple[PathResiduals, FloatArray]] = {}
    for known, held_out in folds(runs):
        torsion = fit_torsion(known) if two_encoders else None
        loss = fit_loss(known, friction).loss
        for n in held_out:
            run = runs[n]
            if not run.moving.any():
                continue
            if torsion is None:
                observed[n] = path_residuals(run, loss, None)
            else:
                observed[n] = observed_run(run, loss, torsion)
                advance = low_pass_advance(run, torsion)[run.standing]
                standing[n] = (path_residuals(run, loss, torsion, run.standing), advance)
    return [observed[n] for n in sorted(observed)], [standing[n] for n in sorted(standing)]
