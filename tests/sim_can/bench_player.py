"""A bench without bus and clock, for tests: spoken to in frames, its answers collected as "ID#DATA" texts."""

import math
import struct

from jtqd.drivers.frame import FRAME
from jtqd.sim_can.bench import Bench, map_pdos
from jtqd.sim_can.source import VELOCITY, ChannelSignal, DriveRatings, DriveSignals

MS = 1_000_000


class FakeSource:
    """A source with knobs instead of physics; remembers what it was commanded."""

    def __init__(self, channels=1, enabled=False, rows=10**9):
        self.ratings = (DriveRatings(100.0, 8.0, 0.5, 12.0), DriveRatings(50.5, 4.0, 0.25, math.inf))
        self.drives = (DriveSignals(), DriveSignals())
        self.channels = tuple(ChannelSignal() for _ in range(channels))
        self.steps = []
        self.commands = []
        self.resumed = 0
        self.rows = rows
        for drive in self.drives:
            drive.enabled = enabled

    def advance(self, dt_s):
        self.steps.append(dt_s)
        return len(self.steps) <= self.rows

    def command(self, drive, mode, target):
        self.commands.append((drive, mode, target))

    def resume(self):
        self.resumed += 1


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


def mapped_player(source=None, profile="rest"):
    """A player whose nodes are mapped and operational."""
    player = Player(source, profile)
    map_pdos(player.bench)
    return player


def quiet(player):
    """Without TPDO3, which comes by its timer: only what a test is about is said."""
    for node in (1, 2):
        player.put(node, 0x1802, 1, 0xC000_0380 + node, 4)
    return player


def enabled(player, mode=VELOCITY, node=1):
    player.put(node, 0x6060, 0, mode, 1)
    for word in (0x06, 0x07, 0x0F):
        player.put(node, 0x6040, 0, word, 2)
    assert player.status(node) == 0x27
