"""Section `fused` of a joint file and the envelope of networks: read back, and every wrong value named by its key."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.estimator.decoder import FieldError, read
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import MAX_NODES, Envelope, Joint
from jtqd.models.files import load_joint
from jtqd.sysid.fit.joint_writer import write_joint
from tests.estimator.fused_helpers import NODES, SIGMA, TORSION, everywhere, fused_joint, loss_of, side

# ---- sections

Mapping = dict[str, Any]


def joint_of(mapping: Mapping) -> Joint:
    return Joint.from_mapping(mapping, "some.yaml")


def refused(change: Callable[[Mapping], object]) -> str:
    """The message for a joint file whose section `fused` was changed."""
    mapping = copy.deepcopy(fused_joint().to_mapping())
    change(mapping["fused"])
    with pytest.raises(ConfigError) as caught:
        joint_of(mapping)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("some.yaml: key 'fused")
    return message


def put(path: str, value: object) -> Callable[[Mapping], None]:
    def change(fused: Mapping) -> None:
        *parents, last = path.split(".")
        for parent in parents:
            fused = fused[parent]
        if value is ...:
            del fused[last]
        else:
            fused[last] = value

    return change


def first_below_zero(path: str) -> Callable[[Mapping], None]:
    def change(fused: Mapping) -> None:
        side, key = path.split(".")
        fused["loss"][side][key][2] = -0.25

    return change


@pytest.mark.parametrize("way", ["positive", "negative"])
def test_a_sign_that_friction_cannot_have_is_refused(way: str) -> None:
    """With file, key, found and expected."""
    message = refused(put(f"loss.{way}.stribeck_nm", -4.1))
    assert f"fused.loss.{way}.stribeck_nm" in message
    assert "-4.1" in message
    assert "at least 0" in message or ">= 0" in message
    message = refused(first_below_zero(f"{way}.viscous_nms_per_rad"))
    assert f"fused.loss.{way}.viscous_nms_per_rad" in message
    message = refused(put(f"loss.{way}.constant_nm", [-2.0] * len(NODES)))
    assert f"fused.loss.{way}.constant_nm" in message
    assert "friction takes energy" in message


@pytest.mark.parametrize("torsion", [TORSION, None, replace(TORSION, orders_per_motor_rev=(2.0, 4.25))])
def test_round_trip(torsion: Any) -> None:
    joint = fused_joint(3, torsion)
    mapping = joint.to_mapping()
    assert ("torsion" in mapping["fused"]) == (torsion is not None)
    assert joint_of(mapping) == joint
    assert joint_of(yaml.safe_load(yaml.safe_dump(mapping))) == joint
    assert Joint.from_mapping(mapping, "x").to_mapping() == mapping


def test_round_trip_through_a_file(tmp_path: Path) -> None:
    joint = fused_joint(4)
    write_joint(tmp_path / "joint.yaml", joint, "A test wrote this.")
    assert load_joint(tmp_path / "joint.yaml").fused == joint.fused


def test_one_order_of_the_kinematic_error_is_enough() -> None:
    one = replace(TORSION, orders_per_motor_rev=(2.0,), cos_rad=(1e-5,), sin_rad=(0.0,))
    joint = fused_joint(1, one)
    assert joint_of(joint.to_mapping()) == joint


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("los", {}, "fused.los': unknown key, did you mean 'loss'?"),
        ("loss.positive.coulomb", 1.0, "fused.loss.positive.coulomb': unknown key"),
        ("loss.color", 1.0, "fused.loss.color': unknown key"),
        ("torsion.zero", 1.0, "fused.torsion.zero': unknown key, did you mean 'zero_rad'?"),
        ("sigma.nm", 1.0, "fused.sigma.nm': unknown key"),
        ("loss", ..., "fused.loss': missing"),
        ("sigma", ..., "fused.sigma': missing"),
        ("loss.negative", ..., "fused.loss.negative': missing"),
        ("loss.temperature_c", ..., "fused.loss.temperature_c': missing"),
        ("sigma.scale", ..., "fused.sigma.scale': missing"),
        ("loss.load_nodes_nm", [1.0], "found 1 number, expected a list of 2 to 64 finite numbers in Nm"),
        ("loss.load_nodes_nm", list(range(MAX_NODES + 1)), "found 65 numbers, expected a list of 2 to 64"),
        (
            "loss.load_nodes_nm",
            [*NODES[:3], -4.0, *NODES[4:]],
            "load_nodes_nm': found [-30.0, -12.0, -4.0, -4",
        ),
        ("loss.load_nodes_nm", list(reversed(NODES)), "expected at least 2 rising numbers"),
        ("loss.load_nodes_nm", "1 2 3", "found '1 2 3', expected a list"),
        (
            "loss.positive.constant_nm",
            [1.0] * 7,
            "positive.constant_nm': found 7 numbers, expected a list of 8",
        ),
        (
            "loss.negative.viscous_nms_per_rad",
            [1.0] * 9,
            "found 9 numbers, expected a list of 8 finite numbers",
        ),
        (
            "loss.positive.quadratic_nms2_per_rad2",
            [1.0] * 7 + [float("nan")],
            "quadratic_nms2_per_rad2': found",
        ),
        ("loss.positive.constant_nm", [1.0] * 7 + [True], "expected a list of finite numbers in Nm"),
        ("loss.positive.stribeck_nm", "0.8", "positive.stribeck_nm': found '0.8', expected a number in Nm"),
        ("loss.stribeck_velocity_rad_s", 0.0, "stribeck_velocity_rad_s': found 0.0"),
        ("loss.velocity_max_rad_s", -1.0, "velocity_max_rad_s': found -1.0"),
        ("loss.temperature_c", 400.0, "temperature_c': found 400.0"),
        ("loss.viscous_per_k", 0.2, "viscous_per_k': found 0.2"),
        ("loss.thermal_viscous_nms_per_rad", -0.1, "thermal_viscous_nms_per_rad': found -0.1"),
        ("torsion.stiffness_nm_per_rad", 0.0, "torsion.stiffness_nm_per_rad': found 0.0"),
        ("torsion.orders_per_motor_rev", [], "found 0 numbers, expected a list of 1 to 64"),
        (
            "torsion.cos_rad",
            [0.0],
            "torsion.cos_rad': found 1 number, expected a list of 2 finite numbers, as many as orders",
        ),
        ("torsion.sin_rad", [0.0] * 3, "torsion.sin_rad': found 3 numbers, expected a list of 2"),
        ("sigma.current_nm", 0.0, "sigma.current_nm': found 0.0"),
        ("sigma.torsion_nm", 0.0, "sigma.torsion_nm': found 0.0"),
        ("sigma.reference_nm", -0.1, "sigma.reference_nm': found -0.1"),
        (
            "sigma.scale",
            [1.0, 1.0, 1.0],
            "sigma.scale': found 3 numbers, expected a list of 4 finite numbers",
        ),
        (
            "sigma.scale",
            [1.0, 1.0, 0.0, 1.0],
            "sigma.scale': found [1.0, 1.0, 0.0, 1.0], expected 4 numbers > 0",
        ),
        ("loss", 5, "fused.loss': found 5, expected a mapping"),
    ],
)
def test_wrong_values_are_named(path: str, value: object, words: str) -> None:
    assert words in refused(put(path, value))


def test_values_made_in_code_are_checked_too() -> None:
    with pytest.raises(ConfigError, match="expected at least 2 rising numbers"):
        loss_of(1, load_nodes_nm=(*NODES[:-1], NODES[-2]))
    with pytest.raises(ConfigError, match="found 3 numbers, expected a list of 8"):
        loss_of(1, negative=side(1, (0.0, 1.0, 2.0)))
    for change in ({"current_nm": 0.0}, {"torsion_nm": -1.0}, {"scale": (1.0, 1.0, 1.0, 0.0)}):
        with pytest.raises(ConfigError, match=f"fused.sigma.{next(iter(change))}: found"):
            replace(SIGMA, **change)


# ---- envelope

MAP = ((0, 1, 0), (1, 1, 1), (0, 1, 0))
GOOD = Envelope(0.25, 3.0, MAP, 4.0, (20.0, 30.0))


def with_envelope(envelope: Envelope | None) -> Joint:
    plain = fused_joint()
    assert plain.fused is not None
    return replace(plain, fused=replace(plain.fused, envelope=envelope))


@pytest.mark.parametrize(
    "envelope", [GOOD, replace(GOOD, temperature_c=None), replace(GOOD, load_nm=38.5), None]
)
def test_a_joint_file_holds_it(envelope: Envelope | None) -> None:
    mapping = with_envelope(envelope).to_mapping()
    assert Joint.from_mapping(mapping, "j.yaml") == with_envelope(envelope)
    if envelope is not None:
        assert mapping["fused"]["envelope"]["known"] == ["010", "111", "010"]


@pytest.mark.parametrize("envelope", [GOOD, everywhere(), replace(GOOD, temperature_c=None)])
def test_metadata_of_a_network_hold_it(envelope: Envelope) -> None:
    mapping = json.loads(json.dumps(envelope.to_mapping()))
    assert read(Envelope, mapping) == envelope
    assert mapping["known"] == [list(row) for row in envelope.known]


WRONG: list[tuple[str, Any, str]] = [
    ("known", ..., "missing"),
    ("kown", 1, "unknown key"),
    ("velocity_step_rad_s", 0.0, "found 0.0, expected a number in rad/s from 1e-06"),
    ("velocity_step_rad_s", True, "found True"),
    ("torque_step_nm", "3 Nm", "found '3 Nm'"),
    ("torque_step_nm", math.nan, "found nan"),
    ("distance_nm", 0.0, "found 0.0"),
    ("distance_nm", 1e-320, "found 1e-320"),
    *(
        ("known", value, "expected odd numbers of rows and of cells in each")
        for value in (
            *([], "010", 7, {"a": 1}, [1, 0, 1], [[]], ["01", "10"], [[1, 1, 1], [1, 1, 1]], [[1, 1]]),
            *([[1, 1, 1], [1], [1, 1, 1]], ["012"], [[2]], [[True]], [[0.5]], [[[1]]], [None], [["0 "]]),
        )
    ),
    ("known", ["0" * 129], "expected at most 127 of either"),
    *(
        ("temperature_c", value, "expected [lowest, highest] in degC, or none")
        for value in ([30.0, 20.0], [20.0], 25.0, [20.0, math.inf], [20.0, None], [True, 20.0], ["1", "2"])
    ),
]


@pytest.mark.parametrize(("key", "value", "words"), WRONG)
def test_wrong_values_are_refused_with_key_and_in_a_joint_file_with_its_name(
    key: str, value: Any, words: str
) -> None:
    mapping = with_envelope(GOOD).to_mapping()
    envelope = {k: v for k, v in (mapping["fused"]["envelope"] | {key: value}).items() if v is not ...}
    mapping["fused"]["envelope"] = envelope
    with pytest.raises(ConfigError) as caught:
        Joint.from_mapping(mapping, "j.yaml")
    assert str(caught.value).startswith(f"j.yaml: key 'fused.envelope.{key}': ")
    assert words in str(caught.value)
    with pytest.raises(FieldError) as error:
        read(Envelope, envelope)
    assert (error.value.key, words in str(error.value)) == (key, True)


@pytest.mark.parametrize("value", [None, [], "x", 3])
def test_an_envelope_that_is_no_mapping(value: object) -> None:
    with pytest.raises(FieldError, match="expected a mapping"):
        read(Envelope, value)
