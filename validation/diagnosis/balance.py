"""One judge of joint files: by how much the torque balances miss what was measured, in the response of the measurement.

A file is given as a joint and its effects, as the file's consumer has them (`jtqd.estimator`); nothing of the diagnosis is
used. Per joint and run, with the signs of `jtqd.estimator.effects.effect`,

    motor      e = G Kt0 (i_needed - i_measured)       i_needed: current at which the motor balance holds, [Nm]
    torsion    e = K0 (twist_needed - twist_measured)  less its mean over the run: one zero per run

with Kt0, K0 of the nominal file, the same for all files that are compared. What is missing in a balance is divided by its
own slope in the response, so that a file whose whole balance is scaled by a factor gains nothing. A constant of the motor
balance (zero of a sensor, error of a known load) stays in. Both are low-passed (25 Hz, zero phase) and judged where
friction has a direction, off the ends of a run. Derivatives are spectral, zero phase, from positions, the same for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.corrections import plain_joint
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import ArrayFunctions, Effect, Joint, State, Values
from jtqd.estimator.run import RunTable
from validation.diagnosis.entries import Array
from validation.study import Z95

CUTOFF_HZ: Final = 25.0
_DERIVATIVE_HZ: Final = 80.0
"""Low-pass of rates and angles that effects use; what is judged passes CUTOFF_HZ once, all terms alike."""
_ENDS_S: Final = 0.3
_SLOW_RAD_S: Final = 0.03
_NEAR_S: Final = 0.05
_LEAST_SLOPE: Final = 0.2
"""Of the median slope over the run: in the middle of a play the twist is anything."""
_PER_S: Final = 100.0
"""Samples of an error per second, at most: four per period of CUTOFF_HZ."""
MOTOR, TORSION = "motor", "torsion"
Pairs = Sequence[tuple[Effect, Values]]


def spectral(x: Array, step_s: float, cutoff_hz: float, order: int = 0) -> Array:
    """Return the derivative of this order of x [n] through a zero-phase low-pass 1/(1 + (f/cutoff)^4).

    The ends are continued by odd reflection, and a straight line is taken off, so that the spectrum sees no jump.
    """
    n = len(x)
    m = min(n - 1, round(1.0 / step_s))
    long = np.concatenate((2 * x[0] - x[m:0:-1], x, 2 * x[-1] - x[-2 : -m - 2 : -1]))
    slope = (long[-1] - long[0]) / (len(long) - 1)
    line = long[0] + slope * np.arange(len(long))
    size = _fast(len(long))
    spare = size - len(long)
    f = np.fft.rfftfreq(size, step_s)
    shape = (2j * np.pi * f) ** order / (1.0 + (f / cutoff_hz) ** 4)
    y = np.fft.irfft(np.fft.rfft(np.pad(long - line, (0, spare))) * shape, size)[m : m + n]
    if order == 0:
        y = y + line[m : m + n]
    elif order == 1:
        y = y + slope / step_s
    return np.asarray(y)


def _fast(n: int) -> int:
    """Return the next 2^a 3^b 5^c."""
    sizes = (2**a * 3**b * 5**c for a in range(20) for b in range(4) for c in range(3))
    return min((int(size) for size in sizes if size >= n), default=n)


@dataclass(frozen=True)
class View:
    """One joint of one run [n]: what was measured, and rates of it. link_rad None: one encoder.

    state: what hooks see of it; the torque is the reading. keep: indices of samples at which the motor balance is judged;
    keep_torsion: the torsion's.
    """

    run: int
    number: int
    step_s: float
    cutoff_hz: float
    state: State
    sensor_temperature_c: Array
    motor_rad: Array
    link_rad: Array | None
    gear_ratio: float

    @cached_property
    def twist_rad(self) -> Array:
        assert self.link_rad is not None
        return np.asarray(self.motor_rad / self.gear_ratio - self.link_rad)

    @cached_property
    def twist_rate_rad_s(self) -> Array:
        return spectral(self.twist_rad, self.step_s, _DERIVATIVE_HZ, 1)

    @cached_property
    def keep_torsion(self) -> Array:
        n = len(self.motor_rad)
        ends = round(_ENDS_S / self.step_s)
        stride = max(1, round(1.0 / (_PER_S * self.step_s)))
        return np.arange(ends, n - ends, stride)

    @cached_property
    def keep(self) -> Array:
        wide = 2 * round(_NEAR_S / self.step_s) + 1
        slow = np.convolve(np.abs(self.state.velocity_rad_s) < _SLOW_RAD_S, np.ones(wide), "same") > 0.5
        return np.asarray(self.keep_torsion[~slow[self.keep_torsion]])

    def low(self, x: Array) -> Array:
        return spectral(x, self.step_s, self.cutoff_hz)


def view(  # noqa: PLR0917
    table: RunTable,
    run: int,
    number: int,
    joint: Joint,
    two_encoders: bool,
    cutoff_hz: float = CUTOFF_HZ,
) -> View:
    """Return a joint of a run; rows are taken as equally spaced between the first and the last stamp."""
    c, t = table.joints[number], table.time_s
    gear, n = joint.gear_ratio, len(t)
    step = float((t[-1] - t[0]) / (n - 1))
    assert c.current_a is not None
    assert c.torque_nm is not None
    link = c.link_position_rad if two_encoders else None
    motor = c.motor_position_rad
    if motor is None:
        assert c.link_position_rad is not None
        motor = c.link_position_rad * gear
    side = motor / gear if link is None else link

    def rate(x: Array, order: int = 1) -> Array:
        return spectral(x, step, min(_DERIVATIVE_HZ, 0.4 / step), order)

    nothing = np.full(n, np.nan)
    velocity = rate(motor) / gear
    other = table.joints.get(1)
    temperature = nothing if c.temperature_c is None else c.temperature_c
    first = other.temperature_c if other is not None and other.temperature_c is not None else temperature
    link_acceleration = rate(side, 2)
    return View(
        run,
        number,
        step,
        cutoff_hz,
        State(
            current_a=c.current_a,
            current_rate_a_s=rate(c.current_a),
            coupling_position_rad=side if number != 2 else -side,
            direction=np.sign(velocity),
            link_acceleration_rad_s2=link_acceleration,
            link_position_rad=side,
            link_velocity_rad_s=rate(side),
            motor_acceleration_rad_s2=rate(motor, 2),
            motor_position_rad=motor,
            temperature_c=temperature,
            time_s=step * np.arange(n),
            torque_nm=c.torque_nm,
            torque_rate_nm_s=rate(c.torque_nm),
            velocity_rad_s=velocity,
        ),
        first,
        motor,
        link,
        gear,
    )


class File(NamedTuple):
    """A joint file as its consumer has it: values, effects that act on it."""

    joint: Any
    pairs: Pairs

    @classmethod
    def of(cls, joint: Any, more: Pairs = ()) -> File:
        pairs = [(EFFECTS[e.name], dict(e.parameters)) for e in joint.effects]
        return cls(plain_joint(joint), [*(pair for pair in pairs if not pair[0].changes_joint), *more])


def _with(state: State, **changes: Any) -> State:
    return State(**{name: getattr(state, name) for name in State.__slots__} | changes)


def _aged(state: State, age_s: float, step_s: float) -> State:
    """Return rates as means over the age of a reading: d times the mean rate ahead is what the reading missed."""
    if not age_s:
        return state

    def ahead(x: Array) -> Array:
        t = np.arange(len(x)) * step_s
        return np.asarray((np.interp(t + age_s, t, x) - x) / age_s)

    return _with(
        state,
        current_rate_a_s=ahead(state.current_a),
        torque_rate_nm_s=ahead(state.torque_nm),
        link_velocity_rad_s=ahead(state.link_position_rad),
    )


def errors(v: View, file: File, nominal: Any) -> dict[str, Array]:
    """Return the error e [Nm] of each balance of a joint in a run, at `keep` and `keep_torsion`."""
    joint, x = file.joint, ArrayFunctions()

    def total(hook: str, state: State, pairs: Pairs = file.pairs) -> Any:
        out: Any = 0.0
        for effect, p in pairs:
            if hook in effect.hooks:
                there = state
                if effect.at_sensor_of(p):
                    there = _with(there, temperature_c=v.sensor_temperature_c)
                there = _aged(there, effect.age_s(p), v.step_s)
                out = out + getattr(effect, hook)(p, there, joint, x)
        return out

    s = v.state
    true_nm = s.torque_nm - total("sensor_nm", s)
    gear_nm = true_nm + joint.link_inertia_kgm2 * s.link_acceleration_rad_s2 + total("load_nm", s)
    current = s.current_a - total("current_a", s)
    motor = [pair for pair in file.pairs if pair[0].at_motor_of(pair[1])]
    acceleration = s.motor_acceleration_rad_s2
    if motor:  # the motor's encoder reads -G link_rad too much
        off = joint.gear_ratio * total("link_rad", s, motor)
        acceleration = acceleration + spectral(off, v.step_s, min(_DERIVATIVE_HZ, 0.4 / v.step_s), 2)
    s = _with(s, torque_nm=gear_nm, current_a=current, motor_acceleration_rad_s2=acceleration)
    return {
        MOTOR: _motor(v, file, nominal, s, total),
        **({} if v.link_rad is None else {TORSION: _torsion(v, file, nominal, s, total)}),
    }


def _motor(v: View, file: File, nominal: Any, s: State, total: Any) -> Array:
    joint, friction = file.joint, file.joint.friction
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    speed = s.velocity_rad_s
    peak = friction.stribeck_nm * np.exp(-((speed / friction.stribeck_velocity_rad_s) ** 2))
    lost = (friction.coulomb_nm + peak) * s.direction + friction.viscous_nms_per_rad * speed
    inertia = joint.gear_ratio * joint.rotor_inertia_kgm2 * s.motor_acceleration_rad_s2
    missing = gain * s.current_a - inertia - lost - total("loss_nm", s) - s.torque_nm
    by_current = [pair for pair in file.pairs if pair[0].group == "actuator"]
    step = 1e-3 * joint.rated_torque_nm / gain
    up, down = (total("loss_nm", _with(s, current_a=s.current_a + d), by_current) for d in (step, -step))
    slope = _bounded(gain - (up - down) / (2.0 * step) + 0.0 * speed)
    scale = nominal.gear_ratio * nominal.torque_constant_nm_per_a
    return np.asarray(v.low(-scale * missing / slope)[v.keep])


def _torsion(v: View, file: File, nominal: Any, s: State, total: Any) -> Array:
    stiffness = file.joint.stiffness_nm_per_rad
    reads = total("link_rad", s)
    twist = v.twist_rad + reads
    damping = file.joint.damping_nms_per_rad * v.twist_rate_rad_s
    zero = float(np.mean(twist - s.torque_nm / stiffness))
    step = 1e-3 * nominal.rated_torque_nm / nominal.stiffness_nm_per_rad
    springs = [pair for pair in file.pairs if pair[0].name in ("nonlinear_stiffness", "lost_motion")]
    e = np.zeros(0)
    for _ in range(2):  # the zero is that of the file's own spring
        d = twist - zero
        own = _with(s, torsion_rad=d, torsion_rate_rad_s=v.twist_rate_rad_s)
        missing = stiffness * (d + total("twist_rad", own)) + damping - s.torque_nm
        up, down = (total("twist_rad", _with(own, torsion_rad=d + k), springs) for k in (step, -step))
        slope = _bounded(stiffness * (1.0 + (up - down) / (2.0 * step)) + 0.0 * d)
        e = missing / slope
        zero += float(np.mean(e))
    e = v.low(-nominal.stiffness_nm_per_rad * e)[v.keep_torsion]
    return np.asarray(e - e.mean())


def _bounded(slope: Array) -> Array:
    middle = float(np.median(slope))
    return np.asarray(np.sign(middle) * np.maximum(np.sign(middle) * slope, _LEAST_SLOPE * abs(middle)))


def combined_nm(
    views: Sequence[View], files: Mapping[int, File], nominal: Mapping[int, Any]
) -> tuple[float, list[float]]:
    """Return the error of files over balances of joints (root of the mean square of the balances' rms) and that of each
    run by itself.
    """
    squares: dict[tuple[int, str], list[Array]] = {}
    per_run: dict[int, list[float]] = {}
    for v in views:
        for balance, e in errors(v, files[v.number], nominal[v.number]).items():
            if len(e):
                squares.setdefault((v.number, balance), []).append(e * e)
                per_run.setdefault(v.run, []).append(float(np.mean(e * e)))
    means = [float(np.mean(np.concatenate(x))) for x in squares.values()]
    return float(np.sqrt(np.mean(means))), [float(np.sqrt(np.mean(x))) for x in per_run.values()]


def ladder(views: Sequence[View], held: Sequence[View], nominal: Mapping[int, Any]) -> float:
    """Return the combined error on held-out runs of the ladder fitted to runs by ordinary least squares.

    Motor balance: current as offset, Coulomb, viscous, inertia, load and gain (of the torque); torsion: twist as a gain of
    the torque. The same samples and the same low-pass as `errors`.
    """
    means = []
    kinds = [MOTOR] if views[0].link_rad is None else [MOTOR, TORSION]
    for number, joint in nominal.items():
        for kind in kinds:
            rows = [_ladder_rows(v, joint, kind) for v in views if v.number == number]
            a, y = (np.concatenate(x) for x in zip(*rows, strict=True))
            scale = np.maximum(np.abs(a).max(axis=0), 1e-12)
            c = np.linalg.lstsq(a / scale, y, rcond=1e-9)[0] / scale
            judged = [_ladder_rows(v, joint, kind) for v in held if v.number == number]
            means.append(float(np.mean(np.concatenate([b @ c - z for b, z in judged]) ** 2)))
    return float(np.sqrt(np.mean(means)))


def _ladder_rows(v: View, joint: Any, kind: str) -> tuple[Array, Array]:
    s = v.state
    torque = s.torque_nm + joint.link_inertia_kgm2 * s.link_acceleration_rad_s2
    if kind == TORSION:
        rows = np.array([v.low(torque), v.low(joint.stiffness_nm_per_rad * v.twist_rad)])[:, v.keep_torsion]
        rows -= rows.mean(axis=1, keepdims=True)
        return rows[:1].T, rows[1]
    columns = [
        np.ones_like(torque),
        v.low(s.direction),
        v.low(s.velocity_rad_s),
        v.low(s.motor_acceleration_rad_s2 / joint.gear_ratio),
        v.low(np.abs(torque) * s.direction),
        v.low(torque),
    ]
    y = v.low(joint.gear_ratio * joint.torque_constant_nm_per_a * s.current_a)
    return np.column_stack(columns)[v.keep], y[v.keep]


# The oracle: the true set, fitted to the same runs.


@dataclass(frozen=True)
class Parameter:
    """One unknown of the oracle: of the joint file (key) or of an effect of its own; scale: typical error; file: value
    that the file given to the tool has. entry: index of what it belongs to.
    """

    entry: int
    joint: int
    key: str
    true: float
    file: float
    scale: float
    effect: str = ""
    of_sensor: bool = False


@dataclass(frozen=True)
class Fit:
    """Values and standard errors by parameter (times Student's t over the normal's for so few runs); files: fitted;
    jacobian [m, p] in whitened errors and scaled parameters; whiten: see `_whitener`; base: errors at the fit.
    """

    values: Array
    sigma: Array
    files: dict[int, File]
    jacobian: Array
    whiten: Any
    base: list[dict[str, Array]]


class Truth:
    """Joint files with the true values of what is free put in: `true` joints (plain), structural effects by joint."""

    def __init__(
        self, joints: Mapping[int, Any], effects: Mapping[int, Pairs], free: Sequence[Parameter]
    ) -> None:
        self.joints, self.effects, self.free = joints, effects, free

    def files(self, values: Array) -> dict[int, File]:
        out = {}
        for number, plain in self.joints.items():
            joint = plain
            pairs = [(effect, dict(p)) for effect, p in self.effects[number]]
            for q, value in zip(self.free, values, strict=True):
                if q.effect:
                    if q.of_sensor or q.joint == number:
                        next(p for e, p in pairs if e.name == q.effect)[q.key] = float(value)
                elif q.joint == number:
                    joint = _replaced(joint, q.key, float(value))
            out[number] = File(joint, pairs)
        return out


def _replaced(joint: Any, key: str, value: float) -> Any:
    value = max(value, 1e-12)
    head, _, tail = key.partition(".")
    return replace(joint, **{head: replace(getattr(joint, head), **{tail: value}) if tail else value})


_FADE: Final = 1e-2
"""What a parameter that the runs do not show stays with: a standard deviation of a hundred times its scale, at the truth."""
_TURNS: Final = 6


def fit(views: Sequence[View], truth: Truth, nominal: Mapping[int, Any]) -> Fit:
    """Return the true set fitted by Gauss-Newton from the truth on: ordinary least squares, then weighted.

    Weights: noise as sums over a second show it, and offset, Coulomb and viscous friction of each run's own, with the spread
    that the residuals of the first fit have. A step that does not lower the sum of squares is halved.
    """
    start = np.array([q.true for q in truth.free])
    scale = np.array([q.scale for q in truth.free])

    def at(moved: Array) -> list[dict[str, Array]]:
        return _all_errors(views, truth.files(start + scale * moved), nominal)

    moved, base = np.zeros(len(start)), at(np.zeros(len(start)))
    stack: Any = _stacked
    for weighted in (False, True):
        if weighted:
            stack = _whitener(views, base)
        e = stack(base)
        for _ in range(_TURNS):
            j = _jacobian(views, truth, nominal, start + scale * moved, scale, base, stack)
            left, rows = np.concatenate((e, _FADE * moved)), np.vstack((j, _FADE * np.eye(len(start))))
            step = np.linalg.lstsq(rows, -left, rcond=None)[0]
            cost = float(left @ left)
            for _ in range(8):
                tried = at(moved + step)
                ahead = stack(tried)
                gained = cost - float(ahead @ ahead) - _FADE**2 * float((moved + step) @ (moved + step))
                if gained > 0.0:
                    break
                step = 0.5 * step
            if not gained > 0.0:
                break
            moved, base, e = moved + step, tried, ahead
            if gained < 1e-3 * cost / len(e):
                break
    j = _jacobian(views, truth, nominal, start + scale * moved, scale, base, stack)
    normal = j.T @ j + _FADE**2 * np.eye(len(start))
    wider = _student(max(len({v.run for v in views}) - 1, 1)) / Z95
    sigma = scale * wider * np.sqrt(np.diag(np.linalg.inv(normal)))
    values = start + scale * moved
    return Fit(values, sigma, truth.files(values), j, stack, base)


def _jacobian(  # noqa: PLR0917
    views: Sequence[View],
    truth: Truth,
    nominal: Mapping[int, Any],
    values: Array,
    scale: Array,
    base: Sequence[dict[str, Array]],
    stack: Any,
) -> Array:
    """Return the slopes of the stacked errors over the scaled parameters [m, p], by differences."""
    e = stack(base)
    columns = [
        stack(_all_errors(views, truth.files(values + 1e-3 * scale * row), nominal, only=q, base=base)) - e
        for q, row in zip(truth.free, np.eye(len(values)), strict=True)
    ]
    return np.array(columns).reshape(len(values), len(e)).T / 1e-3


def _student(freedom: int) -> float:
    """Return the two-sided 95 % quantile of Student's t: what a spread between so few runs costs."""
    table = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 7: 2.36}
    return table.get(freedom, Z95 + 2.5 / freedom)


def _all_errors(
    views: Sequence[View],
    files: Mapping[int, File],
    nominal: Mapping[int, Any],
    *,
    only: Parameter | None = None,
    base: Sequence[dict[str, Array]] = (),
) -> list[dict[str, Array]]:
    """Return the errors of all views; only: of the joint of this parameter, the others as in base."""
    return [
        errors(v, files[v.number], nominal[v.number])
        if only is None or only.of_sensor or v.number == only.joint
        else base[k]
        for k, v in enumerate(views)
    ]


def _stacked(found: Sequence[dict[str, Array]]) -> Array:
    return np.concatenate([e for each in found for e in each.values()])


def _whitener(views: Sequence[View], left: Sequence[dict[str, Array]]) -> Any:
    """Return a function that stacks errors so that their squares count as -2 log likelihood."""
    own: list[dict[str, Array]] = []
    noise: dict[tuple[int, str], list[Array]] = {}
    spread: dict[tuple[int, str], list[Array]] = {}
    for v, each in zip(views, left, strict=True):
        s = v.state
        z = {
            MOTOR: np.column_stack([np.ones(len(v.keep)), s.direction[v.keep], s.velocity_rad_s[v.keep]]),
            TORSION: np.zeros((len(v.keep_torsion), 0)),
        }
        own.append(z)
        for kind, e in each.items():
            c = np.linalg.lstsq(z[kind], e, rcond=1e-4)[0] if len(e) else np.zeros(z[kind].shape[1])
            spread.setdefault((v.number, kind), []).append(c)
            noise.setdefault((v.number, kind), []).append(e - z[kind] @ c)
    sigma = {k: max(float(np.sqrt(np.mean([_long(e) for e in x if len(e)]))), 1e-9) for k, x in noise.items()}
    deviation = {
        k: np.maximum(np.sqrt(np.sum(np.square(x), axis=0) / max(len(x) - 1, 1)), 1e-9)
        for k, x in spread.items()
    }
    bases: list[dict[str, Array]] = []
    for v, z in zip(views, own, strict=True):
        each = {}
        for kind in left[len(bases)]:
            key = (v.number, kind)
            full = np.vstack((z[kind] / sigma[key], np.diag(1.0 / deviation[key])))
            each[kind] = np.linalg.qr(full)[0]
        bases.append(each)

    def whiten(found: Sequence[dict[str, Array]]) -> Array:
        out = []
        for v, q, each in zip(views, bases, found, strict=True):
            for kind, e in each.items():
                r = np.concatenate((e / sigma[v.number, kind], np.zeros(q[kind].shape[1])))
                out.append(r - q[kind] @ (q[kind].T @ r))
        return np.concatenate(out)

    return whiten


def _long(e: Array) -> float:
    """Return the variance per sample as sums over a second have it: slow noise counts as it should."""
    wide = round(_PER_S)
    blocks = e[: len(e) // wide * wide].reshape(-1, wide).sum(axis=1)
    return max(float(np.mean(blocks**2)) / wide if len(blocks) else 0.0, float(np.var(e)))


_RIVAL: Final = 6.0
"""2 log-likelihood by which every single other entry must be worse."""


def settled(  # noqa: PLR0917
    views: Sequence[View],
    found: Fit,
    truth: Truth,
    nominal: Mapping[int, Any],
    moved: Sequence[float],
    skip: Sequence[str],
) -> list[bool]:
    """Return per entry whether no single other effect of the library, at any joint, can take its place.

    Linearised at the fit: y = J_k (found - file) is what entry k does; without it and with the rival's columns of the search
    (`Effect.terms`) beside all other parameters, what stays of y in whitened errors must exceed `_RIVAL`. moved: per
    parameter found - file over its scale. skip: effects that these runs cannot hold (of an encoder or a sensor).
    """
    base = found.whiten(found.base)
    there = {(q.effect, 0 if q.of_sensor else q.joint) for q in truth.free}
    rivals = []
    for number, joint in nominal.items():
        for name, effect in EFFECTS.items():
            sensor = effect.at_sensor
            if (
                name in skip
                or (name, 0 if sensor else number) in there
                or (sensor and number != min(nominal))
            ):
                continue
            if any(
                p.key and (p.key in {q.key for q in truth.free if q.joint == number})
                for p in effect.parameters
            ):
                continue
            warm = any(p.name == "reference_c" for p in effect.parameters)
            for term in effect.terms(joint):
                columns = []
                # about the file's temperature: about any other one, a slope over temperature is any constant
                for p in term.basis[:1] if warm else term.basis:
                    files = dict(found.files)
                    for each in files if sensor or effect.at_sensor_of(p) else (number,):
                        file = files[each]
                        changed = effect.joint(p, file.joint)
                        files[each] = File(
                            changed, file.pairs if effect.changes_joint else [*file.pairs, (effect, p)]
                        )
                    only = Parameter(0, number, "", 0, 0, 1, name, sensor or effect.at_sensor_of(p))
                    columns.append(
                        found.whiten(_all_errors(views, files, nominal, only=only, base=found.base)) - base
                    )
                rivals.append(np.array(columns).T)
    entries = [q.entry for q in truth.free]
    out = []
    for k in range(max(entries, default=-1) + 1):
        mine = np.array([entry == k for entry in entries])
        others = found.jacobian[:, ~mine]
        q0 = _basis(others)
        y = found.jacobian[:, mine] @ np.asarray(moved)[mine]
        y = y - q0 @ (q0.T @ y)
        least = float(y @ y)
        for rival in rivals:
            apart = rival - q0 @ (q0.T @ rival)
            new = np.sum(apart**2, axis=0) > 1e-8 * np.sum(rival**2, axis=0)
            q1 = _basis(apart[:, new])
            z = q1.T @ y
            least = min(least, float(y @ y - z @ z))
        out.append(least > _RIVAL)
    return out


def _basis(a: Array) -> Array:
    """Return an orthonormal basis of the columns of a [m, p], without those that are nothing or repeat others."""
    size = np.sqrt(np.sum(a * a, axis=0))
    a = a[:, size > 1e-9]
    if not a.shape[1]:
        return np.zeros((len(a), 0))
    u, s, _ = np.linalg.svd(a / size[size > 1e-9], full_matrices=False)
    return np.asarray(u[:, s > 1e-5 * s[0]])
