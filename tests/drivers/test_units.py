"""Units of a drive's numbers by each of its scaling objects."""

import math

import pytest

from jtqd.drivers.devices import DriveObject, DriveObjects, DriveProfile, drive_scaling
from jtqd.drivers.units import ScalingError

READ = {
    (0x608F, 1): 4096,
    (0x608F, 2): 1,
    (0x6090, 1): 4096,
    (0x6090, 2): 1,
    (0x60E6, 1): 1000,
    (0x60EB, 1): 1,
    (0x6091, 1): 100,
    (0x6091, 2): 1,
    (0x6075, 0): 5000,
    (0x6076, 0): 400,
    (0x6092, 1): 36000,
    (0x6092, 2): 1,
    (0x60A8, 0): 0xFD41_0000,
    (0x60A9, 0): 0xFEB4_4700,
}
TURN = 2.0 * math.pi


def scaled(**objects):
    profile = DriveProfile(1, objects=DriveObjects(**objects), torque_constant_nm_per_a=0.08)
    read = {key: READ[key] for key in profile.scaling_objects}
    return drive_scaling(profile, read)[0], profile


@pytest.mark.parametrize(
    ("name", "given", "expected"),
    [
        ("motor_position", {"by": "608Fh"}, TURN / 4096),
        ("motor_position", {"by": "6092h"}, TURN / 36000 * 100),  # 0.01 degree of the joint
        ("motor_position", {"by": "6092h", "shaft": "motor"}, TURN / 36000),
        ("motor_position", {"by": "60A8h"}, math.radians(0.001) * 100),
        ("motor_position", {"by": "60A8h", "shaft": "motor", "sign": -1}, -math.radians(0.001)),
        ("link_position", {"by": "60A8h"}, math.radians(0.001)),
        ("link_position", {"by": "6092h"}, TURN / 36000),
        ("motor_velocity", {"by": "608Fh"}, TURN / 4096),
        ("motor_velocity", {"by": "60A9h", "shaft": "motor"}, TURN / 60 * 0.01),  # 0.01 rpm
        ("motor_velocity", {"by": "60A9h"}, TURN / 60 * 0.01 * 100),
        ("motor_velocity", {"by": "6092h", "shaft": "motor"}, TURN / 36000),
        ("current", {"by": "6075h"}, 0.005),
        ("current", {"by": "6076h"}, 0.4 / 1000 / 0.08),  # 1/1000 of 400 mNm
        ("current", {"by": "6076h", "sign": -1}, -0.4 / 1000 / 0.08),
        ("current", {"factor": 0.001, "sign": -1}, -0.001),
    ],
)
def test_by_each_object(name, given, expected):
    scaling, profile = scaled(**{name: DriveObject(0x2000, **given)})
    fields = {
        "motor_position": "motor_rad_per_count",
        "motor_velocity": "motor_rad_s_per_unit",
        "link_position": "link_rad_per_count",
        "current": "ampere_per_unit",
    }
    assert getattr(scaling, fields[name]) == pytest.approx(expected, rel=1e-12)
    if "by" in given:
        index = int(given["by"][:4], 16)
        assert index in {key[0] for key in profile.scaling_objects}, "it is read, and watched in service"


def test_what_a_drive_does_not_have_is_not_scaled():
    scaling, profile = scaled(link_position=None, motor_velocity=None)
    assert scaling.link_rad_per_count == scaling.motor_rad_s_per_unit == 0.0
    assert {key[0] for key in profile.scaling_objects} == {0x608F, 0x6091, 0x6075}
    assert [pdo.words for pdo in profile.tpdos] == [(0x6064_0020,), (0x6078_0010, 0x6041_0010)]


@pytest.mark.parametrize(
    ("key", "by", "word", "text"),
    [
        ((0x60A8, 0), "60A8h", 0x00B5_0000, "SI unit position: expected 0xXX100000 (rad), "),
        ((0x60A8, 0), "60A8h", 0x0041_0300, "found 0x00410300"),
        ((0x60A9, 0), "60A9h", 0x00B4_4800, "SI unit velocity: expected 0xXX10, 0xXX41 or 0xXXB4"),
        ((0x60A8, 0), "60A8h", 0, "SI unit position: expected 1..4294967295, found 0"),
        (
            (0x6092, 2),
            "6092h",
            0,
            "feed constant, driving shaft revolutions: expected 1..2147483648, found 0",
        ),
    ],
)
def test_a_value_that_scales_nothing_is_named(key, by, word, text):
    name = "motor_velocity" if by == "60A9h" else "motor_position"
    profile = DriveProfile(1, objects=DriveObjects(**{name: DriveObject(0x2000, by=by)}))
    with pytest.raises(ScalingError) as caught:
        drive_scaling(profile, READ | {key: word})
    assert caught.value.key == key
    assert text in f"{caught.value.name}: {caught.value}"
