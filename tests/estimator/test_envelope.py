"""The envelope in a joint file: written as rows of 0 and 1, read back, refused where it is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Envelope, Joint
from tests.estimator.fused_helpers import fused_joint

MAP = ((0, 1, 0), (1, 1, 1), (0, 1, 0))
GOOD = Envelope(0.25, 3.0, MAP, 4.0, (20.0, 30.0))


def section(**changes: Any) -> dict[str, Any]:
    mapping = joint(GOOD).to_mapping()
    mapping["fused"]["envelope"] |= changes
    return mapping


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"known": [[0, 1, 0]]}, "key 'fused.envelope.known': found"),
        ({"known": ["01", "10"]}, "expected odd numbers of rows"),
        ({"known": ["012"]}, "rows as texts such as"),
        ({"known": []}, "key 'fused.envelope.known'"),
        ({"known": ["0" * 129]}, "expected at most 127"),
        ({"distance_nm": 0.0}, "key 'fused.envelope.distance_nm': found 0"),
        ({"torque_step_nm": "3 Nm"}, "key 'fused.envelope.torque_step_nm'"),
        ({"temperature_c": [30.0, 20.0]}, "key 'fused.envelope.temperature_c'"),
        ({"kown": 1}, "fused.envelope.kown"),
    ],
)
def test_what_is_none_is_refused_with_file_and_key(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=r"^j\.yaml: ") as caught:
        Joint.from_mapping(section(**changes), "j.yaml")
    assert message in str(caught.value)
