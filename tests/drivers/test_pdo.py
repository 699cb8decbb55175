import re
import struct

import pytest

from jtqd.drivers.pdo import MappedObject, PdoError, PdoMap, split_word

POSITION = MappedObject(0x6064, 0, 32, True, "position")
VELOCITY = MappedObject(0x606C, 0, 32, True, "velocity")
CURRENT = MappedObject(0x6078, 0, 16, True, "current")
STATUSWORD = MappedObject(0x6041, 0, 16, False, "statusword")
STATUS = MappedObject(0x6150, 1, 8, False, "status")


def test_transcript_of_a_drive_pdo():
    pdo = PdoMap(0x281, (VELOCITY, CURRENT, STATUSWORD))
    # -1000 inc/s little endian, -2 permille, statusword 0x9627
    frame = bytes.fromhex("18 FC FF FF  FE FF  27 96")
    assert pdo.layout.unpack(frame) == (-1000, -2, 0x9627)
    assert pdo.layout.pack(-1000, -2, 0x9627) == frame
    assert pdo.length == 8
    assert pdo.words == (0x606C0020, 0x60780010, 0x60410010)
    assert pdo.names == ("velocity", "current", "statusword")


def test_no_padding_between_odd_lengths():
    pdo = PdoMap(0x183, (STATUS, POSITION))
    assert pdo.length == 5
    assert pdo.layout.unpack(bytes.fromhex("05 00 00 00 80")) == (5, -(2**31))


@pytest.mark.parametrize(("bits", "letter"), [(8, "b"), (16, "h"), (32, "i"), (64, "q")])
def test_every_length_round_trips_at_its_ends(bits, letter):
    for signed in (True, False):
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        layout = PdoMap(0x181, (MappedObject(0x2000, 0, bits, signed),)).layout
        for value in (low, high):
            data = layout.pack(value)
            assert data == value.to_bytes(bits // 8, "little", signed=signed)
            assert layout.unpack(data) == (value,)
        with pytest.raises(struct.error):
            layout.pack(high + 1)


@pytest.mark.parametrize("bits", [0, 1, 7, 12, 24, 40, 128])
def test_partial_objects_are_refused(bits):
    with pytest.raises(PdoError, match=rf"6064h:0: {bits} bits mapped"):
        MappedObject(0x6064, 0, bits, True)


@pytest.mark.parametrize("index", [0x0005, 0x0FFF, 0x10000])
def test_dummy_entries_and_nonsense_are_refused(index):
    with pytest.raises(PdoError, match="no such object"):
        MappedObject(index, 0, 8, False)


def test_more_than_a_frame_is_refused():
    with pytest.raises(PdoError, match="PDO 181h: 9 bytes mapped, a frame holds 8"):
        PdoMap(0x181, (POSITION, VELOCITY, STATUS))


def test_empty_is_refused():
    with pytest.raises(PdoError, match="maps no object"):
        PdoMap(0x181, ())


@pytest.mark.parametrize("cob_id", [0x000, 0x080, 0x180, 0x580, 0x600, 0x701, 0x801, 0x20000181])
def test_identifiers_of_other_services_are_refused(cob_id):
    with pytest.raises(PdoError, match=re.escape(f"COB-ID {cob_id:X}h")):
        PdoMap(cob_id, (POSITION,))


@pytest.mark.parametrize("kind", [-1, 241, 251, 256])
def test_reserved_transmission_types_are_refused(kind):
    with pytest.raises(PdoError, match="reserved"):
        PdoMap(0x181, (POSITION,), kind)


def test_names_take_no_part_in_equality():
    assert MappedObject(0x6064, 0, 32, True, "a") == POSITION
    assert PdoMap(0x181, (POSITION,)) == PdoMap(0x181, (MappedObject(0x6064, 0, 32, True),))
    assert PdoMap(0x181, (POSITION,)) != PdoMap(0x182, (POSITION,))


def test_words_split_into_what_made_them():
    assert split_word(0x60E40120) == (0x60E4, 1, 32)
    assert MappedObject(0x60E4, 1, 32, True).word == 0x60E40120
