"""Outlier runs: runs whose channels differ from those of all others in gain, offset or delay.

An effect of the joint is in all runs, and run-to-run variation is small. A larger deviation of one run alone is the
run's own: a loose plug, a sensor zeroed again, another filter of the drive.

    y_r = X_r beta + Z_r u_r + w_r d_r + e          w: a unit of gain, zero or delay of one channel

beta: all entries, each under its prior (`entries`); u_r: run-to-run variation (`regressors.families`); d_r ~ N(0, USUAL^2).
All is linear and Gaussian, so what the rows say of one run's deviation, with all else under its prior, is a Gaussian, too.

A run is an outlier where that differs from the mean of the other runs by more than FAR standard deviations: of its own error
and of what these runs differ by (their spread, mixed with USUAL, which is worth `limits.RUNS_COUNT` runs). Of a gain only
what is beyond its `echo` counts: a channel that is all noise explains its own noise in the residual.

It must explain more of the run's squared error per row than what is left with it exceeds that of all others. A delay of the
current can imitate a brake that drags or a cover that rubs in one run, but explains only some per cent: such a run is no
outlier, and its disturbance must stay in the data.

Of two runs none can be called the outlier. One run at a time is taken away, fewer than half of all (`diagnose`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.entries import entries_of, transform_of
from jtqd.sysid.diagnosis.findings import JointName, OutlierRun, joint_text
from jtqd.sysid.diagnosis.limits import RUNS_COUNT
from jtqd.sysid.diagnosis.regressors import RunData, binned, noise_of_channels, run_sums, seen_in_bins
from jtqd.sysid.diagnosis.signals import JointSignals

FEWEST: Final = 3
"""Recordings among which one can be an outlier."""
FAR: Final = 5.0
"""Standard deviations."""
USUAL: Final[Mapping[str, float]] = {"gain": 0.01, "zero": 0.004, "delay": 5e-4}
"""What runs usually differ by: a part, a part of the rated torque (of a current, its torque), seconds."""
UNITS: Final[Mapping[str, str]] = {"gain": "", "zero": "of rated", "delay": "s"}
_AS_GOOD: Final = 0.8
"""Part of its squared distance from which another deviation of the same run is listed as an alternative."""
_ANY: Final = 1e6
"""Of the usual size: as if any were as likely."""
_TURNS: Final = 4
"""Fits, each with the noise that the one before leaves."""


class Deviation(NamedTuple):
    """What one run may have of its own: a gain, zero or delay of the current of a joint, or of the sensor."""

    what: str
    channel: str
    joint: JointName


class Fit(NamedTuple):
    """Posterior of what all recordings have in common [E] and each its own [r, N], with its covariance [r, N, N]."""

    common: FloatArray
    own: FloatArray
    covariance: FloatArray


class Comparison(NamedTuple):
    """What the rows say of each recording's deviations [r, K], all else under its prior.

    apart: difference from the others; spread: standard deviation of those; error: of the difference, by noise; echo: what of
    it the noise of its own channel makes; explains: whether it is more of the recording's squared error than what is left
    beyond that of all others.
    """

    apart: FloatArray
    spread: FloatArray
    error: FloatArray
    echo: FloatArray
    explains: BoolArray

    @property
    def distance(self) -> FloatArray:
        """In standard deviations [r, K]."""
        beyond = np.maximum(np.abs(self.apart) - self.echo, 0.0)
        return np.asarray(beyond / np.hypot(self.spread, self.error))


def outlier_run(dataset: Dataset) -> tuple[list[int], OutlierRun] | None:
    """Return places in dataset.runs of the run (or its pieces) that differs most from all others, and how; None: none."""
    if max(dataset.recordings) + 1 < FEWEST:
        return None
    kinds = deviations(dataset.joints)
    seen = compared(dataset, kinds)
    far = np.where(seen.explains, seen.distance, 0.0)
    r, k = (int(place) for place in np.unravel_index(np.argmax(far), far.shape))
    if far[r, k] <= FAR:
        return None
    as_good = seen.distance[r] ** 2 >= _AS_GOOD * far[r, k] ** 2
    others = tuple(
        f"{o.what} of {o.channel} of {joint_text(o.joint)}"
        for j, o in enumerate(kinds)
        if j != k and as_good[j]
    )
    places = [place for place, piece in enumerate(dataset.recordings) if piece == r]
    kind, apart = kinds[k], float(seen.apart[r, k])
    if kind.what == "gain" and kind.channel == "torque_nm":
        apart /= 1.0 - apart  # of the true value: g of it is g / (1 + g) of what was read
    name, spread = dataset.runs[places[0]].name, float(seen.spread[r, k])
    return places, OutlierRun(name, *kind, apart, spread, UNITS[kind.what], others)


def compared(dataset: Dataset, kinds: Sequence[Deviation]) -> Comparison:
    """Return what the recordings say of these deviations."""
    pieces, families = np.array(dataset.recordings, np.intp), len(dataset.families)
    both = list(zip(dataset.runs, dataset.signals, strict=True))
    runs = [_with_columns(run, signals, kinds, families) for run, signals in both]
    columns = dataset.candidates[-1].columns.stop if dataset.candidates else 0
    weights = transform_of(entries_of(dataset.candidates, dataset.signals, dataset.trust), columns)
    usual = np.array([USUAL[kind.what] for kind in kinds])
    prior = np.concatenate(([family.sigma for family in dataset.families], usual))
    full = np.eye(columns + len(prior) + 1)[:, columns:]
    full = np.hstack((np.pad(weights, ((0, len(prior) + 1), (0, 0))), full))
    left = {
        c: [np.where(run.channels[c].valid, run.channels[c].residual, np.nan) for run in runs]
        for c in runs[0].channels
    }
    for _ in range(_TURNS):
        noise = noise_of_channels(left, dataset.step_s)
        sums = [run_sums(run, noise, columns, len(prior)) for run in runs]
        grams = np.zeros((int(pieces.max()) + 1, full.shape[1], full.shape[1]))
        np.add.at(grams, pieces, np.array([full.T @ s.gram @ full for s in sums]))
        fit = fitted(grams, prior)
        library = weights @ fit.common
        left = {
            c: [
                np.where(
                    d.valid,
                    d.residual - d.regressors @ library[d.index] - d.nuisances @ fit.own[r][d.families],
                    np.nan,
                )
                for r, d in zip(pieces, (run.channels[c] for run in runs), strict=True)
            ]
            for c in left
        }
    echoes = np.zeros((len(grams), len(kinds)))
    np.maximum.at(
        echoes, pieces, [[echo(kind, signals, run.samples) for kind in kinds] for run, signals in both]
    )
    rows, each = np.bincount(pieces, [s.rows for s in sums]).astype(np.float64), []
    for k in range(len(kinds)):
        own = [*range(families), families + k]
        at = np.array([*range(len(fit.common)), *(len(fit.common) + np.array(own)), -1], np.intp)
        each.append(comparison(grams[:, at[:, None], at], rows, prior[own], echoes[:, k]))
    return Comparison(*map(np.column_stack, zip(*each, strict=True)))


def fitted(grams: FloatArray, prior: FloatArray) -> Fit:
    """Return the posterior from normal equations of every recording over what all have in common, its own and the residual
    [r, E + N + 1, same]; prior: standard deviations of its own [N], those of the others are one.
    """
    e = grams.shape[1] - 1 - len(prior)
    inner = np.linalg.inv(grams[:, e:-1, e:-1] + np.diag(1.0 / prior**2))
    cross = grams[:, e:-1, :e]
    into = inner @ cross
    precision = np.eye(e) + np.sum(grams[:, :e, :e] - cross.transpose(0, 2, 1) @ into, axis=0)
    right = np.sum(grams[:, :e, -1] - (into.transpose(0, 2, 1) @ grams[:, e:-1, -1:])[:, :, 0], axis=0)
    common = np.linalg.solve(precision, right)
    own = (inner @ grams[:, e:-1, -1:])[:, :, 0] - into @ common
    return Fit(common, own, inner + into @ np.linalg.solve(precision, into.transpose(0, 2, 1)))


def comparison(grams: FloatArray, rows: FloatArray, prior: FloatArray, echoes: FloatArray) -> Comparison:
    """Return what normal equations as those of `fitted` say of the last of what a recording has of its own [r].

    rows: of each recording [r]; echoes: of each [r].
    """
    count, usual = len(grams), float(prior[-1])
    # a size that all have in common is any: beside it each is apart from the others
    wide = np.hstack((np.zeros((grams.shape[1], 1)), np.eye(grams.shape[1])))
    wide[-2, 0] = _ANY * usual
    grams = wide.T @ grams @ wide
    fit = fitted(grams, prior)
    mean, variance = fit.own[:, -1], fit.covariance[:, -1, -1]
    # the rows alone: the posterior less the prior of this deviation
    noise = variance / np.maximum(1.0 - variance / usual**2, 1e-9)
    around = (mean.sum() - mean) / (count - 1.0)  # the mean of the others
    square = np.sum(mean**2) - mean**2 - (count - 1.0) * around**2
    spread = np.sqrt((square + RUNS_COUNT * usual**2) / (count - 1.0 + RUNS_COUNT))
    e, rest = len(fit.common), np.concatenate((-fit.common, np.zeros(len(prior)), [1.0]))

    def left(deviation: float, number: int = len(prior)) -> FloatArray:
        """Return the squared error per row of each recording with this prior of the last one, or without it [r]."""
        at = slice(e, e + number)
        inner = grams[:, at, at] + np.diag(1.0 / np.append(prior[:-1], deviation)[:number] ** 2)
        right = grams[:, at] @ rest
        explained = np.sum(right * np.linalg.solve(inner, right[:, :, None])[:, :, 0], axis=1)
        return np.asarray((rest @ (grams @ rest).T - explained) / rows)

    without, with_it, like_others = left(usual, len(prior) - 1), left(_ANY * usual), left(usual)
    explains = without - with_it > with_it - [np.max(np.delete(like_others, r)) for r in range(count)]
    return Comparison(mean * noise / variance, spread, np.sqrt(noise), echoes, explains)


def deviations(joints: Mapping[int, object]) -> list[Deviation]:
    """Return what is asked of every run with these joints; zeros are in parts of the rated torque."""
    where: list[tuple[str, JointName]] = [*(("current_a", n) for n in joints), ("torque_nm", "sensor")]
    return [Deviation(what, channel, joint) for what in USUAL for channel, joint in where]


def column(kind: Deviation, s: JointSignals, balance: str) -> FloatArray | None:
    """Return what one unit of a deviation leaves in a balance of one joint [n], Nm; None: nothing."""
    state, rated = s.state, np.full(len(s.time_s), s.joint.rated_torque_nm)
    if kind.channel == "torque_nm":
        made = {"gain": -state.torque_nm, "zero": -rated, "delay": state.torque_rate_nm_s}
        return np.asarray(made[kind.what] * (s.per_torque if balance == MOTOR else 1.0))
    if kind.joint != s.number or balance != MOTOR:
        return None
    per_a = s.nm_per_a
    made = {"gain": per_a * state.current_a, "zero": rated, "delay": -per_a * state.current_rate_a_s}
    return np.asarray(made[kind.what])


def echo(kind: Deviation, signals: Sequence[JointSignals], samples: float) -> float:
    """Return the gain that a channel's own noise makes in a run: its part of what the channel shows, in bins."""
    if kind.what != "gain":
        return 0.0
    s = next(s for s in signals if kind.joint in (s.number, "sensor"))
    shown = s.state.current_a if kind.channel == "current_a" else s.state.torque_nm
    noise = s.noise.get(kind.channel, 0.0) ** 2 / samples
    return noise / max(float(np.var(binned(shown, samples))), 1e-300) if noise else 0.0


def _with_columns(
    run: RunData, signals: Sequence[JointSignals], kinds: Sequence[Deviation], families: int
) -> RunData:
    """Return the run with the deviations as further nuisances, behind so many families."""
    channels = {}
    of = {s.number: s for s in signals}
    for channel, d in run.channels.items():
        s = of[channel.joint]
        made = [(families + k, column(kind, s, channel.balance)) for k, kind in enumerate(kinds)]
        numbers, columns = seen_in_bins(s, [(k, c) for k, c in made if c is not None], run.samples)
        channels[channel] = replace(
            d, nuisances=np.hstack((d.nuisances, columns)), families=np.concatenate((d.families, numbers))
        )
    return replace(run, channels=channels)
