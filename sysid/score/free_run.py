"""A joint that simulates alone: its velocity in windows of half a second, from the measured current and torque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import ArrayFunctions, Effect, State, Values
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals

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


class FreeRun(NamedTuple):
    """Rms errors of a free run, joint side, over all samples of all windows but their first ones: of the velocity, and of
    the position turned since the window's start.
    """

    rmse_rad_s: float
    rmse_rad: float


Term = tuple[Effect, Values]
Index = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def free_run(signals: JointSignals, joint: Joint, window_s: float = WINDOW_S) -> FreeRun:
    """Simulate one joint of one run in windows and compare its velocity with the measured one.

        (G^2 Jm + Jl) dv/dt = G Kt I - TAU_S - load_nm - loss0 - loss_nm          v = omega_m/G

    with I = i - current_a and TAU_S = tau_s - sensor_nm: the measured inputs less the errors that the effects of the joint
    give them. Each window begins in the measured state and is then left alone, all of them stepped at once. The error of the
    velocity counts every newton metre that the model has wrong over the whole window, where a residual of the torque balance
    sees one sample at a time. The spring is on the other side of the measured torque, so twist_rad and link_rad have no
    part in this. Friction is implicit: its impulse within a step can stop the motor and not turn it round, so a joint
    sticks.

    joint: the model, its `effects` included. A run shorter than one window is one window.
    """
    base = BaseLoss(joint)  # effects do not change the losses of the file
    terms = tuple((EFFECTS[e.name], e.parameters) for e in joint.effects)
    for effect, p in terms:
        joint = effect.joint(p, joint)
    terms = tuple(t for t in terms if not t[0].changes_joint)
    drive, torque = _inputs(signals, joint, terms)
    index = windows(signals.state.time_s, window_s)
    simulated = _simulate(_Model(signals, joint, base, terms), drive, torque, index)
    error = simulated - signals.state.velocity_rad_s[index]
    rmse_rad_s = float(np.sqrt(np.mean(np.square(error[1:]))))
    return FreeRun(rmse_rad_s, _position_error(signals, joint, simulated, index))


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
    current, sensor = signals.current_a, signals.sensor_nm
    whole = ArrayFunctions()
    for effect, p in terms:
        if "current_a" in effect.hooks:
            current = current - effect.current_a(p, state, joint, whole)
        if "sensor_nm" in effect.hooks:
            sensor = sensor - effect.sensor_nm(p, state, joint, whole)
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * current
    return motor - sensor, sensor


def windows(time: FloatArray, window_s: float) -> Index:
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
