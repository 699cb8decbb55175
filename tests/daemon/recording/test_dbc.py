"""The DBC text, read by cantools and tried on frames as candump writes them."""

import math
from types import SimpleNamespace

import cantools
import pytest

from jtqd.daemon.core.estimate_pdo import encode
from jtqd.daemon.recording.dbc import Quantity, dbc_of, dbc_text
from jtqd.drivers.drive import CIA_402, Temperature, drive_layout
from jtqd.drivers.pdo import MappedObject, PdoMap

TURN = 2 * math.pi
SCALING = {
    "motor_rad_per_count": TURN / 65536,
    "motor_rad_s_per_unit": TURN / 65536,
    "link_rad_per_count": TURN / 524288,
    "ampere_per_unit": 0.0043,
}


def drive(number, *, temperature=None):
    return SimpleNamespace(
        number=number,
        node_id=number,
        temperature=temperature,
        objects=CIA_402,
        tpdos=drive_layout(number),
    )


@pytest.fixture(scope="module")
def database():
    joints = (
        drive(1),
        drive(2, temperature=Temperature()),
        drive(4, temperature=Temperature(0x2040, 1, 0.01)),
    )
    config = SimpleNamespace(
        counter_overflow=240,
        node_id=0x20,
        joints=joints,
        sensor=SimpleNamespace(node_id=3, channels=(1, 2)),
        contact=SimpleNamespace(pdo=True),
    )
    nodes = {"1": {"scaling": SCALING}, "2": {"scaling": SCALING | {"ampere_per_unit": 0.002}}}
    nodes["3"] = {"scaling": {"nm_per_unit": {"1": 0.001, "2": 0.01}}}
    return cantools.database.load_string(dbc_text(config, {"nodes": nodes}), "dbc")


def decode(database, line):
    """A line of candump: 181#0000010000000800."""
    identifier, data = line.split("#")
    return database.decode_message(int(identifier, 16), bytes.fromhex(data))


def test_every_frame_of_the_bus_is_there(database):
    expected = {0x080: 1, 0x181: 8, 0x281: 8, 0x182: 8, 0x282: 8, 0x183: 5, 0x283: 3, 0x1A0: 8, 0x3A0: 4}
    expected |= {0x184: 8, 0x284: 8, 0x2A0: 8, 0x4A0: 4}
    expected |= {0x382: 2, 0x384: 2}  # the first drive tells no temperature
    for node in (1, 2, 3, 4, 0x20):
        expected |= {0x080 + node: 8, 0x700 + node: 1}
    assert {message.frame_id: message.length for message in database.messages} == expected
    assert database.get_message_by_frame_id(0x182).name == "drive_2_TPDO1"
    assert database.get_message_by_frame_id(0x281).senders == ["drive_1"]


def test_contact(database):
    """Joint 1: +640 Nm/s, pushed along its direction; joint 2 not known; SYNC 17."""
    values = decode(database, "3A0#14" + "80" + "13" + "11")
    assert values["torque_rate_1"] == 640.0
    assert (values["torque_rate_2"], values["contact_1"], values["contact_2"]) == (
        "no_rate",
        "positive",
        "unknown",
    )
    assert values["sequence"] == 17


def test_drive_position(database):
    """65536 counts are one motor turn; -524288 counts one joint turn backwards."""
    values = decode(database, "181#00000100" + "0000F8FF")
    assert values["motor_position"] == pytest.approx(TURN, rel=1e-12)
    assert values["link_position"] == pytest.approx(-TURN, rel=1e-12)


def test_drive_motion(database):
    """-65536 counts/s, current -100 and statusword 1237h; the second drive has its own ampere per unit."""
    values = decode(database, "281#0000FFFF" + "9CFF" + "3712")
    assert values["motor_velocity"] == pytest.approx(-TURN)
    assert values["current"] == pytest.approx(-0.43)
    assert values["statusword"] == 0x1237
    assert decode(database, "282#00000000" + "9CFF" + "3712")["current"] == pytest.approx(-0.2)


def test_temperature(database):
    assert decode(database, "382#0501") == {"temperature": pytest.approx(26.1)}
    assert decode(database, "382#F6FF") == {"temperature": pytest.approx(-1.0)}
    assert decode(database, "384#0501") == {"temperature": pytest.approx(2.61)}, "in its object's own unit"
    assert decode(database, "382#0080") == {"temperature": "not_measured"}


def test_sensor(database):
    values = decode(database, "183#18FCFFFF" + "02")
    assert (values["torque_1"], values["torque_status_1"]) == (pytest.approx(-1.0), 2)
    assert decode(database, "283#18FC" + "00")["torque_2"] == pytest.approx(-10.0)


def test_estimate(database):
    """12.34 Nm with sigma 0.5 Nm of joint 1; joint 2 stale: no torque, sigma unknown."""
    data = encode((1234, 10, 2), (-0x8000, 255, 4), 240)
    assert data.hex() == "d20400800aff42f0"
    values = decode(database, "1A0#" + data.hex())
    assert values["torque_1"] == pytest.approx(12.34)
    assert values["sigma_1"] == pytest.approx(0.5)
    assert (values["torque_2"], values["sigma_2"]) == ("no_torque", "unknown")
    assert (values["status_1"], values["status_2"], values["sequence"]) == ("valid", "stale", 240)


def test_services(database):
    assert decode(database, "080#F0") == {"sync_counter": 240}
    assert decode(database, "701#05") == {"nmt_state": "operational"}
    values = decode(database, "081#2023" + "04" + "0100000000")
    assert values == {"error_code": 0x2320, "error_register": 4, "manufacturer_error": 1}


def test_without_a_sensor():
    joints = tuple(drive(n) for n in (1, 2))
    config = SimpleNamespace(counter_overflow=0, node_id=0x20, joints=joints, sensor=None, contact=None)
    text = dbc_text(config, {"nodes": {"1": {"scaling": SCALING}, "2": {"scaling": SCALING}}})
    assert "torque_sensor" not in text
    assert len(cantools.database.load_string(text, "dbc").messages) == 1 + 5 + 2 * 3


def test_objects_without_name_and_mapped_in_any_order():
    pdo = PdoMap(0x381, (MappedObject(0x2000, 1, 8, True), MappedObject(0x2001, 0, 32, False, "count")))
    quantities = {(0x381, 0x2001, 0): Quantity(0.5, "s")}
    text = dbc_of([pdo], quantities, {1: "box"}, sync_producer=1, sync_counter=True)
    assert "BO_ 128 SYNC: 1 box" in text
    values = cantools.database.load_string(text, "dbc").decode_message(0x381, bytes.fromhex("ff 03000000"))
    assert values == {"object_2000_1": -1, "count": 1.5}


@pytest.mark.parametrize(("cob_id", "names"), [(0x201, {1: "box"}), (0x181, {2: "box"})])
def test_unknown_sender_is_refused(cob_id, names):
    with pytest.raises(ValueError, match=f"{cob_id:X}h"):
        dbc_of(
            [PdoMap(cob_id, (MappedObject(0x2000, 0, 8, False),))], {}, names, sync_producer=next(iter(names))
        )
