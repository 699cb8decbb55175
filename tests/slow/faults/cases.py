"""The fault catalogue of docs/testing.md: what is injected, what must be seen of it, and which cases other tests show."""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from jtqd.drivers.nmt import PRE_OPERATIONAL, STOPPED
from tests.slow.faults import injections as acts
from tests.slow.faults.injections import Act, Fault, changed, cut, deaf, frozen, late, lost, stopped
from tests.slow.faults.listener import (
    Proof,
    Seen,
    after,
    all_of,
    clock_stepped,
    counter_jumps,
    doubled,
    frames,
    later,
    of_length,
    position_jump,
    sensor_status,
    silent,
    statuswords,
    stuck,
    two_answers,
    velocity_against_position,
    withheld,
)


@dataclass(frozen=True)
class Case:
    """A fault and what is expected of jtqd.

    Attributes:
        key: number of the case, with a letter where it has several parts.
        title: what it is about.
        injected: what is done, for the table.
        fault: makes the fault.
        cycles: how long it lasts, in SYNCs of jtqd (without SYNC: in ms).
        one, two: statuses without torque that joint 1 and 2 must have, all of them and no others; status 1 only follows
            a gap that is long enough, and may be missing.
        emcy: codes that jtqd must send; `may` are allowed besides.
        counters: that must rise (`fault_NAME`, `stale_inputs`, ...).
        notice_ms, recover_ms: at most; from the begin, and from the end of the fault. None: nothing must be noticed.
        wait: a condition on the rig before it begins, for example that the joint moves.
        stall: the loop itself is kept from running: missed cycles are expected.
        long: not in the short list.
        note: for the table.
        proof: what the independent listener must have heard, from the begin of the fault until all was well again.
        during: what must be true of a process, the interface or a node just before the end of the fault.
            Each case has one of the two, and both must say no before the fault begins.
    """

    key: str
    title: str
    injected: str
    fault: Callable[[], Fault]
    cycles: int
    one: frozenset[int] = frozenset()
    two: frozenset[int] = frozenset()
    emcy: frozenset[int] = frozenset()
    may: frozenset[int] = frozenset()
    counters: tuple[str, ...] = ()
    notice_ms: float | None = None
    recover_ms: float = 0.0
    wait: Callable[[object], bool] | None = None
    stall: bool = False
    long: bool = False
    note: str = ""
    settle: int = field(default=60)
    proof: Proof | None = None
    during: Callable[[object], Seen] | None = None

    @property
    def number(self) -> int:
        """1..45."""
        return int(self.key.rstrip("abcdefghijkl"))


def codes(text: str) -> frozenset[int]:
    """`codes("8130 8250")`: EMCY codes."""
    return frozenset(int(each, 16) for each in text.split())


STALE = frozenset({4})
INVALID = frozenset({15})
OFF = frozenset({0})
DRIVE_FAULT = frozenset({5})
STARTING = frozenset({1})
"""The observer begins again after a longer gap in its inputs."""
GAP = STALE | STARTING
LATE = codes("8250")
CHANGED = codes("FF03")
BUS_OFF, RESTARTED, CONTROLLER, NO_ACK = (CAN_ERR_FLAG | bit for bit in (0x40, 0x100, 0x204, 0x20))
NOTHING = bytes(8)
ALL = (0x181, 0x281, 0x182, 0x282, 0x183)
NODE_1 = (0x181, 0x281)
HEARTBEAT_1 = 0x701
_AGAIN_MS = 1500.0
"""A node that went away is configured again within this."""


def _toggling() -> Fault:
    states = [5, 5, 0x7F]

    def toggled(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        states.append(states.pop(0))
        return [(can_id, bytes([states[0]]))]

    return changed(toggled, HEARTBEAT_1)


def _negated_velocity(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
    velocity, current, word = struct.unpack("<ihH", data)
    return [(can_id, struct.pack("<ihH", -velocity, current, word))]


def _says(word: int) -> Fault:
    return changed(lambda can_id, data: [(can_id, data[:6] + struct.pack("<H", word))], 0x281)


def _jumped(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
    motor, link = struct.unpack("<ii", data)
    return [(can_id, struct.pack("<ii", (motor + 65536 + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000, link))]


def _link_only() -> Fault:
    kept: list[bytes] = []

    def stuck(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        kept.append(data[4:]) if not kept else None
        return [(can_id, data[:4] + kept[0])]

    return changed(stuck, 0x181)


def every(act: Act) -> Callable[[], Fault]:
    return lambda: Fault(each_cycle=act)


def of_inputs(
    key: str, title: str, injected: str, fault: type[Fault] | object, cycles: int, **more: object
) -> Case:
    """A case of joint 1's inputs: stale within two cycles, seven cycles after its end good again, no EMCY."""
    expected: dict[str, object] = {
        "one": STALE,
        "counters": ("stale_inputs",),
        "notice_ms": 2.5,
        "recover_ms": 15.0,
        **more,
    }
    return Case(key, title, injected, fault, cycles, **expected)  # type: ignore[arg-type]


# fmt: off
CASES = (
    # The bus and SYNC: 1 to 14.
    Case("1", "bus-off and restart", "error message bus-off, 100 ms of silence in both directions, message restarted",
         lambda: cut((BUS_OFF, NOTHING), (RESTARTED, NOTHING)), 100, one=GAP, two=GAP, emcy=codes("8140"), may=LATE,
         counters=("stale_inputs",), notice_ms=2.5, recover_ms=30.0,
         proof=all_of(frames(1, BUS_OFF), withheld(90, 0x181, 0x182), frames(1, RESTARTED))),
    Case("2", "error passive and active again", "error message TX passive (TEC 136), after 50 ms error active",
         lambda: Fault(lambda rig: rig.send(CONTROLLER, bytes.fromhex("0020000000008800")),
                       end=lambda rig: rig.send(CAN_ERR_FLAG | 4, bytes.fromhex("0040000000000000"))), 50,
         emcy=codes("8120"), notice_ms=60.0, proof=frames(1, CONTROLLER)),
    Case("3", "no-ACK storm", "5 error messages `no acknowledge` in each cycle",
         every(lambda rig: [rig.send(NO_ACK, NOTHING) for _ in range(5)]), 50, proof=frames(250, NO_ACK)),
    Case("8", "receive queue of the loop overflows", "loop stopped for 50 ms; 1000 frames 181h meanwhile",
         lambda: stopped(lambda rig: [rig.send(0x181, b"\x01") for _ in range(1000)]), 50, one=STARTING, two=STARTING,
         emcy=codes("8110"), may=codes("8210 8250"), counters=("rx_dropped", "missed"), notice_ms=120.0,
         recover_ms=60.0, stall=True, proof=all_of(of_length(100, 0x181, 1), silent(0.04, 0x080)),
         during=acts.loop_stands_still),
    Case("9a", "foreign master: stop, all nodes", "NMT stop, node-ID 0, in each of 20 cycles",
         every(lambda rig: rig.inject(0x000, b"\x02\x00")), 20, one=GAP, two=GAP, may=LATE,
         counters=("stale_inputs",), notice_ms=3.0, recover_ms=2500.0,
         proof=all_of(frames(20, 0x000, b"\x02\x00"), withheld(19, *ALL))),
    Case("9b", "foreign master: reset, all nodes", "NMT reset node, node-ID 0, in each of 20 cycles",
         every(lambda rig: rig.inject(0x000, b"\x81\x00")), 20, one=GAP, two=GAP, may=codes("8130 8250"),
         counters=("stale_inputs", "boot_ups"), notice_ms=3.0, recover_ms=2500.0,
         proof=all_of(frames(20, 0x000, b"\x81\x00"), *(frames(1, 0x700 + n, b"\0") for n in (1, 2, 3)))),
    Case("10", "babbling node, high priority", "9 frames 001h in each cycle, more than the wire could carry",
         every(lambda rig: [rig.send(0x001, NOTHING) for _ in range(9)]), 100, proof=frames(900, 0x001)),
    Case("11", "babbling node, low priority", "9 frames 7F0h in each cycle",
         every(lambda rig: [rig.send(0x7F0, NOTHING) for _ in range(9)]), 100, proof=frames(900, 0x7F0)),
    Case("12", "second SYNC producer", "SYNC of another node in each of 50 cycles",
         every(lambda rig: acts.foreign_sync(rig, b"\x05")), 50, one=GAP, two=GAP, emcy=codes("8150"),
         may=LATE, counters=("foreign_sync", "stale_inputs"), notice_ms=3.0, recover_ms=1200.0,
         proof=frames(50, 0x080, b"\x05")),
    Case("13a", "SYNC of a wrong length", "one SYNC of two bytes",
         every(lambda rig: acts.foreign_sync(rig, b"\x01\x02")), 1, one=STALE, two=STALE, emcy=codes("8150"),
         counters=("foreign_sync",), notice_ms=3.0, recover_ms=1200.0, proof=of_length(1, 0x080, 2)),
    Case("13b", "jump of the SYNC counter", "one SYNC with the own counter + 7",
         every(lambda rig: acts.foreign_sync(rig, bytes([(rig.watcher.counter + 6) % 240 + 1]))), 1,
         one=STALE, two=STALE, emcy=codes("8150"), counters=("foreign_sync",), notice_ms=3.0, recover_ms=1200.0,
         proof=counter_jumps(2)),
    Case("14a", "SYNC 0.5 ms late at the nodes", "all answers 0.5 ms later, 50 cycles", lambda: late(500), 50,
         proof=all_of(*(later(45, each, 490.0) for each in ALL))),
    of_inputs("14b", "SYNC 1 ms late at the nodes", "all answers 1 ms later, 50 cycles", lambda: late(1000), 50,
              one=GAP, two=GAP, may=LATE, counters=("late_frames", "stale_inputs"), recover_ms=40.0,
              proof=withheld(1, *ALL)),
    of_inputs("14c", "SYNC 5 ms late at the nodes", "all answers 5 ms later, 50 cycles", lambda: late(5000), 50,
              one=GAP, two=GAP, may=LATE, counters=("late_frames", "stale_inputs"), recover_ms=60.0,
              proof=withheld(2, *ALL)),
    of_inputs("14d", "SYNC lost once", "the nodes do not receive one SYNC", lambda: deaf(0x080), 1, two=STALE,
              proof=withheld(1, *ALL)),
    of_inputs("14e", "SYNC lost twice", "the nodes do not receive two SYNC", lambda: deaf(0x080), 2, two=STALE,
              proof=withheld(2, *ALL)),
    of_inputs("14f", "SYNC lost for 20 cycles", "the nodes do not receive 20 SYNC", lambda: deaf(0x080), 20,
              two=STALE, may=LATE, recover_ms=40.0, proof=withheld(20, *ALL)),
    # Process data objects: 16 to 22.
    of_inputs("16a", "TPDO1 of node 1 lost once", "181h suppressed", lambda: lost(0x181), 1,
              proof=withheld(1, 0x181)),
    of_inputs("16b", "TPDO1 of node 1 lost twice", "181h suppressed", lambda: lost(0x181), 2,
              proof=withheld(2, 0x181)),
    of_inputs("16c", "TPDO1 of node 1 lost 20 times", "181h suppressed", lambda: lost(0x181), 20, may=LATE,
              recover_ms=40.0, proof=withheld(20, 0x181)),
    of_inputs("16d", "TPDO1 of node 1 lost for 0.5 s", "181h suppressed", lambda: lost(0x181), 500, one=GAP,
              emcy=LATE, recover_ms=60.0, proof=withheld(450, 0x181)),
    of_inputs("16e", "all PDOs of node 1 lost for 0.5 s", "181h, 281h suppressed", lambda: lost(*NODE_1), 500,
              one=GAP, emcy=LATE, recover_ms=60.0, proof=withheld(450, *NODE_1)),
    of_inputs("16f", "all PDOs of all nodes lost for 0.5 s", "181h..183h, 281h, 282h suppressed", lambda: lost(*ALL),
              500, one=GAP, two=GAP, emcy=LATE, recover_ms=60.0, proof=withheld(450, *ALL)),
    Case("18a", "TPDO twice in a cycle, equal", "181h sent twice, 20 cycles",
         lambda: changed(lambda can_id, data: [(can_id, data), (can_id, data)], 0x181), 20,
         counters=("duplicate_frames",), notice_ms=12.0, proof=doubled(20, 0x181)),
    of_inputs("18b", "TPDO twice in a cycle, different", "181h and another 181h, 20 cycles",
              lambda: changed(lambda can_id, data: [(can_id, data), (can_id, bytes(8))], 0x181), 20,
              counters=("duplicate_frames", "stale_inputs"), may=LATE, recover_ms=40.0, proof=doubled(20, 0x181)),
    of_inputs("18c", "two cycles merged", "181h of one cycle comes with that of the next", lambda: late(995, 0x181),
              1, recover_ms=20.0, proof=withheld(1, 0x181)),
    Case("19", "TPDO1 after TPDO2", "181h 0.1 ms later, so after 281h, 50 cycles", lambda: late(100, 0x181), 50,
         proof=after(45, 0x181, 0x281)),
    of_inputs("20", "TPDO after the deadline", "181h 0.9 ms after SYNC, 20 cycles", lambda: late(900, 0x181), 20,
              counters=("late_frames", "stale_inputs"), may=LATE, recover_ms=40.0, proof=later(18, 0x181, 890.0)),
    of_inputs("21a", "wrong length 0..7", "181h with 0, 1, ... 7 bytes in eight cycles", acts.shorter, 8,
              emcy=codes("8210"), counters=("rejected_frames", "stale_inputs"),
              proof=all_of(*(of_length(1, 0x181, length) for length in range(8)))),
    Case("21b", "longer than mapped", "183h (sensor, 5 bytes) with 8 bytes, 8 cycles",
         lambda: changed(lambda can_id, data: [(can_id, data + b"\0\0\0")], 0x183), 8, emcy=codes("8220"),
         counters=("rejected_frames",), notice_ms=60.0, proof=of_length(8, 0x183, 8)),
    Case("22", "29-bit and remote frames of the same number", "00000181h and a remote 181h in each of 20 cycles",
         every(lambda rig: [rig.send(CAN_EFF_FLAG | 0x181, bytes(8)),
                                 rig.send(CAN_RTR_FLAG | 0x181, bytes(8))]), 20,
         counters=("rejected_frames",), notice_ms=12.0,
         proof=all_of(frames(20, CAN_EFF_FLAG | 0x181), frames(20, CAN_RTR_FLAG | 0x181))),
    # Nodes, SDO, clocks, processes, the interface: 23 to 38, and 4.
    Case("23", "node reset in the middle of a run", "node 1 restarts: boot-up message, default mapping",
         lambda: Fault(acts.restart), 1, one=GAP, counters=("boot_ups", "stale_inputs"), may=LATE,
         notice_ms=3.0, recover_ms=_AGAIN_MS, proof=frames(1, HEARTBEAT_1, b"\0")),
    Case("24a", "node silently goes pre-operational", "state of node 1 changed in the node",
         lambda: Fault(lambda rig: acts.set_state(rig, 1, PRE_OPERATIONAL)), 1, one=GAP,
         counters=("stale_inputs",), may=LATE, notice_ms=3.0, recover_ms=_AGAIN_MS,
         proof=all_of(frames(1, HEARTBEAT_1, b"\x7f"), withheld(20, 0x181))),
    Case("24b", "node silently stops", "state of node 1 changed in the node",
         lambda: Fault(lambda rig: acts.set_state(rig, 1, STOPPED)), 1, one=GAP, counters=("stale_inputs",),
         may=LATE, notice_ms=3.0, recover_ms=_AGAIN_MS,
         proof=all_of(frames(1, HEARTBEAT_1, b"\x04"), withheld(20, 0x181))),
    Case("25a", "heartbeat lost", "701h suppressed, 0.6 s", lambda: lost(HEARTBEAT_1), 600, emcy=codes("8130"),
         notice_ms=450.0, note="its PDOs come in time: they are used", proof=silent(0.5, HEARTBEAT_1)),
    Case("25b", "heartbeat late", "701h 150 ms later, 0.5 s", lambda: late(150_000, HEARTBEAT_1), 500,
         proof=silent(0.14, HEARTBEAT_1)),
    Case("25c", "heartbeat with a toggling state", "701h says pre-operational every third time, 0.7 s", _toggling,
         700, one=GAP, may=LATE, notice_ms=500.0, recover_ms=_AGAIN_MS,
         note="a node that says so is configured again", proof=frames(2, HEARTBEAT_1, b"\x7f")),
    Case("25d", "heartbeat of 0 or 2 bytes", "701h without data or with two bytes, 0.6 s",
         lambda: changed(lambda can_id, data: [(can_id, b""), (can_id, data * 2)], HEARTBEAT_1), 600,
         emcy=codes("8130"), counters=("rejected_frames",), notice_ms=450.0,
         proof=all_of(of_length(5, HEARTBEAT_1, 0), of_length(5, HEARTBEAT_1, 2))),
    Case("26", "two nodes with one node-ID", "second boot-up message of node 1; its PDOs and heartbeats twice, 1.5 s",
         lambda: replace(changed(lambda can_id, data: [(can_id, data), (can_id, data[:-1] + b"\x05")],
                                 0x181, 0x281, HEARTBEAT_1), begin=lambda rig: rig.send(HEARTBEAT_1, b"\0")), 1500,
         one=GAP, emcy=codes("8150"), may=LATE, counters=("boot_ups", "duplicate_frames"), notice_ms=3.0,
         recover_ms=_AGAIN_MS, proof=all_of(frames(1, HEARTBEAT_1, b"\0"), doubled(1400, 0x181))),
    Case("27", "wrong device comes back", "node 1 restarts with another product code (1018h:2) for 0.8 s",
         lambda: acts.returns_with(1, 0x1018, 2, 0x999), 800, one=GAP, emcy=LATE, may=codes("8130"),
         counters=("boot_ups",), notice_ms=3.0, recover_ms=3500.0,
         proof=all_of(frames(2, HEARTBEAT_1, b"\0"), two_answers(0x581, 0x1018, 2))),
    Case("28", "configuration changed in service", "another master writes 10 to 1800h:2 of node 1",
         lambda: Fault(acts.reconfigure), 1, one=GAP, emcy=CHANGED, may=LATE, counters=("stale_inputs",),
         notice_ms=3.0, recover_ms=20_000.0, note="found by reading the configuration back, one object in 0.1 s",
         proof=all_of(frames(1, 0x581, b"\x60\x00\x18\x02"), withheld(50, 0x181))),
    Case("28b", "the same without a change of 1020h", "the signature in 1020h is unchanged",
         lambda: Fault(acts.reconfigure_signed), 1, one=GAP, emcy=CHANGED, may=LATE, counters=("stale_inputs",),
         notice_ms=3.0, recover_ms=20_000.0, long=True,
         note="found by reading all objects that the PDOs depend on, one after the other",
         proof=all_of(frames(1, 0x581, b"\x60\x00\x18\x02"), withheld(50, 0x181))),
    Case("29a", "EMCY storm", "5 EMCY of node 1 in each of 200 cycles",
         every(lambda rig: [rig.send(0x081, bytes.fromhex("1023 03 0000000000")) for _ in range(5)]), 200,
         note="heard, named and bounded (2207h); the drive's statusword decides", proof=frames(1000, 0x081)),
    Case("29b", "EMCY short, end of errors, register only", "081h with 3 bytes, with 0000h, with 0000h and register 1",
         every(lambda rig: [rig.send(0x081, bytes.fromhex(each))
                                    for each in ("102303", "00" * 8, "000001" + "00" * 5)]), 20,
         proof=all_of(of_length(20, 0x081, 3), frames(20, 0x081, b"\0\0\0"), frames(20, 0x081, b"\0\0\x01"))),
    Case("32a", "SDO: no answer from a node that comes back", "node 1 restarts, and does not receive 601h for 0.8 s",
         acts.mute_restart, 800, one=GAP, emcy=LATE, may=codes("8130"), counters=("boot_ups",), notice_ms=3.0,
         recover_ms=3500.0, proof=all_of(frames(1, HEARTBEAT_1, b"\0"), frames(2, 0x601), silent(0.7, 0x581))),
    Case("32b", "SDO: flood of unsolicited answers", "5 frames 581h and 582h in each of 200 cycles",
         every(lambda rig: [rig.send(can_id, b"\x43\x00\x10\x00\x92\x01\x02\x00")
                                    for can_id in (0x581, 0x582) * 5]), 200,
         proof=all_of(frames(1000, 0x581), frames(1000, 0x582))),
    Case("33", "SDO in the 1 kHz run", "reads of jtqd's and node 1's objects in each of 300 cycles",
         every(acts.sdo_reads), 300,
         proof=all_of(frames(200, 0x5A0), frames(290, 0x581, b"\x43\x18\x10\x01"))),
    Case("36", "rated current changed after a restart", "node 1 restarts with half of 6075h for 0.8 s",
         lambda: acts.returns_with(1, 0x6075, 0, None), 800, one=GAP, emcy=LATE, may=codes("8130"),
         counters=("boot_ups",), notice_ms=3.0, recover_ms=3500.0,
         proof=all_of(frames(2, HEARTBEAT_1, b"\0"), two_answers(0x581, 0x6075, 0))),
    Case("36b", "rated current changed in service", "6075h of node 1 halved for 13 s, without a restart",
         lambda: acts.changes(1, 0x6075, 0, 0.5), 13_000, one=GAP, emcy=CHANGED, may=LATE, counters=("stale_inputs",),
         notice_ms=12_500.0, recover_ms=10_000.0, long=True,
         note="found by reading the scaling again; the node stays out until it is as it was",
         proof=two_answers(0x581, 0x6075, 0)),
    Case("35b", "decimals of the sensor changed in service", "6132h:1 of node 3 one less for 6 s",
         lambda: acts.changes(3, 0x6132, 1, 2.0 / 3.0), 6_000, emcy=CHANGED, may=LATE, counters=("stale_inputs",),
         notice_ms=6_000.0, long=True,
         note="the reference is not used until they are as they were; the estimates do not need it",
         proof=two_answers(0x583, 0x6132, 1)),
    Case("37", "clock step", "CLOCK_REALTIME 1 h forward, after 0.1 s back",
         lambda: Fault(lambda rig: acts.step_clock(3600.0), end=lambda rig: acts.step_clock(-3600.0)), 100,
         note="between two cycles; only differences of stamps within a cycle are used", proof=clock_stepped(3599.0)),
    Case("38a", "loop stopped for 100 ms", "SIGSTOP to the loop", stopped, 100, one=STARTING, two=STARTING,
         counters=("missed",), notice_ms=150.0, recover_ms=60.0, stall=True, proof=silent(0.09, 0x080),
         during=acts.loop_stands_still),
    Case("38b", "supervisor stopped for 1 s", "SIGSTOP to the supervisor",
         lambda: Fault(lambda rig: rig.process.send_signal(signal.SIGSTOP),
                       lambda rig: rig.process.send_signal(signal.SIGCONT)), 1000,
         note="the loop does not need it", during=lambda rig: acts.stands_still("supervisor", rig.process.pid)),
    Case("4", "interface down and up", "ip link set down, after 0.2 s up",
         lambda: Fault(lambda rig: acts.link(rig, "down"), end=lambda rig: acts.link(rig, "up")), 200, one=GAP,
         two=GAP, counters=("bus_errors",), notice_ms=60.0, recover_ms=_AGAIN_MS,
         may=LATE | codes("8130"),  # of a node whose heartbeat falls three times into the 0.21 s
         proof=silent(0.19, 0x181), during=acts.link_is_down),
    # What drives and sensor report is wrong, though it comes in time: 17, 30, 34 and 35.
    Case("30a", "drive in fault", "node 1: fault for 0.2 s, then reset",
         lambda: Fault(lambda rig: acts.drive_fault(rig, 1), end=lambda rig: acts.release(rig, 1)), 200,
         one=DRIVE_FAULT, notice_ms=3.0, recover_ms=300.0, settle=1100,
         proof=all_of(statuswords(190, 1, 0x4F, 0x08), frames(1, 0x081, b"\x10\x23"))),
    Case("30b", "quick stop", "6041h of node 1 says quick stop active, 0.1 s", lambda: _says(0x0237 & ~0x20 | 0x07),
         100, note="the motor still carries current: the estimate goes on", proof=statuswords(95, 1, 0x6F, 0x07)),
    Case("30c", "fault reaction", "6041h of node 1 says fault reaction active, 0.1 s", lambda: _says(0x021F), 100,
         one=DRIVE_FAULT, notice_ms=3.0, recover_ms=500.0, long=True, settle=1100,
         proof=statuswords(95, 1, 0x4F, 0x0F)),
    Case("30d", "power stage off", "6041h of node 1 says switch on disabled, 0.1 s", lambda: _says(0x0250), 100,
         one=OFF, notice_ms=3.0, recover_ms=200.0, settle=500, proof=statuswords(95, 1, 0x4F, 0x40)),
    Case("35", "sensor not valid, overload", "6150h of the sensor's PDO with bits 0 and 1, 0.2 s",
         lambda: changed(lambda can_id, data: [(can_id, data[:4] + b"\x03")], 0x183), 200,
         note="the reference is unknown meanwhile; the estimate does not use it", proof=sensor_status(190, 3)),
    Case("34a", "velocity with the wrong sign", "606Ch of node 1 negated while it moves, 0.3 s",
         lambda: replace(changed(_negated_velocity, 0x281), end=acts.reset), 300, one=INVALID, emcy=codes("FF01"),
         counters=("fault_velocity_mismatch",), notice_ms=350.0, recover_ms=2500.0, wait=acts.moving, long=True,
         settle=600, proof=velocity_against_position(250)),
    Case("34b", "encoder jump", "motor position of node 1 one turn further for 50 ms",
         lambda: replace(changed(_jumped, 0x181), end=acts.reset), 50, one=INVALID | STARTING, emcy=codes("FF02"),
         may=codes("FF01"), counters=("fault_motor_jump", "latches", "latch_resets"), notice_ms=3.0,
         recover_ms=1500.0, settle=600, note="latched; 1 written to 2110h", proof=position_jump(60_000)),
    Case("34c", "link encoder stuck", "link position of node 1 keeps its value while it moves, 0.5 s",
         lambda: replace(_link_only(), end=acts.reset), 500, one=INVALID | STARTING, emcy=codes("FF01"),
         may=codes("FF02"), counters=("fault_torsion",), notice_ms=500.0, recover_ms=2500.0, wait=acts.moving,
         long=True, settle=600, proof=stuck(450, 1)),
    Case("17", "frozen encoder: positions repeat, stamps move", "181h keeps its data while the joint moves, 1 s",
         lambda: replace(frozen(0x181), end=acts.reset), 1000, one=INVALID | STARTING, emcy=codes("FF01"),
         may=codes("FF02"), counters=("fault_velocity_mismatch",), notice_ms=1000.0, recover_ms=2500.0,
         wait=acts.moving, long=True, settle=1100, proof=stuck(900, 0)),
)
# fmt: on


# With nodes of the `canopen` library (tests/library_drives): which cases make sense with them, and what is otherwise.
# These nodes are strict: a SYNC of another length than 1019h gives is 8240h, and an error of communication takes them out of
# operational until a reset. Their SYNC has no counter, as a drive's after its power-up.

LEFT_OUT: Mapping[str, str] = {"13b": "their SYNC has no counter", "28b": "they have no 1020h"}
"""Case -> why it is not played with them."""

_AFTER_A_RESET_MS = 1800.0
"""They answer a SYNC with data by 8240h and stay pre-operational until they are reset."""
_OTHERWISE: Mapping[str, Mapping[str, Any]] = {
    "12": {"recover_ms": _AFTER_A_RESET_MS},
    "13a": {
        "one": STALE | STARTING,
        "two": STALE | STARTING,
        "may": codes("8250"),
        "recover_ms": _AFTER_A_RESET_MS,
    },
    # their boot takes longer, and there are no PDOs while it lasts
    "26": {"proof": all_of(frames(1, 0x701, b"\0"), doubled(1200, 0x181))},
    "28": {"fault": lambda: Fault(acts.reconfigure_by_the_rules)},
}
"""Case -> fields that are otherwise with them."""


def with_library(cases: Iterable[Case]) -> list[Case]:
    """Return the cases as they are played with the nodes of the library."""
    return [replace(each, **_OTHERWISE.get(each.key, {})) for each in cases if each.key not in LEFT_OUT]


class Shown(NamedTuple):
    """What other tests show of a case: what is injected, what comes out, and the tests (path::function)."""

    number: int
    what: str
    outcome: str
    tests: tuple[str, ...]


# fmt: off
ELSEWHERE = (
    Shown(5, "interface removed and created again",
          "exit status 1 with one line; systemd restarts jtqd when the interface is back",
          ("tests/daemon/bus/test_daemon_on_vcan.py::test_an_interface_that_is_removed_ends_the_daemon_with_one_line",
           "tests/systemd/test_systemd_boot.py::test_whatever_happens_to_a_service")),
    Shown(6, "bus absent at the start",
          "one line, exit status 1; a link that is down is reported at the first receive",
          ("tests/daemon/test_jtqd.py::test_unknown_bus",
           "tests/drivers/test_socketcan.py::test_a_link_that_is_down_is_reported_at_the_first_receive")),
    Shown(7, "transmit queue full (ENOBUFS)",
          "the frame is dropped and counted in `tx_dropped`; vcan has no queue that could fill",
          ("tests/drivers/test_frame_socket.py::test_enobufs_is_a_dropped_frame_not_an_error",)),
    Shown(14, "the loop is late for its own SYNC", "the slot is skipped and counted in `missed`, no burst",
          ("tests/daemon/loop/test_cycle.py::test_a_stall_of_minutes_is_recorded_and_not_fatal",)),
    Shown(15, "echo of the own SYNC missing", "no input of the cycle is used, `sync_errors`; vcan always echoes",
          ("tests/daemon/loop/test_intake.py::test_without_the_echo_of_sync_nothing_is_used",)),
    Shown(27, "wrong device at the start", "refused with node, object, expected and found value",
          ("tests/drivers/test_boot.py::test_a_wrong_value_is_named",)),
    Shown(28, "mapping or transmission type that reads back different", "refused at the boot",
          ("tests/drivers/test_boot.py::test_a_value_that_is_not_kept",)),
    Shown(31, "mode of operation display (6061h) changes",
          "a line for the operator; the estimate uses current and positions in any mode",
          ("tests/daemon/bus/test_service.py::test_another_mode_is_reported_and_the_node_is_used",)),
    Shown(32, "SDO: aborts, toggle error, late and wrong answers, sizes, flood",
          "each transfer ends with a result or an error, never with a wrong value",
          ("tests/drivers/test_sdo.py::test_a_refusal_is_the_servers",
           "tests/drivers/test_sdo.py::test_answers_to_something_else_are_ignored",
           "tests/drivers/test_sdo.py::test_a_toggle_error_ends_the_transfer_and_it_is_repeated",
           "tests/drivers/test_sdo.py::test_a_size_that_is_not_kept_and_one_that_is_too_large",
           "tests/drivers/test_sdo.py::test_silence_is_asked_again_and_then_given_up",
           "tests/slow/test_fuzz_frames.py::test_the_supervisors_path")),
    Shown(34, "position counter rolls over at 2^31", "the estimate continues",
          ("tests/daemon/loop/test_cycle.py::test_a_position_that_rolls_over_goes_on",)),
    Shown(36, "rated current 0", "refused at the boot",
          ("tests/drivers/test_boot.py::test_a_wrong_value_is_named",)),
    Shown(38, "loop stopped permanently", "the watchdog of systemd restarts the service",
          ("tests/systemd/test_systemd_boot.py::test_installed_started_restarted_hung_and_stopped",)),
    Shown(39, "a busy process for 0.2 s at a priority above the loop's",
          "slots are skipped and counted in `missed`; published estimates use inputs of their own cycle",
          ("tests/daemon/test_jtqd.py::test_a_processor_hog_costs_counted_cycles_and_nothing_that_is_published_is_stale",)),
    Shown(39, "garbage collection", "it is off in the loop, and no cycle creates objects that need it",
          ("tests/daemon/loop/test_cycle.py::test_the_collector_is_off_once_the_loop_is_ready",
           "tests/daemon/loop/test_cycle.py::test_no_cycle_leaves_anything_to_a_collector")),
    Shown(40, "disk full, slow recorder", "cycles continue; cycles missing in the log are counted",
          ("tests/daemon/test_vcan.py::test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing",
           "tests/slow/test_fuzz_soak.py::test_a_minute_of_faults",
           "tests/daemon/logs/test_recover.py::test_full_disk_leaves_the_file_as_it_was",
           "tests/systemd/test_systemd_boot.py::test_whatever_happens_to_a_service")),
    Shown(41, "kill -9 while the log is written", "repaired at the next start; no complete span is lost",
          ("tests/daemon/test_vcan.py::test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing",
           "tests/daemon/logs/test_recover.py::test_killed_between_two_chunks_loses_nothing",
           "tests/daemon/logs/test_recover.py::test_random_damage",
           "tests/slow/test_fuzz_files.py::test_every_kind_of_file")),
    Shown(42, "network: NaN, slow, far, corrupt, missing",
          "refused at the start, or not used in the cycle and counted by reason",
          ("tests/estimator/test_network.py::test_a_graph_that_is_not_that_of_its_weights_is_refused",
           "tests/estimator/test_network.py::test_unreadable_and_corrupt_files",
           "tests/estimator/test_network.py::test_flipped_bytes_never_give_another_exception",
           "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
           "tests/daemon/loop/test_safety_published.py::test_the_network_that_is_dropped_is_counted_by_its_reason",
           "tests/daemon/loop/test_safety_overrun.py::test_a_network_that_has_become_slow_costs_two_cycles_and_then_only_itself")),
    Shown(43, "invalid configuration and joint files", "one line that names file, key, found and expected value",
          ("tests/daemon/test_config.py::test_mistakes_are_named",
           "tests/daemon/test_config.py::test_files_that_are_no_configuration",
           "tests/models/test_joint_file.py::test_random_garbage_never_gets_past_as_another_exception",
           "tests/slow/test_fuzz_files.py::test_every_kind_of_file",
           "tests/slow/test_fuzz_files.py::test_small_texts_that_explode")),
    Shown(44, "EDS files", "CiA 306 is met; the lint detects each violation",
          ("tests/tools/test_eds.py::test_the_lint_sees_each_breach",
           "tests/slow/test_fuzz_files.py::test_every_kind_of_file")),
    Shown(45, "random frames", "used inputs have the number of their own cycle; garbage is counted and has no effect",
          ("tests/daemon/loop/test_intake.py::test_whatever_is_lost_or_late_what_is_used_is_of_its_own_cycle",
           "tests/daemon/test_jtqd.py::test_garbage_on_the_bus_is_counted_and_changes_nothing",
           "tests/slow/test_fuzz_frames.py::test_50_000_frames",
           "tests/slow/test_fuzz_frames.py::test_a_million_frames",
           "tests/slow/test_fuzz_frames.py::test_minimal_examples",
           "tests/slow/test_fuzz_frames.py::test_the_supervisors_path",
           "tests/slow/test_fuzz_soak.py::test_a_storm")),
)
# fmt: on

NOT_COVERED: dict[int, str] = {}
"""Number of a case that no test shows: why."""
