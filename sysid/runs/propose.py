"""Proposal of what the columns of somebody else's tables are: quantity, side of the gear, unit, sign, and why.

In: columns by name. Out: `Proposal`. Pure. A name counts more than the numbers (`column_names`). Where a name has no unit,
or no side of the gear, the numbers decide:

    unit of a position     d(position)/dt against a velocity of known unit; whole numbers are counts; else its travel
    side of the gear       two positions that turn by a constant factor: the faster is the motor, the factor the gear ratio
    sign of a torque       along the current, with which it correlates
    sign of the motion     current = f(torque or position) + c sign(velocity): friction takes energy, so c > 0
    roll-over              a jump by a whole period from row to row

What nothing shows stays open.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs import column_names as of
from jtqd.sysid.runs.column_names import COUNTS, Name, quoted, read_name
from jtqd.sysid.runs.tables import interleaved

Table = Mapping[str, FloatArray]
"""Columns [n] of one file by name; NaN: a blank cell."""

OPEN: Final = "???"
"""In a source: a number that nothing shows."""
DRIVE: Final = "drive"
"""Target of a voltage or a duty, from which the current follows; and of a torque that a drive computes from its current."""
_TURN: Final = 2.0 * math.pi
_FITS: Final = 0.03
"""Relative: a factor between two columns is that of a unit."""
_ROUND: Final = 0.005
"""Relative: counts per turn are those of a usual encoder."""
_ALIKE: Final = 0.98
"""Correlation of a velocity with a position's derivative."""
_SAME: Final = 0.9995
"""Correlation from which on a torque is the current times a constant."""
_LINK_TURNS: Final = 2.5
"""A joint turns less, a motor behind a gear more."""
_SI: Final = {of.CURRENT: "A", of.TORQUE: "Nm", of.VOLTAGE: "V", of.TEMPERATURE: "degC"}
_LARGEST_RAD: Final = 8.0 * math.pi
_LARGEST_A: Final = 200.0
"""Joint angles beyond are degrees, currents beyond are mA."""
_AGAINST: Final = -0.3
"""Correlation of torque and current."""
_BLOCK_S: Final = 0.05
_FEWEST_BLOCKS: Final = 20
_RATE_HZ: Final = (5.0, 20_000.0)
_CALLS: Final = {
    "deg": "deg2rad",
    "deg/s": "deg2rad",
    "rev": "rev2rad",
    "rev/s": "rev2rad",
    "rpm": "rpm2rad_s",
}
_BY_SIZE: Final = [unit[:3] for unit in of.UNITS if not unit[1].startswith(("mrad", COUNTS))]
_ANGLES: Final = {unit: factor for kind, unit, factor in _BY_SIZE if kind == of.ANGLE}
_SPEEDS: Final = {unit: factor for kind, unit, factor in _BY_SIZE if kind == of.SPEED}


@dataclass
class Guess:
    """A column as it is taken. target: key of the map without the joint ("": none); used: not left out; why: reasons."""

    name: Name
    values: FloatArray
    kind: str
    unit: str
    factor: float
    joint: int = 1
    side: str = ""
    sign: float = 1.0
    period: float = 0.0
    target: str = ""
    used: bool = True
    why: list[str] = field(default_factory=list)

    @property
    def column(self) -> str:
        """Name of the column."""
        return self.name.column

    @property
    def known(self) -> bool:
        """Whether its size in SI units is known."""
        return math.isfinite(self.factor)

    @property
    def finite(self) -> FloatArray:
        """Values without blank cells [n]."""
        return self.values[np.isfinite(self.values)]

    @property
    def whole(self) -> bool:
        """Whether all values are whole numbers."""
        return bool(np.all(self.finite == np.round(self.finite)))

    @property
    def unrolled(self) -> FloatArray:
        """Values [n] without the jumps of a roll-over; a blank cell stays blank."""
        if not self.period:
            return self.values
        rows = np.isfinite(self.values)
        unrolled = np.full(len(rows), np.nan)
        unrolled[rows] = np.unwrap(self.values[rows], period=self.period)
        return unrolled

    @property
    def text(self) -> str:
        """Source in the column map: a column or an expression."""
        x = plain = quoted(self.column)
        if self.period:
            x = f"unwrap({x}, {self.period:.10g})"
        if self.unit == COUNTS:
            x = f"rev2rad({x} / {f'{_TURN / self.factor:.10g}' if self.known else OPEN})"
        elif self.unit in _CALLS:
            x = f"{_CALLS[self.unit]}({x})"
        elif self.factor != 1.0:
            x = f"{self.factor:g} * {x}"
        return self.column if x == plain and self.sign > 0.0 else f"{'-' if self.sign < 0.0 else ''}{x}"

    def drop(self, why: str) -> None:
        """Leave the column out."""
        self.used, self.target, self.why = False, "", [why]

    def take(self, unit: str, factor: float, why: str) -> None:
        """Give the column a unit."""
        self.unit, self.factor = unit, factor
        self.why.append(why)


@dataclass(frozen=True)
class JointProposal:
    """One joint: its columns that have a target, gear ratio where two positions show it, notes."""

    number: int
    columns: tuple[Guess, ...]
    gear_ratio: float | None
    notes: tuple[str, ...]

    @property
    def targets(self) -> dict[str, Guess]:
        """Columns by target."""
        return {each.target: each for each in self.columns}


@dataclass(frozen=True)
class Proposal:
    """columns: all, in the order of the file; time: expression [s]; rate_hz: usual rows per second."""

    columns: tuple[Guess, ...]
    time: str
    rate_hz: float
    joints: tuple[JointProposal, ...]


class ProposalError(ValueError):
    """Nothing can be proposed; one line."""


def propose(tables: Sequence[Table]) -> Proposal:
    """Return the proposal for tables of one rig, by the columns that all have. Raises ProposalError."""
    common = [name for name in tables[0] if all(name in each for each in tables)]
    guesses = []
    for name in map(read_name, common):
        values = np.concatenate([each[name.column] for each in tables])
        guesses.append(Guess(name, values, name.kind, name.unit, name.factor))
    time, seconds = _time(guesses)
    for each in guesses:
        if each.used and each.kind != of.TIME and (why := _unusable(each)):
            each.drop(why)
    columns = [each for each in guesses if each.used and each.kind != of.TIME]
    _set_joints(columns)
    numbers = sorted({each.joint for each in columns if each.used})
    if not numbers:
        raise ProposalError(
            "found no column that its name makes one of a joint, expected words such as position"
        )
    joints = [_Joint(n, [x for x in columns if x.used and x.joint == n], seconds) for n in numbers]
    proposals = tuple(each.proposal() for each in joints)
    if why := interleaved({each.column: np.isfinite(each.values) for each in columns if each.target}):
        raise ProposalError(why)
    steps = np.diff(seconds[np.isfinite(seconds)])
    return Proposal(tuple(guesses), time, 1.0 / float(np.median(steps[steps > 0.0])), proposals)


def _rises(x: FloatArray) -> bool:
    """Return whether a column is a time: it rises from row to row, restarts and rounded stamps apart."""
    steps = np.diff(x[np.isfinite(x)])
    return len(steps) > 0 and float(np.mean(steps > 0.0)) > 0.5 and float(np.mean(steps < 0.0)) < 0.01


def _time(guesses: Sequence[Guess]) -> tuple[str, FloatArray]:
    """Return the expression of the time and its values [n, s]; other columns of a time are dropped. Raises ProposalError."""
    named = [each for each in guesses if each.kind == of.TIME and not of.COMMAND & each.name.words]
    parts = [x for x in named if x.unit == "ns" and np.nanmin(x.values) >= 0.0 and np.nanmax(x.values) < 1e9]
    whole = [x for x in named if x.unit in ("s", "") and x not in parts and x.whole]
    rising = [each for each in named if _rises(each.values) and each not in parts]
    rising.sort(key=lambda each: bool((of.MOTOR | of.LINK | of.SENSOR) - {"ts"} & each.name.words))
    time = next(iter(rising or [each for each in guesses if not each.kind and _rises(each.values)]), None)
    if parts and whole:
        for each in named:
            if not _no_time(each, whole[0]):
                each.drop("a second time")
        for each, why in ((whole[0], "whole seconds of the stamp"), (parts[0], "its part below a second")):
            each.target, each.unit, each.why = "time_s", each.unit or "s", [why]
        text = f"{quoted(whole[0].column)} + 1e-9 * {quoted(parts[0].column)}"
        return text, whole[0].values + 1e-9 * parts[0].values
    if time is None:
        raise ProposalError("found no column that rises from row to row, expected a time in s, ms, us or ns")
    for each in named:
        if each is not time and not _no_time(each, time):
            each.drop("a second time")
    steps = np.diff(time.finite)
    step = float(np.median(steps[steps > 0.0]))
    units = [(unit, factor) for kind, unit, factor, _ in of.UNITS if kind == of.TIME]
    fitting = [each for each in units if _RATE_HZ[0] <= 1.0 / (step * each[1]) <= _RATE_HZ[1]]
    if not time.known and not fitting:
        found = f"column {time.column!r}: found steps of {step:.3g}"
        raise ProposalError(f"{found}, expected a time in s, ms, us or ns")
    if time.known and (not fitting or (time.unit, time.factor) in fitting):
        time.take(time.unit, time.factor, "unit by its name")
    else:
        time.take(*fitting[0], f"unit by its step of {step:.3g}")
    time.kind, time.target = of.TIME, "time_s"
    return time.text, time.factor * time.values


def _no_time(guess: Guess, time: Guess) -> bool:
    """Return whether a column that may be of another quantity by its name is no time, and set its quantity."""
    rows = np.diff(time.values) > 0.0
    rate = float(np.nanmedian(np.diff(guess.values)[rows] / np.diff(time.values)[rows]))
    if not guess.name.others or (rate > 0.0 and _near(rate, [10.0 ** (3 * k) for k in range(-3, 4)])):
        return False
    both = of.TEMPERATURE not in guess.name.others or float(np.nanmin(guess.values)) < 0.0
    guess.kind = of.TORQUE if both else of.TEMPERATURE
    guess.why.append(f"by its name a time too, which it is not{'' if both else '; never negative'}")
    return True


def _near(x: float, values: Sequence[float], part: float = _FITS) -> bool:
    return min(abs(x / each - 1.0) for each in values) < part


def _unusable(guess: Guess) -> str:
    """Return why a column is not used by what its name or its values alone show; "": it may be."""
    x, words = guess.finite, guess.name.words
    reasons = (
        (not guess.kind, f"no quantity of a joint by its name{guess.unit and f' and unit {guess.unit}'}"),
        (bool(of.COMMAND & words), "a command or an estimate, not a measurement"),
        (len(x) < 2, "no finite numbers"),
        (
            guess.kind in _SI and guess.kind != of.TORQUE and of.SUPPLY & words,
            "of the supply, not of the motor",
        ),
        (
            guess.kind != of.ENABLED and len(x) and np.ptp(x) == 0.0,
            f"{x[:1].sum():g} in every row: shows nothing",
        ),
    )
    return next((why for found, why in reasons if found), "")


def _set_joints(guesses: Sequence[Guess]) -> None:
    """Set the joint of each column by the number in its name: where two quantities have several, or behind "joint"."""
    numbers: dict[str, set[int]] = {}
    for each in guesses:
        if each.name.number is not None:
            numbers.setdefault(each.kind, set()).add(each.name.number)
    several = sum(len(found) > 1 for found in numbers.values()) > 1
    first = 1 if several and any(0 in found for found in numbers.values()) else 0
    for each in guesses:
        number = each.name.number
        if several and number is None:
            each.drop("no number of a joint in its name")
        elif number is not None and (several or {"j", "joint", "axis"} & each.name.words):
            each.joint = number + first
            if not 1 <= each.joint <= 7:
                each.drop("joints above 7 are not read")


class _Joint:
    """Columns of one joint against each other; `proposal` has the order."""

    def __init__(self, number: int, guesses: Sequence[Guess], time_s: FloatArray) -> None:
        self.number, self.guesses = number, guesses
        step = np.diff(time_s)
        usual = float(np.nanmedian(step[step > 0.0]))
        self.step = np.where((step > 0.0) & (step < 10.0 * usual), step, np.nan)
        self.block = max(1, round(_BLOCK_S / usual))
        self.notes: list[str] = []
        self.ratio: float | None = None

    def proposal(self) -> JointProposal:
        positions, speeds = self._of(of.ANGLE), self._of(of.SPEED)
        for each in (*positions, *speeds):
            each.side = "motor" if of.MOTOR & each.name.words else "link" if of.LINK & each.name.words else ""
            if each.known:
                each.why.append("unit by its name")
        for each in positions:
            _roll_over(each)
        self._units(positions, speeds)
        positions = self._sides(positions)
        speeds = self._sides_of_speeds(positions, speeds)
        current = self._one(of.CURRENT, "current_a", frozenset({"iq", "motor", "q", "actual"}))
        voltage = None if current else self._one(of.VOLTAGE, DRIVE, frozenset({"uq", "motor"}))
        drive = current or voltage or self._one(of.DUTY, DRIVE)
        for each in (*self._of(of.VOLTAGE), *self._of(of.DUTY)):
            if drive is not None and each is not drive:
                each.drop(f"not needed besides {drive.column!r}")
        torque = self._torque(current, drive)
        self._one(of.TEMPERATURE, "temperature_c", frozenset({"motor", "winding", "coil"}))
        self._one(of.ENABLED, "enabled")
        if drive is not None:
            self._sign(drive, torque, [*positions, *speeds])
        columns = tuple(each for each in self.guesses if each.target)
        return JointProposal(self.number, columns, self.ratio, tuple(self.notes))

    def _of(self, kind: str) -> list[Guess]:
        return [each for each in self.guesses if each.kind == kind and each.used]

    def _moves(self, guess: Guess) -> FloatArray:
        """Return how far a position, or the integral of a velocity, moves in each block [n], in its own unit."""
        x = guess.values
        if guess.kind == of.SPEED:
            return self._blocks(0.5 * (x[1:] + x[:-1]) * self.step)
        return self._blocks(np.diff(guess.unrolled) + 0.0 * self.step)

    def _blocks(self, x: FloatArray) -> FloatArray:
        """Return the sum of each block of rows [n]."""
        count = len(self.step) // self.block * self.block
        return np.asarray(x[:count].reshape(-1, self.block).sum(axis=1), np.float64)

    def _factor(self, one: Guess, two: Guess) -> float:
        """Return the factor of the motion of `one` against that of `two`, own units; NaN where they do not go together."""
        a, b = self._moves(one), self._moves(two)
        good = np.isfinite(a) & np.isfinite(b)
        a, b = a[good], b[good]
        power = float(a @ a) * float(b @ b)
        alike = abs(float(a @ b)) >= _ALIKE * math.sqrt(power) > 0.0
        return float(a @ b) / float(b @ b) if alike else math.nan

    def _units(self, positions: Sequence[Guess], speeds: Sequence[Guess]) -> None:
        """Give units to positions and velocities that have none by name: by each other, else by size."""
        for each in positions:
            if not each.unit and each.whole and len(np.unique(each.finite)) > 20:
                each.unit = COUNTS
        self._units_by_derivative(positions, speeds)
        bare = [each for each in positions if not each.unit]
        sizes = [float(np.max(np.abs(each.finite))) for each in bare if each.side != "motor"]
        # of two positions without a unit the slower one shows it
        large = min(sizes, default=0.0) > _LARGEST_RAD
        for each in bare:
            unit, by = ("deg", "by its size") if large else ("rad", "taken as rad")
            each.take(unit, _ANGLES[unit], f"no unit in its name: {by}")
        self._units_by_derivative(positions, speeds)
        for each in speeds:
            if not each.known:
                deg = any(p.unit == "deg" and math.isnan(self._factor(p, each)) for p in positions)
                unit = "deg/s" if deg else "rad/s"  # in its own unit it is not the derivative of any
                each.take(unit, _SPEEDS[unit], f"no unit in its name: taken as {unit}")

    def _units_by_derivative(self, positions: Sequence[Guess], speeds: Sequence[Guess]) -> None:
        for position in positions:
            for speed in speeds:
                ratio = abs(self._factor(position, speed))
                if math.isfinite(ratio) and {position.side, speed.side} != {"motor", "link"}:
                    _units_by_ratio(position, speed, ratio)

    def _sides(self, positions: Sequence[Guess]) -> list[Guess]:
        """Return the position of the motor and that of the link, and set the gear ratio that they show."""
        for one, two in combinations(positions, 2):
            ratio = abs(self._factor(one, two) * one.factor / two.factor)
            if not abs(ratio - 1.0) > _FITS:  # NaN, too
                continue
            for each, faster in ((one, ratio > 1.0), (two, ratio < 1.0)):
                if not each.side:
                    each.side = "motor" if faster else "link"
                    each.why.append(f"the {'faster' if faster else 'slower'} of two positions")
        for each in positions:
            if not each.side:
                turns = float(np.ptp(each.unrolled[np.isfinite(each.values)])) * each.factor / _TURN
                each.side = "link" if turns <= _LINK_TURNS else "motor"
                by = f"it travels {turns:.2g} turns" if each.known else "it counts"
                each.why.append(f"taken as that of the {'joint' if each.side == 'link' else 'motor'}: {by}")
        kept = self._one_a_side(positions, "position_rad")
        for motor, link in ((a, b) for a in kept for b in kept if (a.side, b.side) == ("motor", "link")):
            ratio = self._factor(motor, link)
            if ratio < 0.0:
                link.sign = -1.0
                link.why.append("turns against the motor: sign turned")
            ratio = abs(ratio * motor.factor / link.factor)
            if math.isfinite(ratio):
                whole = abs(ratio / round(ratio) - 1.0) < 0.003
                self.ratio = float(round(ratio)) if whole else round(ratio, 3)
        for each in kept:
            steps = np.diff(np.unique(each.finite))
            least = float(np.mean(steps[steps < 1.5 * steps.min()]))
            size = f"{least * each.factor:.2g} rad" if each.known else f"{least:.3g} counts"
            self.notes.append(f"smallest step of {each.column!r}: {size}")
        return kept

    def _one_a_side(self, guesses: Sequence[Guess], quantity: str) -> list[Guess]:
        """Keep the first of each side and give it its target."""
        kept: dict[str, Guess] = {}
        for each in guesses:
            if each.side in kept:
                each.drop(f"a second {each.kind} of the {each.side}, besides {kept[each.side].column!r}")
            else:
                kept[each.side] = each
                each.target = f"{each.side}_{quantity}"
        return list(kept.values())

    def _sides_of_speeds(self, positions: Sequence[Guess], speeds: Sequence[Guess]) -> list[Guess]:
        """Return the velocities of motor and link, with the sign of the position of their side."""
        for each in speeds:
            for position in positions:
                ratio = self._factor(position, each)
                same = not abs(abs(ratio) * position.factor / each.factor - 1.0) > 3.0 * _FITS
                if math.isfinite(ratio) and same and each.side in ("", position.side):
                    each.side, each.sign = position.side, math.copysign(1.0, position.sign * ratio)
                    each.why.append(f"goes with the derivative of {position.column!r}")
                    break
            if not each.side:
                each.side = positions[0].side if len(positions) == 1 else "motor"
                each.why.append(f"taken as that of the {each.side}: no position has it as its derivative")
        return self._one_a_side(speeds, "velocity_rad_s")

    def _one(self, kind: str, target: str, better: frozenset[str] = frozenset()) -> Guess | None:
        """Give the target to one column of a kind: the first with one of the better words, else the first."""
        columns = self._of(kind)
        chosen = next((each for each in columns if better & each.name.words), next(iter(columns), None))
        if chosen is None:
            return None
        for each in columns:
            if each is not chosen:
                each.drop(f"a second {kind}, besides {chosen.column!r}")
        chosen.target = target
        if chosen.known:
            chosen.why.append("by its name")
        elif kind == of.CURRENT and float(np.max(np.abs(chosen.finite))) > _LARGEST_A:
            chosen.take("mA", 1e-3, "no unit in its name: by its size")
        else:
            unit = _SI.get(kind, "")
            chosen.take(unit, 1.0, f"by its name, which has no unit{unit and f': taken as {unit}'}")
        return chosen

    def _torque(self, current: Guess | None, drive: Guess | None) -> Guess | None:
        """Return the torque that is a reference: a sensor's, along the current. What a drive computes of it is none."""
        for each in self._of(of.TORQUE):
            if of.SENSOR & each.name.words:
                continue
            if current is not None and abs(_alike(current, each)) > _SAME:
                each.drop(f"{current.column!r} times a constant: the drive's own torque, no reference")
            elif drive is None:
                factor = each.factor if each.known else 1.0
                each.take(each.unit or "Nm", factor, "no current: taken as the drive's own")
                each.target, each.used = DRIVE, False
        torque = self._one(of.TORQUE, "torque_nm", of.SENSOR)
        if torque is not None and current is not None and (alike := _alike(current, torque)) < _AGAINST:
            torque.sign = -1.0
            torque.why.append(f"against the current (correlation {alike:.2f}): sign turned")
        return torque

    def _sign(self, drive: Guess, torque: Guess | None, motion: Sequence[Guess]) -> None:
        """Turn the sign of all motion where drive = f(torque or position) + c sign(velocity) has c < 0."""
        if not motion:
            return
        v, i = motion[0].sign * self._moves(motion[0]), self._blocks(drive.values[1:])
        other = np.nancumsum(v) if torque is None else self._blocks(torque.values[1:])
        good = np.isfinite(v) & np.isfinite(i) & np.isfinite(other)
        good &= np.abs(v) > 0.1 * float(np.max(np.abs(v[good]), initial=0.0))
        v, i, other = v[good], i[good], other[good]
        if len(v) < _FEWEST_BLOCKS or np.ptp(other) == 0.0:
            return
        other = other / float(np.ptp(other))
        powers = (other, other**2, other**3) if torque is None else (other,)
        x = np.column_stack((np.sign(v), np.ones(len(v)), *powers))
        if float(np.linalg.lstsq(x, i, rcond=None)[0][0]) < -0.05 * float(np.std(i)):
            for each in motion:
                each.sign = -each.sign
                each.why.append("else friction would give energy: sign turned")


def _roll_over(guess: Guess) -> None:
    """Find the period of a position that rolls over; that of counts is a turn of the encoder."""
    x = guess.finite
    span = float(np.ptp(x))
    whole = guess.whole and span > 50.0
    power = 2.0 ** math.ceil(math.log2(max(span, 1.0)))
    periods = {"deg": (360.0,), "rad": (_TURN,), "rev": (1.0,), COUNTS: (power, span + 1.0)}
    for period in periods.get(guess.unit, (power,) if whole else (_TURN, 360.0)):
        jumps = int(np.count_nonzero(np.abs(np.diff(x)) > 0.8 * period))
        if 0.9 * period < span <= 1.001 * period and 0 < jumps < 0.1 * len(x):
            guess.period = period
            counting = whole and guess.unit in ("", COUNTS)
            unit = COUNTS if counting else guess.unit or ("deg" if period == 360.0 else "rad")
            guess.take(unit, _TURN / period if counting else _ANGLES[unit], f"rolls over at {period:.6g}")
            return


def _units_by_ratio(position: Guess, speed: Guess, ratio: float) -> None:
    """Give the units that d(position)/dt = ratio * speed, in own units, shows; those that a name states stay."""
    if position.known and speed.known:
        return
    rates = {speed.unit: speed.factor} if speed.known else _SPEEDS
    if position.unit == COUNTS and not position.known:
        turns = {rate: _TURN * ratio / factor for rate, factor in rates.items()}
        found = [rate for rate, per_turn in turns.items() if speed.known or _is_round(per_turn)]
        for rate in found if len(found) == 1 else ():
            why = f"{turns[rate]:.6g} counts per turn by {speed.column!r}"
            position.take(COUNTS, _TURN / turns[rate], why)
            if not speed.known:
                speed.take(rate, rates[rate], f"with it {position.column!r} has a usual resolution")
        return
    angles = {position.unit: position.factor} if position.known else _ANGLES
    fitting = [(a, r) for a in angles for r in rates if abs(ratio * angles[a] / rates[r] - 1.0) < _FITS]
    if len(fitting) != 1 and not (position.known or speed.known):
        return  # rad with rad/s look like deg with deg/s
    for angle, rate in fitting[:1]:
        if not position.known:
            position.take(angle, angles[angle], f"unit by {speed.column!r}, its derivative")
        if not speed.known:
            speed.take(rate, rates[rate], f"unit by the derivative of {position.column!r}")


def _is_round(per_turn: float) -> bool:
    """Return whether encoders have so many counts per turn: powers of two; 1, 2, 4, 5 times a power of ten."""
    usual = [2.0**k for k in range(7, 25)] + [m * 10.0**k for m in (1, 2, 4, 5) for k in range(2, 7)]
    return _near(per_turn, usual, _ROUND)


def _alike(one: Guess, two: Guess) -> float:
    """Return the correlation of two columns; 0 where one is constant."""
    good = np.isfinite(one.values) & np.isfinite(two.values)
    a, b = one.values[good], two.values[good]
    return float(np.corrcoef(a, b)[0, 1]) if len(a) > 2 and np.ptp(a) > 0.0 < np.ptp(b) else 0.0
