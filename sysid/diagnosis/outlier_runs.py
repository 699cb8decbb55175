"""Outlier runs: runs whose channels differ from those of all others in gain, offset or delay.

An effect of the joint is in all runs, and run-to-run variation is small. A larger deviation of one run alone is the
run's own: a loose plug, a sensor zeroed again, another filter of the drive.

    y_r = X_r beta + Z_r u_r + w_r d_r + e          w: a unit of gain, zero or delay of one channel of run r alone

1. Effects of the library and deviations of single runs are added one by one, whichever lowers the squared error most, beside
   run-to-run variation u_r (`regressors.families`), until none lowers BIC by ENTER.
2. A run is an outlier where a deviation was chosen and, with the chosen effects fitted too, differs from the mean of the
   other runs by more than FAR standard deviations. These hold the run's own error and the spread of the others, mixed with
   the usual one (USUAL, worth `limits.RUNS_COUNT` runs). Of a gain only what is beyond its `echo` counts: a channel that is
   all noise explains its own noise in the residual.
3. The run's squared error per row exceeds the median of the others; this deviation must explain most of that excess.
   A delay of the current can imitate a brake that drags or a cover that rubs in one run, but explains only some per cent:
   such a run is no outlier, and its disturbance must stay in the data.

Of two runs none can be called the outlier. One run at a time is taken away, fewer than half of all (`diagnose`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.findings import JointName, OutlierRun, joint_text
from jtqd.sysid.diagnosis.limits import RUNS_COUNT
from jtqd.sysid.diagnosis.regressors import (
    EffectCandidate,
    RunData,
    binned,
    noise_of_channels,
    run_sums,
    saturated_residuals,
    seen_in_bins,
)
from jtqd.sysid.diagnosis.signals import JointSignals

ENTER: Final = 10.0
"""BIC difference: very strong evidence on the scale of Kass and Raftery 1995, J. Am. Stat. Assoc. 90."""
FEWEST: Final = 3
"""Recordings among which one can be an outlier."""
FAR: Final = 5.0
"""Standard deviations."""
USUAL: Final[Mapping[str, float]] = {"gain": 0.01, "zero": 0.004, "delay": 5e-4}
"""What runs usually differ by: a part, a part of the rated torque (of a current, its torque), seconds."""
UNITS: Final[Mapping[str, str]] = {"gain": "", "zero": "of rated", "delay": "s"}
_AS_GOOD: Final = 0.8
"""Part of the drop of the squared error from which another deviation of the same run is listed as an alternative."""


class Deviation(NamedTuple):
    """What one run may have of its own: a gain, zero or delay of the current of a joint, or of the sensor."""

    what: str
    channel: str
    joint: JointName


def outlier_run(dataset: Dataset) -> tuple[list[int], OutlierRun] | None:
    """Return places in dataset.runs of the run (or its pieces) that differs most from all others, and how; None: none."""
    if max(dataset.recordings) + 1 < FEWEST:
        return None
    kinds = deviations(dataset.joints)
    comparison = compared(dataset, kinds)
    chosen, off = comparison.chosen(dataset.candidates)
    far = []
    for at in off:
        found = comparison.far(chosen, at, kinds)
        if found is not None and comparison.explains_excess(chosen, off, at):
            far.append((comparison.drop(chosen, off, *at), at, found))
    if not far:
        return None
    most, (r, k), (apart, spread) = max(far)
    others = tuple(
        f"{o.what} of {o.channel} of {joint_text(o.joint)}"
        for j, o in enumerate(kinds)
        if j != k and comparison.drop(chosen, off, r, j) >= _AS_GOOD * most
    )
    places = [place for place, piece in enumerate(dataset.recordings) if piece == r]
    kind, name = kinds[k], dataset.runs[places[0]].name
    if kind.what == "gain" and kind.channel == "torque_nm":
        apart /= 1.0 - apart  # of the true value: g of it is g / (1 + g) of what was read
    return places, OutlierRun(name, *kind, apart, spread, UNITS[kind.what], others)


def compared(dataset: Dataset, kinds: Sequence[Deviation]) -> Comparison:
    """Return the comparison of all recordings; the noise is what nothing explains."""
    pieces, families = np.array(dataset.recordings, np.intp), len(dataset.families)
    both = list(zip(dataset.runs, dataset.signals, strict=True))
    runs = [_with_columns(run, signals, kinds, families) for run, signals in both]
    residuals = {c: saturated_residuals(runs, c, dataset.candidates) for c in runs[0].channels}
    noise = noise_of_channels(residuals, dataset.step_s)
    columns = dataset.candidates[-1].columns.stop if dataset.candidates else 0
    sums = [run_sums(run, noise, columns, families + len(kinds)) for run in runs]
    grams = np.zeros((int(pieces.max()) + 1, *sums[0].gram.shape))
    np.add.at(grams, pieces, np.array([s.gram for s in sums]))
    rows = np.bincount(pieces, [s.rows for s in sums]).astype(np.float64)
    echoes = np.zeros((len(grams), len(kinds)))
    np.maximum.at(
        echoes, pieces, [[echo(kind, signals, run.samples) for kind in kinds] for run, signals in both]
    )
    sigma = np.array([family.sigma for family in dataset.families])
    return Comparison(without_variation(grams, columns, sigma), rows, columns, echoes)


@dataclass(frozen=True)
class Comparison:
    """Normal equations of every run over effects, deviations and residual [r, P + K + 1, same], and its rows [r].

    columns: P; echoes: of every run's deviations [r, K].
    """

    runs: FloatArray
    rows: FloatArray
    columns: int
    echoes: FloatArray

    @property
    def kinds(self) -> int:
        """Number of deviations K."""
        return int(self.runs.shape[1]) - 1 - self.columns

    @cached_property
    def total(self) -> FloatArray:
        """The sum over the runs [P + R K + 1, same], every deviation of every run a column of its own."""
        count, p, k = len(self.runs), self.columns, self.kinds
        out = np.zeros((p + count * k + 1,) * 2)
        for r, run in enumerate(self.runs):
            places = np.array([*range(p), *range(p + r * k, p + (r + 1) * k), out.shape[0] - 1], np.intp)
            out[places[:, None], places] += run
        return out

    def place(self, r: int, k: int) -> int:
        """Return the column of deviation k of run r in `total`."""
        return self.columns + r * self.kinds + k

    def chosen(self, candidates: Sequence[EffectCandidate]) -> tuple[list[int], list[tuple[int, int]]]:
        """Return the columns of the effects, and the deviations (run, kind), that are there: added one by one."""
        own = [(r, k) for r in range(len(self.runs)) for k in range(self.kinds)]
        log_n = math.log(float(self.rows.sum()))
        price = log_n + 2.0 * math.log(len(own))
        blocks: list[tuple[list[int], EffectCandidate | tuple[int, int], float]] = [
            (list(c.columns), c, c.size * log_n) for c in candidates if not c.effect.scales_all
        ]
        blocks += [([self.place(*at)], at, price) for at in own]
        here: list[int] = []
        off: list[tuple[int, int]] = []
        while blocks:
            before = explained(self.total, here)
            worth = [explained(self.total, [*here, *block]) - before - cost for block, _, cost in blocks]
            if max(worth) < ENTER:
                break
            block, new, _ = blocks.pop(int(np.argmax(worth)))
            if isinstance(new, EffectCandidate):
                beta, _ = solve(self.total, [*here, *block])
                if not within(new, beta[len(here) :].tolist()):
                    continue
                blocks = [b for b in blocks if not isinstance(b[1], EffectCandidate) or b[1].key != new.key]
            else:
                off.append(new)
            here += block
        return [p for p in here if p < self.columns], off

    def drop(self, chosen: Sequence[int], off: Sequence[tuple[int, int]], r: int, k: int) -> float:
        """Return by how much deviation k of run r lowers the squared error beside the effects and other runs' deviations."""
        beside = [*chosen, *(self.place(*at) for at in off if at[0] != r)]
        return explained(self.total, [*beside, self.place(r, k)]) - explained(self.total, beside)

    def explains_excess(
        self, chosen: Sequence[int], off: Sequence[tuple[int, int]], at: tuple[int, int]
    ) -> bool:
        """Return whether a deviation is most of what sets its run apart beside all else that was chosen."""
        beta, _ = solve(self.total, [*chosen, *(self.place(*one) for one in off)])
        effects = np.append(-beta[: len(chosen)], 1.0)

        def square(r: int, own: Sequence[int]) -> float:
            """Return the squared error per row of a run with these deviations free."""
            fixed, free = np.array([*chosen, -1], np.intp), self.columns + np.array(own, np.intp)
            right = self.runs[r][free[:, None], fixed] @ effects
            whole = float(effects @ self.runs[r][fixed[:, None], fixed] @ effects)
            gram = self.runs[r][free[:, None], free]
            return (whole - float(right @ np.linalg.lstsq(gram, right, rcond=1e-10)[0])) / float(self.rows[r])

        own = {r: [k for q, k in off if q == r] for r in range(len(self.runs))}
        usual = float(np.median([square(r, own[r]) for r in own if r != at[0]]))
        without, with_it = square(at[0], [k for k in own[at[0]] if k != at[1]]), square(at[0], own[at[0]])
        return without - with_it > 0.5 * (without - usual)

    def far(
        self, chosen: Sequence[int], at: tuple[int, int], kinds: Sequence[Deviation]
    ) -> tuple[float, float] | None:
        """Return by how much a run is apart from the others, and their spread, where it is far from them."""
        r, k = at
        values, errors = own_deviations(self.runs, chosen, self.columns + k)
        apart, spread = apart_from_others(values, r, USUAL[kinds[k].what])
        least = FAR * float(np.hypot(spread, errors[r])) + float(self.echoes[r, k])
        return (apart, spread) if abs(apart) > least else None


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


def without_variation(grams: FloatArray, columns: int, sigma: FloatArray) -> FloatArray:
    """Return per run the normal equations of effects, deviations and residual [r, P + K + 1, same], with the usual changes
    from run to run (of standard deviation sigma [q]) integrated out.
    """
    own = np.arange(columns, columns + len(sigma))
    rest = np.concatenate((np.arange(columns), np.arange(columns + len(sigma), grams.shape[1])))
    inner = np.linalg.inv(grams[:, own[:, None], own] + np.diag(1.0 / sigma**2))
    cross = grams[:, rest[:, None], own]
    return np.asarray(grams[:, rest[:, None], rest] - cross @ inner @ cross.transpose(0, 2, 1))


def own_deviations(runs: FloatArray, chosen: Sequence[int], at: int) -> tuple[FloatArray, FloatArray]:
    """Return the deviation in column `at` of every run [r], estimated beside the chosen columns in common, and its standard
    error as a difference from the mean of the others [r].
    """
    count, shared = len(runs), len(chosen)
    common = np.array(chosen, np.intp)
    size = shared + count
    gram = np.zeros((size + 1, size + 1))
    gram[:shared, :shared] = runs[:, common[:, None], common].sum(axis=0)
    gram[:shared, size] = runs[:, common, -1].sum(axis=0)
    for place, run in enumerate(runs, shared):
        gram[:shared, place] = gram[place, :shared] = run[common, at]
        gram[place, place] = run[at, at]
        gram[place, size] = run[at, -1]
    solution, covariance = solve(gram, range(size))
    contrast = (count * np.eye(count) - np.ones((count, count))) / (count - 1.0)
    spread = contrast @ covariance[shared:, shared:] @ contrast.T
    return solution[shared:], np.sqrt(np.maximum(np.diag(spread), 0.0))


def apart_from_others(own: FloatArray, r: int, usual: float) -> tuple[float, float]:
    """Return by how much run r differs from the mean of the others, and their standard deviation."""
    others = np.delete(own, r)
    squares = float(np.sum((others - others.mean()) ** 2)) + RUNS_COUNT * usual**2
    return float(own[r] - others.mean()), math.sqrt(squares / (len(others) + RUNS_COUNT))


def solve(total: FloatArray, columns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return least squares of these columns for the last, and its covariance, with a little of the diagonal added."""
    at = np.array(columns, np.intp)
    gram = total[at[:, None], at]
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(gram), 1e-30))
    scaled = gram * scale[:, None] * scale + 1e-10 * np.eye(len(at))
    covariance = np.linalg.pinv(scaled, hermitian=True) * scale[:, None] * scale
    return covariance @ total[at, -1], covariance


def explained(total: FloatArray, columns: Sequence[int]) -> float:
    """Return by how much these columns lower the sum of squares (last row: residual)."""
    beta, _ = solve(total, columns)
    return float(beta @ total[np.array(columns, np.intp), -1])


def within(candidate: EffectCandidate, coefficients: Sequence[float]) -> bool:
    """Return whether the parameters of these coefficients are plausible."""
    values = candidate.term.combine(coefficients)
    return all(p.low <= values[p.name] <= p.high for p in candidate.effect.parameters if p.name in values)
