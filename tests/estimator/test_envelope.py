"""The envelope in a joint file and in a network's metadata: read back, and refused where it cannot be."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest

from jtqd.estimator.decoder import FieldError, read
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Envelope, Joint
from tests.estimator.fused_helpers import everywhere, fused_joint

MAP = ((0, 1, 0), (1, 1, 1), (0, 1, 0))
GOOD = Envelope(0.25, 3.0, MAP, 4.0, (20.0, 30.0))


def joint(envelope: Envelope | None) -> Joint:
    plain = fused_joint()
    assert plain.fused is not None
    return replace(plain, fused=replace(plain.fused, envelope=envelope))


@pytest.mark.parametrize(
    "envelope", [GOOD, replace(GOOD, temperature_c=None), replace(GOOD, load_nm=38.5), None]
)
def test_a_joint_file_holds_it(envelope: Envelope | None) -> None:
    mapping = joint(envelope).to_mapping()
    assert Joint.from_mapping(mapping, "j.yaml") == joint(envelope)
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
    mapping = joint(GOOD).to_mapping()
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
