"""What a diagnosis sees of one joint in one run: state for the effects, residuals of both balances, masks.

The residuals are those of `jtqd.estimator.effects.effect`: measured less simulated with the joint file.

The torsion that the effects see is tau/K, not the encoders' difference: the residual of the torsion balance contains that
difference, and a regressor that contains it too would explain its noise. Its rate is that of the difference, whose noise
has no part in the noise of the difference itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import MOTOR, TORSION, Effect, State, Values
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import DRIVING_CURRENT_MAX_A, LossModel
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sim_can.plant import TORQUE_STEPS, LossTable
from jtqd.sim_can.plant_file import plant_of_joint
from jtqd.sysid.diagnosis.smoothing import (
    FIRST,
    REACH,
    SECOND,
    Smoother,
    acceleration_noise,
    below,
    cutoff_hz,
    described,
    first_difference,
    known_below_hz,
    mean_ahead,
    noise_of,
    second_difference,
    steps_of,
)
from jtqd.sysid.runs.bad_samples import Held

SLOPE: Final = 0.0075
"""Part of the rated torque over which the losses' slope is taken: as wide as zeros of torque sensors are."""


class BaseLoss:
    """Losses of one joint file as the simulation has them, loss0(tau, v), signed like the velocity [Nm, joint side].

    The law of the emulated plant for this file (`jtqd.sim_can.plant_file.plant_of_joint`): with an efficiency the table of
    `jtqd.sim_can.plant` and the file's Stribeck peak, else the file's friction.
    """

    def __init__(self, joint: Joint) -> None:
        self._friction: Final = joint.friction
        self._slope_nm: Final = SLOPE * joint.rated_torque_nm
        self.depends_on_load: Final = joint.efficiency is not None
        self._rows: tuple[FloatArray, FloatArray] | None = None
        if joint.efficiency is not None:
            highest = max(DRIVING_CURRENT_MAX_A, 9.0)
            table = LossTable(
                LossModel(joint).loss, joint.gear_ratio, joint.torque_constant_nm_per_a, highest
            )
            self._rows = (np.array(table.forward), np.array(table.reverse))
            self._limit = table.torque_limit
            self._per_torque = table.per_torque_step
            self._per_velocity = table.per_velocity_step
            self._last = table.last_row
            peak = plant_of_joint(joint).joints[0].deviations.stribeck
            self._peak = peak.torque_nm, peak.velocity_rad_s

    def loss(self, torque_nm: FloatArray, velocity_rad_s: FloatArray) -> FloatArray:
        """Return the loss [n] at torque_nm [n] and velocity_rad_s [n]."""
        v = velocity_rad_s
        if self._rows is None:
            f = self._friction
            peak = f.stribeck_nm * np.exp(-((v / f.stribeck_velocity_rad_s) ** 2))
            result: FloatArray = np.sign(v) * (f.coulomb_nm + peak) + f.viscous_nms_per_rad * v
            return result
        x = np.minimum(np.abs(v) * self._per_velocity, self._last + 1.0)
        k = np.minimum(x.astype(np.intp), self._last)
        y = np.clip((torque_nm + self._limit) * self._per_torque, 0.0, TORQUE_STEPS - 1e-9)
        m = y.astype(np.intp)
        x, y = x - k, y - m
        out = np.empty_like(v)
        for rows, here in ((self._rows[0], v >= 0.0), (self._rows[1], v < 0.0)):
            a, b, p, q = k[here], m[here], x[here], y[here]
            low = rows[a, b] + q * (rows[a, b + 1] - rows[a, b])
            high = rows[a + 1, b] + q * (rows[a + 1, b + 1] - rows[a + 1, b])
            out[here] = low + p * (high - low)
        height, vs = self._peak
        signed: FloatArray = np.sign(v) * (out + height * np.exp(-((v / vs) ** 2)))
        return signed

    def slope(self, torque_nm: FloatArray, velocity_rad_s: FloatArray) -> FloatArray:
        """Return d loss / d torque [n], zero without efficiency; over +-SLOPE of the rated torque, so that the grid of the
        table does not show.
        """
        if self._rows is None:
            return np.zeros_like(velocity_rad_s)
        wide = self._slope_nm
        ahead = self.loss(torque_nm + wide, velocity_rad_s)
        behind = self.loss(torque_nm - wide, velocity_rad_s)
        return (ahead - behind) / (2.0 * wide)


def held_by_spring(joint: Joint, torque_nm: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return what of a torque through the gear [n] its spring holds: the rest is its damping's, D d tau/dt / K."""
    rate = first_difference(torque_nm, time_s) / joint.stiffness_nm_per_rad
    return torque_nm - joint.damping_nms_per_rad * rate


class Channel(NamedTuple):
    """One balance ("motor" or "torsion") of one joint."""

    joint: int
    balance: str


@dataclass(frozen=True)
class Line:
    """A line in a residual: at `order` per motor revolution, or at `order` Hz by the unit; ratio: its power
    against the median of the neighbourhood.
    """

    channel: Channel
    order: float
    amplitude_nm: float
    ratio: float
    unit: str = "1/rev"


COMPUTED_HZ: Final = 12.0
"""Cutoff of the balances where the torque is computed; least cutoff of any torque."""
_STATIC: Final = 1.0 / 3.0
"""Part of the frequency at which a link swings on its spring, up to which both balances are judged: there the spring follows
the torque but for a tenth of it, whatever the stiffness is.
"""
_ALL_VISIBLE: Final = Smoother(1.0)
SLOWEST_RAD_S: Final = 0.03
"""Below it the direction of friction, and so its value, is not known from a velocity measurement."""
_AFTER_REST_S: Final = 0.03
"""So long after (and before) such a velocity the transients of sticking are still in the torque."""
_VISIBLE: Final = 1e-3
"""Part of the rated torque (rms) that the noise of an acceleration may be worth; beyond, the balance is filtered."""
_REMEMBERED: Final = 1.2
"""Periods of its cutoff after which a filter has forgotten a standstill."""
_SHOWN_HZ: Final = 10.0
"""Below it a velocity channel is compared with the derivative of the position."""
_SAME: Final = 0.02, 1e-3
"""Gain and delay, s, of a velocity channel that do no harm."""
_SURELY: Final = 3.0
"""Standard deviations."""


@dataclass
class Believed:
    """What a set makes of a joint: joint: with the values found, None for those of the file: effects are relative to it;
    loss_per_torque: d loss / d torque of its effects.
    """

    joint: Joint | None = None
    loss_per_torque: FloatArray | float = 0.0


@dataclass(frozen=True)
class JointSignals:
    """One joint of one run, arrays [n] at the run's own rate.

    number: joint; state: what hooks use; motor_nm, torsion_nm: residuals of the two balances [Nm] (torsion None: one
    encoder only); moving: samples at which friction has a direction; loss_per_torque: d loss / d torque of the joint file
    (`about_zero`); off: samples at which the power stage is off (None: not recorded).
    """

    run: str
    number: int
    joint: Joint
    time_s: FloatArray
    state: State
    motor_nm: FloatArray
    torsion_nm: FloatArray | None
    moving: BoolArray
    sensor_nm: FloatArray
    current_a: FloatArray
    quick_nm: FloatArray  # what of the torque that motion and load need is too quick to be known
    loss_per_torque: FloatArray | float = 0.0
    twist_rad: FloatArray | None = None  # theta_m/G - theta_l less its zero, smoothed
    # what a step of an angle is worth in torsion
    rounded_nm: FloatArray = field(default_factory=lambda: np.zeros(1))
    off: BoolArray | None = None
    held: Mapping[str, BoolArray] = field(default_factory=dict)  # by balance: rows of a held channel
    held_nm: Mapping[str, FloatArray] = field(default_factory=dict)  # by balance: what they are worth there
    of_position: bool = True  # the acceleration is a difference of the position, else of the velocity
    noise: Mapping[str, float] = field(default_factory=dict)  # of current and torque as recorded, usual
    sensor_temperature_c: FloatArray | None = None  # None: that of this joint (`with_one_sensor`)
    visible: Smoother = _ALL_VISIBLE  # what it leaves of both balances is judged, and of their regressors
    known_motion: Smoother = _ALL_VISIBLE  # what the noise of the motion leaves of them
    believed: Believed = field(default_factory=Believed)
    torque_hz: float = math.inf  # torques in regressors are known below it
    coarse: str = ""  # what the resolution of the recording costs, "" for nothing

    @cached_property
    def step_s(self) -> float:
        """Usual step of this run."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def nm_per_a(self) -> float:
        """Motor torque per current, joint side: G Kt of the joint file."""
        return self.joint.gear_ratio * self.joint.torque_constant_nm_per_a

    @property
    def per_torque(self) -> FloatArray | float:
        """By how much the motor residual falls per Nm that the sensor reads too high, and rises per Nm of a further load."""
        return 1.0 + self.loss_per_torque + self.believed.loss_per_torque

    @property
    def demand_nm(self) -> FloatArray:
        """Motor torque that the joint file's simulation needs for this motion and load [n], Nm joint side."""
        return np.asarray(self.nm_per_a * self.current_a - self.motor_nm - self.quick_nm)

    def usable(self, balance: str) -> BoolArray:
        """Return the samples that a balance is judged at [n]: those of `known` at which no channel of it is held."""
        out = self.known(balance)
        return out & ~self.held[balance] if balance in self.held else out

    def known(self, balance: str) -> BoolArray:
        """Return the samples at which a balance is known, if the channels are right [n]: the motor's where friction has a
        direction; none within the reach of a difference or a filter from the ends.
        """
        out = self.moving.copy() if balance == MOTOR else np.ones(len(self.time_s), bool)
        wide = max(REACH, round(_REMEMBERED / self.visible.slowest_hz / self.visible.step_s))
        out[:wide] = out[-wide:] = False
        return out

    def state_of(self, effect: Effect, p: Values) -> State:
        """Return what the hooks of an effect with parameters p use: the one sensor has one temperature, for every joint's
        balances, and its torque is what it reads; rates are means over the age of a reading.
        """
        other: dict[str, FloatArray] = {}
        if effect.at_sensor_of(p):
            other["torque_nm"] = self.reading_nm
            if self.sensor_temperature_c is not None:
                other["temperature_c"] = self.sensor_temperature_c
        if effect.follows_torsion and self.twist_rad is not None:
            other["torsion_rad"] = self.twist_rad
        if age := effect.age_s(p):
            other |= {name: mean_ahead(self.time_s, getattr(self.state, name), age) for name in _RATES}
        if not other:
            return self.state
        return State(**{name: getattr(self.state, name) for name in State.__slots__} | other)

    @cached_property
    def reading_nm(self) -> FloatArray:
        """What the sensor reads [n], as far as a torque is known."""
        return below(self.sensor_nm, self.step_s, self.torque_hz)

    def followed(self, angle: FloatArray) -> FloatArray:
        """Return what of a twist [n] the link's acceleration has less than the motor's."""
        if self.torsion_nm is None:
            return angle
        return below(angle, self.step_s, _followed_hz(self.joint, self.torque_hz))

    def highest_order(self) -> FloatArray:
        """Return the order of the motor whose wave is as quick as what these balances hold, at each sample [n]."""
        hz = min(self.visible.highest_hz, 0.25 / self.step_s)
        turns = np.abs(self.joint.gear_ratio * self.state.velocity_rad_s) / (2.0 * math.pi)
        return np.asarray(hz / np.maximum(turns, 1e-12))

    def visible_share(self, rate_rad_s: FloatArray) -> FloatArray:
        """Return how much of a torque that swings at this rate [n] the motor balance holds [n].

        A quick torque moves the rotor and nothing else, and samples show less of that acceleration than there is: nothing at
        the sampling rate, where the regressor alone would be left, standing still.
        """
        turn = np.maximum(np.abs(rate_rad_s) * self.step_s, 1e-3)
        if self.of_position:
            waves = sum(2.0 * weight * np.cos(k * turn) for k, weight in enumerate(SECOND[1:], 1))
            return np.asarray(-(SECOND[0] + waves) / (turn * turn))
        return np.asarray(sum(2.0 * weight * np.sin(k * turn) for k, weight in enumerate(FIRST, 1)) / turn)


_RATES: Final = ("current_rate_a_s", "link_velocity_rad_s", "torque_rate_nm_s")
"""What the hooks of an effect on a reading that is old use."""


def without_held(s: JointSignals, held: Mapping[str, Held]) -> JointSignals:
    """Return the signals with the samples at which a column is held, and those that its smoothing reaches, not usable:
    torque in both balances, current in the motor's. `held_nm` is what they are from a straight line between those around
    them: at rest nothing else shows it.
    """
    if not held:
        return s
    reach = _REMEMBERED / min(s.visible.slowest_hz, s.torque_hz)
    out, worth = {}, {}
    for balance, units in (
        (TORSION, {"torque_nm": -1.0}),
        (MOTOR, {"torque_nm": -1.0, "current_a": s.nm_per_a}),
    ):
        found = [(unit, held[name]) for name, unit in units.items() if name in held]
        if found:
            worth[balance] = np.asarray(sum(unit * h.deviation for unit, h in found))
            wide = max(1, round(reach / s.step_s)) + 2  # and that of a second difference
            out[balance] = _near(np.any([h.rows for _, h in found], axis=0), wide)
    return replace(s, held=out, held_nm=worth)


def _near(rows: BoolArray, wide: int) -> BoolArray:
    """Return the samples that are at most `wide` from one of these."""
    return np.asarray(np.convolve(rows, np.ones(2 * wide + 1), "same") > 0.5)


def with_one_sensor(run: Sequence[JointSignals]) -> list[JointSignals]:
    """Return the joints of one run with the sensor at the temperature of the first, as in the plant, which has the sensor's
    effects in one joint's file.
    """
    temperature = run[0].state.temperature_c
    return [run[0], *(replace(s, sensor_temperature_c=temperature) for s in run[1:])]


class SignalsError(ValueError):
    """A run cannot serve a diagnosis; one line."""


@dataclass(frozen=True)
class _Motion:
    """Motion of one motor as it is known, at the motor's shaft.

    speed: as recorded or derived; whole: acceleration at the full rate; visible: smoother after which its noise is worth
    `_VISIBLE`; of_position: all is of the position, else of the velocity; coarse: what its noise costs, in words.
    """

    position: FloatArray
    speed: FloatArray
    whole: FloatArray
    visible: Smoother
    of_position: bool
    coarse: str

    def below(self, hz: float, step_s: float, why: str) -> _Motion:
        """Return the motion with accelerations of nothing quicker than hz, below which the torque is known."""
        lowest = np.full(len(self.whole), min(hz, self.visible.slowest_hz))
        text = f"torque_nm: {why}, known below {hz:.0f} Hz; the balances are judged below it"
        coarse = self.coarse if self.visible.slowest_hz <= hz else text
        return replace(self, visible=Smoother.of(lowest, step_s), coarse=coarse)


def _motion(
    time: FloatArray, raw: JointColumns, columns: JointColumns, joint: Joint, like: JointSignals | None
) -> _Motion:
    """Return the motion by the channel whose acceleration is known best, position or velocity, of the motor's side or, with
    one encoder, of the link's; like: by the same channel and filters as there.

    A velocity channel may be filtered, late or of another scale: beside a position it is taken only where that shows none.
    """
    ratio, one = joint.gear_ratio, not raw.two_encoders(joint.gear_ratio)
    position, speed = raw.motor_position_rad, raw.motor_velocity_rad_s
    if position is None and speed is None and raw.link_position_rad is not None:
        position = ratio * raw.link_position_rad
    if speed is None and one and raw.link_velocity_rad_s is not None:
        speed = ratio * raw.link_velocity_rad_s
    if like is not None:
        position, speed = (position, None) if like.of_position else (None, speed)
    both = [
        _known(time, x, joint, like, of_position=of_position)
        for x, of_position in ((position, True), (speed, False))
        if x is not None
    ]
    found = both[-1] if len(both) > 1 and _better(time, both[1], both[0]) else both[0]
    there = columns.motor_position_rad
    if there is None:
        v = found.speed
        there = np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(time))))
    return replace(found, position=there)


def _known(
    time: FloatArray, x: FloatArray, joint: Joint, like: JointSignals | None, *, of_position: bool
) -> _Motion:
    """Return the motion by one channel."""
    whole = second_difference(x, time) if of_position else first_difference(x, time)
    noise = noise_of(x)
    if like is None:
        step = float(np.median(np.diff(time)))
        per_rated = joint.rated_torque_nm / (joint.gear_ratio * joint.rotor_inertia_kgm2)
        hz = cutoff_hz(noise, step, _VISIBLE * per_rated, of_velocity=not of_position)
        visible = Smoother.of(hz, step)
    else:
        visible = like.visible
    coarse = _cost(joint, time, x, noise, visible, of_position=of_position)
    speed = np.asarray(np.gradient(x, time)) if of_position else x
    return _Motion(x, speed, whole, visible, of_position, coarse)


def _better(time: FloatArray, speed: _Motion, position: _Motion) -> bool:
    """Return whether the acceleration of the velocity channel is known further than the position's, and it agrees with it.

    Of the slow part, derivative of the position = gain v + late dv/dt, by least squares: gain 1 and late 0 but for what
    the position's noise, in as many samples as this bandwidth has, may make of them.
    """
    if speed.visible.slowest_hz <= position.visible.slowest_hz:
        return False
    step = float(np.median(np.diff(time)))
    wide = max(1, round(_REMEMBERED / _SHOWN_HZ / step))
    if len(time) < 4 * wide:
        return False
    y, *x = (below(each, step, _SHOWN_HZ)[wide:-wide] for each in (position.speed, speed.speed, speed.whole))
    columns = np.column_stack(x)
    found, *_ = np.linalg.lstsq(columns, y, rcond=None)
    share = 1.0 / max(1.0, 2.0 * _SHOWN_HZ * step * len(y)) * float(np.mean((y - columns @ found) ** 2))
    sigma = np.sqrt(share * np.diag(np.linalg.pinv(columns.T @ columns / len(y))))
    off = np.abs(found - np.array([1.0, 0.0]))
    return bool(np.all(off <= np.maximum(np.array(_SAME), _SURELY * sigma)))


def joint_signals(  # noqa: PLR0917
    run: str,
    table: RunTable,
    number: int,
    joint: Joint,
    base: BaseLoss,
    like: JointSignals | None = None,
    *,
    computed: bool = False,
) -> JointSignals:
    """Return the signals of one joint; like: by the channel and the filters of these, so that a difference is that of the
    tables; computed: the torque is one of a known load or a model, whose acceleration was smoothed, and as slow as that.
    Raises SignalsError for a column that is missing and cannot be derived.
    """
    raw = table.joints[number]
    columns = table.joint(number, joint.gear_ratio)
    for name in ("current_a", "torque_nm", "motor_velocity_rad_s"):
        if getattr(columns, name) is None:
            raise SignalsError(f"{run}: j{number}.{name}: missing, and no column to derive it from")
    assert columns.current_a is not None
    assert columns.torque_nm is not None
    time, sensor = table.time_s, columns.torque_nm
    motion = _motion(time, raw, columns, joint, like)
    step = float(np.median(np.diff(time)))
    if computed and like is None:
        motion = motion.below(COMPUTED_HZ, step, "computed")
    both = raw.two_encoders(joint.gear_ratio)
    shown = known_below_hz(sensor, step)
    known, known_motion = like.torque_hz if like else max(COMPUTED_HZ, shown), motion.visible
    if like is None and both:
        static, held = _static_hz(joint), motion.visible(motion.whole)
        quick = joint.link_inertia_kgm2 / joint.gear_ratio * (held - below(held, step, static))
        if static < shown or float(np.std(quick)) > _VISIBLE * joint.rated_torque_nm:
            motion = motion.below(static, step, "quicker than the spring follows")
    velocity = motion.visible(motion.speed) / joint.gear_ratio
    link = columns.link_position_rad
    if link is None:
        link = motion.position / joint.gear_ratio
    acceleration = motion.visible(motion.whole)
    link_acceleration = acceleration / joint.gear_ratio
    slow_sensor = below(sensor, step, known)
    if both:
        # not of the link encoder, whose noise is K times over in the torsion balance; the spring's part is small
        twist = below(sensor, step, _followed_hz(joint, known)) / joint.stiffness_nm_per_rad
        link_acceleration = link_acceleration - second_difference(twist, time)
    gear_torque = sensor + joint.link_inertia_kgm2 * link_acceleration
    slow_torque = below(gear_torque, step, known)
    loss = base.loss(gear_torque, velocity)
    reflected = joint.gear_ratio * joint.rotor_inertia_kgm2
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    demand = (slow_torque + loss + reflected * acceleration) / nm_per_a
    state = State(
        current_a=demand,
        current_rate_a_s=first_difference(demand, time),
        direction=np.where(np.abs(velocity) > 1e-6, np.sign(velocity), 0.0),
        link_acceleration_rad_s2=link_acceleration,
        link_position_rad=link,
        link_velocity_rad_s=velocity,
        motor_acceleration_rad_s2=acceleration,
        motor_position_rad=motion.position,
        temperature_c=np.full(len(time), np.nan) if columns.temperature_c is None else columns.temperature_c,
        time_s=time - time[0],
        torque_nm=slow_torque,
        torque_rate_nm_s=first_difference(slow_sensor, time),
        torsion_rad=held_by_spring(joint, slow_torque, time) / joint.stiffness_nm_per_rad,
        torsion_rate_rad_s=np.full(len(time), np.nan),
        velocity_rad_s=velocity,
        coupling_position_rad=link if number != 2 else -link,
    )
    too_quick = motion.whole - acceleration  # of the motor: the balances hold it until they are filtered
    link_quick = joint.link_inertia_kgm2 * too_quick / joint.gear_ratio
    motor_torque = joint.gear_ratio * (
        joint.torque_constant_nm_per_a * columns.current_a - joint.rotor_inertia_kgm2 * motion.whole
    )
    torsion, bent, rounded = None, None, 0.0 * time
    if both:
        rounded = joint.stiffness_nm_per_rad * (steps_of(motion.position) / joint.gear_ratio + steps_of(link))
        twist = motion.position / joint.gear_ratio - link
        zero = _zero(twist - gear_torque / joint.stiffness_nm_per_rad, gear_torque)
        torsion = joint.stiffness_nm_per_rad * (twist - zero)
        torsion += joint.damping_nms_per_rad * first_difference(twist, time)
        torsion -= gear_torque + link_quick
        bent = below(twist - zero, step, known) + (gear_torque - slow_torque) / joint.stiffness_nm_per_rad
        state.torsion_rate_rad_s = first_difference(bent, time)
    return JointSignals(
        run,
        number,
        joint,
        time,
        state,
        motor_torque - loss - gear_torque - link_quick,
        torsion,
        _moving(time, velocity, motion.visible.slowest_hz),
        sensor,
        columns.current_a,
        gear_torque - slow_torque + link_quick + reflected * too_quick,
        twist_rad=bent,
        rounded_nm=rounded,
        off=None if columns.enabled is None else np.asarray(columns.enabled < 0.5),
        of_position=motion.of_position,
        noise={
            name: float(np.median(noise_of(x)))
            for name, x in (("current_a", columns.current_a), ("torque_nm", sensor))
        },
        visible=motion.visible,
        known_motion=known_motion,
        torque_hz=known,
        coarse=motion.coarse,
    )


def _static_hz(joint: Joint) -> float:
    """Return below which frequency the spring follows the torque: part of that at which the link swings, inf without one."""
    inertia = joint.link_inertia_kgm2
    swings = math.sqrt(joint.stiffness_nm_per_rad / inertia) / math.tau if inertia > 0.0 else math.inf
    return max(COMPUTED_HZ, _STATIC * swings)


def _followed_hz(joint: Joint, torque_hz: float) -> float:
    """Return up to which frequency the torque's twist is taken off: its noise is then worth a tenth of itself at most."""
    return max(torque_hz, _static_hz(joint)) if joint.link_inertia_kgm2 else torque_hz


def _cost(
    joint: Joint, time: FloatArray, x: FloatArray, noise: FloatArray, visible: Smoother, *, of_position: bool
) -> str:
    """Return what the noise of position or velocity costs the motor balance, in words."""
    if not visible.parts:
        return ""
    name, unit = ("motor_position_rad", "rad") if of_position else ("motor_velocity_rad_s", "rad/s")
    worst = float(np.max(noise))
    found = described(x, unit) or f"noise of {worst:.2g} {unit} rms"
    hz, step = visible.slowest_hz, float(np.median(np.diff(time)))
    known = float(acceleration_noise(worst, step, hz, of_velocity=not of_position))
    torque = joint.gear_ratio * joint.rotor_inertia_kgm2 * known
    return (
        f"{name}: found {found}: acceleration known to {known:.2g} rad/s2 ({torque:.2g} Nm at the joint) below {hz:.0f} Hz; "
        "the balances are judged below it"
    )


def _zero(apart: FloatArray, torque: FloatArray) -> float:
    """Return the zero of the torsion [rad]: in the middle between both signs of the load, as play and hysteresis are odd."""
    sides = [apart[torque > 0.0], apart[torque < 0.0]]
    if min(map(len, sides)) < 0.1 * len(apart):
        return float(np.median(apart))
    return 0.5 * float(np.median(sides[0]) + np.median(sides[1]))


def _moving(time: FloatArray, velocity: FloatArray, slowest_hz: float) -> BoolArray:
    """Return True where the joint moves and has done so, and will, for _AFTER_REST_S, or as long as a filter remembers."""
    apart = max(_AFTER_REST_S, _REMEMBERED / slowest_hz)
    wide = max(1, round(apart / max(float(np.median(np.diff(time))), 1e-9)))
    return ~_near(np.abs(velocity) < SLOWEST_RAD_S, wide)


_LARGEST_ZERO: Final = 0.05
"""Part of the rated torque that a first guess of the sensor's zero may be."""
_TURNS: Final = 2
_OF_A_GUESS: Final = "direction", "velocity_rad_s", "current_a", "motor_acceleration_rad_s2", "torque_nm"


def about_zero(run: Sequence[JointSignals], bases: Mapping[int, BaseLoss]) -> list[JointSignals]:
    """Return the signals of one run's joints with motor residual and losses expanded about the sensor's zero of the
    run, where the losses depend on the load.

    The simulation takes its losses at the measured torque, so a zero z of the sensor is in the residual twice: as -z, and
    as the losses' error. Driving with an efficiency of a half that doubles it, driven back it takes part of it away:

        motor = .. - loss0(tau) - tau = .. - z - (loss0(tau) - loss0(tau - z))  ~  .. - z (1 + loss0')

    A zero of 1 % of the rated torque is not small where the efficiency turns over, within 5 %. So loss0 is expanded
    about a first guess z0 of each run's zero and not about 0; the residual still holds the whole of z, now linearly.
    """
    if not any(bases[s.number].depends_on_load for s in run):
        return list(run)
    out = [_expanded(s, bases[s.number], 0.0) for s in run]
    for _ in range(_TURNS):
        guess = _first_guess(out)
        out = [_expanded(s, bases[s.number], guess) for s in run]
    return out


def _expanded(s: JointSignals, base: BaseLoss, zero_nm: float) -> JointSignals:
    torque, velocity = s.state.torque_nm, s.state.velocity_rad_s
    true = torque - zero_nm
    slope = base.slope(true, velocity)
    less = base.loss(torque, velocity) - base.loss(true, velocity) - slope * zero_nm
    return replace(s, motor_nm=s.motor_nm + less, loss_per_torque=slope)


def _first_guess(run: Sequence[JointSignals]) -> float:
    """Return the zero [Nm] that fits all motor balances best, beside friction, inertia and gain of each joint."""
    moving = [s for s in run if s.moving.any()]
    if not moving:
        return 0.0
    zero = [-np.broadcast_to(s.per_torque, s.moving.shape)[s.moving] for s in moving]
    own = [np.column_stack([getattr(s.state, name)[s.moving] for name in _OF_A_GUESS]) for s in moving]
    columns = np.column_stack((np.concatenate(zero), linalg.block_diag(*own)))
    found = np.linalg.lstsq(columns, np.concatenate([s.motor_nm[s.moving] for s in moving]), rcond=None)[0]
    largest = _LARGEST_ZERO * min(s.joint.rated_torque_nm for s in run)
    return float(np.clip(found[0], -largest, largest))
