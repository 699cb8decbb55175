"""Program of the nodes.

    python -m tests.library_drives BUS [--boot-ups N] [--sdo S] [--without 1016,1029] [--family epos4]
        [--fixed mapping|valid|event]

BUS is unix:PATH or a SocketCAN interface. Orders come as lines, each is answered by one: "off 1", "on 1", "cut 1", "join 1",
"emcy 1 2310", "well 1 2310", "mute 1" (no heartbeat), "state".
"""

from __future__ import annotations

import argparse
import json
import logging
import sys

import can

from tests.library_drives.families import FAMILIES, manners_of
from tests.library_drives.nodes import Manners, StrictDrive, StrictNode, StrictSensor


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("bus")
    parser.add_argument("--boot-ups", type=int, default=1)
    parser.add_argument("--sdo", type=float, default=0.0)
    parser.add_argument("--without", default="")
    parser.add_argument("--fixed", choices=("mapping", "valid", "event"), default="")
    parser.add_argument("--family", choices=FAMILIES, default="standard", help="of drive 1")
    arguments = parser.parse_args()
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    without = tuple(int(each, 16) for each in arguments.without.split(",") if each)
    manners = Manners(arguments.boot_ups, arguments.sdo, without, fixed=arguments.fixed)

    def open_bus() -> can.BusABC:
        if arguments.bus.startswith("unix:"):
            return can.Bus(interface="jtq_unix", channel=arguments.bus.removeprefix("unix:"))
        return can.Bus(interface="socketcan", channel=arguments.bus)

    nodes: dict[int, StrictNode] = {
        1: FAMILIES[arguments.family](1, open_bus, manners_of(arguments.family, manners)),
        2: StrictDrive(2, open_bus, manners),
        3: StrictSensor(3, open_bus, manners),
    }
    for node in nodes.values():
        node.power_on()
    print("ready", flush=True)
    for line in sys.stdin:
        print(json.dumps(obey(nodes, line.split())), flush=True)


def obey(nodes: dict[int, StrictNode], words: list[str]) -> object:
    order, *rest = words
    if order == "state":
        return {
            number: {"state": node.state, "errors": list(node.errors), "emergencies": node.emergencies}
            for number, node in nodes.items()
        }
    node = nodes[int(rest[0])]
    if order == "on":
        node.power_on()
    elif order == "off":
        node.power_off()
    elif order in ("cut", "join"):
        node.cable.cut = order == "cut"
    elif order == "emcy":
        node.raise_error(int(rest[1], 16), 0x02)
    elif order == "well":
        node.clear_error(int(rest[1], 16))
    elif order == "mute":
        node.node.nmt.stop_heartbeat()
    else:
        raise ValueError(order)
    return True


if __name__ == "__main__":
    main()
