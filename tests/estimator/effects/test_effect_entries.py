"""Entries of a joint file's list `effects`: checked against the library, one line that says what is wrong."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator import effects
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.effects.library import EFFECTS, discover
from jtqd.estimator.joint import Effect as Entry
from tests.estimator.effects.effect_signals import PLAIN, balances, state

SEED = 4711
K = PLAIN.stiffness_nm_per_rad


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("magic", {}, "found 'magic', expected one of channel_delay"),
        ("cogging", {"amplitude_nm": 0.1}, "order_per_motor_rev: missing, expected a number in 1/rev"),
        (
            "cogging",
            {"amplitude_nm": -0.1, "order_per_motor_rev": 6},
            "found -0.1, expected a number in Nm from 0",
        ),
        ("sensor_gain", {"gain": 1.0, "offset_nm": 0.0}, "offset_nm: unknown key"),
        ("sensor_gain", {"gain": math.nan}, "gain: found nan"),
        ("sensor_gain", {"gain": True}, "gain: found True"),
        (
            "channel_delay",
            {"delay_s": 1e-3, "channel": 0.5},
            "found 0.5, expected a whole number from 0 to 2",
        ),
    ],
)
def test_wrong_parameters_are_refused(name: str, given: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        Entry(name, given)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_defaults_are_filled_in_and_the_files_own_values_are_not() -> None:
    assert Entry("encoder_eccentricity", {"amplitude_rad": 1e-5}).parameters == {
        "amplitude_rad": 1e-5,
        "phase_rad": 0.0,
        "motor_side": 0.0,
    }
    assert Entry("stribeck_friction", {"stribeck_nm": 1.0}).parameters == {"stribeck_nm": 1.0}
    s = state(SEED + 7)
    for name, p, own in (
        ("stribeck_friction", {"stribeck_nm": 1.0}, {"stribeck_velocity_rad_s": 0.05}),
        ("nonlinear_stiffness", {"cubic_nm_per_rad3": 1e9}, {"stiffness_nm_per_rad": K}),
    ):
        for left, right in zip(
            balances(EFFECTS[name], p, s, PLAIN), balances(EFFECTS[name], p | own, s, PLAIN), strict=True
        ):
            np.testing.assert_array_equal(left, right)


def test_one_key_has_one_right_value() -> None:
    twice = (Entry("torque_constant", {"torque_constant_nm_per_a": 0.07}),) * 2
    with pytest.raises(ConfigError, match="found 'torque_constant' twice"):
        replace(PLAIN, effects=twice)
    waves = tuple(Entry("torque_ripple", {"amplitude_nm": 0.1, "order_per_motor_rev": n}) for n in (1, 2))
    assert len(replace(PLAIN, effects=waves).effects) == 2


NEW = """
from jtqd.estimator.effects.coulomb_friction import CoulombFriction
class Squeak(CoulombFriction):
    name = "{name}"
    group = "{group}"
    hooks = {hooks}
EFFECT = {effect}
"""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"name": "squeal"}, "found the name 'squeal', expected 'squeak"),
        ({"group": "noise"}, "found group 'noise', expected one of"),
        ({"hooks": ("loss",)}, "found hooks \\('loss',\\), expected some of"),
        ({"effect": "Squeak"}, "expected an Effect"),
    ],
    ids=["right", "name", "group", "hook", "no instance"],
)
def test_a_new_effect_is_one_new_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    change: dict[str, str],
    message: str,
) -> None:
    name = "squeak" + request.node.callspec.id.replace(" ", "_")  # a module of its own per case
    values = {"name": name, "group": "friction", "hooks": ("loss_nm",), "effect": "Squeak()"} | change
    (tmp_path / f"{name}.py").write_text(NEW.format(**values))
    monkeypatch.setattr(effects, "__path__", [*effects.__path__, str(tmp_path)])
    if message is None:
        assert set(discover()) == set(EFFECTS) | {name}
        return
    with pytest.raises(TypeError, match=message):
        discover()
