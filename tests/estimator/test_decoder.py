"""The typed decoder: what a section may hold follows from the annotations, and so does what a message says."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
import pytest

from jtqd.estimator.decoder import FieldError, Text, check, choice, decode, limits
from jtqd.estimator.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    gain: Annotated[float, limits(gt=0.0)]
    at: Annotated[tuple[float, ...], limits("rad", length=(1, 3))] = (0.0,)


@dataclass(frozen=True)
class Outer:
    name: Text
    inner: Inner
    torque_nm: Annotated[float, limits("Nm", ge=-5.0, le=5.0)] = 1.0
    count: Annotated[int, limits(ge=1, le=2_000_000)] | None = None
    mode: Annotated[str, choice(("fast", "slow"))] = "slow"
    on: bool = False
    other: Inner | None = None
    each: tuple[Inner, ...] = ()
    units: Mapping[str, Annotated[float, limits(ge=0.0)]] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self, "outer")
        if self.other == self.inner:
            raise FieldError("outer", "other.gain", self.inner.gain, "another gain")


LEAST: dict[str, Any] = {"name": "n", "inner": {"gain": 2}}


def read(**change: Any) -> Outer:
    return decode(Outer, LEAST | change, "f.yaml", "top")


def test_defaults_and_every_kind_of_field() -> None:
    assert read() == Outer("n", Inner(2.0))
    assert type(read().inner.gain) is float
    full = read(
        torque_nm=-5,
        count=3,
        mode="fast",
        on=True,
        other={"gain": 1.5, "at": [1, 2.5]},
        each=[{"gain": 1}, {"gain": np.float64(2.0)}],
        units={"any": 3},
        notes={"by": [1, "x"]},
    )
    other, each = Inner(1.5, (1.0, 2.5)), (Inner(1.0), Inner(2.0))
    assert full == Outer("n", Inner(2.0), -5.0, 3, "fast", True, other, each, {"any": 3.0}, {"by": [1, "x"]})
    assert type(full.each[1].gain) is float


def test_what_is_empty_in_the_file_counts_as_left_out() -> None:
    assert read(other=None, each=None, units=None, notes=None, count=None) == read()


ENDLESS: list[Any] = []
ENDLESS.append(ENDLESS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": " "}, "'top.name': found ' ', expected a text"),
        ({"name": 3}, "'top.name': found 3, expected a text"),
        ({"inner": {}}, "'top.inner.gain': missing, expected a number > 0"),
        ({"inner": None}, "'top.inner': found None, expected a mapping of keys to values"),
        ({"inner": {"gain": 0}}, "'top.inner.gain': found 0, expected a number > 0"),
        ({"inner": {"gain": math.inf}}, "'top.inner.gain': found inf, expected a number > 0"),
        ({"inner": {"gain": 10**400}}, "expected a number > 0"),
        ({"inner": {"gian": 1}}, "'top.inner.gian': unknown key, did you mean 'gain'?"),
        ({"torque": 1.0}, "'top.torque': unknown key, did you mean 'torque_nm'?"),
        ({"torque_nm": math.nan}, "'top.torque_nm': found nan, expected a number in Nm from -5 to 5"),
        ({"torque_nm": True}, "found True, expected a number in Nm from -5 to 5"),
        ({"torque_nm": "1e0"}, "found '1e0', expected a number in Nm from -5 to 5 (YAML reads this as text"),
        ({"torque_nm": None}, "'top.torque_nm': found None, expected a number in Nm"),
        ({"count": 3.0}, "'top.count': found 3.0, expected a whole number from 1 to 2000000"),
        ({"count": 0}, "'top.count': found 0, expected a whole number from 1 to 2000000"),
        ({"mode": "fasts"}, "'top.mode': found 'fasts', expected one of 'fast', 'slow'"),
        ({"on": 1}, "'top.on': found 1, expected true or false"),
        ({"other": [1]}, "'top.other': found [1], expected a mapping"),
        ({"each": {"gain": 1}}, "'top.each': found {'gain': 1}, expected a list of mappings"),
        ({"each": [{"gain": 1}, {}]}, "'top.each[1].gain': missing"),
        ({"units": {"any": -1}}, "'top.units.any': found -1, expected a number >= 0"),
        ({"notes": 5}, "'top.notes': found 5, expected a mapping"),
        (
            {"inner": {"gain": 1, "at": []}},
            "'top.inner.at': found 0 numbers, expected a list of 1 to 3 finite",
        ),
        ({"inner": {"gain": 1, "at": [1.0, math.nan]}}, "found [1.0, nan], expected a list of 1 to 3 finite"),
        ({"inner": {"gain": 1, "at": {1.0}}}, "found {1.0}, expected a list of 1 to 3 finite numbers in rad"),
        ({"inner": {"gain": 1, "at": ENDLESS}}, "expected a list of 1 to 3 finite numbers in rad"),
        ({"other": LEAST["inner"]}, "'top.other.gain': found 2, expected another gain"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(**change)
    assert str(caught.value).startswith("f.yaml: key 'top.")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_key_is_named_before_the_one_that_is_missing_for_it() -> None:
    with pytest.raises(ConfigError, match="did you mean 'name'"):
        decode(Outer, {"nam": "n", "inner": {"gain": 1}}, "f.yaml")


def test_all_missing_keys_are_in_one_error() -> None:
    with pytest.raises(ConfigError) as caught:
        decode(Outer, {"other": {}, "each": [{"gain": 1}, {}], "units": {"any": -1}}, "f.yaml", "top")
    assert str(caught.value) == (
        "f.yaml: key 'top.name': missing, expected a text of printable characters that is not empty; "
        "key 'top.inner': missing, expected a mapping of keys to values (gain); "
        "key 'top.other.gain': missing, expected a number > 0; "
        "key 'top.each[1].gain': missing, expected a number > 0"
    )


def test_a_wrong_value_above_the_missing_keys_comes_first() -> None:
    with pytest.raises(ConfigError, match=r"'name': found 3, expected a text of [^;]*$"):
        decode(Outer, {"name": 3}, "f.yaml")


def test_a_key_with_a_default_can_be_required() -> None:
    with pytest.raises(ConfigError, match=r"'mode': missing, expected one of [^;]*; key 'on': missing"):
        decode(Outer, LEAST, "f.yaml", required=("on", "mode"))
    assert decode(Outer, {**LEAST, "on": True}, "f.yaml", required=("on",)).on


@dataclass(frozen=True)
class Unknown:
    stiffness: Annotated[float, limits("Nm/rad", gt=0.0)] = math.nan

    def __post_init__(self) -> None:
        check(self, "unknown")


def test_nan_is_a_value_only_as_a_default() -> None:
    assert math.isnan(decode(Unknown, {}, "f.yaml").stiffness)
    assert math.isnan(replace(Unknown(3.0), stiffness=math.nan).stiffness)
    with pytest.raises(ConfigError, match="found nan"):
        decode(Unknown, {"stiffness": math.nan}, "f.yaml")
    with pytest.raises(ConfigError, match="found -1"):
        Unknown(-1.0)


def test_given_values_are_no_keys() -> None:
    mapping = {"inner": {"gain": 1}}
    assert decode(Outer, mapping, "f.yaml", name="given").name == "given"
    with pytest.raises(ConfigError, match="'name': unknown key"):
        decode(Outer, mapping | {"name": "n"}, "f.yaml", name="given")


@pytest.mark.parametrize(
    "change",
    [{"torque_nm": 5.5}, {"torque_nm": math.nan}, {"torque_nm": True}, {"count": 1.0}, {"mode": "x"}],
)
def test_values_built_in_code_keep_the_same_ranges(change: dict[str, Any]) -> None:
    (key,) = change
    with pytest.raises(ConfigError, match=rf"^outer\.{key}: found .*, expected"):
        replace(read(), **change)
    assert replace(read(), torque_nm=np.float64(4.0)).torque_nm == 4.0


def test_an_error_reaches_another_process() -> None:
    error = pickle.loads(pickle.dumps(FieldError("outer", "gain", 1.0, "2")))
    assert isinstance(error, ConfigError)
    assert str(error) == "outer.gain: found 1.0, expected 2"


def test_the_command_line_does_not_wait_for_the_decoder() -> None:
    """`jtqd --help` and the drivers need errors and numbers of a command line only."""
    code = "import sys, jtqd.daemon.jtqd, jtqd.estimator.errors; print('msgspec' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"
