import dataclasses
import json
import random
import struct

import pytest

from jtqd.drivers.emcy import ErrorHistory
from jtqd.drivers.object_dictionary import (
    ObjectStore,
    SdoServer,
    entries_from_json,
    entries_to_json,
    read_eds,
)
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
        entries = list(read_eds(EDS / f"{name}.eds", node).entries)
        again = entries_from_json(json.loads(json.dumps(entries_to_json(entries))))
        assert again == entries
        assert [each.layout.format if each.layout else None for each in again] == [
            each.layout.format if each.layout else None for each in entries
        ]


# SDO server


@pytest.fixture
def store():
    return drive_store(1)


@pytest.fixture
def server(store):
    return SdoServer(store)


def talk(server, transcript):
    for line in transcript.strip().splitlines():
        request, _, reply = line.split("#")[0].partition("->")
        answer = server.handle(bytes.fromhex(request))
        expected = bytes.fromhex(reply) if reply.strip() != "nothing" else None
        assert answer == expected, f"{line.strip()}: got {answer.hex(' ') if answer else answer}"


def text_store(text):
    store = ObjectStore(EDS / "jtqd.eds", 0x20)
    store.set_text(0x2204, 0, text)
    return store


TRANSCRIPTS = {
    "expedited_upload_of_three_bytes": ("abc", "40 04 22 00 00 00 00 00 -> 47 04 22 00 61 62 63 00", {}),
    "expedited_upload_of_1_2_and_4_bytes": (
        None,
        """
        40 29 10 01 00 00 00 00 -> 4F 29 10 01 00 00 00 00   # U8: three bytes unused
        40 17 10 00 00 00 00 00 -> 4B 17 10 00 00 00 00 00   # U16
        40 00 10 00 00 00 00 00 -> 43 00 10 00 92 01 02 00   # U32
        """,
        {},
    ),
    "expedited_download_of_1_2_and_4_bytes": (
        None,
        """
        2F 19 10 00 F0 00 00 00 -> 60 19 10 00 00 00 00 00
        2B 17 10 00 64 00 00 00 -> 60 17 10 00 00 00 00 00
        23 16 10 01 F4 01 20 00 -> 60 16 10 01 00 00 00 00
        22 75 60 00 88 13 00 00 -> 60 75 60 00 00 00 00 00   # size not indicated, 4 bytes
        22 17 10 00 65 00 FF FF -> 60 17 10 00 00 00 00 00   # size not indicated: the object's 2 count
        """,
        {(0x1019, 0): 240, (0x1017, 0): 101, (0x1016, 1): 0x002001F4, (0x6075, 0): 5000},
    ),
    "segmented_upload_with_toggle": (
        None,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        70 00 00 00 00 00 00 00 -> 10 64 20 6A 6F 69 6E 74
        60 00 00 00 00 00 00 00 -> 03 20 64 72 69 76 65 00
        70 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # the transfer is over
        """,
        {},
    ),
    "upload_of_exactly_seven_bytes_is_one_segment": (
        "abcdefg",
        """
        40 04 22 00 00 00 00 00 -> 41 04 22 00 07 00 00 00
        60 00 00 00 00 00 00 00 -> 01 61 62 63 64 65 66 67
        """,
        {},
    ),
    "upload_of_nothing_is_an_empty_segment": (
        "",
        """
        40 04 22 00 00 00 00 00 -> 41 04 22 00 00 00 00 00
        60 00 00 00 00 00 00 00 -> 0F 00 00 00 00 00 00 00
        """,
        {},
    ),
    "segmented_download_of_a_number": (
        None,
        """
        21 75 60 00 04 00 00 00 -> 60 75 60 00 00 00 00 00   # size 4 announced
        00 10 27 00 00 00 00 00 -> 80 75 60 00 12 00 07 06   # 7 bytes are more than 4
        21 75 60 00 04 00 00 00 -> 60 75 60 00 00 00 00 00
        07 10 27 00 00 00 00 00 -> 20 00 00 00 00 00 00 00   # n=3 unused, c=1
        """,
        {(0x6075, 0): 10000},
    ),
    "segmented_download_in_two_segments_without_size": (
        None,
        """
        20 75 60 00 00 00 00 00 -> 60 75 60 00 00 00 00 00
        0A 39 30 00 00 00 00 00 -> 20 00 00 00 00 00 00 00   # two bytes, more follows
        1B 00 00 00 00 00 00 00 -> 30 00 00 00 00 00 00 00   # two bytes, toggle 1, last
        """,
        {(0x6075, 0): 12345},
    ),
    "size_mismatches": (
        None,
        """
        2F 75 60 00 01 00 00 00 -> 80 75 60 00 13 00 07 06   # 1 byte into a U32
        23 17 10 00 01 00 00 00 -> 80 17 10 00 12 00 07 06   # 4 bytes into a U16
        21 75 60 00 05 00 00 00 -> 80 75 60 00 12 00 07 06   # announced 5 bytes for a U32
        21 75 60 00 00 00 00 00 -> 80 75 60 00 10 00 07 06   # announced none
        21 75 60 00 04 00 00 00 -> 60 75 60 00 00 00 00 00
        0B 01 00 00 00 00 00 00 -> 80 75 60 00 13 00 07 06   # last, but 2 of 4 bytes came
        20 75 60 00 00 00 00 00 -> 60 75 60 00 00 00 00 00
        0B 01 00 00 00 00 00 00 -> 80 75 60 00 13 00 07 06   # not announced, found by the object
        """,
        {(0x6075, 0): 5000},
    ),
    "toggle_errors_end_the_transfer": (
        None,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        70 00 00 00 00 00 00 00 -> 80 08 10 00 00 00 03 05
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # nothing runs any more
        20 75 60 00 00 00 00 00 -> 60 75 60 00 00 00 00 00
        0A 39 30 00 00 00 00 00 -> 20 00 00 00 00 00 00 00
        0B 00 00 00 00 00 00 00 -> 80 75 60 00 00 00 03 05   # toggle repeated
        """,
        {(0x6075, 0): 5000},
    ),
    "unknown_commands": (
        None,
        """
        A0 08 10 00 00 00 00 00 -> 80 08 10 00 01 00 04 05   # block upload
        C2 75 60 00 00 00 00 00 -> 80 75 60 00 01 00 04 05   # block download
        E0 00 10 00 00 00 00 00 -> 80 00 10 00 01 00 04 05   # reserved
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # segment of no transfer
        00 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
        """,
        {},
    ),
    "segment_of_the_other_direction": (
        None,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        01 00 00 00 00 00 00 00 -> 80 08 10 00 01 00 04 05
        """,
        {},
    ),
    "abort_by_the_client_ends_silently": (
        None,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        80 08 10 00 00 00 04 05 -> nothing
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
        """,
        {},
    ),
    "a_new_initiate_replaces_the_running_transfer": (
        None,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        """,
        {},
    ),
}
"""Name -> (text of 2204h, None: a drive; requests and replies; numbers afterwards)."""


@pytest.mark.parametrize("name", TRANSCRIPTS)
def test_transcripts(name):
    text, transcript, numbers = TRANSCRIPTS[name]
    store = drive_store(1) if text is None else text_store(text)
    talk(SdoServer(store), transcript)
    assert {key: store.number(*key) for key in numbers} == numbers


def test_a_string_shorter_than_announced_is_refused():
    store = text_store("old")
    store.entries[0x2204, 0] = dataclasses.replace(store.entries[0x2204, 0], access="rw")
    talk(
        SdoServer(store),
        """
        21 04 22 00 05 00 00 00 -> 60 04 22 00 00 00 00 00   # 5 bytes announced
        07 61 62 63 64 00 00 00 -> 80 04 22 00 13 00 07 06   # 4 came, and no more follow
        21 04 22 00 08 00 00 00 -> 60 04 22 00 00 00 00 00
        00 61 62 63 64 65 66 67 -> 20 00 00 00 00 00 00 00
        1D 68 00 00 00 00 00 00 -> 30 00 00 00 00 00 00 00
        """,
    )
    assert store.read(0x2204, 0) == b"abcdefgh"


def test_rights_and_absence(server):
    talk(
        server,
        """
        23 00 10 00 00 00 00 00 -> 80 00 10 00 02 00 01 06   # read only
        21 08 10 00 05 00 00 00 -> 80 08 10 00 02 00 01 06   # read only, refused at once
        40 99 60 00 00 00 00 00 -> 80 99 60 00 00 00 02 06   # no object
        2F 99 60 00 00 00 00 00 -> 80 99 60 00 00 00 02 06
        40 8F 60 03 00 00 00 00 -> 80 8F 60 03 11 00 09 06   # no sub-index
        23 75 60 00 00 00 00 00 -> 80 75 60 00 30 00 09 06   # below LowLimit
        """,
    )
    talk(SdoServer(sensor_store(3)), "40 25 61 01 00 00 00 00 -> 80 25 61 01 01 00 01 06   # write only")


def test_an_abort_of_the_hook_reaches_the_client(server, store):
    def refuse(_data):
        raise SdoAbort(0x08000022)

    store.on_write(0x1017, 0, refuse)
    talk(server, "2B 17 10 00 64 00 00 00 -> 80 17 10 00 22 00 00 08")


@pytest.mark.parametrize("length", [0, 1, 7, 9])
def test_a_request_that_is_not_eight_bytes_is_ignored(server, length):
    assert server.handle(bytes([0x40] + [0] * 8)[:length]) is None


def test_a_download_without_end_is_bounded(server, store):
    server.handle(bytes.fromhex("20 75 60 00 00 00 00 00"))
    for number in range(4096 // 7 + 1):
        reply = server.handle(bytes([(number & 1) << 4]) + bytes(7))
    assert reply == bytes.fromhex("80 75 60 00 05 00 04 05")


def test_fuzz_every_answer_is_eight_bytes_and_read_only_stays(store, server):
    seed = 20260501
    print(f"seed {seed}")
    rng = random.Random(seed)
    keys = list(store.entries)
    fixed = {key: store.read(*key) for key, entry in store.entries.items() if not entry.writable}
    for _ in range(30_000):
        request = bytearray(rng.randbytes(8))
        if rng.random() < 0.7:
            index, subindex = rng.choice(keys)
            request[1:4] = index.to_bytes(2, "little") + bytes([subindex])
        reply = server.handle(bytes(request))
        assert (reply is None) == (request[0] >> 5 == 4)
        assert reply is None or len(reply) == 8
    assert {key: store.read(*key) for key in fixed} == fixed
