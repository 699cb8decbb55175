"""A master of the `canopen` library: boots the nodes of the bench, sends SYNC, and does what its standard input asks for.

    python -m tests.daemon.bus.library_master INTERFACE CHANNEL

Lines: boot, remap, period S, pause S, identify; each is answered by its name. It shares no code with jtqd.
"""

from __future__ import annotations

import sys
import time

import canopen

MAPPING = {1: (0x60640020, 0x60E40120), 2: (0x606C0020, 0x60780010, 0x60410010)}
SWAPPED = {1: (0x60E40120, 0x60640020), 2: MAPPING[2]}
"""Same length, other objects."""
DRIVES, SENSOR = (1, 2), 3


class Master:
    def __init__(self, interface: str, channel: str) -> None:
        self.network = canopen.Network()
        self.network.connect(interface=interface, channel=channel)
        self.nodes = {
            node: self.network.add_node(node, canopen.ObjectDictionary()) for node in (*DRIVES, SENSOR)
        }
        self.period_s = 0.001

    def write(self, node: int, index: int, sub: int, value: int, size: int) -> None:
        self.nodes[node].sdo.download(index, sub, value.to_bytes(size, "little"))

    def map(self, node: int, mapping: dict[int, tuple[int, ...]]) -> None:
        for number, words in mapping.items():
            communication, objects = 0x17FF + number, 0x19FF + number
            cob_id = 0x80 + 0x100 * number + node
            self.write(node, communication, 1, cob_id | 0x8000_0000, 4)
            self.write(node, objects, 0, 0, 1)
            for entry, word in enumerate(words, 1):
                self.write(node, objects, entry, word, 4)
            self.write(node, objects, 0, len(words), 1)
            self.write(node, communication, 2, 1, 1)
            self.write(node, communication, 1, cob_id, 4)

    def boot(self) -> None:
        """As after its own restart: no SYNC meanwhile."""
        self.network.sync.stop()
        self.network.nmt.send_command(0x82)
        time.sleep(0.1)
        for node in DRIVES:
            self.map(node, MAPPING)
            self.write(node, 0x1017, 0, 100, 2)
        self.map(SENSOR, {1: (0x91300120, 0x61500108)})
        self.network.nmt.send_command(0x01)
        self.network.sync.start(self.period_s)

    def remap(self, mapping: dict[int, tuple[int, ...]]) -> None:
        """Another mapping of drive 1, beside the running SYNC."""
        self.nodes[1].nmt.send_command(0x80)
        self.map(1, mapping)
        self.nodes[1].nmt.send_command(0x01)

    def identify(self) -> None:
        for node in DRIVES:
            for sub in (1, 2):
                self.nodes[node].sdo.upload(0x1018, sub)

    def do(self, name: str, value: float) -> None:
        match name:
            case "boot":
                self.boot()
            case "remap":
                self.remap(SWAPPED)
            case "restore":
                self.remap(MAPPING)
            case "identify":
                self.identify()
            case "pause":
                self.network.sync.stop()
                time.sleep(value)
                self.network.sync.start(self.period_s)
            case "period":
                self.period_s = value
                self.network.sync.stop()
                self.network.sync.start(value)
            case "start" | "stop":
                self.network.nmt.send_command(0x01 if name == "start" else 0x02)


def main() -> None:
    master = Master(*sys.argv[1:3])
    print("ready", flush=True)
    for line in sys.stdin:
        name, *values = line.split()
        master.do(name, float(values[0]) if values else 0.0)
        print(name, flush=True)
    master.network.sync.stop()
    master.network.disconnect()


if __name__ == "__main__":
    main()
