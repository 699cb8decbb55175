"""Option --trust: how far a value may be off, in percent or in its unit, as a factor on the default."""

from dataclasses import replace

import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.scope import trusted
from jtqd.sysid.runs.options import UsageError

JOINT = load_joint(shipped("joint1.yaml"))


@pytest.mark.parametrize(
    ("item", "factor"),
    [
        ("sensor_gain=5%", 5.0),
        ("sensor_gain=0.5 %", 0.5),
        ("coulomb_friction=50%", 0.5),
        ("coulomb_friction=1.5Nm", 0.5),  # of the file's 3 Nm
        ("rotor_inertia=1.4e-5kgm2", 1.0),  # 20 % of 7e-5
        ("channel_delay=6ms", 2.0),
        ("channel_delay=0.006s", 2.0),
        ("encoder_eccentricity.motor=10mrad", 2.0),
        ("lost_motion=30urad", 0.1),
    ],
)
def test_how_far_a_value_may_be_off_is_a_factor_on_its_prior(item: str, factor: float) -> None:
    name = item.partition("=")[0]
    assert trusted([item], {1: JOINT}) == pytest.approx({name: factor})


@pytest.mark.parametrize(
    ("items", "wanted"),
    [
        (["gravity=5%"], "found 'gravity', expected NAME=SIZE with one of channel_delay, "),
        (["sensor_gain"], "found '', expected a number above 0 with a unit: % (default 1 %)"),
        (["sensor_gain=wide%"], "found 'wide%', expected a number above 0"),
        (["sensor_gain=0%"], "found '0%', expected a number above 0"),
        (["sensor_gain=1.2.3%"], "found '1.2.3%', expected a number above 0"),
        (["sensor_gain=0.05"], "found 'no unit', expected % (default 1 %)"),
        (["sensor_gain=5Nm"], "found 'Nm', expected %"),
        (["channel_delay=5%"], "found '%', expected s (default 3 ms)"),
        (["lost_motion=1mNm"], "found 'mNm', expected rad"),
        (["viscous_friction=3Nms/rad"], "found Nms/rad, expected %"),  # of the usual speed
        (["sensor_gain=5%", "sensor_gain=2%"], "found sensor_gain twice"),
    ],
)
def test_a_wrong_trust_is_one_line(items: list[str], wanted: str) -> None:
    with pytest.raises(UsageError) as caught:
        trusted(items, {1: JOINT})
    assert wanted in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_size_in_a_unit_is_one_factor_or_refused() -> None:
    joints = {1: JOINT, 2: replace(JOINT, friction=replace(JOINT.friction, coulomb_nm=9.0))}
    assert trusted(["coulomb_friction=50%", "channel_delay=6ms"], joints) == {
        "coulomb_friction": 0.5,
        "channel_delay": 2.0,
    }
    with pytest.raises(UsageError, match="found Nm, expected %: the default"):
        trusted(["coulomb_friction=2Nm"], joints)
