"""PDO mappings: coding byte by byte; then the re-mapping rules of CiA 301, 7.5.2.36, with the abort code of each breach."""

import doctest
import re
import struct

import pytest

from jtqd import drivers
from jtqd.drivers import pdo as pdo_module
from jtqd.drivers.drive import drive_tpdo1, drive_tpdo2, drive_tpdo3
from jtqd.drivers.pdo import MappedObject, PdoError, PdoMap, PdoParameters, split_word
from jtqd.drivers.sdo import SdoAbort
from tests.drivers.canopen_nodes import drive_store, sensor_store

POSITION = MappedObject(0x6064, 0, 32, True, "position")
VELOCITY = MappedObject(0x606C, 0, 32, True, "velocity")
CURRENT = MappedObject(0x6078, 0, 16, True, "current")
STATUSWORD = MappedObject(0x6041, 0, 16, False, "statusword")
STATUS = MappedObject(0x6150, 1, 8, False, "status")
OFF = 0x80000000


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(((0x6064, 0, bits, True), rf"6064h:0: {bits} bits mapped") for bits in (0, 1, 7, 12, 24, 40, 128)),
        *(((index, 0, 8, False), "no such object") for index in (0x0005, 0x0FFF, 0x10000)),
    ],
)
def test_objects_that_cannot_be_mapped(arguments, message):
    with pytest.raises(PdoError, match=message):
        MappedObject(*arguments)


SERVICES = 0x000, 0x080, 0x180, 0x580, 0x600, 0x701, 0x801, 0x20000181


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0x181, (POSITION, VELOCITY, STATUS)), "PDO 181h: 9 bytes mapped, a frame holds 8"),
        ((0x181, ()), "maps no object"),
        *(((cob_id, (POSITION,)), f"COB-ID {cob_id:X}h") for cob_id in SERVICES),
        *(((0x181, (POSITION,), kind), "reserved") for kind in (-1, 241, 251, 256)),
    ],
)
def test_maps_that_cannot_be(arguments, message):
    with pytest.raises(PdoError, match=re.escape(message)):
        PdoMap(*arguments)


def test_names_take_no_part_in_equality():
    assert MappedObject(0x6064, 0, 32, True, "a") == POSITION
    assert PdoMap(0x181, (POSITION,)) == PdoMap(0x181, (MappedObject(0x6064, 0, 32, True),))
    assert PdoMap(0x181, (POSITION,)) != PdoMap(0x182, (POSITION,))


def test_words_split_into_what_made_them():
    assert split_word(0x60E40120) == (0x60E4, 1, 32)
    assert MappedObject(0x60E4, 1, 32, True).word == 0x60E40120


def test_examples_in_the_docstrings():
    for module in (drivers, pdo_module):
        failed, tried = doctest.testmod(module)
        assert (failed, tried > 0) == (0, True)


# Re-mapping in an object dictionary ------------------------------------------------------------------------


@pytest.fixture
def store():
    return drive_store(1)


@pytest.fixture
def parameters(store):
    return PdoParameters(store)


def write(store, index, subindex, value):
    size = store.entry(index, subindex).bits // 8
    store.write(index, subindex, value.to_bytes(size, "little"))


def code_of(store, index, subindex, value):
    before = store.read(index, subindex)
    with pytest.raises(SdoAbort) as caught:
        write(store, index, subindex, value)
    assert store.read(index, subindex) == before
    return caught.value.code


def remap(store, pdo):
    communication = 0x1800 + (pdo.cob_id - 0x180) // 0x100
    mapping = communication + 0x200
    write(store, communication, 1, OFF | store.number(communication, 1))
    write(store, mapping, 0, 0)
    for entry, word in enumerate(pdo.words, 1):
        write(store, mapping, entry, word)
    write(store, mapping, 0, len(pdo.words))
    write(store, communication, 2, pdo.transmission_type)
    write(store, communication, 1, 0x40000000 | pdo.cob_id)


def test_default_maps_are_not_those_of_the_bench(parameters):
    tpdos = parameters.tpdos()
    assert [pdo.words for pdo in tpdos] == [(0x60410010,), (0x60640020, 0x606C0020), (0x30010010,)]
    assert [pdo.transmission_type for pdo in tpdos] == [255, 255, 255]
    assert [(pdo.cob_id, pdo.words) for pdo in parameters.rpdos()] == [
        (0x201, (0x60400010, 0x60710010)),
        (0x301, (0x60FF0020,)),
    ]


def test_the_whole_procedure_gives_the_bench_map(store, parameters):
    remap(store, drive_tpdo1(1))
    remap(store, drive_tpdo2(1))
    assert parameters.tpdos()[:2] == [drive_tpdo1(1), drive_tpdo2(1)]
    assert parameters.tpdos()[2].words == drive_tpdo3(1).words


def test_generation_grows_with_accepted_writes_only(store, parameters):
    assert code_of(store, 0x1A00, 0, 0) == 0x08000022
    assert parameters.generation == 0
    write(store, 0x1800, 1, OFF | 0x40000181)
    assert parameters.generation == 1
    assert [pdo.cob_id for pdo in parameters.tpdos()] == [0x281, 0x381]


def test_mapping_of_an_existing_pdo_is_refused(store, parameters):
    assert code_of(store, 0x1A00, 0, 0) == 0x08000022
    assert code_of(store, 0x1A00, 1, 0x60640020) == 0x08000022
    assert code_of(store, 0x1800, 3, 10) == 0x08000022  # inhibit time
    assert code_of(store, 0x1800, 6, 1) == 0x08000022  # SYNC start value


def test_entries_wait_for_sub_index_0(store, parameters):
    write(store, 0x1800, 1, OFF | 0x40000181)
    assert code_of(store, 0x1A00, 1, 0x60640020) == 0x08000022
    write(store, 0x1A00, 0, 0)
    write(store, 0x1A00, 1, 0x60640020)


@pytest.mark.parametrize(
    ("word", "code"),
    [
        (0x60990020, 0x06020000),  # no such object
        (0x60E40220, 0x06090011),  # no such sub-index
        (0x60750020, 0x06040041),  # PDOMapping=0
        (0x60640010, 0x06040041),  # half of the object
        (0x60400010, 0x06040041),  # rww: an RPDO's
        (0x10080008, 0x06040041),  # a string
    ],
)
def test_what_cannot_be_mapped(store, parameters, word, code):
    write(store, 0x1800, 1, OFF | 0x40000181)
    write(store, 0x1A00, 0, 0)
    assert code_of(store, 0x1A00, 1, word) == code


def test_statusword_is_not_for_an_rpdo(store, parameters):
    write(store, 0x1400, 1, OFF | 0x201)
    write(store, 0x1600, 0, 0)
    assert code_of(store, 0x1600, 1, 0x60410010) == 0x06040041


def test_nine_bytes_are_refused_when_the_mapping_is_enabled(store, parameters):
    write(store, 0x1800, 1, OFF | 0x40000181)
    write(store, 0x1A00, 0, 0)
    for entry, word in enumerate((0x60640020, 0x606C0020, 0x60610008), 1):
        write(store, 0x1A00, entry, word)
    assert code_of(store, 0x1A00, 0, 3) == 0x06040042
    assert code_of(store, 0x1A00, 0, 4) == 0x06040041  # entry 4 maps nothing
    write(store, 0x1A00, 0, 2)
    assert code_of(store, 0x1A00, 0, 9) == 0x06090030  # HighLimit of the EDS


@pytest.mark.parametrize("value", [0x40000182, 0x60000181, 0x40000080, 0x40000601, 0x40000981])
def test_cob_ids_that_cannot_be(store, parameters, value):
    """Changed while the PDO exists; 29-bit; SYNC; SDO; more than 11 bits."""
    assert code_of(store, 0x1800, 1, value) == 0x06090030


def test_cob_id_may_change_while_the_pdo_does_not_exist(store, parameters):
    write(store, 0x1800, 1, OFF | 0x40000191)
    write(store, 0x1800, 1, 0x40000191)
    assert parameters.tpdos()[0].cob_id == 0x191


@pytest.mark.parametrize(("kind", "good"), [(0, 1), (1, 1), (240, 1), (241, 0), (252, 0), (253, 0), (254, 1)])
def test_transmission_types(store, parameters, kind, good):
    if good:
        write(store, 0x1800, 2, kind)
    else:
        assert code_of(store, 0x1800, 2, kind) == 0x06090030


def test_sensor_decodes_by_its_own_map():
    store = sensor_store(3)
    (first, second) = PdoParameters(store).tpdos()
    assert (first.cob_id, second.cob_id) == (0x183, 0x283)
    assert first.layout.unpack(struct.pack("<h", -5)) == (-5,)
