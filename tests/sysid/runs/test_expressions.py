"""Expressions of a column map: arithmetic of columns gives what numpy gives, and nothing else is evaluated."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jtqd.sysid.runs.column_map import ExpressionError, parse

CELLS = {
    "a": np.array([1.0, 2.0, 4.0]),
    "b": np.array([-1.0, 0.5, 3.0]),
    "motor angle [deg]": np.array([0.0, 90.0, 180.0]),
    "effort.j1": np.array([7.0, 8.0, 9.0]),
    "counts": np.array([4090.0, 4094.0, 2.0]),
    "a+b": np.array([100.0, 200.0, 300.0]),
    "stamp_ns": np.array([0.0, 1e6, 2e6]),
}
HEADER = tuple(CELLS)


@pytest.mark.parametrize(
    ("text", "expected", "names"),
    [
        ("a", [1.0, 2.0, 4.0], ("a",)),
        ("a + 0.87*b", [0.13, 2.435, 6.61], ("a", "b")),
        ("-(a - b) / 2", [-1.0, -0.75, -0.5], ("a", "b")),
        ("a+b", [100.0, 200.0, 300.0], ("a+b",)),  # the name of a column is that column
        ("deg2rad(`motor angle [deg]`)", [0.0, math.pi / 2, math.pi], ("motor angle [deg]",)),
        ("effort.j1 - 7", [0.0, 1.0, 2.0], ("effort.j1",)),
        ("unwrap(counts, 4096) - 4090", [0.0, 4.0, 8.0], ("counts",)),
        ("unwrap(a, 2*pi)", [1.0, 2.0, 4.0], ("a",)),
        ("rpm2rad_s(a) * 30/pi", [1.0, 2.0, 4.0], ("a",)),
        ("rev2rad(a)/2/pi", [1.0, 2.0, 4.0], ("a",)),
        ("1.5 * 9.81 * 0.2 * sin(b)", list(1.5 * 9.81 * 0.2 * np.sin(CELLS["b"])), ("b",)),
        ("sign(b) * abs(b) + cos(a) - cos(a)", [-1.0, 0.5, 3.0], ("b", "a")),
        ("12", [12.0, 12.0, 12.0], ()),
    ],
)
def test_values(text: str, expected: list[float], names: tuple[str, ...]) -> None:
    found = parse(text, HEADER)
    assert found.names == names
    assert found.value(CELLS).tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a + d", "no column 'd', expected it for j1.torque_nm"),
        ("motor angle [deg]x", "expected a column of the file or an expression of columns"),
        ("`no such` * 2", "no column 'no such'"),
        ("a ** 2", "found the operator **"),
        ("a if b else a", "found IfExp"),
        ("a < b", "found Compare"),
        ("a[0]", "found brackets (a name with signs stands in backquotes)"),
        ("a + 0,87 * b", "found a comma"),
        ("[a]", "found List"),
        ("'a' + b", "found 'a' in"),
        ("True * a", "found True"),
        ("1j * a", "found 1j"),
        ("exp(a)", "found the call of 'exp'"),
        ("__import__('os').system('true')", "found the call of"),
        ("sin(a).__class__", "found Attribute"),
        ("sin(a, b)", "found 2 arguments of sin"),
        ("sin(x=a)", "found the call of 'sin'"),
        ("unwrap(a, b)", "a period of unwrap that is no number"),
        ("(lambda: a)()", "found the call of"),
        ("1" + "0" * 400 + "*a", "out of range"),
        ("+".join(["a"] * 60), "more than 40 levels"),
        ("a" * 1001, "1001 characters"),
        ("(" * 300 + "a" + ")" * 300, "expected"),
    ],
)
def test_everything_else_is_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse(text, HEADER, "j1.torque_nm")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.text(alphabet="ab`()+-*/. 019,sincospi_[]'\"=<>!lambdexr", max_size=60))
def test_no_text_gets_past_as_another_exception(text: str) -> None:
    try:
        found = parse(text, HEADER)
    except ExpressionError:
        return
    assert found.value(CELLS).shape == (3,)
