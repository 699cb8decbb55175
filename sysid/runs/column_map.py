"""Column map: where the columns of a run table come from in a file with other names, units and signs.

    time_s: "stamp_s + 1e-9 * stamp_ns"                    a column, or an expression of columns
    j1.link_position_rad: {column: angle, scale: 0.0175}   value = scale * cell + offset
    j1.load: {mass_kg: 1.5, lever_m: 0.2}                  the torque reference is a known load
    j2.load: {inertia_kgm2: 0.03}                          ... or an inertia without weight
    j3.load: {torque_nm: "model_torque - payload_torque"}  ... or a rigid-body model's torque
    j4.load: {light: {mass_kg: 2, lever_m: 0.3, arm: unknown}, heavy: {..}}   by what the run's path has in it
    j1.drive: {voltage_v: "duty * 12", resistance_ohm: 2.0, back_emf_vs_per_rad: 0.01}
    j1.joint_file: joint1.yaml                             beside the map

A known load is a pendulum on the joint's axis, q its link position [rad], positive along positive current:

    torque_nm = inertia d2q/dt2 + mass g lever sin(q - hangs_at)

With `arm: unknown` it hangs on an arm that was not weighed: the run has a known part of the load and no `torque_nm`. A map
without columns is for the run table's own names; where it has a load, a torque column is not read.

A drive without a current signal has its voltage; the winding's inductance is neglected (it settles within a row):

    current_a = (voltage - back_emf omega_m) / resistance

Expressions ("b + 0.87 * c", "deg2rad(`motor angle [deg]`)"): a text that is the name of a column is that column. Any other
text is parsed by Python's `ast` and walked here: numbers, names of columns, + - * / and parentheses, `pi`, and the functions
of FUNCTIONS. Names that are no Python names stand in backquotes. Nothing else is evaluated.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import (
    Field,
    FieldError,
    Text,
    below,
    choice,
    field_of,
    in_file,
    limits,
    parsed,
    read,
    read_values,
)
from jtqd.estimator.errors import Verbatim, shown
from jtqd.estimator.run import COLUMN_NAMES
from jtqd.models.files import load_yaml
from jtqd.sysid.runs.bad_samples import are_even, on_a_cubic, outlier_rows, row_times

LONGEST: Final = 1000
DEEPEST: Final = 40
"""Characters and levels of an expression."""
_QUOTED: Final = re.compile(r"`([^`]*)`")
_STAND_IN: Final = "_column_{}_"

Cells = Mapping[str, FloatArray]
"""Columns [n] of a file by name."""


class ExpressionError(ValueError):
    """A text is neither a column nor an expression; the message has what was found and what was expected."""


@dataclass(frozen=True)
class Function:
    """Function of an expression. what: unit in, unit out, for messages and the docs; arguments: their number."""

    what: str
    arguments: int
    call: Callable[..., FloatArray]


FUNCTIONS: Final[Mapping[str, Function]] = {
    "deg2rad": Function("degrees -> rad, deg/s -> rad/s", 1, np.deg2rad),
    "rev2rad": Function("revolutions -> rad, rev/s -> rad/s", 1, lambda x: 2.0 * math.pi * x),
    "rpm2rad_s": Function("rpm -> rad/s", 1, lambda x: x * (2.0 * math.pi / 60.0)),
    "unwrap": Function(
        "unwrap(x, period): a position that rolls over, in its own unit",
        2,
        lambda x, period: np.unwrap(x, period=float(period)),
    ),
    "sin": Function("rad -> 1", 1, np.sin),
    "cos": Function("rad -> 1", 1, np.cos),
    "abs": Function("any unit, kept", 1, np.abs),
    "sign": Function("any unit -> -1, 0, 1", 1, np.sign),
}
_CONSTANTS: Final = {"pi": math.pi}
_OPERATORS: Final[Mapping[type[ast.operator], Callable[[FloatArray, FloatArray], FloatArray]]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}
_REFUSED: Final[Mapping[type[ast.operator], str]] = {
    ast.Pow: "**",
    ast.Mod: "%",
    ast.FloorDiv: "//",
    ast.MatMult: "@",
}
NO_COLUMN: Final = "found no column"
_ALLOWED: Final = "numbers, columns of the file, + - * /, pi and " + ", ".join(FUNCTIONS)


@dataclass(frozen=True)
class Expression:
    """A parsed expression. names: columns that it reads, each once, in order."""

    names: tuple[str, ...]
    _evaluate: Callable[[Cells], Any]

    def value(self, cells: Cells) -> FloatArray:
        """Return the value [n] from columns [n]; division by zero gives infinity, which a run table refuses."""
        n = len(next(iter(cells.values())))
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(self._evaluate(cells), np.float64), (n,)).copy()


def parse(text: str, header: Sequence[str], target: str = "it") -> Expression:
    """Return the expression that `text` is for a file with these columns; target: its use, in messages. Raises
    ExpressionError.
    """
    if text in header:
        return Expression((text,), lambda cells: cells[text])
    if len(text) > LONGEST:
        raise ExpressionError(f"found an expression of {len(text)} characters, expected at most {LONGEST}")
    quoted: dict[str, str] = {}

    def stand_in(match: re.Match[str]) -> str:
        quoted[name := _STAND_IN.format(len(quoted))] = match.group(1)
        return name

    source = _QUOTED.sub(stand_in, text)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            body = ast.parse(source.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ExpressionError(
            f"found {shown(text)} for {target}, expected a column of the file or an expression of columns: {_ALLOWED}"
        ) from None
    names: dict[str, None] = {}
    evaluate = _Compiler(text, target, tuple(header), quoted, names).compiled(body)
    return Expression(tuple(names), evaluate)


class _Compiler(NamedTuple):
    """Turns the syntax tree of a text into a function of the cells, and refuses everything that is not allowed.

    header: columns of the file; quoted: columns by the name that stands for them in the tree; names: columns read so far.
    """

    text: str
    target: str
    header: tuple[str, ...]
    quoted: Mapping[str, str]
    names: dict[str, None]

    def error(self, found: str, expected: str = _ALLOWED) -> ExpressionError:
        return ExpressionError(f"found {found} in {shown(self.text)} for {self.target}, expected {expected}")

    def compiled(self, node: ast.expr, depth: int = 0) -> Callable[[Cells], Any]:
        if depth > DEEPEST:
            raise self.error(f"more than {DEEPEST} levels", "fewer parentheses")
        if isinstance(node, ast.Constant):
            number = self._number(node.value)
            return lambda _: number
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            operator = _OPERATORS[type(node.op)]
            left, right = self.compiled(node.left, depth + 1), self.compiled(node.right, depth + 1)
            return lambda cells: operator(left(cells), right(cells))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            inner = self.compiled(node.operand, depth + 1)
            return (lambda cells: -inner(cells)) if isinstance(node.op, ast.USub) else inner
        if isinstance(node, ast.Call):
            call = self._function(node).call
            arguments = [self.compiled(each, depth + 1) for each in node.args]
            return lambda cells: call(*(each(cells) for each in arguments))
        name = _name(node)
        if not name:
            raise self.error(_kind(node))
        column = self.quoted.get(name, name)
        if column in self.header:
            self.names[column] = None
            return lambda cells: cells[column]
        if name not in _CONSTANTS:
            few = ", ".join(f"'{each}'" for each in self.header[:4])
            there = few if len(self.header) <= 4 else f"{few}, ... {len(self.header)} in all"
            raise ExpressionError(f"{NO_COLUMN} '{column}', expected it for {self.target} ({there})")
        return lambda _: np.float64(_CONSTANTS[name])

    def _number(self, value: object) -> np.float64:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(shown(value))
        try:
            return np.float64(value)
        except OverflowError:
            raise self.error("a number out of range") from None

    def _function(self, node: ast.Call) -> Function:
        name = _name(node.func)
        if name not in FUNCTIONS or node.keywords:
            raise self.error(f"the call of {name or 'something'!r}")
        function = FUNCTIONS[name]
        if len(node.args) != function.arguments:
            raise self.error(
                f"{len(node.args)} arguments of {name}", f"{function.arguments} ({function.what})"
            )
        if name == "unwrap":
            names = (
                _name(each) for each in ast.walk(node.args[1]) if isinstance(each, ast.Name | ast.Attribute)
            )
            if any(each != "pi" for each in names):
                raise self.error("a period of unwrap that is no number", "e.g. 2 * pi or 4096")
            with np.errstate(all="ignore"):
                period = float(self.compiled(node.args[1])({}))
            if not 0.0 < period < math.inf:
                raise self.error(f"a period of unwrap of {period:g}", "a number above 0, e.g. 2 * pi or 4096")
        return function


def _kind(node: ast.expr) -> str:
    """Return what is not allowed, in words; a comma is often meant as a decimal point."""
    if isinstance(node, ast.BinOp):
        return f"the operator {_REFUSED.get(type(node.op), type(node.op).__name__)}"
    if isinstance(node, ast.Subscript):
        return "brackets (a name with signs stands in backquotes)"
    return "a comma" if isinstance(node, ast.Tuple) else type(node).__name__


def _name(node: ast.AST) -> str:
    """Return the name of a column or function; dots belong to it ("effort.j1"); "" for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = _name(node.value)
        return f"{before}.{node.attr}" if before else ""
    return ""


TIME: Final = "time_s"
JOINTS: Final = range(1, 8)
GRAVITY_M_S2: Final = 9.80665
WINDOW_S: Final = 0.1
"""Longest window of a position to which a quintic is fitted for its velocity and acceleration."""
QUIET: Final = 0.02
SHARP: Final = 0.06
"""Noise of an acceleration, in parts of the largest: a fit of whole runs averages it, but no ripple that is lacking."""
_FEWEST_ROWS: Final = 7
_OUTLIER_RAD: Final = 0.1
_SOURCE: Final = "a column of the file, an expression of columns, or {column: either, scale: 1, offset: 0}"


@dataclass(frozen=True)
class Column:
    """value = scale * cell + offset, in the target's SI unit; name: a column or an expression."""

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class KnownLoad:
    """Load of a joint without a torque sensor: the torque that a model gives (a column or an expression), or a pendulum:

    mass [kg] at lever [m] from the axis, inertia about the axis [kg m2], hangs_at: link position at rest [rad].
    arm: whether what it hangs on is "known" (a part of it, or without mass) or "unknown".
    """

    torque_nm: str | None = None
    mass_kg: float = 0.0
    lever_m: float = 0.0
    inertia_kgm2: float = 0.0
    hangs_at_rad: float = 0.0
    gravity_m_s2: float = GRAVITY_M_S2
    arm: str = "known"

    def torque(self, time_s: FloatArray, position_rad: FloatArray, quiet: float = QUIET) -> FloatArray:
        """Return the torque of the joint on the pendulum [n, Nm] at link positions [n] of one segment without gaps."""
        _, acceleration = motion_of(time_s, position_rad, quiet)
        weight = self.mass_kg * self.gravity_m_s2 * self.lever_m * np.sin(position_rad - self.hangs_at_rad)
        return self.inertia_kgm2 * acceleration + weight


@dataclass(frozen=True)
class VoltageDrive:
    """A drive that gives its voltage [V] (a column or an expression) and no current; back EMF: motor side, Vs/rad."""

    voltage_v: Text
    resistance_ohm: Annotated[float, limits("ohm", gt=0.0)]
    back_emf_vs_per_rad: Annotated[float, limits("Vs/rad", ge=0.0)]

    def current(self, voltage_v: FloatArray, motor_velocity_rad_s: FloatArray) -> FloatArray:
        """Return the current of the winding [n, A]."""
        return (voltage_v - self.back_emf_vs_per_rad * motor_velocity_rad_s) / self.resistance_ohm


@dataclass(frozen=True)
class ColumnMap:
    """Where each target column comes from; known loads (of each run by a part of its path, "": of all), voltage drives and
    joint files by joint; `where`: the map's file.
    """

    columns: Mapping[str, Column]
    joint_files: Mapping[int, Path]
    loads: Mapping[int, KnownLoad] | None = None
    drives: Mapping[int, VoltageDrive] | None = None
    where: str = ""
    loads_of_runs: Mapping[int, Mapping[str, KnownLoad]] | None = None

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object], where: str, folder: Path) -> ColumnMap:
        """Check a column map read from YAML; `TARGET: NAME` is short for `TARGET: {column: NAME}`. Raises ConfigError."""
        with in_file(where):
            values = read_values(_keys(any(key in mapping for key in targets())), mapping)
            columns = {key: values[key] for key in targets() if key in values}
            loads = {n: values[f"j{n}.load"] for n in JOINTS if f"j{n}.load" in values}
            drives = {n: values[f"j{n}.drive"] for n in JOINTS if f"j{n}.drive" in values}
            for n, by_run in loads.items():
                for load in by_run.values():
                    _check_load(n, load, columns)
            for n in drives:
                _check_drive(n, columns)
        files = {n: folder / values[f"j{n}.joint_file"] for n in JOINTS if f"j{n}.joint_file" in values}
        every = {n: by_run[""] for n, by_run in loads.items() if "" in by_run}
        return cls(columns, files, every, drives, where, loads)

    @classmethod
    def load(cls, path: Path | str) -> ColumnMap:
        """Read a column map file. Raises ConfigError."""
        mapping = load_yaml(Path(path))
        return cls.from_mapping(mapping, str(path), Path(path).parent)

    @property
    def known_loads(self) -> tuple[int, ...]:
        """Joints whose reference is a known load, not a sensor."""
        return tuple(sorted({*(self.loads or ()), *(self.loads_of_runs or ())}))

    def of_run(self, path: Path, header: Sequence[str]) -> ColumnMap:
        """Return the map of one run file with these columns: its loads, and without columns those of the run table's names.
        Raises ExpressionError.
        """
        loads = dict(self.loads or {})
        for n, by_run in (self.loads_of_runs or {}).items():
            names = [name for name in by_run if name in str(path)]
            if len(names) != 1:
                found = " and ".join(map(repr, names)) or f"none of {', '.join(map(repr, by_run))}"
                raise ExpressionError(f"found {found} in the path, expected one: j{n}.load of {self.where}")
            loads[n] = by_run[names[0]]
        known = {f"j{n}.torque_nm" for n in loads}
        own = {name: Column(name) for name in targets() if name in header and name not in known}
        columns = self.columns or own
        for key in (f"j{n}.link_position_rad" for n, load in loads.items() if load.torque_nm is None):
            if key not in columns:
                raise ExpressionError(f"found no column {key!r}, expected the angle of the load")
        return replace(self, loads=loads, columns=columns)

    def sources(self) -> dict[str, Column]:
        """Return every column or expression that is read: targets, `jN.load` (a torque) and `jN.drive` (a voltage)."""
        found = dict(self.columns)
        found |= {f"j{n}.load": Column(x.torque_nm) for n, x in (self.loads or {}).items() if x.torque_nm}
        return found | {f"j{n}.drive": Column(x.voltage_v) for n, x in (self.drives or {}).items()}

    def parsed(self, header: list[str], file: str) -> dict[str, Expression]:
        """Return the expression of every source for a file with these columns; `file`: file and place in messages. Raises
        ExpressionError.
        """
        found = {}
        for key, column in self.sources().items():
            try:
                found[key] = parse(column.name, header, f"{key} of {self.where}" if self.where else key)
            except ExpressionError as error:
                raise ExpressionError(f"{file} {error}") from None
        return found

    def completed(self, values: Mapping[str, FloatArray], quiet: float = QUIET) -> dict[str, FloatArray]:
        """Return the targets [n] of one segment without gaps, torques of known loads and currents of voltage drives too.

        `jN.load`: the known part of a load on an unknown arm, in place of `jN.torque_nm`.
        """
        found = {key: value for key, value in values.items() if key in self.columns}
        time = found[TIME]
        for n, load in (self.loads or {}).items():
            if load.torque_nm is not None:
                found[f"j{n}.torque_nm"] = values[f"j{n}.load"]
            else:
                key = f"j{n}.torque_nm" if load.arm == "known" else f"j{n}.load"
                found[key] = load.torque(time, found[f"j{n}.link_position_rad"], quiet)
        for n, drive in (self.drives or {}).items():
            speed = found.get(f"j{n}.motor_velocity_rad_s")
            if speed is None:
                speed = motion_of(time, found[f"j{n}.motor_position_rad"])[0]
            found[f"j{n}.current_a"] = drive.current(values[f"j{n}.drive"], speed)
        return found

    def remarks(self) -> list[str]:
        """Return one line for everything in the run table that was computed and not recorded."""
        lines = []
        for n, load in (self.loads or {}).items():
            what = (
                f"{load.torque_nm!r} of a model"
                if load.torque_nm is not None
                else f"a known load of {load.mass_kg:g} kg at {load.lever_m:g} m and {load.inertia_kgm2:g} kg m2"
            )
            if load.arm != "known":
                lines.append(f"j{n} carries {what}, on an unknown arm")
                continue
            lines.append(
                f"j{n}.torque_nm is {what}: taken as true, no effect of a torque sensor is looked for; an error of the load "
                "is taken for the joint's"
            )
        for n, drive in (self.drives or {}).items():
            lines.append(
                f"j{n}.current_a is computed from {drive.voltage_v!r}, {drive.resistance_ohm:g} ohm and "
                f"{drive.back_emf_vs_per_rad:g} Vs/rad: a wrong resistance shows as torque_constant, a wrong back EMF "
                "as viscous_friction"
            )
        return lines


def targets() -> list[str]:
    """Return the columns of a run table."""
    return [TIME, *(f"j{joint}.{quantity}" for joint in JOINTS for quantity in COLUMN_NAMES)]


_LONGEST_GAP: Final = 10.0
"""Steps between two rows that the motion of a position is followed over."""


def motion_of(
    time_s: FloatArray, position: FloatArray, quiet: float = QUIET
) -> tuple[FloatArray, FloatArray]:
    """Return velocity and acceleration [n] of the quintic through a window of the position around each row, ends held.

    The window is the shortest in which the position's noise is below `quiet` of the motion's largest acceleration, WINDOW_S
    at most: a longer one rounds the reversals off (Savitzky and Golay 1964, doi 10.1021/ac60214a047); rows that are not
    even are brought to equal steps and back. Outlier samples are interpolated.
    """
    outliers = outlier_rows(position, _OUTLIER_RAD)
    if outliers.any():
        position = on_a_cubic(time_s, time_s[~outliers], position[~outliers])
    if not are_even(time_s):
        rows, step, _ = row_times(time_s, [position])
        short = np.minimum(
            np.diff(rows), _LONGEST_GAP * step
        )  # nothing is known of the motion in a longer one
        rows = np.concatenate(([0.0], np.cumsum(short)))
        even = np.arange(rows[0], rows[-1] + 1e-9, step)
        found = motion_of(even, on_a_cubic(even, rows, position), quiet)
        velocity, acceleration = (on_a_cubic(rows, even, x) for x in found)
        return velocity, acceleration
    step = float(np.median(np.diff(time_s)))
    longest = min(max(_FEWEST_ROWS // 2, round(0.5 * WINDOW_S / step)), (len(position) - 1) // 2)
    if longest < 2:
        velocity = np.gradient(position, time_s)
        return velocity, np.gradient(velocity, time_s)
    weights = _weights(longest, step)
    largest = float(np.max(np.abs(np.correlate(position, weights[1], mode="valid"))))
    # white noise; the motion adds almost nothing
    noise = float(np.std(np.diff(position, 4))) / math.sqrt(70.0)
    half = longest
    for half in range(min(_FEWEST_ROWS // 2, longest), longest + 1):
        weights = _weights(half, step)
        if noise * float(np.linalg.norm(weights[1])) <= quiet * largest:
            break
    slope, bend = (np.correlate(position, each, mode="valid") for each in weights)
    return np.pad(slope, half, mode="edge"), np.pad(bend, half, mode="edge")


def _weights(half: int, step: float) -> tuple[FloatArray, FloatArray]:
    """Return weights [2 half + 1] of a quintic's slope and second derivative in its middle."""
    at = np.arange(-half, half + 1) * step
    quintic = np.linalg.pinv(np.vander(at / at[-1], 6, increasing=True))
    return quintic[1] / at[-1], 2.0 * quintic[2] / at[-1] ** 2


def _source_text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("found no text")
    return value


@dataclass(frozen=True)
class _ColumnFile:
    column: Annotated[str, parsed(_source_text, "a column of the file, or an expression of columns")]
    scale: Annotated[float, limits("target units per cell unit")] = 1.0
    offset: Annotated[float, limits("target units")] = 0.0

    def __post_init__(self) -> None:
        if self.scale == 0.0:
            raise FieldError("column", "scale", self.scale, "a number other than 0")


def _column(value: Any) -> Column:
    if isinstance(value, str):
        return Column(value)
    if not isinstance(value, dict):
        raise ValueError("found neither a text nor a mapping")
    file = read(_ColumnFile, value)
    return Column(file.column, file.scale, file.offset)


@dataclass(frozen=True)
class _Model:
    torque_nm: Text


_ARM: Final = choice(("known", "unknown"))


@dataclass(frozen=True)
class _Inertia:
    """A load without weight."""

    inertia_kgm2: Annotated[float, limits("kg m2", ge=0.0)] = 0.0
    hangs_at_rad: Annotated[float, limits("rad")] = 0.0
    gravity_m_s2: Annotated[float, limits("m/s2", ge=0.0, le=30.0)] = GRAVITY_M_S2
    arm: Annotated[str, _ARM] = "known"


@dataclass(frozen=True)
class _Pendulum:
    """A load with weight; by default its inertia is that of a point mass."""

    mass_kg: Annotated[float, limits("kg", ge=0.0)]
    lever_m: Annotated[float, limits("m", ge=0.0)]
    inertia_kgm2: Annotated[float, limits("kg m2", ge=0.0)] = math.nan
    hangs_at_rad: Annotated[float, limits("rad")] = 0.0
    gravity_m_s2: Annotated[float, limits("m/s2", ge=0.0, le=30.0)] = GRAVITY_M_S2
    arm: Annotated[str, _ARM] = "known"


def _loads(value: Any) -> dict[str, KnownLoad]:
    """Return the loads by a part of the run's path; "": one for all runs."""
    if not isinstance(value, dict) or not value or not all(isinstance(each, dict) for each in value.values()):
        return {"": _load(value)}
    found = {}
    for name, each in value.items():
        with below(str(name)):
            found[str(name)] = _load(each)
    return found


def _load(value: Any) -> KnownLoad:
    keys = value if isinstance(value, dict) else {}
    if "torque_nm" in keys:
        return KnownLoad(read(_Model, value).torque_nm)
    if {"inertia_kgm2", "arm"} & set(keys) and "mass_kg" not in keys:
        return KnownLoad(**vars(read(_Inertia, value)))
    load = KnownLoad(**vars(read(_Pendulum, value)))
    if not math.isnan(load.inertia_kgm2):
        return load
    return replace(load, inertia_kgm2=load.mass_kg * load.lever_m * load.lever_m)


@cache
def _keys(needs_time: bool) -> tuple[Field, ...]:
    """Return how every key of a column map is read."""
    column = Annotated[Column, parsed(_column, _SOURCE)]
    section = "a mapping of keys to values"
    kinds = {
        "joint_file": Text,
        "load": Annotated[dict[str, KnownLoad], parsed(_loads, section)],
        "drive": Annotated[VoltageDrive, parsed(lambda value: read(VoltageDrive, value), section)],
    }
    keys = [field_of(key, column, optional=key != TIME or not needs_time) for key in targets()]
    for joint in JOINTS:
        keys += [field_of(f"j{joint}.{key}", kind, optional=True) for key, kind in kinds.items()]
    return tuple(keys)


def _check_load(joint: int, load: KnownLoad, columns: Mapping[str, Column]) -> None:
    key = f"j{joint}.load"
    if f"j{joint}.torque_nm" in columns:
        found = Verbatim(f"it beside 'j{joint}.torque_nm'")
        raise FieldError("map", key, found, f"one reference of joint {joint}")
    if columns and load.torque_nm is None and f"j{joint}.link_position_rad" not in columns:
        expected = "the angle of the load (from a motor encoder: its column with scale 1/gear_ratio)"
        raise FieldError("map", key, Verbatim(f"no 'j{joint}.link_position_rad'"), expected)


def _check_drive(joint: int, columns: Mapping[str, Column]) -> None:
    key = f"j{joint}.drive"
    velocity, position = f"j{joint}.motor_velocity_rad_s", f"j{joint}.motor_position_rad"
    if f"j{joint}.current_a" in columns:
        raise FieldError("map", key, Verbatim(f"it beside 'j{joint}.current_a'"), "one of them")
    if not {velocity, position} & set(columns):
        found = Verbatim(f"neither '{velocity}' nor '{position}'")
        raise FieldError("map", key, found, "one: the back EMF needs the motor's speed")
