"""Drives and torque sensors: identity, PDOs, scaling to SI by the objects that are named."""

import math

import pytest

from jtqd.drivers.drive import (
    DriveObject,
    DriveObjects,
    DriveProfile,
    ScalingError,
    drive_scaling,
    drive_tpdo1,
    drive_tpdo2,
    drive_tpdo3,
)
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.drivers.sdo import parse_key
from jtqd.drivers.sensor import SensorProfile, sensor_scaling, sensor_tpdo1, sensor_tpdo2

DRIVE = {
    (0x608F, 1): 65536,
    (0x608F, 2): 1,
    (0x6090, 1): 65536,
    (0x6090, 2): 1,
    (0x60E6, 1): 524288,
    (0x60EB, 1): 1,
    (0x6091, 1): 201,
    (0x6091, 2): 2,
    (0x6075, 0): 5000,
}
SENSOR = {(0x6131, 1): 0x00230000, (0x6132, 1): 3}


def test_maps_are_those_of_the_bus_layout():
    assert (drive_tpdo1(2).cob_id, drive_tpdo1(2).words) == (0x182, (0x60640020, 0x60E40120))
    assert (drive_tpdo2(1).cob_id, drive_tpdo2(1).words) == (0x281, (0x606C0020, 0x60780010, 0x60410010))
    assert (sensor_tpdo1(3).cob_id, sensor_tpdo1(3).words) == (0x183, (0x91300120, 0x61500108))
    assert (sensor_tpdo2(3).cob_id, sensor_tpdo2(3).words) == (0x283, (0x71300210, 0x61500208))
    temperature = drive_tpdo3(2)
    assert (temperature.cob_id, temperature.words, temperature.transmission_type) == (
        0x382,
        (0x30010010,),
        255,
    )
    lengths = [drive_tpdo1(1).length, drive_tpdo2(1).length, sensor_tpdo1(3).length, sensor_tpdo2(3).length]
    assert lengths == [8, 8, 5, 3]


def test_estimate_frame_byte_by_byte():
    pdo = estimate_tpdos(2)[0]
    assert pdo.cob_id == 0x1A0
    # -12.34 Nm, none (8000h), sigma 0.05 * 7, unknown, joint 1 valid (2), joint 2 stale (4), SYNC 240
    frame = bytes.fromhex("2E FB  00 80  07 FF  42  F0")
    assert pdo.layout.unpack(frame) == (-1234, -32768, 7, 255, 0x42, 240)


def test_drive_scaling_in_si():
    scaling, gear_ratio = drive_scaling(DriveProfile(1), DRIVE)
    assert scaling.motor_rad_per_count * 65536 == pytest.approx(2 * math.pi)
    assert scaling.motor_rad_s_per_unit * 65536 == pytest.approx(2 * math.pi)
    assert scaling.link_rad_per_count * 524288 == pytest.approx(2 * math.pi)
    assert scaling.ampere_per_unit * 1000 == pytest.approx(5.0)  # 1000 permille of 5000 mA
    assert gear_ratio == 100.5


def test_encoders_of_several_revolutions():
    values = {**DRIVE, (0x608F, 2): 4, (0x6090, 2): 3, (0x60EB, 1): 2}
    scaling, _ = drive_scaling(DriveProfile(1), values)
    assert scaling.motor_rad_per_count * 65536 == pytest.approx(8 * math.pi)
    assert scaling.motor_rad_s_per_unit * 65536 == pytest.approx(6 * math.pi)
    assert scaling.link_rad_per_count * 524288 == pytest.approx(4 * math.pi)


@pytest.mark.parametrize("key", list(DRIVE))
def test_zero_is_refused_by_name(key):
    with pytest.raises(ScalingError) as caught:
        drive_scaling(DriveProfile(2), {**DRIVE, key: 0})
    error = caught.value
    assert (error.key, error.found) == (key, "0")
    assert error.expected.startswith("1..")


def test_given_values_replace_objects():
    profile = DriveProfile(1, given={(0x6091, 1): 50, (0x6091, 2): 1})
    assert (0x6091, 1) not in profile.scaling_objects
    assert drive_scaling(profile, {**DRIVE, (0x6091, 1): 0})[1] == 50


@pytest.mark.parametrize(
    ("word", "decimals", "nm"),
    [(0x00230000, 0, 1.0), (0x00230000, 3, 1e-3), (0xFD230000, 0, 1e-3), (0x03230000, 2, 10.0)],
)
def test_sensor_units(word, decimals, nm):
    values = {(0x6131, 1): word, (0x6132, 1): decimals}
    assert sensor_scaling(SensorProfile(3), values).nm_per_unit == {1: pytest.approx(nm)}


def test_each_channel_has_its_own_decimals():
    values = {**SENSOR, (0x6131, 2): 0x00230000, (0x6132, 2): 2}
    scaling = sensor_scaling(SensorProfile(3, channels=(1, 2)), values)
    assert scaling.nm_per_unit == {1: pytest.approx(1e-3), 2: pytest.approx(1e-2)}


@pytest.mark.parametrize("word", [0x004E0000, 0x00210000, 0x00230100, 0x00230001, 0])
def test_other_units_are_refused(word):
    with pytest.raises(ScalingError, match=f"expected .*, found 0x{word:08X}") as caught:
        sensor_scaling(SensorProfile(3), {**SENSOR, (0x6131, 1): word})
    assert (caught.value.key, caught.value.name) == ((0x6131, 1), "physical unit")


def test_a_vendor_word_is_accepted_when_given():
    profile = SensorProfile(3, unit_words={0x00560000: 0.5})
    values = {(0x6131, 1): 0x00560000, (0x6132, 1): 1}
    assert sensor_scaling(profile, values).nm_per_unit[1] == pytest.approx(0.05)


def test_decimals_are_bounded():
    with pytest.raises(ScalingError, match=r"expected 0\.\.9, found 10") as caught:
        sensor_scaling(SensorProfile(3), {**SENSOR, (0x6132, 1): 10})
    assert (caught.value.key, caught.value.name) == ((0x6132, 1), "decimal digits")


def test_keys():
    assert parse_key("608Fh:1") == (0x608F, 1)
    assert parse_key("6075h") == (0x6075, 0)
    for bad in ("608f:1", "608Fh:x", "", "608Fh:1:2"):
        with pytest.raises(ValueError, match=r".*"):
            parse_key(bad)


def test_objects_of_a_drive_with_factors_and_signs_of_their_own():
    """A factor of its own needs no scaling object, and a sign turns either kind."""
    objects = DriveObjects(
        current=DriveObject(0x2030, 0, 16, sign=-1, factor=0.001),
        motor_velocity=DriveObject(0x2031, 0, 16, factor=0.1),
        link_position=DriveObject(0x60E4, 1, sign=-1),
    )
    profile = DriveProfile(1, objects=objects)
    assert profile.tpdos[1].words == (0x20310010, 0x20300010, 0x60410010)
    read = {
        (0x608F, 1): 65536,
        (0x608F, 2): 1,
        (0x60E6, 1): 4096,
        (0x60EB, 1): 1,
        (0x6091, 1): 100,
        (0x6091, 2): 1,
    }
    assert set(profile.scaling_objects) == set(read)
    scaling, gear = drive_scaling(profile, read)
    assert scaling.ampere_per_unit == -0.001
    assert scaling.motor_rad_s_per_unit == 0.1
    assert scaling.link_rad_per_count == pytest.approx(-2.0 * math.pi / 4096)
    assert scaling.motor_rad_per_count == pytest.approx(2.0 * math.pi / 65536)
    assert gear == 100.0


# Units


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
