"""Cases 1 to 14 of the list: the bus and SYNC."""

from __future__ import annotations

from jtqd.drivers.frame import CAN_ERR_FLAG
from tests.slow.faults import acts, proofs
from tests.slow.faults.case import STALE, STARTING, Case, codes
from tests.slow.faults.injections import Added, Cut, Deaf, Fault, Late, Stopped

BUS_OFF, RESTARTED, CONTROLLER, NO_ACK = (CAN_ERR_FLAG | bit for bit in (0x40, 0x100, 0x204, 0x20))
NOTHING = bytes(8)
ALL = (0x181, 0x281, 0x182, 0x282, 0x183)
LATE = codes("8250")


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


CASES = (
    Case(
        "1",
        "bus-off and restart",
        "error message bus-off, 100 ms of silence in both directions, message restarted",
        lambda: Cut((BUS_OFF, NOTHING), (RESTARTED, NOTHING)),
        100,
        one=STALE | STARTING,
        two=STALE | STARTING,
        emcy=codes("8140"),
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=2.5,
        recover_ms=30.0,
        proof=proofs.all_of(
            proofs.frames(1, BUS_OFF), proofs.withheld(90, 0x181, 0x182), proofs.frames(1, RESTARTED)
        ),
    ),
    Case(
        "2",
        "error passive and active again",
        "error message TX passive (TEC 136), after 50 ms error active",
        lambda: Added(
            first=lambda rig: rig.send(CONTROLLER, bytes.fromhex("0020000000008800")),
            last=lambda rig: rig.send(CAN_ERR_FLAG | 4, bytes.fromhex("0040000000000000")),
        ),
        50,
        emcy=codes("8120"),
        notice_ms=60.0,
        proof=proofs.frames(1, CONTROLLER),
    ),
    Case(
        "3",
        "no-ACK storm",
        "5 error messages `no acknowledge` in each cycle",
        lambda: Added(lambda rig: [rig.send(NO_ACK, NOTHING) for _ in range(5)]),
        50,
        proof=proofs.frames(250, NO_ACK),
    ),
    Case(
        "8",
        "receive queue of the loop overflows",
        "loop stopped for 50 ms; 1000 frames 181h meanwhile",
        lambda: Stopped(lambda rig: [rig.send(0x181, b"\x01") for _ in range(1000)]),
        50,
        one=STARTING,
        two=STARTING,
        emcy=codes("8110"),
        may=codes("8210 8250"),
        counters=("rx_dropped", "missed"),
        notice_ms=120.0,
        recover_ms=60.0,
        stall=True,
        proof=proofs.all_of(proofs.of_length(100, 0x181, 1), proofs.silent(0.04, 0x080)),
        during=acts.loop_stands_still,
    ),
    Case(
        "9a",
        "foreign master: stop, all nodes",
        "NMT stop, node-ID 0, in each of 20 cycles",
        lambda: Added(lambda rig: rig.inject(0x000, b"\x02\x00")),
        20,
        one=STALE | STARTING,
        two=STALE | STARTING,
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=3.0,
        recover_ms=2500.0,
        proof=proofs.all_of(proofs.frames(20, 0x000, b"\x02\x00"), proofs.withheld(19, *ALL)),
    ),
    Case(
        "9b",
        "foreign master: reset, all nodes",
        "NMT reset node, node-ID 0, in each of 20 cycles",
        lambda: Added(lambda rig: rig.inject(0x000, b"\x81\x00")),
        20,
        one=STALE | STARTING,
        two=STALE | STARTING,
        may=codes("8130 8250"),
        counters=("stale_inputs", "boot_ups"),
        notice_ms=3.0,
        recover_ms=2500.0,
        proof=proofs.all_of(
            proofs.frames(20, 0x000, b"\x81\x00"), *(proofs.frames(1, 0x700 + n, b"\0") for n in (1, 2, 3))
        ),
    ),
    Case(
        "10",
        "babbling node, high priority",
        "9 frames 001h in each cycle, more than the wire could carry",
        lambda: Added(lambda rig: [rig.send(0x001, NOTHING) for _ in range(9)]),
        100,
        proof=proofs.frames(900, 0x001),
    ),
    Case(
        "11",
        "babbling node, low priority",
        "9 frames 7F0h in each cycle",
        lambda: Added(lambda rig: [rig.send(0x7F0, NOTHING) for _ in range(9)]),
        100,
        proof=proofs.frames(900, 0x7F0),
    ),
    Case(
        "12",
        "second SYNC producer",
        "SYNC of another node in each of 50 cycles",
        lambda: Added(lambda rig: acts.foreign_sync(rig, b"\x05")),
        50,
        one=STALE | STARTING,
        two=STALE | STARTING,
        emcy=codes("8150"),
        may=LATE,
        counters=("foreign_sync", "stale_inputs"),
        notice_ms=3.0,
        recover_ms=1200.0,
        proof=proofs.frames(50, 0x080, b"\x05"),
    ),
    Case(
        "13a",
        "SYNC of a wrong length",
        "one SYNC of two bytes",
        lambda: Added(lambda rig: acts.foreign_sync(rig, b"\x01\x02")),
        1,
        one=STALE,
        two=STALE,
        emcy=codes("8150"),
        counters=("foreign_sync",),
        notice_ms=3.0,
        recover_ms=1200.0,
        proof=proofs.of_length(1, 0x080, 2),
    ),
    Case(
        "13b",
        "jump of the SYNC counter",
        "one SYNC with the own counter + 7",
        lambda: Added(lambda rig: acts.foreign_sync(rig, bytes([(rig.watcher.counter + 6) % 240 + 1]))),
        1,
        one=STALE,
        two=STALE,
        emcy=codes("8150"),
        counters=("foreign_sync",),
        notice_ms=3.0,
        recover_ms=1200.0,
        proof=proofs.counter_jumps(2),
    ),
    Case(
        "14a",
        "SYNC 0.5 ms late at the nodes",
        "all answers 0.5 ms later, 50 cycles",
        lambda: Late(500),
        50,
        proof=proofs.all_of(*(proofs.later(45, each, 490.0) for each in ALL)),
    ),
    of_inputs(
        "14b",
        "SYNC 1 ms late at the nodes",
        "all answers 1 ms later, 50 cycles",
        lambda: Late(1000),
        50,
        one=STALE | STARTING,
        two=STALE | STARTING,
        may=LATE,
        counters=("late_frames", "stale_inputs"),
        recover_ms=40.0,
        proof=proofs.withheld(1, *ALL),
    ),
    of_inputs(
        "14c",
        "SYNC 5 ms late at the nodes",
        "all answers 5 ms later, 50 cycles",
        lambda: Late(5000),
        50,
        one=STALE | STARTING,
        two=STALE | STARTING,
        may=LATE,
        counters=("late_frames", "stale_inputs"),
        recover_ms=60.0,
        proof=proofs.withheld(2, *ALL),
    ),
    of_inputs(
        "14d",
        "SYNC lost once",
        "the nodes do not receive one SYNC",
        lambda: Deaf(0x080),
        1,
        two=STALE,
        proof=proofs.withheld(1, *ALL),
    ),
    of_inputs(
        "14e",
        "SYNC lost twice",
        "the nodes do not receive two SYNC",
        lambda: Deaf(0x080),
        2,
        two=STALE,
        proof=proofs.withheld(2, *ALL),
    ),
    of_inputs(
        *("14f", "SYNC lost for 20 cycles", "the nodes do not receive 20 SYNC", lambda: Deaf(0x080), 20),
        two=STALE,
        may=LATE,
        recover_ms=40.0,
        proof=proofs.withheld(20, *ALL),
    ),
)
