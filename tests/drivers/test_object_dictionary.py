import json
import struct

import pytest

from jtqd.drivers.emcy import ErrorHistory
from jtqd.drivers.object_dictionary import ObjectStore, entries_from_json, entries_to_json, read_eds
from jtqd.drivers.sdo import SdoAbort
from tests.drivers.canopen_nodes import EDS, drive_store, sensor_store


def code_of(call, *arguments):
    with pytest.raises(SdoAbort) as caught:
        call(*arguments)
    return caught.value.code


def u32(value):
    return struct.pack("<I", value)


def test_defaults_with_the_node_number():
    store = drive_store(5)
    assert store.number(0x1000) == 0x00020192
    assert store.number(0x1014) == 0x085
    assert store.number(0x1800, 1) == 0x40000185
    assert store.number(0x1200, 2) == 0x585
    assert store.number(0x60C2, 2) == -3
    assert store.read(0x60C2, 2) == b"\xfd"
    assert store.read(0x1008, 0) == b"emulated joint drive"


def test_access_rights():
    drive, sensor = drive_store(1), sensor_store(3)
    assert code_of(drive.write, 0x1000, 0, u32(1)) == 0x06010002  # ro
    assert code_of(drive.write, 0x1008, 0, b"x") == 0x06010002  # const
    assert code_of(sensor.read, 0x6125, 1) == 0x06010001  # wo
    sensor.write(0x6125, 1, u32(0x6F72657A))
    assert sensor.number(0x6125, 1) == 0x6F72657A
    drive.write(0x6040, 0, b"\x0f\x00")  # rww is writable
    assert drive.read(0x6040, 0) == b"\x0f\x00"


def test_absent_objects_and_subindices():
    store = drive_store(1)
    for call, rest in ((store.read, ()), (store.write, (b"\0",))):
        assert code_of(call, 0x6099, 0, *rest) == 0x06020000
        assert code_of(call, 0x608F, 3, *rest) == 0x06090011
        assert code_of(call, 0x1800, 4, *rest) == 0x06090011  # reserved sub-index
        assert code_of(call, 0x0005, 0, *rest) == 0x06020000  # dummy types are no objects


def test_lengths():
    store = drive_store(1)
    assert code_of(store.write, 0x1017, 0, b"\x01\x00\x00") == 0x06070012
    assert code_of(store.write, 0x1017, 0, b"\x01") == 0x06070013
    assert code_of(store.write, 0x1017, 0, b"") == 0x06070010
    assert store.number(0x1017) == 0


def test_limits_of_unsigned_and_signed():
    store = drive_store(1)
    assert code_of(store.write, 0x6075, 0, u32(0)) == 0x06090030
    assert code_of(store.write, 0x1019, 0, b"\xf1") == 0x06090030
    store.write(0x1019, 0, b"\xf0")
    assert code_of(store.write, 0x60C2, 2, b"\x40") == 0x06090030  # +64, highest is 63
    store.write(0x60C2, 2, b"\x80")  # -128
    assert store.number(0x60C2, 2) == -128


def test_the_device_itself_knows_no_rights():
    store = drive_store(1)
    store.set_number(0x6064, 0, -7)
    assert store.read(0x6064, 0) == b"\xf9\xff\xff\xff"
    with pytest.raises(ValueError, match="6064h:0 Position actual value"):
        store.set_number(0x6064, 0, 2**31)
    with pytest.raises(ValueError, match="not an integer"):
        store.number(0x1008)


def test_real32():
    store = ObjectStore(EDS / "jtqd.eds", 0x20)
    store.set_number(0x2202, 2, 0.5)
    assert store.read(0x2202, 2) == bytes.fromhex("0000003F")


def test_hooks():
    store = drive_store(1)
    store.on_read(0x6064, 0, lambda: -1)
    assert store.read(0x6064, 0) == b"\xff\xff\xff\xff"
    assert store.number(0x6064) == -1
    seen = []

    def refuse_odd(data):
        seen.append(data)
        if data[0] & 1:
            raise SdoAbort(0x08000022)

    store.on_write(0x1017, 0, refuse_odd)
    assert code_of(store.write, 0x1017, 0, b"\x65\x00") == 0x08000022
    assert store.number(0x1017) == 0
    store.write(0x1017, 0, b"\x64\x00")
    assert store.number(0x1017) == 100
    assert seen == [b"\x65\x00", b"\x64\x00"]
    with pytest.raises(SdoAbort):
        store.on_read(0x7777, 0, lambda: 0)


def test_restore_gives_power_on_values_in_its_range():
    store = drive_store(1)
    store.set_number(0x1018, 4, 77)
    store.keep_as_default(0x1018, 4)
    store.write(0x1017, 0, b"\x64\x00")
    store.write(0x6075, 0, u32(9))
    store.restore(0x1000, 0x1FFF)
    assert (store.number(0x1017), store.number(0x6075), store.number(0x1018, 4)) == (0, 9, 77)
    store.restore()
    assert store.number(0x6075) == 5000


def test_node_number_is_checked():
    with pytest.raises(ValueError, match=r"1\.\.127"):
        drive_store(0)


def test_error_history_is_bounded_newest_first_and_cleared_by_zero():
    store = drive_store(1)
    history = ErrorHistory(store)
    for code in range(1, 11):
        history.push(0x8100 + code)
    assert store.number(0x1003, 0) == 8
    assert [store.number(0x1003, n) for n in (1, 2, 8)] == [0x810A, 0x8109, 0x8103]
    assert code_of(store.write, 0x1003, 0, b"\x01") == 0x06090030
    assert store.number(0x1003, 0) == 8
    store.write(0x1003, 0, b"\x00")
    assert [store.number(0x1003, n) for n in (0, 1, 8)] == [0, 0, 0]


def test_entries_survive_json():
    for name, node in (("drive", 1), ("torque_sensor", 3), ("jtqd", 0x20)):
        entries = read_eds(EDS / f"{name}.eds", node)
        again = entries_from_json(json.loads(json.dumps(entries_to_json(entries))))
        assert again == entries
        assert [each.layout.format if each.layout else None for each in again] == [
            each.layout.format if each.layout else None for each in entries
        ]
