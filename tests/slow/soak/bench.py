"""The emulated bench as a process that takes faults as orders: `python -m tests.slow.soak.bench --bus BUS [--seed N]`.

One order is one line of JSON on standard input, its answer one line on standard output when it is over:

    {"kind": "lost", "ids": [385], "frames": 1}    one 181h does not reach the bus; answer {"kind": "lost", "frames": 1}
    {"kind": "restart", "node": 2, "ms": 1}        node 2 restarts by itself

`frames` ends an order after so many frames that it withheld, changed or delayed, `ms` after a time. It takes effect
with the next SYNC. The kinds are those of `tests.slow.faults.injections`, without which this is `jtq sim`.
"""

from __future__ import annotations

import argparse
import heapq
import json
import sys
import threading
from collections import deque
from typing import Any

from jtqd.drivers.frame import CAN_ERR_FLAG, FRAME, pack
from jtqd.models.files import shipped
from jtqd.sim_can.bench import Bench, run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource
from tests.slow.faults import injections as acts
from tests.slow.faults.injections import Fault

MS = 1_000_000
SENSOR = 0x183
BUS_OFF, RESTARTED = CAN_ERR_FLAG | 0x40, CAN_ERR_FLAG | 0x100
_NEVER_NS = 1 << 62


def fault_of(order: dict[str, Any]) -> Fault:
    """What an order means. Raises KeyError for one that is none."""
    node, ids = order.get("node", 1), order.get("ids", ())
    kinds = {
        "lost": lambda: acts.lost(*ids),
        "late": lambda: acts.late(order["delay_us"], *ids),
        "bus-off": lambda: acts.cut((BUS_OFF, bytes(8)), (RESTARTED, bytes(8))),
        "sensor invalid": lambda: acts.changed(lambda can_id, data: [(can_id, data[:4] + b"\x01")], SENSOR),
        "drive fault": lambda: Fault(
            lambda rig: acts.drive_fault(rig, node), lambda rig: acts.release(rig, node)
        ),
        "restart": lambda: Fault(lambda rig: acts.restart(rig, node)),
        "forget": lambda: Fault(lambda rig: acts.forget(rig, node)),
    }
    return kinds[order["kind"]]()


class OrderedBench(Bench):
    """A bench whose frames pass through the fault of the order that is in force.

    Attributes:
        orders: those that wait; another thread may append.
        bench: itself, for the acts, which reach into a rig's bench.
    """

    def __init__(self, source: PlantSource, profile: str = "demo") -> None:
        super().__init__(source, profile)
        self.orders: deque[dict[str, Any]] = deque()
        self.bench = self
        self._order: dict[str, Any] | None = None
        self._fault = self._none = Fault()
        self._over_ns, self._touched = _NEVER_NS, 0
        self._said: list[bytes] = []
        self._told: list[bytes] = []
        self._delayed: list[tuple[int, int, bytes]] = []
        self._number = 0

    @property
    def due_ns(self) -> int:
        """As of the bench, and of delayed frames and the order's end."""
        due = min(super().due_ns, self._over_ns)
        return min(due, self._delayed[0][0]) if self._delayed else due

    def on_frame(self, can_id: int, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        self._turn(now_ns)
        heard = self._fault.hears(can_id)
        return self._out(super().on_frame(can_id, data, stamp_ns, now_ns) if heard else [], now_ns)

    def tick(self, now_ns: int) -> list[bytes]:
        self._turn(now_ns)
        return self._out(super().tick(now_ns), now_ns)

    def emit(self, frames: list[bytes]) -> None:
        self._said += frames

    def send(self, can_id: int, data: bytes) -> None:
        """A message of the driver, not of a node: no fault keeps it from the bus."""
        self._told.append(pack(can_id, data))

    def _turn(self, now_ns: int) -> None:
        order = self._order
        if order is None:
            if not self.orders:
                return
            self._order = order = self.orders.popleft()
            self._fault, self._touched = fault_of(order), 0
            self._over_ns = now_ns + round(order["ms"] * MS) if "ms" in order else _NEVER_NS
            self._fault.begin(self)  # type: ignore[arg-type]
        elif now_ns >= self._over_ns or self._touched >= order.get("frames", _NEVER_NS):
            self._fault.end(self)  # type: ignore[arg-type]
            self._order, self._fault, self._over_ns = None, self._none, _NEVER_NS
            print(json.dumps({"kind": order["kind"], "frames": self._touched}), flush=True)

    def _out(self, frames: list[bytes], now_ns: int) -> list[bytes]:
        out, self._told = self._told, []
        most = _NEVER_NS if self._order is None else self._order.get("frames", _NEVER_NS)
        for frame in [*self._said, *frames]:
            can_id, length, data = FRAME.unpack(frame)
            as_it_is = [(0, can_id, data[:length])]
            passed = list(self._fault.passes(can_id, data[:length])) if self._touched < most else as_it_is
            self._touched += passed != as_it_is
            for delay_ns, other_id, other in passed:
                if delay_ns <= 0:
                    out.append(pack(other_id, other))
                else:
                    self._number += 1
                    heapq.heappush(self._delayed, (now_ns + delay_ns, self._number, pack(other_id, other)))
        self._said = []
        while self._delayed and self._delayed[0][0] <= now_ns:
            out.append(heapq.heappop(self._delayed)[2])
        return out


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.slow.soak.bench")
    parser.add_argument("--bus", required=True)
    parser.add_argument("--seed", type=int, default=1, help="of the noise")
    options = parser.parse_args()
    plant = load_plant(shipped("campaign_plant.yaml"))
    bench = OrderedBench(PlantSource(plant, options.seed), plant.profile)

    def read() -> None:
        for line in sys.stdin:
            bench.orders.append(json.loads(line))

    threading.Thread(target=read, daemon=True).start()
    return run(options.bus, bench)


if __name__ == "__main__":
    sys.exit(main())
