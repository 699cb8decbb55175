"""Contender: the usual way. canopen's Network with its Notifier thread, RemoteNodes from the EDS files, PDO callbacks.

What a good engineer does is done: variables are looked up once, the callbacks only count, the loop thread sends the
SYNC on an absolute grid and waits for all five PDOs on one condition, garbage collection is frozen, scheduling is that
of jtqd. The arithmetic is the same JointEstimator, sending is python-can's. It keeps no log and checks neither lateness
nor duplicates, so it does less than jtqd's loop.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from typing import Any

import canopen

from jtqd.daemon.config import load_config
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.loop import process as loop
from jtqd.drivers.can_unix import UnixBus
from jtqd.drivers.drive import drive_tpdo1, drive_tpdo2
from jtqd.drivers.pdo import PdoMap
from jtqd.drivers.sensor import sensor_tpdo1
from jtqd.estimator.status import OFF, PUBLISHED, STALE
from tests.benchmarks.contender import ROOT, Task, serve
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import CycleMeter, punctual
from tests.benchmarks.traffic import SCALING

_PERIOD_NS = 1_000_000
_DEADLINE_S = 850e-6
_HEARTBEAT_CYCLES = 100
_NODE = 0x20
_OPERATION_ENABLED = 0x27
_EDS = ROOT / "drivers" / "eds"


def _map(node: Any, number: int, wanted: PdoMap) -> Any:
    """TPDO `number` of a remote node with our mapping, as `read()` would set it up from the device."""
    pdo = node.tpdo[number]
    pdo.clear()
    pdo.cob_id = wanted.cob_id
    pdo.trans_type = 1
    pdo.enabled = True
    for mapped in wanted.objects:
        pdo.add_variable(mapped.index, mapped.subindex, mapped.bits)
    pdo.subscribe()
    return pdo


class CanopenLoop:
    """The network, its nodes and the loop thread (the main thread of this process)."""

    def __init__(self, task: Task) -> None:
        self._bus = task.bus.removeprefix("unix:")
        config = load_config(Fixture(task.directory).config)
        self._estimators = [loop.build_estimator(config, joint) for joint in config.joints]
        loop.warm_up(self._estimators)
        punctual(task.cpu, task.priority)
        self._all_here = threading.Condition()
        self._here: set[int] = set()
        self._statuses = [OFF, OFF]
        gc.collect()
        gc.freeze()
        gc.disable()

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        self._network = canopen.Network(bus=UnixBus(self._bus))
        self._network.connect()
        maps = self._subscribe()
        # One look-up per variable, not one per cycle.
        self._joints = [[*maps[2 * n], *maps[2 * n + 1]] for n in (0, 1)]
        self._wanted = len(maps)
        for estimator in self._estimators:
            estimator.reset()
        meter = CycleMeter()
        grid = Grid(first_slot_ns or time.monotonic_ns() + 2 * _PERIOD_NS, _PERIOD_NS)
        end_ns = grid.slot_ns + cycles * _PERIOD_NS
        last_ns, index = 0, 0
        while grid.slot_ns < end_ns:
            pause = grid.slot_ns - time.monotonic_ns()
            if pause > 0:
                time.sleep(pause * 1e-9)
            last_ns = self._cycle(index, last_ns, meter)
            meter.cycle_done()
            grid.advance(time.monotonic_ns())
            index += 1
        self._network.disconnect()
        return meter.result(grid.missed)

    def _subscribe(self) -> list[Any]:
        network = self._network
        maps = []
        for node_id in (1, 2):
            node = network.add_node(canopen.RemoteNode(node_id, str(_EDS / "drive.eds")))
            maps += [_map(node, 1, drive_tpdo1(node_id)), _map(node, 2, drive_tpdo2(node_id))]
        sensor = network.add_node(canopen.RemoteNode(3, str(_EDS / "torque_sensor.eds")))
        maps.append(_map(sensor, 1, sensor_tpdo1(3)))
        for pdo in maps:
            pdo.add_callback(self._on_pdo)
        return maps

    def _on_pdo(self, pdo: Any) -> None:
        """In the Notifier's thread: one more input of this cycle."""
        with self._all_here:
            self._here.add(pdo.cob_id)
            if len(self._here) == self._wanted:
                self._all_here.notify()

    def _cycle(self, index: int, last_ns: int, meter: CycleMeter) -> int:
        counter = index % 240 + 1
        self._here.clear()
        now = time.monotonic_ns()
        self._network.sync.transmit(counter)
        with self._all_here:
            complete = self._all_here.wait_for(lambda: len(self._here) == self._wanted, _DEADLINE_S)
        dt = (now - last_ns) * 1e-9 if last_ns else 0.0
        if complete:
            fields = [self._estimate(joint, dt) for joint in (0, 1)]
            last_ns = now
        else:
            self._statuses = [STALE, STALE]
            fields = [estimate_pdo.field(0.0, 0.0, STALE)] * 2
        data = estimate_pdo.encode(fields[0], fields[1], counter)
        self._network.send_message(0x180 + _NODE, data)
        meter.sent(now)
        if index % _HEARTBEAT_CYCLES == 0:
            self._network.send_message(0x700 + _NODE, b"\x05")
        meter.published += self._statuses[0] in PUBLISHED and self._statuses[1] in PUBLISHED
        return last_ns

    def _estimate(self, number: int, dt: float) -> tuple[int, int, int]:
        motor, link, velocity, current, statusword = [variable.raw for variable in self._joints[number]]
        estimate = self._estimators[number].step(
            dt,
            current * SCALING["ampere_per_unit"],
            motor * SCALING["motor_rad_per_count"],
            velocity * SCALING["motor_rad_s_per_unit"],
            link * SCALING["link_rad_per_count"],
        )
        status = estimate.status if statusword & 0x6F == _OPERATION_ENABLED else OFF
        self._statuses[number] = status
        return estimate_pdo.field(estimate.torque_nm, estimate.sigma_nm, status)


if __name__ == "__main__":
    sys.exit(serve(CanopenLoop))
