"""The bench's nodes: transcripts of what they say on the bus, driven from lists of frames; no bus, no clock."""

import math
import random
import struct

import pytest

from drivers.devices import sensor_tpdo2
from drivers.frame import FRAME
from models.files import shipped
from sim_can.bench import Bench, bench_filters
from sim_can.cost import map_pdos
from sim_can.plant_parameters import load_plant
from sim_can.plant_source import PlantSource
from sim_can.source import CURRENT, OFF, VELOCITY, ChannelSignal, DriveRatings, DriveSignals

MS = 1_000_000
PLANT = load_plant(shipped("plant.yaml"))
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130


class FakeSource:
    """A source with knobs instead of physics; remembers what it was commanded."""

    def __init__(self, channels=1, enabled=False, rows=10**9):
        self.ratings = (DriveRatings(100.0, 8.0, 0.5, 12.0), DriveRatings(50.5, 4.0, 0.25, math.inf))
        self.drives = (DriveSignals(), DriveSignals())
        self.channels = tuple(ChannelSignal() for _ in range(channels))
        self.steps = []
        self.commands = []
        self.rows = rows
        for drive in self.drives:
            drive.enabled = enabled

    def advance(self, dt_s):
        self.steps.append(dt_s)
        return len(self.steps) <= self.rows

    def command(self, drive, mode, target):
        self.commands.append((drive, mode, target))


class Player:
    """Talks to a bench and collects what it answers as "ID#DATA" texts."""

    def __init__(self, source=None, profile="rest"):
        self.source = source or FakeSource()
        self.bench = Bench(self.source, profile)
        self.stamp = 5_000_000_000
        self.now = 0
        self.said = self.texts(self.bench.tick(0))

    @staticmethod
    def texts(frames):
        out = []
        for frame in frames:
            can_id, length, data = FRAME.unpack(frame)
            out.append(f"{can_id:03X}#{data[:length].hex().upper()}")
        return out

    def send(self, can_id, data=b"", after_ms=0):
        self.now += after_ms * MS
        return self.texts(self.bench.on_frame(can_id, data, self.stamp, self.now))

    def sync(self, counter=1, after_ms=1.0):
        self.stamp += round(after_ms * MS)
        self.now += round(after_ms * MS)
        return self.texts(self.bench.on_frame(0x080, bytes([counter]), self.stamp, self.now))

    def tick(self, to_ms):
        self.now = to_ms * MS
        return self.texts(self.bench.tick(self.now))

    def write(self, node, index, subindex, value, size):
        head = bytes([0x23 | (4 - size) << 2]) + struct.pack("<HB", index, subindex)
        return self.send(0x600 + node, head + (value & 0xFFFFFFFF).to_bytes(4, "little"))

    def put(self, node, index, subindex, value, size):
        replies = self.write(node, index, subindex, value, size)
        assert f"{0x580 + node:03X}#60{index & 0xFF:02X}{index >> 8:02X}{subindex:02X}00000000" in replies
        return [text for text in replies if not text.startswith(f"{0x580 + node:03X}#")]

    def read(self, node, index, subindex=0):
        """Value of an expedited upload, or the abort code as text."""
        (reply,) = self.send(0x600 + node, b"\x40" + struct.pack("<HB", index, subindex) + bytes(4))
        data = bytes.fromhex(reply[4:])
        if data[0] == 0x80:
            return f"{int.from_bytes(data[4:], 'little'):08X}"
        return int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little")

    def nmt(self, command, node=0):
        return self.send(0x000, bytes([command, node]))

    def status(self, node=1):
        return self.read(node, 0x6041) & 0x6F


@pytest.fixture
def player():
    return Player()


@pytest.fixture
def mapped(player):
    map_pdos(player.bench)
    return player


# NMT, heartbeat, EMCY ---------------------------------------------------------------------------------------


def test_boot_up_messages(player):
    assert player.said == ["701#00", "702#00", "703#00"]


def test_heartbeat_comes_on_its_own_grid_with_the_state(player):
    player.now = 7 * MS
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
    player.nmt(PRE_OPERATIONAL)
    player.put(1, 0x1017, 0, 0, 2)
    assert player.tick(5000) == []


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


# CiA 402 on the bus -----------------------------------------------------------------------------------------


def enabled(player, mode=VELOCITY, node=1):
    player.put(node, 0x6060, 0, mode, 1)
    for word in (0x06, 0x07, 0x0F):
        player.put(node, 0x6040, 0, word, 2)
    assert player.status(node) == 0x27


def test_velocity_mode_target_is_in_increments_per_second_motor_side(mapped):
    enabled(mapped)
    mapped.put(1, 0x60FF, 0, -65536 * 10, 4)
    drive, mode, target = mapped.source.commands[-1]
    assert (drive, mode) == (0, VELOCITY)
    assert target == pytest.approx(-20 * math.pi)
    assert mapped.read(1, 0x6061) == 9
    mapped.put(1, 0x6040, 0, 0x10F, 2)  # halt
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)


def test_quick_stop_brakes_then_switches_off(mapped):
    enabled(mapped)
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    mapped.put(1, 0x6040, 0, 0x02, 2)
    assert mapped.status() == 0x07
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    mapped.sync()
    assert mapped.status() == 0x07  # still turning
    mapped.source.drives[0].motor_velocity_rad_s = 0.5
    mapped.sync()
    assert mapped.status() == 0x40
    assert mapped.source.commands[-1] == (0, OFF, 0.0)


def test_overcurrent_is_a_latched_fault_with_emcy(mapped):
    enabled(mapped)
    mapped.source.drives[0].current_a = -12.5
    texts = mapped.sync()
    assert texts[0] == "081#1023030000000000"  # 2310h, register: generic + current
    assert mapped.status() & 0x4F == 0x08
    assert mapped.read(1, 0x603F) == 0x2310
    assert mapped.source.commands[-1] == (0, OFF, 0.0)
    mapped.source.drives[0].current_a = 0.0
    mapped.put(1, 0x6040, 0, 0x0F, 2)
    assert mapped.status() & 0x4F == 0x08
    assert mapped.put(1, 0x6040, 0, 0x80, 2) == ["081#0000000000000000"]
    assert mapped.status() == 0x40
    assert mapped.read(1, 0x603F) == 0


def test_lost_master_heartbeat_stops_a_commanded_drive(mapped):
    """1016h: node 20h, 200 ms. Watched from the first heartbeat on; EMCY 8130h, fault, pre-operational (1029h
    = 0).
    """
    mapped.put(1, 0x1016, 1, 0x0020_00C8, 4)
    enabled(mapped)
    mapped.now = 0
    assert mapped.tick(1000) == []  # no heartbeat seen yet
    mapped.send(0x720, b"\x05")
    mapped.send(0x721, b"\x05", after_ms=100)  # another node
    mapped.send(0x720, b"\x05\x05", after_ms=50)  # not a heartbeat
    assert mapped.tick(1199) == []
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    assert mapped.tick(1200) == ["081#3081110000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x0F  # fault reaction: braking
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    assert mapped.bench.drives[0].state == 0x7F
    mapped.source.drives[0].motor_velocity_rad_s = 0.0
    mapped.sync()
    assert mapped.read(1, 0x6041) & 0x4F == 0x08
    assert mapped.tick(5000) == []  # told once
    assert mapped.send(0x720, b"\x05") == ["081#0000000000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x08  # the fault stays until it is reset


def test_heartbeats_in_time_are_no_error(mapped):
    mapped.put(1, 0x1016, 1, 0x0020_00C8, 4)
    for k in range(1, 30):
        assert mapped.tick(100 * k) == []
        assert mapped.send(0x720, b"\x05") == []


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


# Bench ------------------------------------------------------------------------------------------------------


def test_first_sync_is_time_zero_and_then_measured_time_counts():
    player = Player()
    player.sync(after_ms=123.0)
    player.sync(after_ms=1.0)
    player.sync(after_ms=1.7)
    player.sync(after_ms=400.0)  # clipped
    player.stamp -= 10_000 * MS  # the clock was stepped back
    player.sync(after_ms=1.0)
    assert player.source.steps == pytest.approx([0.0, 0.001, 0.0017, 0.05, 0.0])


def test_equal_stamps_give_equal_frames():
    def run():
        player = Player(PlantSource(PLANT, 4), "demo")
        map_pdos(player.bench)
        return [player.sync(1 + k % 240, 1.0 + 0.03 * (k % 3)) for k in range(1500)]

    first = run()
    assert first == run()
    assert len(set(map(tuple, first))) > 1400


def test_demo_enables_both_drives_at_the_first_sync_and_moves():
    player = Player(PlantSource(PLANT, 1), "demo")
    map_pdos(player.bench)
    assert player.status(1) == player.status(2) == 0x40
    player.sync()
    assert player.status(1) == player.status(2) == 0x27
    assert (player.read(1, 0x6061), player.read(2, 0x6061)) == (VELOCITY, CURRENT)
    for k in range(4000):
        player.sync(1 + k % 240)
    assert abs(player.source.drives[0].motor_velocity_rad_s) > 5.0
    assert abs(player.source.channels[0].torque_nm) > 1.0


@pytest.mark.parametrize(("index", "value", "size"), [(0x6060, 9, 1), (0x6040, 0, 2)])
def test_a_master_ends_the_demo_on_both_drives(index, value, size):
    player = Player(PlantSource(PLANT, 1), "demo")
    for _ in range(5):
        player.sync()
    player.put(1, index, 0, value, size)
    assert player.status(1) == player.status(2) == 0x40
    for _ in range(5):
        player.sync()
    assert player.status(1) == player.status(2) == 0x40


def test_demo_is_released_without_the_master_and_begins_again_from_rest():
    player = Player(PlantSource(PLANT, 1), "demo")
    for drive in (1, 2):
        player.put(drive, 0x1016, 1, 0x0020_00C8, 4)
    for _ in range(3000):
        player.sync()
    player.send(0x720, b"\x05")
    lost = player.tick(player.now // MS + 300)
    assert [text[:8] for text in lost] == ["081#3081", "082#3081"]
    assert player.status(1) == 0x40  # no fault: nobody commands it
    assert player.bench._profile_s > 2.9
    player.sync()
    assert player.status(1) == 0x27
    assert player.bench._profile_s == 0.0


def test_powered_drives_go_on_slowly_without_sync():
    player = Player()
    enabled(player)
    player.sync()
    start = player.now
    player.tick(start // MS)
    assert player.bench.due_ns == start + 50 * MS
    player.tick(start // MS + 50)
    assert player.source.steps[-1] == pytest.approx(0.05)
    assert player.bench.due_ns == player.now + 10 * MS
    player.tick(player.now // MS + 10)
    assert player.source.steps[-1] == pytest.approx(0.01)
    player.stamp += 60 * MS
    player.sync(after_ms=1.0)
    assert player.source.steps[-1] == pytest.approx(0.001)  # what idle steps covered does not count twice


def test_standing_bench_sleeps_without_sync(player):
    player.sync()
    assert player.bench.due_ns > player.now + 10**12


def test_played_run_reports_operation_enabled_and_ends():
    player = Player(FakeSource(channels=2, enabled=True, rows=3))
    map_pdos(player.bench)
    assert [len(player.sync()) for _ in range(4)] == [5, 5, 5, 0]
    assert player.bench.over
    assert player.status(1) == player.status(2) == 0x27


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


@pytest.mark.parametrize("seed", range(4))
def test_random_frames_never_raise_and_never_enable_a_drive_outside_its_states(seed):
    rng = random.Random(seed)
    player = Player(FakeSource(channels=2))
    map_pdos(player.bench)
    ids = [each.can_id for each in bench_filters()]
    for _ in range(6000):
        can_id = rng.choice(ids)
        length = rng.choice((0, 1, 2, 3, 4, 5, 7, 8, 8, 8))
        data = rng.randbytes(length)
        if can_id > 0x600 and rng.random() < 0.7:  # plausible SDO requests
            index = rng.choice((0x1016, 0x1017, 0x1800, 0x1A00, 0x1600, 0x6040, 0x6060, 0x6132, 0x60FF))
            data = bytes([rng.choice((0x2F, 0x2B, 0x23, 0x40, 0x60, 0x21))]) + struct.pack(
                "<HBI",
                index,
                rng.randrange(9),
                rng.choice((0, 1, 2, 9, 0x4000_0181, 0x6064_0020, rng.getrandbits(32))),
            )
        for frame in player.bench.on_frame(can_id, data, player.stamp, player.now):
            assert len(frame) == 16
            assert FRAME.unpack(frame)[1] <= 8
        if rng.random() < 0.2:
            player.now += rng.randrange(50 * MS)
            player.stamp += MS
            player.bench.tick(player.now)
    for node, state in ((1, 0x7F), (2, 0x7F), (3, 0x7F)):
        player.nmt(RESET_NODE, node)
        assert player.bench.nodes[node - 1].state == state
        assert isinstance(player.read(node, 0x1018, 1), int)
