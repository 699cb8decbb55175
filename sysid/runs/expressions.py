"""Expressions of columns in a column map: "b + 0.87 * c", "deg2rad(`motor angle [deg]`)". Nothing else is evaluated.

A text that is the name of a column is that column, whatever it looks like. Any other text is parsed by Python's `ast` and
walked here: numbers, names of columns, + - * / and parentheses, `pi`, and the functions of FUNCTIONS. Names that are no
Python names stand in backquotes. There is no power, comparison, index, keyword or call of anything else.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import shown

LONGEST: Final = 1000
DEEPEST: Final = 40
"""Characters and levels of an expression: more is no expression that a person wrote."""
_QUOTED: Final = re.compile(r"`([^`]*)`")
_STAND_IN: Final = "_column_{}_"


class ExpressionError(ValueError):
    """A text is neither a column nor an expression; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Function:
    """What a map may call. what: unit in, unit out, for messages and the docs; arguments: least and most of them."""

    what: str
    arguments: tuple[int, int]
    call: Callable[..., FloatArray]


def _unwrapped(x: FloatArray, period: float) -> FloatArray:
    return np.unwrap(x, period=float(period))


FUNCTIONS: Final[Mapping[str, Function]] = {
    "deg2rad": Function("degrees -> rad, deg/s -> rad/s", (1, 1), np.deg2rad),
    "rev2rad": Function("revolutions -> rad, rev/s -> rad/s", (1, 1), lambda x: 2.0 * math.pi * x),
    "rpm2rad_s": Function("rpm -> rad/s", (1, 1), lambda x: x * (2.0 * math.pi / 60.0)),
    "unwrap": Function("unwrap(x, period): a position that rolls over, in its own unit", (2, 2), _unwrapped),
    "sin": Function("rad -> 1", (1, 1), np.sin),
    "cos": Function("rad -> 1", (1, 1), np.cos),
    "abs": Function("any unit, kept", (1, 1), np.abs),
    "sign": Function("any unit -> -1, 0, 1", (1, 1), np.sign),
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
_ALLOWED: Final = "numbers, columns of the file, + - * /, pi and " + ", ".join(FUNCTIONS)


@dataclass(frozen=True)
class Expression:
    """A parsed text. names: columns that it reads, each once, in order."""

    text: str
    names: tuple[str, ...]
    _body: ast.expr
    _columns: Mapping[str, str]

    def value(self, cells: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value [n] from columns [n]; division by zero gives infinity, which a run table refuses."""
        n = len(next(iter(cells.values())))
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(self._eval(self._body, cells), np.float64), (n,)).copy()

    def _eval(self, node: ast.expr, cells: Mapping[str, FloatArray]) -> FloatArray:
        if isinstance(node, ast.Constant):
            return np.float64(node.value)  # type: ignore[arg-type, return-value]
        if isinstance(node, ast.BinOp):
            return _OPERATORS[type(node.op)](self._eval(node.left, cells), self._eval(node.right, cells))
        if isinstance(node, ast.UnaryOp):
            inner = self._eval(node.operand, cells)
            return -inner if isinstance(node.op, ast.USub) else inner
        if isinstance(node, ast.Call):
            function = FUNCTIONS[_name(node.func)]
            return function.call(*(self._eval(each, cells) for each in node.args))
        name = _name(node)
        return cells[self._columns[name]] if name in self._columns else np.float64(_CONSTANTS[name])  # type: ignore[return-value]


def parse(text: str, header: Sequence[str], target: str = "it") -> Expression:
    """Return the expression that `text` is for a file with these columns; target: what it is for, in messages.

    Raises ExpressionError.
    """
    if text in header:
        return Expression(text, (text,), ast.Name(text), {text: text})
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
    columns: dict[str, str] = {}
    _check(body, _Text(text, target, tuple(header), quoted), columns, 0)
    return Expression(text, tuple(dict.fromkeys(columns.values())), body, columns)


class _Text(NamedTuple):
    """What is being parsed: the text, what for, the columns of the file, the names that stand for backquoted ones."""

    text: str
    target: str
    header: tuple[str, ...]
    quoted: Mapping[str, str]

    def error(self, found: str, expected: str = _ALLOWED) -> ExpressionError:
        return ExpressionError(f"found {found} in {shown(self.text)} for {self.target}, expected {expected}")


def _check(node: ast.expr, whole: _Text, columns: dict[str, str], depth: int) -> None:
    """Refuse everything that is not allowed, and note the columns."""
    if depth > DEEPEST:
        raise whole.error(f"more than {DEEPEST} levels", "fewer parentheses")
    inner: list[ast.expr] = []
    if isinstance(node, ast.Constant):
        _check_number(node, whole)
    elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        inner = [node.left, node.right]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        inner = [node.operand]
    elif isinstance(node, ast.Call):
        inner = _arguments(node, whole)
    elif name := _name(node):
        column = whole.quoted.get(name, name)
        if column in whole.header:
            columns[name] = column
        elif name not in _CONSTANTS:
            raise ExpressionError(
                f"found no column '{column}', expected it for {whole.target} (there are {_some(whole.header)})"
            )
    else:
        raise whole.error(_kind(node))
    for each in inner:
        _check(each, whole, columns, depth + 1)


def _kind(node: ast.expr) -> str:
    """What is not allowed, in words; a comma is one that was meant as a decimal point, most of the time."""
    if isinstance(node, ast.BinOp):
        return f"the operator {_REFUSED.get(type(node.op), type(node.op).__name__)}"
    if isinstance(node, ast.Subscript):
        return "brackets (a name with signs stands in backquotes)"
    return "a comma" if isinstance(node, ast.Tuple) else type(node).__name__


def _check_number(node: ast.Constant, whole: _Text) -> None:
    value = node.value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise whole.error(shown(value))
    try:
        float(value)
    except OverflowError:
        raise whole.error("a number out of range") from None


def _arguments(node: ast.Call, whole: _Text) -> list[ast.expr]:
    name = _name(node.func)
    if name not in FUNCTIONS or node.keywords:
        raise whole.error(f"the call of {name or 'something'!r}")
    function = FUNCTIONS[name]
    low, high = function.arguments
    if not low <= len(node.args) <= high:
        raise whole.error(f"{len(node.args)} arguments of {name}", f"{low} ({function.what})")
    if name == "unwrap":
        names = (_name(each) for each in ast.walk(node.args[1]) if isinstance(each, ast.Name | ast.Attribute))
        if any(each != "pi" for each in names):
            raise whole.error("a period of unwrap that is no number", "e.g. 2 * pi or 4096")
    return node.args


def _name(node: ast.AST) -> str:
    """The name of a column or function; dots belong to it ("effort.j1"); "" for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = _name(node.value)
        return f"{before}.{node.attr}" if before else ""
    return ""


def _some(header: tuple[str, ...]) -> str:
    few = ", ".join(f"'{name}'" for name in header[:4])
    return few if len(header) <= 4 else f"{few}, ... {len(header)} in all"
