"""Conversations as byte transcripts: left the client's eight bytes, right the server's."""

import dataclasses
import random

import pytest

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import SdoAbort
from jtqd.drivers.sdo_server import SdoServer
from tests.drivers.canopen_nodes import EDS, drive_store, sensor_store


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


def test_expedited_upload_of_1_2_and_4_bytes(server):
    talk(
        server,
        """
        40 29 10 01 00 00 00 00 -> 4F 29 10 01 00 00 00 00   # U8: three bytes unused
        40 17 10 00 00 00 00 00 -> 4B 17 10 00 00 00 00 00   # U16
        40 00 10 00 00 00 00 00 -> 43 00 10 00 92 01 02 00   # U32
        """,
    )


def test_expedited_upload_of_three_bytes():
    talk(SdoServer(text_store("abc")), "40 04 22 00 00 00 00 00 -> 47 04 22 00 61 62 63 00")


def test_expedited_download_of_1_2_and_4_bytes(server, store):
    talk(
        server,
        """
        2F 19 10 00 F0 00 00 00 -> 60 19 10 00 00 00 00 00
        2B 17 10 00 64 00 00 00 -> 60 17 10 00 00 00 00 00
        23 16 10 01 F4 01 20 00 -> 60 16 10 01 00 00 00 00
        22 75 60 00 88 13 00 00 -> 60 75 60 00 00 00 00 00   # size not indicated, 4 bytes
        22 17 10 00 65 00 FF FF -> 60 17 10 00 00 00 00 00   # size not indicated: the object's 2 count
        """,
    )
    assert store.number(0x1019) == 240
    assert store.number(0x1017) == 101
    assert store.number(0x1016, 1) == 0x002001F4
    assert store.number(0x6075) == 5000


def test_segmented_upload_with_toggle(server):
    talk(
        server,  # "emulated joint drive", 20 bytes = 7 + 7 + 6
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        70 00 00 00 00 00 00 00 -> 10 64 20 6A 6F 69 6E 74
        60 00 00 00 00 00 00 00 -> 03 20 64 72 69 76 65 00
        70 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # the transfer is over
        """,
    )


def test_upload_of_exactly_seven_bytes_is_one_segment():
    talk(
        SdoServer(text_store("abcdefg")),
        """
        40 04 22 00 00 00 00 00 -> 41 04 22 00 07 00 00 00
        60 00 00 00 00 00 00 00 -> 01 61 62 63 64 65 66 67
        """,
    )


def test_upload_of_nothing_is_an_empty_segment():
    talk(
        SdoServer(text_store("")),
        """
        40 04 22 00 00 00 00 00 -> 41 04 22 00 00 00 00 00
        60 00 00 00 00 00 00 00 -> 0F 00 00 00 00 00 00 00
        """,
    )


def test_segmented_download_of_a_number(server, store):
    talk(
        server,
        """
        21 75 60 00 04 00 00 00 -> 60 75 60 00 00 00 00 00   # size 4 announced
        00 10 27 00 00 00 00 00 -> 80 75 60 00 12 00 07 06   # 7 bytes are more than 4
        21 75 60 00 04 00 00 00 -> 60 75 60 00 00 00 00 00
        07 10 27 00 00 00 00 00 -> 20 00 00 00 00 00 00 00   # n=3 unused, c=1
        """,
    )
    assert store.number(0x6075) == 10000


def test_segmented_download_in_two_segments_without_size(server, store):
    talk(
        server,
        """
        20 75 60 00 00 00 00 00 -> 60 75 60 00 00 00 00 00
        0A 39 30 00 00 00 00 00 -> 20 00 00 00 00 00 00 00   # two bytes, more follows
        1B 00 00 00 00 00 00 00 -> 30 00 00 00 00 00 00 00   # two bytes, toggle 1, last
        """,
    )
    assert store.number(0x6075) == 12345


def test_size_mismatches(server, store):
    talk(
        server,
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
    )
    assert store.number(0x6075) == 5000


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


def test_toggle_errors_end_the_transfer(server, store):
    talk(
        server,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        70 00 00 00 00 00 00 00 -> 80 08 10 00 00 00 03 05
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # nothing runs any more
        20 75 60 00 00 00 00 00 -> 60 75 60 00 00 00 00 00
        0A 39 30 00 00 00 00 00 -> 20 00 00 00 00 00 00 00
        0B 00 00 00 00 00 00 00 -> 80 75 60 00 00 00 03 05   # toggle repeated
        """,
    )
    assert store.number(0x6075) == 5000


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


def test_unknown_commands(server):
    talk(
        server,
        """
        A0 08 10 00 00 00 00 00 -> 80 08 10 00 01 00 04 05   # block upload
        C2 75 60 00 00 00 00 00 -> 80 75 60 00 01 00 04 05   # block download
        E0 00 10 00 00 00 00 00 -> 80 00 10 00 01 00 04 05   # reserved
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05   # segment of no transfer
        00 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
        """,
    )


def test_segment_of_the_other_direction(server):
    talk(
        server,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        01 00 00 00 00 00 00 00 -> 80 08 10 00 01 00 04 05
        """,
    )


def test_abort_by_the_client_ends_silently(server):
    talk(
        server,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        80 08 10 00 00 00 04 05 -> nothing
        60 00 00 00 00 00 00 00 -> 80 00 00 00 01 00 04 05
        """,
    )


def test_a_new_initiate_replaces_the_running_transfer(server):
    talk(
        server,
        """
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        40 08 10 00 00 00 00 00 -> 41 08 10 00 14 00 00 00
        60 00 00 00 00 00 00 00 -> 00 65 6D 75 6C 61 74 65
        """,
    )


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
