"""Frames through the supervisor's path: the bus service with its own node, EMCY log, heartbeat consumers and SDO clients.

The service is one that has booted real nodes over a hub; then its socket and its time are taken over. Boots that the frames
bring about end at once without a word, which is one of the answers that a boot can give.
"""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

from jtqd.daemon.bus.boot import ReturningNodes
from jtqd.daemon.bus.service import BusService, nodes_of, service_filters
from jtqd.daemon.shared.conditions import Conditions
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK, FRAME
from jtqd.drivers.frame_socket import CAPACITY
from jtqd.drivers.object_dictionary import ObjectStore
from tests.slow.soak.rig import rss_kb

OWN = 0x20
_TURN = 400
"""Frames between two turns, at most."""
_LIKELY = (
    0x000,
    0x620,
    0x081,
    0x082,
    0x083,
    0x581,
    0x582,
    0x583,
    0x601,
    0x602,
    0x603,
    0x701,
    0x702,
    0x703,
    0x720,
)


class _EndedBoot:
    """A boot process that has ended without an answer."""

    def alive(self) -> bool:
        return False

    def poll_answer(self) -> None:
        return None

    def send(self, _request: dict[str, Any]) -> None:
        pass

    def end_of_input(self) -> None:
        pass


class _Socket:
    """What has been put is received, if a filter lets it through."""

    def __init__(self, filters: list[CanFilter]) -> None:
        self._filters = filters
        self.frames = bytearray(16 * CAPACITY)
        self.waiting: list[bytes] = []
        self.sent: list[bytes] = []

    def put(self, can_id: int, data: bytes) -> bool:
        masked = any((can_id & mask) == (wanted & mask) for wanted, mask in self._filters)
        if masked or can_id & CAN_ERR_FLAG:
            self.waiting.append(FRAME.pack(can_id, len(data), data))
        return masked

    def receive(self) -> int:
        batch, self.waiting = self.waiting[:CAPACITY], self.waiting[CAPACITY:]
        for n, each in enumerate(batch):
            self.frames[16 * n : 16 * n + 16] = each
        return len(batch)

    def send(self, frame: bytes) -> bool:
        self.sent.append(bytes(frame))
        return True


def _draw(source: random.Random) -> tuple[int, bytes]:
    """A frame; half of them under an identifier that the service looks at."""
    chance = source.random()
    if chance < 0.7:
        can_id = source.choice(_LIKELY)
    elif chance < 0.75:
        can_id = CAN_ERR_FLAG | source.getrandbits(12)
    else:
        flags = source.choice((0, 0, CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG))
        can_id = source.getrandbits(29 if flags & CAN_EFF_FLAG else 11) & CAN_EFF_MASK | flags
        if not flags & CAN_EFF_FLAG:
            can_id &= CAN_SFF_MASK | CAN_RTR_FLAG
    data = source.randbytes(source.choice((0, 1, 1, 2, 4, 7, 8, 8, 8, 8)))
    if 0x580 < can_id < 0x680 and len(data) == 8 and source.random() < 0.8:
        # An SDO message of an object that exists, or nearly: uploads, downloads, blocks, aborts, segments.
        index = source.choice(
            (0x1000, 0x1001, 0x1003, 0x1005, 0x1008, 0x1017, 0x1018, 0x1019, 0x1020, 0x2100, 0x2200, 0x2206)
        )
        command = source.choice(
            (0x40, 0x60, 0x70, 0x23, 0x21, 0x2F, 0x80, 0x00, 0x10, 0x01, 0x43, 0x41, 0xA0, 0xC0)
        )
        data = bytes((command, index & 0xFF, index >> 8, source.randrange(6))) + data[4:]
    return can_id, data


def fuzz_service(directory: Path, seed: int, count: int) -> dict[str, Any]:
    """`count` frames; counts by name, `ok` among them."""
    from tests.daemon.bus.master_bench import MasterBench
    from tests.paths import EDS

    source, begun = random.Random(seed), time.perf_counter()
    lines: list[str] = []
    exceptions, first, base_kb, passed, sdo_replies, emcys = 0, "", 0, 0, 0, 0
    with MasterBench(directory) as bench:
        conditions = Conditions()
        log = lambda _topic, _node, line: lines.append(line)  # noqa: E731
        socket = _Socket(service_filters(bench.config))
        returning = ReturningNodes(bench.config, bench.bus, bench.report, lambda *_: _EndedBoot(), log)  # type: ignore[arg-type,return-value]
        store = ObjectStore(EDS / "jtqd.eds", OWN)
        service = BusService(
            socket,  # type: ignore[arg-type]
            bench.config,
            bench.report,
            reader=bench.reader,
            store=store,
            returning=returning,
            conditions=conditions,
            log=log,
            directory=directory,
        )
        now_s, given = 1000.0, 0
        service.begin(now_s)
        while given < count:
            for _ in range(source.randrange(_TURN)):
                passed += socket.put(*_draw(source))
                given += 1
            now_s += source.choice((0.001, 0.02, 0.05, 0.05, 0.5))
            try:
                service.turn(bench.reader.read(), now_s)
                lines += [line.text for line in conditions.lines(now_s)]
            except Exception as error:
                import traceback

                traceback.print_exc()
                exceptions += 1
                first = first or f"frame {given}: {error!r}"
                if exceptions > 10:
                    break
            ids = [int.from_bytes(each[:4], "little") for each in socket.sent]
            sdo_replies += ids.count(0x580 + OWN)
            emcys += ids.count(0x080 + OWN)
            socket.sent.clear()
            if not base_kb and given > count // 5:
                base_kb = rss_kb()
        growth_kb = rss_kb() - base_kb
        answers = _answers(service, socket, bench.reader, now_s)
    # Lines are limited to a few per node, topic and 5 s, whatever comes.
    per_minute = 60.0 * len(lines) / max(now_s - 1000.0, 1.0)
    lines_ok = per_minute < 12 * 60
    return {
        "seed": seed,
        "frames": given,
        "frames_for_it": passed,
        "exceptions": exceptions,
        "exception": first,
        "sdo_replies": sdo_replies,
        "emcys_sent": emcys,
        "emcys_heard": sum(service.emergencies.count_of(node) for node in nodes_of(bench.config)),
        "lines": len(lines),
        "lines_per_minute": round(per_minute, 1),
        "answers_afterwards": answers,
        "memory_growth_kb": growth_kb,
        "seconds": round(time.perf_counter() - begun, 1),
        "ok": not exceptions and answers and lines_ok and growth_kb < 3000,
    }


def _answers(service: BusService, socket: _Socket, reader: Any, now_s: float) -> bool:
    """The own node still says what it is: 1000h:0 read by SDO, after the abort of whatever a client had begun."""
    socket.waiting.clear()
    socket.put(0x600 + OWN, bytes((0x80, 0, 0, 0, 0, 0, 0, 0)))
    socket.put(0x600 + OWN, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0)))
    service.turn(reader.read(), now_s)
    replies = [FRAME.unpack(each) for each in socket.sent]
    return any(can_id == 0x580 + OWN and data[:4] == b"\x43\x00\x10\x00" for can_id, _, data in replies)
