"""Design excitation runs: Fourier coefficients chosen so that the runs determine the losses best (D-optimality).

    designs = design(ExcitationLimits(), count=8, duration_s=20.0, seed=1)
    segment = designs[0].to_mapping()          # the `fourier` segment of a plan (schema jtq.plan/1)

Each run moves one joint by velocity while the other one drives it with a current. The runs are designed one after the
other, each for what it adds to those before it (sequential D-optimality): the first four of eight are a design of four.
`draw` gives runs that are not optimised, for judging: within the same limits, but chosen by nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, check_installed
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import DIRECTION_VELOCITY_RAD_S
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.excitation.fourier import MAX_HARMONICS, FourierSeries, FourierTrajectory
from jtqd.sysid.excitation.model import Bench, Candidates, ExcitationLimits

Criterion = Callable[[FloatArray], FloatArray]
"""Values [m], lower is better, of genomes [m, d] in [-1, 1]; may be infinite, never NaN."""

POPULATION: Final = 40
STRATEGY: Final = "randtobest1bin"
MUTATION: Final = (0.3, 0.7)
RECOMBINATION: Final = 0.9
"""Of the differential evolution (docs/excitation.md has the comparison). scipy's own settings take four times as many
evaluations for a design as good."""
POLISHING: Final = 0.1
"""Share of the evaluations that is kept for walking downhill from the best genome: a design gains nothing more from it
than from as much evolution, but where the criterion is smooth the minimum is reached, not only approached."""
_SLOPE_STEP: Final = 1e-3
"""Of the differences that the slope is made of: above the steps of a scale that bisection finds (1/4096)."""


class Found(NamedTuple):
    """Best genome [d] and its value."""

    genome: FloatArray
    value: float


def minimise(criterion: Criterion, dimension: int, *, evaluations: int, rng: np.random.Generator) -> Found:
    """Return the best genome of a search of at most `evaluations` (>= 1); the same generator state gives the same result.

    Below two populations the genomes are drawn uniformly, POPULATION at most; beyond it they evolve (scipy's
    differential evolution, whole generations of POPULATION), and the last tenth polishes the best of them.

    Raises:
        ValueError: evaluations below 1.
        ConfigError: scipy is needed and not installed.
    """
    if evaluations < 1:
        raise ValueError(f"found {evaluations} evaluations, expected at least 1")
    first = rng.uniform(-1.0, 1.0, (min(POPULATION, evaluations), dimension))
    if evaluations < 2 * POPULATION:
        values = criterion(first)
        best = int(np.argmin(values))
        return Found(first[best], float(values[best]))
    check_installed("analysis", "scipy")
    from scipy.optimize import differential_evolution

    generations = max(2, int((1.0 - POLISHING) * evaluations) // POPULATION)
    evolved = differential_evolution(
        lambda genomes: criterion(genomes.T),
        [(-1.0, 1.0)] * dimension,
        strategy=STRATEGY,
        mutation=MUTATION,
        recombination=RECOMBINATION,
        init=first,
        maxiter=generations - 1,  # the first is `init`
        tol=0.0,  # no early end
        polish=False,  # scipy's own has no limit of evaluations
        updating="deferred",
        vectorized=True,
        rng=rng,
    )
    found = Found(np.asarray(evolved.x), float(evolved.fun))
    return _polished(criterion, found, evaluations - generations * POPULATION)


class _SpentError(Exception):
    """The evaluations are spent; scipy's own limit is looked at between two lines only."""


def _polished(criterion: Criterion, found: Found, evaluations: int) -> Found:
    """Return the best of a walk downhill from a genome (L-BFGS-B); a slope takes one evaluation per gene and one more."""
    from scipy.optimize import minimize

    best, left = found, evaluations

    def value_and_slope(genome: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best, left
        left -= len(genome) + 1
        if left < 0:
            raise _SpentError
        step = np.where(genome > 0.0, -_SLOPE_STEP, _SLOPE_STEP)  # inwards: the box is kept
        around = np.vstack([genome, genome + np.diag(step)])
        values = criterion(around)
        k = int(np.argmin(values))
        if values[k] < best.value:
            best = Found(around[k], float(values[k]))
        with np.errstate(invalid="ignore"):  # infinite less infinite
            slope = (values[1:] - values[0]) / step
        return float(values[0]), np.where(np.isfinite(slope), slope, 0.0)

    with suppress(_SpentError):
        minimize(
            value_and_slope,
            found.genome,
            jac=True,
            method="L-BFGS-B",
            bounds=[(-1.0, 1.0)] * len(found.genome),
            options={"ftol": 0.0, "gtol": 0.0},  # only the evaluations end it, or no step that still improves
        )
    return best


STRIBECK_VELOCITY_RAD_S: Final = 0.05
_RIDGE: Final = 1e-9
"""Added to the diagonal of the information, whose columns have a mean square near 1: a run that leaves out a quadrant
gets a bad log det in place of an infinite one; that of a useful run changes by less than 0.001."""


def loss_regressor(velocity_rad_s: FloatArray, torque_nm: FloatArray) -> FloatArray:
    """Return the 20 columns of the loss model [..., 20] at velocities [rad/s] and joint torques [Nm] of one shape [...].

    Per direction of motion d and, in it, per quadrant q (driving or back-driven), with s = tanh(v/0.02):

        loss = s (c_d + f_d |v| + q_d v^2 + p_d exp(-(v/0.05)^2)) + s (k_dq |tau| + m_dq tau^2 + n_dq |tau| |v|)

    The estimator's own loss (estimator/losses.pyx) is finer in the load: lines between nodes. For a design the few
    coefficients of a polynomial do better: they ask for the ends and the middle of every range. At the same instant the
    other joint has (-v, tau), which only changes places and signs of the columns: one determinant serves both joints.

    Order: direction positive, then negative; in each 4 columns of speed, 3 of load driving (tau v >= 0), 3 back-driven.
    """
    v, tau = velocity_rad_s, torque_nm
    s = np.tanh(v / DIRECTION_VELOCITY_RAD_S)
    load, speed = np.abs(tau), np.abs(v)
    own = np.stack([s, speed * s, v * speed, s * np.exp(-np.square(v / STRIBECK_VELOCITY_RAD_S))], axis=-1)
    loaded = np.stack([load * s, load * load * s, load * speed * s], axis=-1)
    driving = tau * v >= 0.0
    blocks = []
    for side in (v >= 0.0, v < 0.0):
        blocks.append(own * side[..., None])
        blocks += [loaded * (side & quadrant)[..., None] for quadrant in (driving, ~driving)]
    return np.concatenate(blocks, axis=-1)


class Information:
    """Information matrices with fixed scales: the mean square of each column over the box of velocity and torque.

    velocity_rad_s, torque_nm: half widths of the box. The scale is a constant, so it shifts every log det by the same
    amount; it makes them readable and the matrices well scaled. Without it an optimum would be the same.
    """

    def __init__(self, velocity_rad_s: float, torque_nm: float) -> None:
        # fine in velocity for the narrow Stribeck column
        grid = np.meshgrid(
            velocity_rad_s * np.linspace(-1.0, 1.0, 1000), torque_nm * np.linspace(-1.0, 1.0, 20)
        )
        v, tau = (axis.ravel() for axis in grid)
        self._scale: Final = np.sqrt(np.mean(np.square(loss_regressor(v, tau)), axis=0))

    def of(self, velocity: FloatArray, torque: FloatArray) -> FloatArray:
        """Return X^T X / n [m, 20, 20] of m runs over n instants, [m, n] each, columns scaled."""
        X = loss_regressor(velocity, torque) / self._scale
        product: FloatArray = np.matmul(X.transpose(0, 2, 1), X) / X.shape[1]
        return product


def log_det(information: FloatArray) -> FloatArray:
    """Natural log of the determinant of [..., 20, 20], finite also where a quadrant is missing; higher is better."""
    return np.asarray(np.linalg.slogdet(information + _RIDGE * np.eye(information.shape[-1]))[1])


def condition(information: FloatArray) -> float:
    """Condition number of the scaled regressor, the root of that of its information [20, 20]."""
    return float(np.sqrt(np.linalg.cond(information)))


Search = Callable[[Criterion, int, int, np.random.Generator], Found]
"""(criterion, dimension, evaluations, generator) -> the best genome found."""

STARTS: Final = 3
SEARCH_RATE_HZ: Final = 20.0
"""Grid of the search: at least 40 instants in a period of the fastest harmonic (0.5 Hz with five of 0.1 Hz)."""
FINAL_RATE_HZ: Final = 1000.0
"""Grid of the final scaling: that of the set-points, so that none of them exceeds a limit."""
SHORTEST_S: Final = 1.0
LONGEST_S: Final = 600.0


@dataclass(frozen=True)
class Design:
    """One run of the excitation: motion of the velocity joint and current of the driving joint.

    Attributes:
        velocity, current: the two series, of the same duration.
        information_log_det: log det of the scaled information of all runs so far, this one included; grows with every
            run. It compares designs for the same limits; its zero has no meaning of its own.
    """

    velocity: FourierTrajectory
    current: FourierSeries
    information_log_det: float

    def to_mapping(self) -> dict[str, Any]:
        """Return the `fourier` segment of a plan: plain numbers, ready for YAML."""
        return {
            "kind": "fourier",
            "velocity": self.velocity.to_mapping(),
            "current": self.current.to_mapping(),
            "duration_s": self.velocity.duration_s,
        }


def design(
    limits: ExcitationLimits,
    *,
    count: int,
    duration_s: float,
    harmonics: int = 5,
    seed: int = 0,
    evaluations: int = 2000,
    starts: int | None = None,
    joints: tuple[Joint, Joint] | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[Design, ...]:
    """Return `count` runs of duration_s seconds each, every one within the limits and with at least one limit reached.

    Args:
        limits: what no run may exceed at any set-point of 1 kHz.
        count: number of runs, >= 1. duration_s: length of each, 1 to 600 s. harmonics: of velocity and of current.
        seed: the same arguments give the same runs.
        evaluations: most motions that each search tries, >= 1.
        starts: independent searches for each run, of which the best counts. None: 3, or 1 where there are so few
            evaluations that nothing would be searched but only drawn.
        joints: velocity joint and driving joint; None: the two that ship. They give the torque of a current and the
            current of a motion.
        on_progress: called after each batch with the number of motions tried since the last call.

    Raises:
        ConfigError: an argument is out of range, or scipy is needed (more than one generation) and not installed.
    """
    if starts is None:
        starts = STARTS if evaluations > POPULATION else 1
    _check_range("count", count, 1, 1000)
    _check_range("evaluations", evaluations, 1, 10_000_000)
    _check_range("starts", starts, 1, 1000)

    def search(criterion: Criterion, dimension: int, evaluations: int, rng: np.random.Generator) -> Found:
        generators = rng.spawn(starts or 1)
        found = [minimise(criterion, dimension, evaluations=evaluations, rng=each) for each in generators]
        return min(found, key=lambda one: one.value)

    return sequence(
        Problem(limits, duration_s=duration_s, harmonics=harmonics, joints=joints, on_progress=on_progress),
        search,
        count=count,
        seed=seed,
        evaluations=evaluations,
    )[0]


def draw(
    limits: ExcitationLimits,
    *,
    count: int,
    duration_s: float,
    harmonics: int = 5,
    seed: int = 0,
    joints: tuple[Joint, Joint] | None = None,
) -> tuple[Design, ...]:
    """Return runs with random coefficients within the same limits: the first that are drawn, chosen by nothing.

    Arguments and errors as `design`.
    """
    return design(
        limits,
        count=count,
        duration_s=duration_s,
        harmonics=harmonics,
        seed=seed,
        evaluations=1,
        starts=1,
        joints=joints,
    )


class Problem:
    """Limits and joints of a design task, with the matrices that its evaluation needs.

    Raises:
        ConfigError: duration or harmonics out of range.
    """

    def __init__(
        self,
        limits: ExcitationLimits,
        *,
        duration_s: float,
        harmonics: int,
        joints: tuple[Joint, Joint] | None = None,
        on_progress: Callable[[int], None] | None = None,
    ) -> None:
        _check_range("duration_s", duration_s, SHORTEST_S, LONGEST_S)
        _check_range("harmonics", harmonics, 1, MAX_HARMONICS)
        bench = Bench(*(joints or (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))))
        coarse, fine = (
            Candidates(bench, limits, duration_s=duration_s, harmonics=harmonics, rate_hz=rate_hz)
            for rate_hz in (SEARCH_RATE_HZ, FINAL_RATE_HZ)
        )
        self._coarse: Final = coarse
        self._fine: Final = fine
        self._information: Final = Information(limits.velocity_rad_s, limits.torque_nm)
        self._on_progress: Final = on_progress
        self.dimension: Final = coarse.dimension

    def criterion(self, before: FloatArray) -> Criterion:
        """Return -log det of the information so far [20, 20] plus that of each candidate, as a function of genomes."""

        def value(genomes: FloatArray) -> FloatArray:
            motion = self._coarse.motion(genomes)
            if self._on_progress is not None:
                self._on_progress(len(genomes))
            return -log_det(before + self._information.of(motion.velocity, motion.torque))

        return value

    def finish(
        self, genome: FloatArray, before: FloatArray
    ) -> tuple[FourierTrajectory, FourierSeries, FloatArray]:
        """Scale a genome [d] on the fine grid; return its series and the information so far with it."""
        velocity, current, motion = self._fine.series(genome)
        return velocity, current, before + self._information.of(motion.velocity, motion.torque)[0]


def sequence(
    problem: Problem, search: Search, *, count: int, seed: int, evaluations: int
) -> tuple[tuple[Design, ...], FloatArray]:
    """Design `count` runs one after the other by any search; return them and their common information [20, 20].

    Run k of a seed has its own random numbers, whatever the number of runs.
    """
    designs: list[Design] = []
    information: FloatArray = np.zeros((1, 1))
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        found = search(problem.criterion(information), problem.dimension, evaluations, rng)
        velocity, current, information = problem.finish(found.genome, information)
        designs.append(Design(velocity, current, float(log_det(information))))
    return tuple(designs), information


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name}: found {value!r}, expected {low:g} to {high:g}")
