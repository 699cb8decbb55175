"""The bench's nodes as CANopen devices: NMT, heartbeat, SDO, PDOs and the sensor, from lists of frames."""

import math
import struct

import pytest

from jtqd.drivers.nmt import ENTER_PRE_OPERATIONAL, RESET_COMMUNICATION, RESET_NODE, START, STOP
from jtqd.drivers.sensor import sensor_tpdo2
from jtqd.sim_can.source import CURRENT
from tests.sim_can.bench_player import (
    MS,
    FakeSource,
    Player,
    mapped_player,
    quiet,
)


@pytest.fixture
def player():
    return Player()


@pytest.fixture
def mapped():
    return mapped_player()


# NMT, heartbeat, EMCY ---------------------------------------------------------------------------------------


def test_boot_up_messages(player):
    assert player.said == ["701#00", "702#00", "703#00"]


def test_heartbeat_comes_on_its_own_grid_with_the_state(player):
    quiet(player).now = 7 * MS
    assert player.put(1, 0x1017, 0, 100, 2) == []
    assert player.tick(106) == []
    assert player.bench.due_ns == 107 * MS
    assert player.tick(107) == ["701#7F"]  # pre-operational
    assert player.nmt(START, 1) != player.nmt(START, 2)  # event-driven statusword of each node, once
    assert player.tick(215) == ["701#05"]  # 8 ms late
    assert player.tick(306) == []
    assert player.tick(307) == ["701#05"]  # the grid has not moved
    player.nmt(STOP, 1)
    assert player.tick(1000) == ["701#04"]  # missed ones are not made up for
    assert player.tick(1001) == []
    assert player.tick(1007) == ["701#04"]
    player.nmt(ENTER_PRE_OPERATIONAL)
    player.put(1, 0x1017, 0, 0, 2)
    assert player.tick(5000) == []


def test_a_master_that_restarts_is_missing_until_its_heartbeat_is_back(player):
    """As CANopenNode: the boot-up message of a node that was heard is 8130h, and no start before it is over."""
    quiet(player)
    player.put(1, 0x1016, 1, 0x0020_01F4, 4)
    assert player.send(0x720, b"\x00") == [], "nobody was heard before"
    assert player.send(0x720, b"\x7f") == []
    assert player.send(0x720, b"\x00") == ["081#3081110000000000"]
    player.nmt(START, 1)
    assert player.bench.drives[0].state == 0x7F
    assert player.send(0x720, b"\x7f") == ["081#0000000000000000"]
    player.nmt(START, 1)
    assert player.bench.drives[0].state == 0x05


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x01\x01", b"\x01\x02"])
def test_nmt_of_wrong_length_or_for_another_node_is_ignored(player, data):
    player.send(0x000, data)
    assert player.bench.drives[0].state == 0x7F


def test_stopped_node_answers_no_sdo(player):
    player.nmt(STOP, 1)
    assert player.send(0x601, bytes.fromhex("4000100000000000")) == []
    assert player.read(2, 0x1000) == 0x0002_0192


def test_reset_communication_takes_the_mapping_back_to_the_eds(mapped):
    assert mapped.read(1, 0x1A00, 1) == 0x6064_0020
    mapped.put(1, 0x6076, 0, 777, 4)
    assert mapped.nmt(RESET_COMMUNICATION, 1) == ["701#00"]
    assert mapped.read(1, 0x1A00, 1) == 0x6041_0010
    assert mapped.read(1, 0x1800, 2) == 255
    assert mapped.read(1, 0x6076) == 777  # only 1000h..1FFFh
    assert not any(text.startswith(("181", "281")) for text in mapped.sync())
    assert mapped.nmt(RESET_NODE, 1) == ["701#00"]
    assert mapped.read(1, 0x6076) == 500
    mapped.nmt(START, 1)
    assert not any(text.startswith(("181", "281")) for text in mapped.sync())  # EDS default: event-driven
    assert any(text.startswith("182") for text in mapped.sync())  # the other node never stopped


# SDO and PDOs -----------------------------------------------------------------------------------------------


def test_identity_and_scaling_objects_tell_the_ratings(player):
    assert player.read(1, 0x1000) == 0x0002_0192
    assert player.read(3, 0x1000) == 0x0002_0194
    assert [player.read(n, 0x1018, 4) for n in (1, 2, 3)] == [0x1001, 0x1002, 0x1003]
    assert [player.read(1, *key) for key in ((0x608F, 1), (0x6090, 1), (0x60E6, 1))] == [65536, 65536, 524288]
    assert [player.read(n, 0x6075) for n in (1, 2)] == [8000, 4000]
    assert [player.read(n, 0x6076) for n in (1, 2)] == [500, 250]
    assert [player.read(2, 0x6091, s) for s in (1, 2)] == [101, 2]  # 50.5 : 1


def test_sdo_transcripts(player):
    """Device type, expedited; read-only; absent object and sub-index; wrong length."""
    assert player.send(0x601, bytes.fromhex("40 00 10 00 00 00 00 00")) == ["581#4300100092010200"]
    assert player.send(0x601, bytes.fromhex("2B 41 60 00 01 00 00 00")) == ["581#8041600002000106"]
    assert player.send(0x601, bytes.fromhex("40 00 50 00 00 00 00 00")) == ["581#8000500000000206"]
    assert player.send(0x601, bytes.fromhex("40 8F 60 07 00 00 00 00")) == ["581#808F600711000906"]
    assert player.send(0x601, bytes.fromhex("23 60 60 00 09 00 00 00")) == ["581#8060600012000706"]
    assert player.send(0x601, bytes.fromhex("2F 60 60 00 01 00 00 00")) == ["581#8060600030000906"]  # mode 1
    assert player.send(0x601, b"\x40\x00\x10") == []


def test_tpdos_on_sync_carry_the_source_in_the_drives_units(mapped):
    one, two = mapped.source.drives
    one.motor_position_rad = 2 * math.pi * 1.5  # 98304 counts = 18000h
    one.link_position_rad = -2 * math.pi / 524288 * 3
    one.motor_velocity_rad_s = -2 * math.pi  # -65536 inc/s
    one.current_a = 1.0  # of 8 A: 125
    two.current_a = -0.5  # of 4 A: -125
    mapped.source.channels[0].torque_nm = -1.2345
    assert mapped.sync() == [
        "181#00800100FDFFFFFF",
        "281#0000FFFF7D005002",  # 6041h 0250h: switch on disabled, voltage, remote
        "182#0000000000000000",
        "282#0000000083FF5002",
        "183#2EFBFFFF00",  # -1234 (round half to even of -1234.5): FFFFFB2Eh, status valid
    ]
    assert mapped.read(1, 0x6064) == 98304
    assert mapped.read(2, 0x6078) == 0xFF83
    assert mapped.read(1, 0x60E4, 1) == 0xFFFFFFFD


def test_pdo_values_at_their_limits(mapped):
    one = mapped.source.drives[0]
    one.motor_position_rad = 2 * math.pi * 32768  # 2^31 counts: wraps
    one.motor_velocity_rad_s = 1e9
    one.current_a = -1000.0
    mapped.source.channels[0].torque_nm = 3e6
    texts = mapped.sync()
    assert texts[0] == "181#0000008000000000"
    assert texts[1].startswith("281#FFFFFF7F0180")  # limited, not wrapped
    assert texts[4] == "183#FFFFFF7F02"  # positive overload


def test_transmission_type_n_sends_every_nth_sync(mapped):
    mapped.put(1, 0x1800, 1, 0xC000_0181, 4)
    mapped.put(1, 0x1800, 2, 3, 1)
    mapped.put(1, 0x1800, 1, 0x4000_0181, 4)
    sent = ["181" in {text[:3] for text in mapped.sync()} for _ in range(9)]
    assert sent == [False, False, True] * 3


def test_sync_start_value_waits_for_the_counter(mapped):
    mapped.put(2, 0x1801, 1, 0xC000_0282, 4)
    mapped.put(2, 0x1801, 6, 4, 1)
    mapped.put(2, 0x1801, 1, 0x4000_0282, 4)
    sent = ["282" in {text[:3] for text in mapped.sync(counter)} for counter in (2, 3, 4, 5)]
    assert sent == [False, False, True, True]


def test_no_pdo_before_nmt_start(player):
    assert player.sync() == []


def test_remapping_while_the_pdo_exists_is_refused(mapped):
    (reply,) = mapped.write(1, 0x1A00, 0, 0, 1)
    assert reply == "581#80001A0022000008"


def test_rpdo_commands_the_drive_and_a_short_one_only_gives_an_emcy(mapped):
    mapped.put(1, 0x6060, 0, CURRENT, 1)
    for word in (0x06, 0x07, 0x0F):
        mapped.send(0x201, struct.pack("<Hh", word, 250))  # 6040h, 6071h
    assert mapped.status() == 0x27
    assert mapped.source.commands[-1] == (0, CURRENT, 2.0)  # 250/1000 of 8 A
    assert mapped.send(0x201, b"\x00\x00") == ["081#1082110000000000"]
    assert mapped.status() == 0x27  # not applied
    assert mapped.read(1, 0x1001) == 0x11
    assert mapped.read(1, 0x1003, 1) == 0x8210
    assert mapped.send(0x201, struct.pack("<Hh", 0x0F, -250) + b"\xff") == ["081#0000000000000000"]
    assert mapped.source.commands[-1] == (0, CURRENT, -2.0)


def test_rpdo_before_nmt_start_is_ignored(player):
    player.send(0x201, struct.pack("<Hh", 0x06, 0))
    assert player.status() == 0x40


# Sensor -----------------------------------------------------------------------------------------------------


def test_autozero_and_decimals(mapped):
    channel = mapped.source.channels[0]
    channel.torque_nm = 2.5
    (refused,) = mapped.write(3, 0x6125, 1, 0x11111111, 4)
    assert refused.startswith("583#80256101")
    mapped.put(3, 0x6125, 1, 0x6F72_657A, 4)
    assert mapped.read(3, 0x9130, 1) == 0
    channel.torque_nm = 3.5
    assert mapped.read(3, 0x9130, 1) == 1000
    mapped.put(3, 0x6132, 1, 2, 1)
    assert mapped.read(3, 0x9130, 1) == 100
    mapped.nmt(RESET_NODE, 3)
    assert mapped.read(3, 0x9130, 1) == 3500


def test_invalid_channel_says_so(mapped):
    mapped.source.channels[0].valid = False
    assert mapped.sync()[-1] == "183#0000000001"
    assert mapped.read(3, 0x6150, 2) == 1  # the bench has one sensor: channel 2 is never valid


def test_second_channel_in_16_bits():
    player = Player(FakeSource(channels=2))
    player.source.channels[1].torque_nm = -12.345
    assert player.read(3, 0x7130, 2) == 0x10000 - 1234  # two decimals, half to even
    player.source.channels[1].torque_nm = 400.0
    assert (player.read(3, 0x7130, 2), player.read(3, 0x6150, 2)) == (0x7FFF, 2)


def test_second_sensor_pdo_can_be_mapped():
    player = Player(FakeSource(channels=2))
    pdo = sensor_tpdo2(3)
    player.put(3, 0x1801, 1, 0xC000_0283, 4)
    player.put(3, 0x1A01, 0, 0, 1)
    for entry, word in enumerate(pdo.words, 1):
        player.put(3, 0x1A01, entry, word, 4)
    player.put(3, 0x1A01, 0, 2, 1)
    player.put(3, 0x1801, 2, 1, 1)
    player.put(3, 0x1801, 1, 0x4000_0283, 4)
    player.nmt(START)
    player.source.channels[1].torque_nm = 1.25
    assert "283#7D0000" in player.sync()
