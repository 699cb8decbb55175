"""Gain of the extended model on held-out runs: error of its torque, and of a free run of the motor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import ArrayFunctions, Effect, State, Values
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Effect as Effect_parameters
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.findings import Gain, RunGain, shows_at
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS, solve
from jtqd.sysid.diagnosis.refine import PresentEffect, Refined, places
from jtqd.sysid.diagnosis.signals import BaseLoss, Channel, JointSignals

_BOOTSTRAPS: Final = 2000


def held_out_gain(dataset: Dataset, refined: Refined, seed: int = 0) -> Gain:
    """Return the error of the simulation's torque before and after, each run with the parameters of all others.

    In the balance where most goes away; the run's own zero and friction of the day stay in, as in service, if the error
    falls with them (`judged_squares`). ci95: of rmse_before - rmse_after [Nm], bootstrap over runs.
    """
    steps = left_out_steps(refined)
    pieces = refined.mixed.pieces
    squares, plain = judged_squares(dataset, refined, steps)
    drops = falls_nm(squares)
    channel = max(drops, key=lambda c: drops[c])
    table = squares[channel]
    names = [dataset.runs[int(np.argmax(pieces == r))].name for r in range(len(table))]
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(table), size=(_BOOTSTRAPS, len(table)))
    sums = table[picks].sum(axis=1)
    drawn = np.sqrt(sums[:, 0] / sums[:, 2]) - np.sqrt(sums[:, 1] / sums[:, 2])
    low, high = np.percentile(drawn, (2.5, 97.5))
    velocity, position = free_run_errors(dataset, refined, steps)
    return Gain(
        _rms(table, 0),
        _rms(table, 1),
        f"each of {len(table)} runs held out once; {channel.balance} balance of joint {channel.joint}"
        + ("; without run-to-run variation" if plain else ""),
        (float(low), float(high)),
        *velocity,
        tuple(
            RunGain(name, _rms(row, 0), _rms(row, 1))
            for name, row in zip(names, table[:, None, :], strict=True)
            if row[0, 2] > 0.0
        ),
        *position,
        plain_nm=(_rms(plain[channel], 0), _rms(plain[channel], 1)) if plain else None,
    )


Squares = dict[Channel, FloatArray]
"""Per channel and recording the sums of squares before and after [Nm^2], and the count of bins: [r, 3]."""


def judged_squares(
    dataset: Dataset, refined: Refined, steps: Sequence[FloatArray]
) -> tuple[Squares, Squares]:
    """Return the squares by which the gain is judged, and the plain ones where it is not by those, else nothing.

    What a run has of its own can be several times all causes together, and in the mean of a few runs lie against them by
    chance: then the plain error falls in no balance, whatever the causes are worth. With ENOUGH_RUNS to know how large it
    usually is, it counts as little as it is usual (`squares_beside`); with fewer the plain error decides.
    """
    plain = left_out_squares(dataset, refined, steps)
    if refined.mixed.runs < ENOUGH_RUNS or max(falls_nm(plain).values()) > 0.0:
        return plain, {}
    return left_out_squares(dataset, refined, steps, beside_own=True), plain


def left_out_squares(
    dataset: Dataset, refined: Refined, steps: Sequence[FloatArray], *, beside_own: bool = False
) -> Squares:
    """Return the squares of each run with the parameters of all others (steps: `left_out_steps`); beside_own: with what the
    run has of its own counted as little as it is usual.
    """
    squares: Squares = {}
    floor = noise_squares(dataset)
    for place, run, left, step in zip(refined.mixed.pieces, dataset.runs, refined.runs, steps, strict=True):
        for channel, d in left.channels.items():
            before = run.channels[channel].residual[d.valid]
            after = (d.residual - d.regressors @ step[d.index])[d.valid]
            if channel.balance == "torsion" and len(before):
                before, after = before - before.mean(), after - after.mean()
            rows = squares.setdefault(channel, np.zeros((refined.mixed.runs, 3)))
            both = np.column_stack((before, after))
            own = d.nuisances[d.valid] if beside_own else np.empty((len(both), 0))
            weights = floor[channel] / refined.variances[d.families] if beside_own else np.empty(0)
            rows[place] += (*squares_beside(both, own, weights).tolist(), len(before))
    return squares


def noise_squares(dataset: Dataset) -> dict[Channel, float]:
    """Return per channel the mean square of what no effect explains [Nm^2]."""
    return {c: float(np.nanmean(np.concatenate(x) ** 2)) for c, x in dataset.unexplained.items()}


def squares_beside(columns: FloatArray, own: FloatArray, weights: FloatArray) -> FloatArray:
    """Return x' (1 + Z V Z'/s2)^-1 x of each column x [n, k], Nm^2: its square where what the run has of its own counts as
    little as it is usual. own: Z [n, q]; weights: s2 / V [q], of noise and of the runs' own changes.
    """
    common = own.T @ columns
    explained = np.sum(common * np.linalg.solve(own.T @ own + np.diag(weights), common), axis=0)
    return np.asarray(np.sum(columns**2, axis=0) - explained)


def falls_nm(squares: Mapping[Channel, FloatArray]) -> dict[Channel, float]:
    """Return per channel by how much the rms of all recordings falls [Nm]; squares: of `left_out_squares`."""
    return {c: _rms(s, 0) - _rms(s, 1) for c, s in squares.items()}


Before = tuple[float, float]
"""Without and with; NaN where there is nothing to simulate."""


def free_run_errors(
    dataset: Dataset, refined: Refined, steps: Sequence[FloatArray], cause: int | None = None
) -> tuple[Before, Before]:
    """Return the rms errors of the simulation running free, of its velocity [rad/s] and its position [rad], joint side: over
    all joints and runs, each run with the parameters of all others (steps: `left_out_steps`). cause: without and with
    this one beside the others; None: without and with all of them.
    """
    squares = np.zeros((2, 2))
    count = 0
    mine = places(refined.present)
    for run, step in zip(dataset.signals, steps, strict=True):
        causes = [p.moved(step[own].tolist()) for p, own in zip(refined.present, mine, strict=True)]
        for s in run:
            there = [k for k, p in enumerate(causes) if shows_at(p.joint, s.number)]
            asked = there if cause is None else [cause]
            if not set(asked) & set(there):
                continue
            try:
                after = free_run(s, _extended(s.joint, [causes[k] for k in there]))
                rest = [causes[k] for k in there if k not in asked]
                before = free_run(s, _extended(s.joint, rest))
            except ConfigError:
                continue  # a run left out can take a parameter out of its range
            squares += [[r.rmse_rad_s**2 for r in (before, after)], [r.rmse_rad**2 for r in (before, after)]]
            count += 1
    if not count:
        return (math.nan, math.nan), (math.nan, math.nan)
    velocity, position = np.sqrt(squares / count).tolist()
    return (velocity[0], velocity[1]), (position[0], position[1])


def _extended(joint: Joint, causes: Sequence[PresentEffect]) -> Joint:
    effects = [*joint.effects, *(Effect_parameters(p.effect.name, dict(p.values)) for p in causes)]
    return replace(joint, effects=tuple(effects))


def _rms(table: FloatArray, column: int) -> float:
    return float(np.sqrt(table[:, column].sum() / max(table[:, 2].sum(), 1.0)))


def left_out_steps(refined: Refined) -> list[FloatArray]:
    """Return per piece of a run the change of the free parameters when the run is left out."""
    marginals, _ = refined.mixed.marginal_runs(refined.variances)
    total = marginals.sum(axis=0)
    k = refined.mixed.columns
    of_runs = [solve(total - m, k)[0] for m in marginals]
    return [of_runs[r] for r in refined.mixed.pieces]


WINDOW_S: Final = 0.5
_MEASURED: Final = (
    "current_a",
    "current_rate_a_s",
    "temperature_c",
    "time_s",
    "torque_rate_nm_s",
    "torsion_rad",
    "torsion_rate_rad_s",
)
"""Fields of the state that the windows take from the measurement; the others are simulated."""
_NEARLY_ZERO_RAD_S: Final = 1e-9
"""Speed at which the loss of a sticking joint is asked for."""


@dataclass(frozen=True)
class FreeRun:
    """Error of a free run of one joint over one run.

    rmse_rad_s: of the velocity, joint side, over all samples of all windows but their first ones; rmse_rad: of the position
    turned since the window's start; windows_rad_s [w]: of the velocity of each window, which begins at start_s [w] (time
    since the run's first sample) and is window_s long.
    """

    run: str
    joint: int
    rmse_rad_s: float
    rmse_rad: float
    window_s: float
    start_s: FloatArray
    windows_rad_s: FloatArray


Term = tuple[Effect, Values]
Index = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def free_run(
    signals: JointSignals, joint: Joint, base: BaseLoss | None = None, *, window_s: float = WINDOW_S
) -> FreeRun:
    """Simulate one joint of one run in windows and compare its velocity with the measured one.

        (G^2 Jm + Jl) dv/dt = G Kt I - TAU_S - load_nm - loss0 - loss_nm          v = omega_m/G

    with I = i - current_a and TAU_S = tau_s - sensor_nm: the measured inputs less the errors that the effects of the joint
    give them. Each window begins in the measured state and is then left alone, all of them stepped at once. The error of the
    velocity counts every newton metre that the model has wrong over the whole window, where a residual of the torque balance
    sees one sample at a time. The spring is on the other side of the measured torque, so twist_rad and link_rad have no
    part in this. Friction is implicit: its impulse within a step can stop the motor and not turn it round, so a joint
    sticks.

    joint: the model, its `effects` included; signals.joint itself for the run before anything is extended. base: losses of
    the joint file (effects do not change them), made here if not given. A run shorter than one window is one window.
    """
    base = base or BaseLoss(joint)
    terms = tuple((EFFECTS[e.name], e.parameters) for e in joint.effects)
    for effect, p in terms:
        joint = effect.joint(p, joint)
    terms = tuple(t for t in terms if not t[0].changes_joint)
    drive, torque = _inputs(signals, joint, terms)
    time = signals.state.time_s
    index = _windows(time, window_s)
    simulated = _simulate(_Model(signals, joint, base, terms), drive, torque, index)
    error = simulated - signals.state.velocity_rad_s[index]
    squares = np.mean(np.square(error[1:]), axis=0)
    return FreeRun(
        signals.run,
        signals.number,
        float(np.sqrt(np.mean(squares))),
        _position_error(signals, joint, simulated, index),
        float(time[index[-1, 0]] - time[index[0, 0]]),
        time[index[0]],
        np.sqrt(squares),
    )


def _position_error(signals: JointSignals, joint: Joint, simulated: FloatArray, index: Index) -> float:
    """Return the rms error [rad, joint side] of what the simulation has turned since the windows' starts; of the motor's
    position, else the link's, else of the integral of the measured velocity.
    """
    seen = signals.state
    step = np.diff(seen.time_s[index], axis=0)
    turned = np.cumsum(0.5 * step * (simulated[1:] + simulated[:-1]), axis=0)
    for position in (seen.motor_position_rad / joint.gear_ratio, seen.link_position_rad):
        if np.isfinite(position).all() and np.ptp(position) > 0.0:
            return float(np.sqrt(np.mean((turned - (position[index[1:]] - position[index[0]])) ** 2)))
    v = seen.velocity_rad_s[index]
    return float(np.sqrt(np.mean((turned - np.cumsum(0.5 * step * (v[1:] + v[:-1]), axis=0)) ** 2)))


def _inputs(signals: JointSignals, joint: Joint, terms: Sequence[Term]) -> tuple[FloatArray, FloatArray]:
    """Return (G Kt I - TAU_S, TAU_S) [n, Nm]: what was measured less the effects' errors of measurement."""
    state = signals.state
    current, sensor = state.current_a, signals.sensor_nm
    whole = ArrayFunctions()
    for effect, p in terms:
        if "current_a" in effect.hooks:
            current = current - effect.current_a(p, state, joint, whole)
        if "sensor_nm" in effect.hooks:
            sensor = sensor - effect.sensor_nm(p, state, joint, whole)
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * current
    return motor - sensor, sensor


def _windows(time: FloatArray, window_s: float) -> Index:
    """Return sample numbers [steps + 1, windows]; the last window ends with the run and may overlap the one before."""
    count = len(time)
    steps = min(max(1, round(window_s / float(np.median(np.diff(time))))), count - 1)
    starts = np.arange(0, count - steps, steps)
    if starts[-1] + steps < count - 1:
        starts = np.append(starts, count - 1 - steps)
    return starts[None, :] + np.arange(steps + 1)[:, None]


class _Model:
    """One joint with its effects, asked for what acts in a step; arrays [w] over the windows.

    pushing(): torque that neither current nor sensor shows; friction(): magnitude in a direction, >= 0, Nm joint side.
    `state` is what the hooks see; it is written by `look`.
    """

    def __init__(self, signals: JointSignals, joint: Joint, base: BaseLoss, terms: Sequence[Term]) -> None:
        self.signals, self.joint, self._base = signals, joint, base
        self._side = -1.0 if signals.number == 2 else 1.0  # coupling angle: joint 1's frame
        self._measured = {name: getattr(signals.state, name) for name in _MEASURED} if terms else {}
        losses = [(e, p) for e, p in terms if "loss_nm" in e.hooks]
        self._frictions = [(e.loss_nm, p, _Stepwise()) for e, p in losses if e.dissipative]
        self._others = [(e.loss_nm, p, _Stepwise()) for e, p in losses if not e.dissipative]
        self._others += [(e.load_nm, p, _Stepwise()) for e, p in terms if "load_nm" in e.hooks]
        self._state = State()

    def look(
        self,
        at: Index,
        v: FloatArray,
        motor: FloatArray,
        link: FloatArray,
        *,
        acceleration: FloatArray,
        gear: FloatArray,
    ) -> None:
        """Where the joint is: sample numbers at [w], velocity, positions, acceleration of the step before, torque."""
        state = self._state
        state.torque_nm = gear
        if not self._measured:
            return
        for name, column in self._measured.items():
            setattr(state, name, column[at])
        state.velocity_rad_s = state.link_velocity_rad_s = v
        state.direction = np.sign(v)
        state.motor_position_rad, state.link_position_rad = motor, link
        state.coupling_position_rad = self._side * link
        state.link_acceleration_rad_s2 = acceleration
        state.motor_acceleration_rad_s2 = self.joint.gear_ratio * acceleration

    def pushing(self) -> FloatArray | float:
        """Return what the effects that are no friction add to the torque that accelerates, negative for a loss."""
        total: FloatArray | float = 0.0
        for hook, p, functions in self._others:
            total = total - hook(p, self._state, self.joint, functions)
        return total

    def friction(self, s: FloatArray, speed: FloatArray) -> FloatArray:
        """Return the friction of moving in direction s [w] (-1, 0, 1) at speed [w] >= 0."""
        state = self._state
        v = s * np.maximum(speed, _NEARLY_ZERO_RAD_S)
        loss = self._base.loss(state.torque_nm, v)
        if self._frictions:
            state.velocity_rad_s = state.link_velocity_rad_s = v
            state.direction = s
            for hook, p, functions in self._frictions:
                loss = loss + hook(p, state, self.joint, functions)
        return np.maximum(s * loss, 0.0)


def _simulate(model: _Model, drive: FloatArray, sensor: FloatArray, index: Index) -> FloatArray:
    """Return velocities [steps + 1, windows], joint side; row 0 is the measured start.

    Inputs are linear between samples: a step takes their mean, positions and speed in its middle. A step in which the
    joint comes to rest is divided there: what is left of it begins at rest, and friction may hold it.
    """
    seen, joint = model.signals.state, model.joint
    G, Jl = joint.gear_ratio, joint.link_inertia_kgm2
    inertia = G * G * joint.rotor_inertia_kgm2 + Jl
    steps = np.diff(seen.time_s[index], axis=0)
    push = 0.5 * (drive[index[:-1]] + drive[index[1:]])
    torque = 0.5 * (sensor[index[:-1]] + sensor[index[1:]])
    velocity: FloatArray = np.empty(index.shape)
    v = velocity[0] = seen.velocity_rad_s[index[0]]
    motor, link = seen.motor_position_rad[index[0]], seen.link_position_rad[index[0]]
    acceleration = seen.link_acceleration_rad_s2[index[0]]
    for k, h in enumerate(steps):
        turned = 0.5 * h * (v + 0.5 * h * acceleration)
        gear = torque[k] + Jl * acceleration
        model.look(index[k], v, motor + G * turned, link + turned, acceleration=acceleration, gear=gear)
        pushing = push[k] + model.pushing()
        s = np.where(v != 0.0, np.sign(v), np.sign(pushing))
        held = model.friction(s, np.abs(v) + 0.5 * h * s * acceleration)
        a = (pushing - s * held) / inertia
        end = v + h * a
        stopped = end * s < 0.0
        if stopped.any():
            s = np.sign(pushing)
            left = np.where(v != 0.0, np.minimum(end / np.where(stopped, a, 1.0), h), h)
            free = np.maximum(np.abs(pushing) - model.friction(s, np.zeros_like(v)), 0.0)
            end = np.where(stopped, s * free / inertia * left, end)
        acceleration = (end - v) / h
        motor, link = motor + G * 0.5 * h * (v + end), link + 0.5 * h * (v + end)
        v = velocity[k + 1] = end
    return velocity


class _Stepwise(ArrayFunctions):
    """Functions of arrays over windows [w], each call one instant later: `slip` remembers its state."""

    __slots__ = ("_last", "_z")

    def __init__(self) -> None:
        super().__init__()
        self._last: FloatArray | None = None
        self._z: FloatArray = np.zeros(1)

    def slip(self, d: FloatArray, travel: float) -> FloatArray:
        """Return the states [w] after the deflections went on to d [w]; 0 at the first."""
        moved = np.zeros_like(d) if self._last is None else (d - self._last) / travel
        self._last, self._z = d, np.clip(self._z + moved, -1.0, 1.0)
        return self._z
