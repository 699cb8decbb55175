"""D-optimal excitation of two coupled joints: Fourier coefficients that determine the losses best within limits.

    designs = design(ExcitationLimits(), count=8, duration_s=20.0, seed=1)
    designs[0].segment                         # a Fourier segment of a plan

One joint moves by velocity, the other one loads it with a current. A genome [4 H + 1] holds the amplitudes a, b of the
velocity, a, b of the current and its offset, H harmonics each. Only its direction counts: `Candidates` scales it radially
into the limits, with the torque that the joint files predict.

The runs are designed one after the other, each for the information that it adds (sequential D-optimality): the first four
of eight are a design of four. With one evaluation the coefficients are drawn, not optimised, as a validation needs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import repeat
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import check_installed
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import DIRECTION_VELOCITY_RAD_S, LossModel
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.planner.plan import MAX_HARMONICS, Fourier, FourierSeries, FourierTrajectory

FUNDAMENTAL_HZ: Final = 0.1
GOLDEN: Final = 0.5 * (1.0 + math.sqrt(5.0))
REVERSAL_S: Final = 0.1
REVERSAL_RAD_S: Final = 0.2
REVERSAL_OVERSHOOT: Final = 0.2
"""Time for which the torque rings about a reversal, the velocity from which Table I counts, and the overshoot as a part of
the torque; time and overshoot as the emulated bench shows them at 5 A."""
_BISECTIONS: Final = 12
SEARCH_RATE_HZ: Final = 20.0
"""Grid of the search: at least 40 instants in a period of the fastest harmonic (0.5 Hz with five of 0.1 Hz)."""
FINAL_RATE_HZ: Final = 1000.0
"""Grid of the final scaling: that of the set-points, so that none of them exceeds a limit."""
SHORTEST_S: Final = 1.0
LONGEST_S: Final = 600.0


@dataclass(frozen=True)
class ExcitationLimits:
    """Limits of a designed run; joint side, each > 0 (ConfigError otherwise).

    velocity, acceleration: peaks of the velocity joint; travel_rad: from the start, either way; current_a: peak of the
    driving joint's commanded current; joint_current_a: of the current that the velocity joint needs; torque_nm: between
    the joints, both by the joint files.
    """

    velocity_rad_s: float = 3.0
    acceleration_rad_s2: float = 12.0
    travel_rad: float = 60.0
    current_a: float = 5.0
    joint_current_a: float = 8.0
    torque_nm: float = 50.0

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"limits: {one.name}: found {value!r}, expected a finite number > 0")


class Bench:
    """Static model of two coupled joints: the first moves by velocity, the second drives it by current.

    In steady state the second joint, at i_2 and v_2 = -v_1, gives tau = G Kt i_2 - loss_2(i_2, v_2) (estimator/losses.pyx);
    rotor and link inertia are added, stiffness and control are neglected.
    """

    def __init__(self, velocity_joint: Joint, driving_joint: Joint) -> None:
        pair = (velocity_joint, driving_joint)
        self._losses: Final = tuple(LossModel(joint) for joint in pair)
        self._rotor: Final = tuple(j.gear_ratio**2 * j.rotor_inertia_kgm2 for j in pair)
        self._links: Final = tuple(j.link_inertia_kgm2 for j in pair)

    def torque(self, current: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return the torque between the joints [Nm] for a current of the driving joint [A] and a motion of the other.

        The loss belongs to the current less the part that accelerates the rotor, as in the estimator.
        """
        loss = self._losses[1]
        effective = current + self._rotor[1] / loss.torque_per_ampere * acceleration  # v_2' = -v_1'
        joint = loss.torque_per_ampere * effective - loss.loss_many(effective, -velocity)
        return joint + self._links[1] * acceleration

    def torque_range(
        self, own_current_a: float, velocity: FloatArray, acceleration: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the least and largest torque [Nm] at which the velocity joint needs at most own_current_a.

        Its torque grows with its current, so the range of currents maps onto the range of torques by its ends.
        """
        loss = self._losses[0]
        rotor = self._rotor[0] / loss.torque_per_ampere * acceleration
        low, high = (
            loss.torque_per_ampere * i - loss.loss_many(i, velocity) - self._links[0] * acceleration
            for i in (-own_current_a - rotor, own_current_a - rotor)
        )
        return low, high


class Motion(NamedTuple):
    """Scaled candidates over the grid: every array [m, n].

    velocity, acceleration of the velocity joint [rad/s, rad/s^2]; current of the driving joint [A]; torque between the
    joints [Nm], positive along the positive current of either; factors of the genome's amplitudes [m, 1].
    """

    velocity: FloatArray
    acceleration: FloatArray
    current: FloatArray
    torque: FloatArray
    velocity_scale: FloatArray
    current_scale: FloatArray


class Candidates:
    """Turns genomes into motions of duration_s on a grid of rate_hz that keep the limits, by products with matrices.

    Raises ConfigError for limits that leave no motion at all.
    """

    def __init__(
        self, bench: Bench, limits: ExcitationLimits, *, duration_s: float, harmonics: int, rate_hz: float
    ) -> None:
        self.bench: Final = bench
        self.limits: Final = limits
        self.harmonics: Final = harmonics
        self.duration_s: Final = duration_s
        self.dimension: Final = 4 * harmonics + 1
        self.omega_velocity, self.omega_current = fundamentals(duration_s)
        time_s = _grid(duration_s, rate_hz)
        pair = 2 * harmonics
        self._position, self._velocity, self._acceleration = unit_motions(
            self.omega_velocity, harmonics, duration_s, time_s
        )
        self._current: Final = np.array(
            [self._series(tuple(c)).value(time_s) for c in np.eye(pair + 1).tolist()]
        )
        self._refuse_too_weak()

    def _refuse_too_weak(self) -> None:
        """Refuse limits below what every motion needs: to drag the idle driving joint slowly, with its overshoot."""
        slow = min(REVERSAL_RAD_S, self.limits.velocity_rad_s)
        velocity, acceleration = np.array([[slow, -slow]]), np.zeros((1, 2))
        torque = self.bench.torque(np.zeros((1, 2)), velocity, acceleration) * (1.0 + REVERSAL_OVERSHOOT)
        low, high = self._torque_range(velocity, acceleration)
        if not _between(low, torque, high).all():
            raise ConfigError(
                f"limits: found joint_current_a {self.limits.joint_current_a:g} and torque_nm "
                f"{self.limits.torque_nm:g}, expected more, because turning the idle driving joint takes "
                f"{float(np.abs(torque).max()):.1f} Nm"
            )

    def _series(self, c: tuple[float, ...]) -> FourierSeries:
        H = self.harmonics
        return FourierSeries(self.omega_current, c[:H], c[H:-1], self.duration_s, c[-1])

    def motion(self, genomes: FloatArray) -> Motion:
        """Scale every genome [m, 4 H + 1] radially until a limit is active for the velocity and one for the current.

        The velocity alone is scaled to its own three limits, and further down where the velocity joint could not drag the
        idle driving joint. Then the current is scaled to its peak, or, where that asks too much of the velocity joint or too
        much torque, to the largest allowed scale. Both bisections stay on the allowed side.
        """
        limits, pair = self.limits, 2 * self.harmonics
        velocity, acceleration = genomes[:, :pair] @ self._velocity, genomes[:, :pair] @ self._acceleration
        position, current = genomes[:, :pair] @ self._position, genomes[:, pair:] @ self._current
        v_scale = 1.0 / np.maximum.reduce(
            [
                _peak(velocity) / limits.velocity_rad_s,
                _peak(acceleration) / limits.acceleration_rad_s2,
                _peak(position) / limits.travel_rad,
            ]
        )
        i_scale = limits.current_a / _peak(current)

        def idle_allowed(scale: FloatArray, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
            v, a = scale * velocity[rows], scale * acceleration[rows]
            low, high = self._torque_range(v, a)
            return _between(low, self.bench.torque(np.zeros_like(v), v, a), high)

        v_scale = _largest(v_scale, idle_allowed)
        velocity, acceleration = v_scale * velocity, v_scale * acceleration
        hardest, margin = _at_reversal(velocity, acceleration, current)
        low, high = self._torque_range(hardest, acceleration)
        low, high = low / margin, high / margin

        def allowed(scale: FloatArray, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
            torque = self.bench.torque(scale * current[rows], hardest[rows], acceleration[rows])
            return _between(low[rows], torque, high[rows])

        i_scale = _largest(i_scale, allowed)
        current = i_scale * current
        torque = self.bench.torque(current, velocity, acceleration)
        return Motion(velocity, acceleration, current, torque, v_scale, i_scale)

    def _torque_range(self, velocity: FloatArray, acceleration: FloatArray) -> tuple[FloatArray, FloatArray]:
        low, high = self.bench.torque_range(self.limits.joint_current_a, velocity, acceleration)
        limit = self.limits.torque_nm
        return np.maximum(low, -limit), np.minimum(high, limit)

    def segment(self, genome: FloatArray) -> tuple[Fourier, Motion]:
        """Return the scaled run of one genome [4 H + 1], as a segment and over the grid ([1, n])."""
        motion = self.motion(genome[None, :])
        H = self.harmonics
        v = tuple((float(motion.velocity_scale[0, 0]) * genome[: 2 * H]).tolist())
        i = tuple((float(motion.current_scale[0, 0]) * genome[2 * H :]).tolist())
        trajectory = FourierTrajectory(self.omega_velocity, v[:H], v[H:], self.duration_s)
        return Fourier(trajectory, self._series(i)), motion


def _grid(duration_s: float, rate_hz: float) -> FloatArray:
    return np.linspace(0.0, duration_s, round(duration_s * rate_hz) + 1)


def unit_motions(
    omega_rad_s: float, harmonics: int, duration_s: float, time_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, velocity, acceleration [2 H, n] of the trajectories with a single amplitude of 1."""
    H = harmonics
    motions = [
        FourierTrajectory(omega_rad_s, tuple(c[:H]), tuple(c[H:]), duration_s).motion(time_s)
        for c in np.eye(2 * H).tolist()
    ]
    position, velocity, acceleration = (np.array([one[order] for one in motions]) for order in range(3))
    return position, velocity, acceleration


def fundamentals(duration_s: float) -> tuple[float, float]:
    """Return angular frequencies [rad/s] of velocity and current: whole periods of about 10 s, and over the golden
    ratio.

    Harmonics of the two never stay in step, so that all four quadrants of velocity and torque fill.
    """
    velocity = 2.0 * math.pi * max(1.0, round(FUNDAMENTAL_HZ * duration_s)) / duration_s
    return velocity, velocity / GOLDEN


def _at_reversal(
    velocity: FloatArray, acceleration: FloatArray, current: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the velocity to check the limits with, and the margin of the torque to them as a factor; [m, n] each.

    When the driving joint turns from driving to being driven under load, its loss changes sides: the torque jumps by half
    and rings. Within REVERSAL_S of a reversal the check therefore takes the side with the larger torque and leaves
    REVERSAL_OVERSHOOT for the ringing.
    """
    close = np.abs(velocity) < np.maximum(REVERSAL_RAD_S, REVERSAL_S * np.abs(acceleration))
    driven = np.where(current >= 0.0, REVERSAL_RAD_S, -REVERSAL_RAD_S)  # v_2 = -v_1 against its current
    return np.where(close, driven, velocity), np.where(close, 1.0 + REVERSAL_OVERSHOOT, 1.0)


def _peak(values: FloatArray) -> FloatArray:
    """Return the largest magnitude of each row, [m, 1], never zero: a genome of zeros stays at rest."""
    return np.asarray(np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-12))


def _between(low: FloatArray, value: FloatArray, high: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(((low <= value) & (value <= high)).all(axis=1))


def _largest(
    scale: FloatArray, allowed: Callable[[FloatArray, NDArray[np.intp]], NDArray[np.bool_]]
) -> FloatArray:
    """Return each row's scale [m, 1], or where it is not allowed the largest allowed one that bisection finds below.

    allowed(scale [k, 1], rows [k]): whether these rows may have this scale; scale 0 must be allowed.
    """
    rows = np.flatnonzero(~allowed(scale, np.arange(len(scale))))
    if not len(rows):
        return scale
    low, high = np.zeros((len(rows), 1)), scale[rows]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        good = allowed(middle, rows)[:, None]
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    result = scale.copy()
    result[rows] = low
    return result


# Information ----------------------------------------------------------------------------------------------------

STRIBECK_VELOCITY_RAD_S: Final = 0.05
_RIDGE: Final = 1e-9
"""Added to the diagonal of the information, whose columns have a mean square near 1: a run that leaves out a quadrant
gets a bad log det in place of an infinite one; that of a useful run changes by less than 0.001."""


def loss_regressor(velocity_rad_s: FloatArray, torque_nm: FloatArray) -> FloatArray:
    """Return the 20 columns of the loss model [..., 20] at velocities [rad/s] and joint torques [Nm] of one shape
    [...].

    Per direction of motion d and, in it, per quadrant q (driving or back-driven), with s = tanh(v/0.02):

        loss = s (c_d + f_d |v| + q_d v^2 + p_d exp(-(v/0.05)^2)) + s (k_dq |tau| + m_dq tau^2 + n_dq |tau| |v|)

    The few coefficients of a polynomial make a better design than the estimator's lines between nodes. At the same
    instant the other joint has (-v, tau), which only permutes columns and changes signs: one determinant serves both.
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
    """Information matrices, each column scaled by its mean square over the box of half widths velocity_rad_s,
    torque_nm.

    The scales shift every log det by the same amount and leave the optimum unchanged.
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
    """Return the log of the determinant of [..., p, p], finite also where a quadrant is missing; higher is better."""
    return np.asarray(np.linalg.slogdet(information + _RIDGE * np.eye(information.shape[-1]))[1])


# Search ---------------------------------------------------------------------------------------------------------

Criterion = Callable[[FloatArray], FloatArray]
"""Values [m], lower is better, of genomes [m, d] in [-1, 1]; may be infinite, never NaN."""

POPULATION: Final = 40
STRATEGY: Final = "randtobest1bin"
MUTATION: Final = (0.3, 0.7)
RECOMBINATION: Final = 0.9
"""Of the differential evolution (docs/fit.md has the comparison). scipy's own settings take four times as many
evaluations for a design as good."""
POLISHING: Final = 0.1
"""Share of the evaluations for the descent from the best genome, which reaches the minimum where the criterion is smooth."""
_SLOPE_STEP: Final = 1e-3
"""Of the differences for the slope: above the steps of a scale that bisection finds (1/4096)."""
STARTS: Final = 3


class Found(NamedTuple):
    """Best genome [d] and its value."""

    genome: FloatArray
    value: float


def minimise(criterion: Criterion, dimension: int, *, evaluations: int, rng: np.random.Generator) -> Found:
    """Return the best genome of a search of at most `evaluations` (>= 1); the same generator state gives the same
    result.

    Below two populations the genomes are drawn uniformly, POPULATION at most; beyond it they evolve (differential
    evolution, whole generations), and the last tenth polishes the best. Raises ConfigError where scipy is needed and
    not installed.
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
    """The evaluations are spent; scipy checks its own limit between two lines only."""


def _polished(criterion: Criterion, found: Found, evaluations: int) -> Found:
    """Return the best of a descent from a genome (L-BFGS-B); a slope takes one evaluation per gene and one more."""
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


def sequence(
    problems: Iterable[CoupledJoints | SingleJoint], *, seed: int, evaluations: int, starts: int = 0
) -> list[tuple[Fourier, FloatArray]]:
    """Return a trajectory for each problem, the best one given those before it, and the information up to it.

    Trajectory k of a seed has its own random numbers, whatever their number. starts: searches for each, of which the best
    counts; 0: one, with the trajectory's own generator.
    """
    designed: list[tuple[Fourier, FloatArray]] = []
    information: FloatArray = np.zeros((1, 1))
    for k, problem in enumerate(problems):
        rng = np.random.default_rng([seed, k])
        criterion = problem.criterion(information)
        found = [
            minimise(criterion, problem.dimension, evaluations=evaluations, rng=each)
            for each in (rng.spawn(starts) if starts else [rng])
        ]
        genome = min(found, key=lambda one: one.value).genome
        segment, information = problem.finish(genome, information)
        designed.append((segment, information))
    return designed


# Two coupled joints ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Design:
    """One trajectory; information_log_det: of the scaled information of all so far, comparable for the same limits
    only.
    """

    segment: Fourier
    information_log_det: float


class CoupledJoints:
    """Problem of one trajectory of two coupled joints. Raises ConfigError for duration or harmonics out of range."""

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
        self._coarse, self._fine = (
            Candidates(bench, limits, duration_s=duration_s, harmonics=harmonics, rate_hz=rate_hz)
            for rate_hz in (SEARCH_RATE_HZ, FINAL_RATE_HZ)
        )
        self._information: Final = Information(limits.velocity_rad_s, limits.torque_nm)
        self._on_progress: Final = on_progress
        self.dimension: Final = self._coarse.dimension

    def criterion(self, before: FloatArray) -> Criterion:
        """Return -log det of the information so far [20, 20] plus that of each candidate, as a function of genomes."""

        def value(genomes: FloatArray) -> FloatArray:
            motion = self._coarse.motion(genomes)
            if self._on_progress is not None:
                self._on_progress(len(genomes))
            return -log_det(before + self._information.of(motion.velocity, motion.torque))

        return value

    def finish(self, genome: FloatArray, before: FloatArray) -> tuple[Fourier, FloatArray]:
        """Return the segment of a genome [d] and the information so far with it."""
        segment, motion = self._fine.segment(genome)
        return segment, before + self._information.of(motion.velocity, motion.torque)[0]


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
    """Return `count` trajectories of duration_s (1 to 600 s), each within the limits, with at least one limit reached.

    The same arguments give the same trajectories. evaluations: most motions that each search tries; 1: the coefficients
    are drawn. starts: searches per trajectory, of which the best counts; None: `starts_of`. joints: velocity joint and
    driving joint; None: the two that ship. on_progress: called with the number of motions tried since the last call.

    Raises ConfigError for an argument out of range, or where scipy is needed and not installed.
    """
    starts = starts_of(evaluations) if starts is None else starts
    _check_range("count", count, 1, 1000)
    _check_range("evaluations", evaluations, 1, 10_000_000)
    _check_range("starts", starts, 1, 1000)
    problem = CoupledJoints(
        limits, duration_s=duration_s, harmonics=harmonics, joints=joints, on_progress=on_progress
    )
    designed = sequence(repeat(problem, count), seed=seed, evaluations=evaluations, starts=starts)
    return tuple(Design(segment, float(log_det(information))) for segment, information in designed)


def starts_of(evaluations: int) -> int:
    """Return the number of searches for a trajectory: one where so few evaluations only draw."""
    return STARTS if evaluations > POPULATION else 1


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name}: found {value!r}, expected {low:g} to {high:g}")


# One joint ------------------------------------------------------------------------------------------------------

SHARE: Final = 0.9
"""Planned peaks as a part of the limits: a controller overshoots, and a limit that is met ends the run."""
HARMONICS: Final = 5
SHORTEST_TRAJECTORY_S: Final = 2.0
_DIRECTION_SHARE: Final = 0.02
"""w0 of the regressor, as a part of the fastest velocity."""


@dataclass(frozen=True)
class MotionRange:
    """What a joint that is moved alone may do: `limits` of the commander, and the peak acceleration [rad/s2]."""

    limits: Limits
    acceleration_rad_s2: float

    @property
    def reach_rad(self) -> float:
        """Largest distance of a planned motion from its start."""
        low, high = self.limits.position_rad
        return 0.5 * SHARE * (high - low)

    @property
    def velocity_rad_s(self) -> float:
        """Fastest planned."""
        return SHARE * self.limits.velocity_rad_s


class SingleJoint:
    """Problem of a trajectory of one length and peak velocity; a genome is its amplitudes [2 H], scaled into the range."""

    dimension: Final = 2 * HARMONICS

    def __init__(self, motion: MotionRange, level: float, duration_s: float) -> None:
        self._motion, self._level, self._duration_s = motion, level, duration_s
        self._omega = fundamentals(duration_s)[0]
        self._coarse, self._fine = (
            unit_motions(self._omega, HARMONICS, duration_s, _grid(duration_s, rate_hz))
            for rate_hz in (SEARCH_RATE_HZ, FINAL_RATE_HZ)
        )

    def _scaled(self, genomes: FloatArray, grid: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
        """Return scales [m] and motions [3, m, n]."""
        own = self._motion
        motion = np.array([genomes @ each for each in grid])
        bounds = (own.reach_rad, self._level * own.velocity_rad_s, SHARE * own.acceleration_rad_s2)
        scale = np.min(
            [bound / peak for bound, peak in zip(bounds, np.abs(motion).max(axis=2), strict=True)], axis=0
        )
        return scale, motion * scale[:, None]

    def _information(self, motion: FloatArray) -> FloatArray:
        """Return the information [m, 6, 6] of motions [3, m, n], per sample."""
        q, w, a = motion
        fastest = self._motion.velocity_rad_s
        friction = np.tanh(w / (_DIRECTION_SHARE * fastest)), w / fastest
        load = a / self._motion.acceleration_rad_s2, np.sin(q), np.cos(q), np.ones_like(q)
        x = np.stack((*friction, *load), axis=2)
        found: FloatArray = np.swapaxes(x, 1, 2) @ x / q.shape[1]
        return found

    def criterion(self, before: FloatArray) -> Criterion:
        """Return -log det of the information so far [6, 6] and that of each genome."""
        return lambda genomes: -log_det(before + self._information(self._scaled(genomes, self._coarse)[1]))

    def finish(self, genome: FloatArray, before: FloatArray) -> tuple[Fourier, FloatArray]:
        """Return the segment of a genome, scaled on the grid of the set-points, and the information so far with it."""
        scale, motion = self._scaled(genome[None, :], self._fine)
        amplitudes = tuple((float(scale[0]) * genome).tolist())
        trajectory = FourierTrajectory(
            self._omega, amplitudes[:HARMONICS], amplitudes[HARMONICS:], self._duration_s
        )
        return Fourier.alone(trajectory), before + self._information(motion)[0]


def trajectories(
    motion: MotionRange, levels: Sequence[float], duration_s: float, *, seed: int, evaluations: int
) -> list[Fourier]:
    """Return a trajectory for each level (peak as a part of the fastest velocity), the best one given those before it.

    evaluations: of each search; 1: drawn. Raises ConfigError for runs that are too short.
    """
    if duration_s < SHORTEST_TRAJECTORY_S:
        raise ConfigError(
            f"--seconds: found trajectories of {duration_s:g} s, expected at least {SHORTEST_TRAJECTORY_S:g} s"
        )
    problems = (SingleJoint(motion, level, duration_s) for level in levels)
    return [segment for segment, _ in sequence(problems, seed=seed, evaluations=evaluations)]


# Currents of a torque -------------------------------------------------------------------------------------------

STEPS: Final = 200
OVER: Final = 3.0
"""Number of currents tried, and the largest of them in torques over G Kt."""


def current_at(joint: Joint, torque_nm: float, velocity_rad_s: float) -> float:
    """Return the current [A] at which the joint, driving at this velocity, gives this torque."""
    loss = LossModel(joint)
    highest = OVER * torque_nm / loss.torque_per_ampere
    currents = np.linspace(0.0, highest, STEPS)
    speeds = np.full_like(currents, velocity_rad_s)
    given = loss.torque_per_ampere * currents - loss.loss_many(currents, speeds)
    enough = np.flatnonzero(given >= torque_nm)
    return float(currents[enough[0]] if len(enough) else highest)


def rounded_down(value: float) -> float:
    """Round down to two significant digits, for limits that people read."""
    place = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(round(math.floor(value / place + 1e-9) * place, 6))
