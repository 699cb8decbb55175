"""Regularised fit of loss, sigma and rotor inertia to one to five runs of a joint with one encoder.

    tau_raw - tau + Jm G^2 alpha = loss + offset_r + J alpha
    loss = (1+s)/2 L_+(tau_raw) - (1-s)/2 L_-(-tau_raw),    L_d(x) = c_d(x) + f_d |v| + Stribeck of the file

alpha = dv/dt, s the observer's direction, c_d linear between loads of -R, 0 and R (R: rated torque), J the reflected rotor
inertia. A few seconds do not separate these: where a joint turns one way only, an offset looks like Coulomb friction, and
where load and speed come together, load friction looks like viscous. Least squares then takes any split that fits, and errs
by ten newton metres once the joint turns the other way. Here each has a Gaussian prior about the joint file, in proportion
to the joint: the runs change what they determine, the rest stays near the file and widens sigma.

- c_d = Fc +- o + m |x| + k x: Coulomb, offset of current and sensor, load friction, error of torque constant or sensor gain.
  The deviation of each c and f from that has a prior, too: no joint is the same both ways.
- offset_r: of the sensor on that day. It enters no result.
- c_d and f_d are at least 0: friction takes energy.
- **Effective samples**: the residual of a wrong law is correlated. A run counts as n/(1 + 2 sum rho_k) samples
  (`plateaus.effective_samples`), at most one per 0.1 s of motion.
- **Sigma**: covariance of the fitted values, the residual in held-out fifths of each run, and the change of friction from
  day to day, which one run cannot show. As a^2 + (b v)^2 + (c tau_raw)^2 times a factor per quadrant, fitted on a grid over
  all loads and speeds: a quadrant without a run gets the width of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import quadrants
from jtqd.estimator.joint import AdditiveLoss, Friction, Fused, FusedSigma, Joint, LossSide
from jtqd.sysid.fit.losses import PER_K_PRIOR, LossFitError, bounded
from jtqd.sysid.fit.plateaus import effective_samples
from jtqd.sysid.fit.signals import RunSignals

MOST_RUNS: Final = 5
"""From six runs on `fit_fused` holds out whole runs."""


# Standard deviations of the prior; `_RATED`: parts of the rated torque (per rad/s where it is viscous), `_SHARE`: of the
# file's value. From catalogues where these have any, else estimates, settled on emulated joints (docs/results.md).
_COULOMB_SHARE: Final = 0.5
"""No-load running torques scatter by as much over parts and temperatures."""
_COULOMB_RATED: Final = 0.02
_VISCOUS_SHARE: Final = 0.5
_VISCOUS_RATED: Final = 0.02
_LOAD_MEAN: Final = 0.05
_LOAD: Final = 0.1
"""A harmonic drive loses 5 to 15 % of the load beside its no-load torque (catalogue efficiency 0.7 to 0.85)."""
_GAIN: Final = 0.05
"""Catalogues allow 5 to 10 % on the torque constant."""
_INERTIA_SHARE: Final = 0.3
_OFFSET_RATED: Final = 0.01
_ZERO_RATED: Final = 0.01
"""Of a run's own offset, beside the common one."""
_OTHER_WAY_RATED: Final = 0.005
"""Of the constant part at no load, one direction against the other."""
_CURVED_RATED: Final = 0.01
"""The same at rated load: a loss is no straight line."""
_OTHER_WAY_VISCOUS: Final = 0.1
"""Of the viscous part's own prior."""
_DAY_SHARE: Final = 0.1
"""Of the loss, from day to day."""
_SAMPLE_S: Final = 0.005
_LONGEST_S: Final = 0.1
"""The error of a law that is not quite that of the joint is correlated for so long at least."""
_SLOW_RAD_S: Final = 0.05
"""Slower, the direction of friction is not settled."""
_LEAST_MOTION_S: Final = 0.5
_LEAST_RATED: Final = 0.01
"""No law of friction is better than that."""
_PARTS: Final = 5
_REPETITIONS: Final = 4
_FASTER: Final = 3.0
"""The viscous part is linear up to so many times the fastest speed: it is the file's as much as the run's."""
_NODES, _COMMON, _INERTIA = 6, 9, 8
_VISCOUS, _LOSS, _PHYSICAL = slice(6, 8), slice(0, 8), slice(0, 9)
"""c_+ at -R, 0, R, c_- at -R, 0, R, f_+, f_-, J; the offsets of the runs follow."""
_NAMES: Final = (
    ("Coulomb friction", "Nm"),
    ("load friction", ""),
    ("viscous friction", "Nms/rad"),
    ("offset", "Nm"),
    ("gain error", ""),
    ("rotor inertia", "kg m2"),
)


@dataclass(frozen=True)
class FewTerm:
    """One fitted quantity: value and standard deviation, after the fit and in the joint file before."""

    name: str
    unit: str
    value: float
    sigma: float
    file: float
    file_sigma: float

    def line(self) -> str:
        """Return the line of the report, with the share of the prior's variance that the runs removed."""
        removed = 1.0 - (self.sigma / self.file_sigma) ** 2
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.name} {self.value:.3g} +- {self.sigma:.2g}{unit} (before: {self.file:.3g} +- {self.file_sigma:.2g}; "
            f"the runs tell {100.0 * max(removed, 0.0):.0f} %)"
        )


@dataclass(frozen=True)
class FewRunsFit:
    """joint: with section `fused` (no torsion) and rotor inertia. terms: of the report. residual_nm, held_out_nm: RMS in the
    runs, and in held-out fifths of them. effective: samples that count. samples: used, thinned.
    """

    joint: Joint
    terms: tuple[FewTerm, ...]
    residual_nm: float
    held_out_nm: float
    effective: float
    samples: int

    @property
    def fused(self) -> Fused:
        """The section that was fitted."""
        assert self.joint.fused is not None
        return self.joint.fused

    def lines(self) -> list[str]:
        """Return the report, one fact per line."""
        return [
            *(term.line() for term in self.terms),
            f"residual {self.residual_nm:.3f} Nm, in fifths left out {self.held_out_nm:.3f} Nm "
            f"(effective samples: {self.effective:.0f} of {self.samples})",
        ]


class Block(NamedTuple):
    """Equations of one run: columns x [n, k] of all runs' numbers, target y [n], speed [n], seconds of motion; of that day
    [n, m].
    """

    x: FloatArray
    y: FloatArray
    v: FloatArray
    motion_s: float
    day: FloatArray


def fit_few_runs(runs: Sequence[RunSignals], joint: Joint) -> FewRunsFit:
    """Return the joint with loss, sigma and rotor inertia of one to five runs.

    joint: what is known before the runs. Raises LossFitError for too little motion.
    """
    rated = joint.rated_torque_nm
    blocks = [_block(run, joint) for run in runs]
    motion_s = sum(block.motion_s for block in blocks)
    if motion_s < _LEAST_MOTION_S:
        raise LossFitError(
            f"found {motion_s:.2g} s in motion (above {_SLOW_RAD_S} rad/s), expected at least {_LEAST_MOTION_S} s"
        )
    blocks = [block for block in blocks if len(block.y)]
    before = _before(joint)
    weights = [
        block.motion_s / _LONGEST_S / len(block.y) / (2.0 * _LEAST_RATED * rated) ** 2 for block in blocks
    ]
    for _ in range(_REPETITIONS):
        w, _ = solve(blocks, weights, before)
        weights = weights_of(blocks, w, _LEAST_RATED * rated)
    w, covariance = solve(blocks, weights, before, _PHYSICAL)
    residual = _rms(errors_of(blocks, w))
    held_out = _rms(_held_out_errors(blocks, weights, before))
    speed = max(float(np.abs(block.v).max()) for block in blocks)
    teacher = max((float(run.teacher_nm.max()) for run in runs if run.teacher_nm is not None), default=0.0)
    least = float(np.hypot(max(held_out, _LEAST_RATED * rated), teacher))
    sigma = _sigma(w[_LOSS], covariance[_LOSS, _LOSS], least, rated, speed)
    loss = _loss(w, joint, speed, _temperature(runs))
    fitted = replace(
        joint, rotor_inertia_kgm2=float(w[_INERTIA]) / joint.gear_ratio**2, fused=Fused(loss, None, sigma)
    )
    effective = sum(map(_effective, blocks, errors_of(blocks, w)))
    terms = _terms(w, covariance, before, joint)
    return FewRunsFit(fitted, terms, residual, held_out, effective, sum(len(block.y) for block in blocks))


def _block(run: RunSignals, joint: Joint) -> Block:
    """Return the equations of a run's moving samples, about 200 per second."""
    seen, friction = run.seen, joint.friction
    step = float(np.median(seen.dt_s[1:])) if len(seen.dt_s) > 1 else _SAMPLE_S
    moving = np.flatnonzero(run.moving & (np.abs(np.nan_to_num(seen.velocity_rad_s)) > _SLOW_RAD_S))
    index = moving[:: max(1, round(_SAMPLE_S / step))]
    if not len(index):
        return Block(np.zeros((0, _COMMON)), np.zeros(0), np.zeros(0), 0.0, np.zeros((0, 1)))
    time_s = np.cumsum(np.maximum(seen.dt_s, 1e-9))
    alpha = np.gradient(np.nan_to_num(seen.velocity_rad_s), time_s)[index]
    raw, v, s = seen.raw_nm[index], seen.velocity_rad_s[index], seen.direction[index]
    peak = friction.stribeck_nm * np.exp(-((v / friction.stribeck_velocity_rad_s) ** 2)) * s
    x = np.column_stack((_columns(raw, v, s, joint.rated_torque_nm), alpha))
    target = raw + _reflected(joint) * alpha - run.sensor_nm[index] - peak
    return Block(x, target, v, step * len(moving), np.ones((len(index), 1)))


def _columns(raw: FloatArray, v: FloatArray, s: FloatArray, rated: float) -> FloatArray:
    """Return the loss at unit value of each of its numbers [n, 8]."""
    ahead, back = 0.5 * (1.0 + s)[:, None], -0.5 * (1.0 - s)[:, None]
    speed = np.abs(v)[:, None]
    return np.hstack((_hats(raw / rated) * ahead, _hats(-raw / rated) * back, speed * ahead, speed * back))


def _hats(load: FloatArray) -> FloatArray:
    """Return the shares [n, 3] of loads of -1, 0 and 1; lines beyond."""
    below, above = np.maximum(-load, 0.0), np.maximum(load, 0.0)
    return np.column_stack((below, 1.0 - below - above, above))


def _reflected(joint: Joint) -> float:
    return joint.rotor_inertia_kgm2 * joint.gear_ratio**2


def _mixing(rated: float) -> FloatArray:
    """Return [9, 6]: the numbers of the fit out of Coulomb, load, viscous, offset, gain and inertia."""
    b = np.zeros((_COMMON, len(_NAMES)))
    for n, x in enumerate((-rated, 0.0, rated)):
        b[n] = 1.0, abs(x), 0.0, 1.0, x, 0.0
        b[3 + n] = 1.0, abs(x), 0.0, -1.0, x, 0.0
    b[_VISCOUS, 2] = 1.0
    b[_INERTIA, 5] = 1.0
    return b


class Before(NamedTuple):
    """The prior: mean [k] and covariance [k, k] of all runs' numbers; standard deviations of those of a day."""

    mean: FloatArray
    covariance: FloatArray
    day: tuple[float, ...]


def _before(joint: Joint) -> Before:
    rated, friction = joint.rated_torque_nm, joint.friction
    viscous = float(np.hypot(_VISCOUS_SHARE * friction.viscous_nms_per_rad, _VISCOUS_RATED * rated))
    coulomb, inertia = (
        np.hypot(_COULOMB_SHARE * friction.coulomb_nm, _COULOMB_RATED * rated),
        _reflected(joint),
    )
    sigmas = np.array((coulomb, _LOAD, viscous, _OFFSET_RATED * rated, _GAIN, _INERTIA_SHARE * inertia))
    means = np.array((friction.coulomb_nm, _LOAD_MEAN, friction.viscous_nms_per_rad, 0, 0, inertia))
    side = np.array((_CURVED_RATED, _OTHER_WAY_RATED, _CURVED_RATED)) * rated
    own = np.concatenate((side, side, np.full(2, _OTHER_WAY_VISCOUS * viscous), [0.0]))
    b = _mixing(rated)
    covariance = b @ np.diag(sigmas**2) @ b.T + np.diag(own**2)
    return Before(b @ means, covariance, (_ZERO_RATED * rated,))


def solve(
    blocks: Sequence[Block], weights: Sequence[float], before: Before, signed: slice = slice(0)
) -> tuple[FloatArray, FloatArray]:
    """Return the most probable numbers, then those of each day, and their covariance before the bounds: `signed` >= 0."""
    common, ends = len(before.mean), _ends(blocks, len(before.mean))
    left, right = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    left[:common, :common] = np.linalg.inv(before.covariance)
    right[:common] = left[:common, :common] @ before.mean
    for block, weight, (first, end) in zip(blocks, weights, pairwise(ends), strict=True):
        at = np.r_[:common, first:end]
        x = np.column_stack((block.x, block.day))
        left[np.ix_(at, at)] += weight * (x.T @ x)
        left[at[common:], at[common:]] += np.array(before.day[: end - first]) ** -2
        right[at] += weight * (x.T @ block.y)
    covariance = np.asarray(np.linalg.inv(left), np.float64)
    w = covariance @ right
    return (bounded(left, right, signed) if (w[signed] < 0.0).any() else w), covariance


def _ends(blocks: Sequence[Block], common: int) -> list[int]:
    return [int(end) for end in np.cumsum([common, *(block.day.shape[1] for block in blocks)])]


def errors_of(blocks: Sequence[Block], w: FloatArray) -> list[FloatArray]:
    """Return the error [n] of each block."""
    common = blocks[0].x.shape[1]
    days = pairwise(_ends(blocks, common))
    return [b.y - b.x @ w[:common] - b.day @ w[a:end] for b, (a, end) in zip(blocks, days, strict=True)]


def _effective(block: Block, error: FloatArray) -> float:
    """Return how many samples of a run count."""
    return min(effective_samples(error), max(2.0, block.motion_s / _LONGEST_S))


def weights_of(blocks: Sequence[Block], w: FloatArray, least_nm: float) -> list[float]:
    """Return the weight of each sample of each block: those that count share it. Three numbers of a law take freedom."""
    weights = []
    for block, error in zip(blocks, errors_of(blocks, w), strict=True):
        n = _effective(block, error)
        variance = float(np.mean(error**2)) * n / max(n - 3.0, 1.0)
        weights.append(n / len(error) / max(variance, least_nm**2))
    return weights


def _held_out_errors(blocks: Sequence[Block], weights: Sequence[float], before: Before) -> list[FloatArray]:
    """Return the errors in each fifth of each run, of a fit without it."""
    found = []
    for n, block in enumerate(blocks):
        edges = np.linspace(0, len(block.y), _PARTS + 1).astype(int).tolist()
        for a, b in pairwise(edges):
            keep = np.r_[:a, b : len(block.y)]
            others = [*blocks]
            others[n] = Block(block.x[keep], block.y[keep], block.v[keep], block.motion_s, block.day[keep])
            w, _ = solve(others, weights, before, _PHYSICAL)
            found.append(errors_of(blocks, w)[n][a:b])
    return found


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _sigma(
    w: FloatArray, covariance: FloatArray, residual_nm: float, rated: float, speed: float
) -> FusedSigma:
    """Return sigma of the current path on another day, over loads up to the rated one and speeds up to the fastest."""
    from scipy.optimize import nnls

    slow = min(_SLOW_RAD_S, speed)
    speeds = np.linspace(2.0 * slow if speed > 2.0 * slow else slow, speed, 8)
    raw, v = (each.ravel() for each in np.meshgrid(np.linspace(-rated, rated, 21), np.r_[-speeds, speeds]))
    x = _columns(raw, v, np.sign(v), rated)
    variance = np.einsum("ij,jk,ik->i", x, covariance, x) + residual_nm**2 + (_DAY_SHARE * (x @ w)) ** 2
    a, b, c = nnls(np.column_stack((np.ones_like(v), v * v, raw * raw)), variance)[0]
    a = max(a, (0.5 * _LEAST_RATED * rated) ** 2)
    ratio = variance / (a + b * v * v + c * raw * raw)
    at = quadrants(raw, v)
    one, two, three, four = (float(np.sqrt(np.mean(ratio[at == q]))) for q in range(4))
    current, viscous, load = (float(np.sqrt(each)) for each in (a, b, c))
    # without torsion the estimator does not read its sigma; the file must have a number above 0
    return FusedSigma(current, viscous, load, current, 0.0, 0.0, (one, two, three, four))


def _temperature(runs: Sequence[RunSignals]) -> float:
    known = [run.temperature_c for run in runs if np.isfinite(run.temperature_c)]
    return float(np.mean(known)) if known else 25.0


def _loss(w: FloatArray, joint: Joint, speed: float, temperature_c: float) -> AdditiveLoss:
    rated, friction, viscous = joint.rated_torque_nm, joint.friction, float(np.mean(w[_VISCOUS]))
    sides = _side(w[:3], w[6], friction), _side(w[3:_NODES], w[7], friction)
    place = friction.stribeck_velocity_rad_s, _FASTER * speed, temperature_c
    return AdditiveLoss((-rated, 0.0, rated), *sides, *place, viscous, PER_K_PRIOR[0])


def _side(constant: FloatArray, viscous: float, friction: Friction) -> LossSide:
    one, two, three = (float(value) for value in constant)
    return LossSide((one, two, three), (float(viscous),) * 3, (0.0,) * 3, friction.stribeck_nm)


def _terms(w: FloatArray, covariance: FloatArray, before: Before, joint: Joint) -> tuple[FewTerm, ...]:
    """Return the physical quantities of the report: least squares on the fit's numbers."""
    back = np.linalg.pinv(_mixing(joint.rated_torque_nm))
    back[np.abs(back) < 1e-12] = 0.0  # a prior of 0 is to read 0
    units = np.array((1.0, 1.0, 1.0, 1.0, 1.0, joint.gear_ratio**-2))
    columns = (
        back @ w[:_COMMON] * units,
        np.sqrt(np.diag(back @ covariance[:_COMMON, :_COMMON] @ back.T)) * units,
        back @ before.mean * units,
        np.sqrt(np.diag(back @ before.covariance @ back.T)) * units,
    )
    return tuple(
        FewTerm(name, unit, *(round(float(each[n]), 12) + 0.0 for each in columns))
        for n, (name, unit) in enumerate(_NAMES)
    )
