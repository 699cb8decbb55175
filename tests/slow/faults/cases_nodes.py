"""Cases 23 to 38 of the list, and 4: nodes, SDO, clocks, processes, the interface."""

from __future__ import annotations

from jtqd.drivers.nmt import PRE_OPERATIONAL, STOPPED
from tests.slow.faults import acts, proofs
from tests.slow.faults.case import STALE, STARTING, Case, codes
from tests.slow.faults.injections import Added, AndThen, Changed, Late, Lost, Stopped

GAP = STALE | STARTING
LATE = codes("8250")
CHANGED = codes("FF03")
HEARTBEAT_1 = 0x701
_AGAIN_MS = 1500.0
"""A node that went away is configured again within this."""


def _toggling() -> Changed:
    states = [5, 5, 0x7F]

    def toggled(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        states.append(states.pop(0))
        return [(can_id, bytes([states[0]]))]

    return Changed(toggled, HEARTBEAT_1)


CASES = (
    Case(
        *("23", "node reset in the middle of a run", "node 1 restarts: boot-up message, default mapping"),
        lambda: Added(first=acts.restart),
        1,
        one=GAP,
        counters=("boot_ups", "stale_inputs"),
        may=LATE,
        notice_ms=3.0,
        recover_ms=_AGAIN_MS,
        proof=proofs.frames(1, HEARTBEAT_1, b"\0"),
    ),
    Case(
        *("24a", "node silently goes pre-operational", "state of node 1 changed in the node"),
        lambda: Added(first=lambda rig: acts.set_state(rig, 1, PRE_OPERATIONAL)),
        1,
        one=GAP,
        counters=("stale_inputs",),
        may=LATE,
        notice_ms=3.0,
        recover_ms=_AGAIN_MS,
        proof=proofs.all_of(proofs.frames(1, HEARTBEAT_1, b"\x7f"), proofs.withheld(20, 0x181)),
    ),
    Case(
        *("24b", "node silently stops", "state of node 1 changed in the node"),
        lambda: Added(first=lambda rig: acts.set_state(rig, 1, STOPPED)),
        1,
        one=GAP,
        counters=("stale_inputs",),
        may=LATE,
        notice_ms=3.0,
        recover_ms=_AGAIN_MS,
        proof=proofs.all_of(proofs.frames(1, HEARTBEAT_1, b"\x04"), proofs.withheld(20, 0x181)),
    ),
    Case(
        *("25a", "heartbeat lost", "701h suppressed, 0.6 s"),
        lambda: Lost(HEARTBEAT_1),
        600,
        emcy=codes("8130"),
        notice_ms=450.0,
        note="its PDOs come in time: they are used",
        proof=proofs.silent(0.5, HEARTBEAT_1),
    ),
    Case(
        *("25b", "heartbeat late", "701h 150 ms later, 0.5 s"),
        lambda: Late(150_000, HEARTBEAT_1),
        500,
        proof=proofs.silent(0.14, HEARTBEAT_1),
    ),
    Case(
        *("25c", "heartbeat with a toggling state", "701h says pre-operational every third time, 0.7 s"),
        _toggling,
        700,
        one=GAP,
        may=LATE,
        notice_ms=500.0,
        recover_ms=_AGAIN_MS,
        note="a node that says so is configured again",
        proof=proofs.frames(2, HEARTBEAT_1, b"\x7f"),
    ),
    Case(
        *("25d", "heartbeat of 0 or 2 bytes", "701h without data or with two bytes, 0.6 s"),
        lambda: Changed(lambda can_id, data: [(can_id, b""), (can_id, data * 2)], HEARTBEAT_1),
        600,
        emcy=codes("8130"),
        counters=("rejected_frames",),
        notice_ms=450.0,
        proof=proofs.all_of(proofs.of_length(5, HEARTBEAT_1, 0), proofs.of_length(5, HEARTBEAT_1, 2)),
    ),
    Case(
        *(
            "26",
            "two nodes with one node-ID",
            "second boot-up message of node 1; its PDOs and heartbeats twice, 1.5 s",
        ),
        lambda: AndThen(
            Changed(
                lambda can_id, data: [(can_id, data), (can_id, data[:-1] + b"\x05")],
                0x181,
                0x281,
                HEARTBEAT_1,
            ),
            first=lambda rig: rig.send(HEARTBEAT_1, b"\0"),
        ),
        1500,
        one=GAP,
        emcy=codes("8150"),
        may=LATE,
        counters=("boot_ups", "duplicate_frames"),
        notice_ms=3.0,
        recover_ms=_AGAIN_MS,
        proof=proofs.all_of(proofs.frames(1, HEARTBEAT_1, b"\0"), proofs.doubled(1400, 0x181)),
    ),
    Case(
        *("27", "wrong device comes back", "node 1 restarts with another product code (1018h:2) for 0.8 s"),
        lambda: acts.returns_with(1, 0x1018, 2, 0x999),
        800,
        one=GAP,
        emcy=LATE,
        may=codes("8130"),
        counters=("boot_ups",),
        notice_ms=3.0,
        recover_ms=3500.0,
        proof=proofs.all_of(proofs.frames(2, HEARTBEAT_1, b"\0"), proofs.two_answers(0x581, 0x1018, 2)),
    ),
    Case(
        *("28", "configuration changed in service", "another master writes 10 to 1800h:2 of node 1"),
        lambda: Added(first=acts.reconfigure),
        1,
        one=GAP,
        emcy=CHANGED,
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=3.0,
        recover_ms=20_000.0,
        note="found by reading the configuration back, one object in 0.1 s",
        proof=proofs.all_of(proofs.frames(1, 0x581, b"\x60\x00\x18\x02"), proofs.withheld(50, 0x181)),
    ),
    Case(
        *("28b", "the same without a change of 1020h", "the signature in 1020h is unchanged"),
        lambda: Added(first=acts.reconfigure_signed),
        1,
        one=GAP,
        emcy=CHANGED,
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=3.0,
        recover_ms=20_000.0,
        long=True,
        note="found by reading all objects that the PDOs depend on, one after the other",
        proof=proofs.all_of(proofs.frames(1, 0x581, b"\x60\x00\x18\x02"), proofs.withheld(50, 0x181)),
    ),
    Case(
        *("29a", "EMCY storm", "5 EMCY of node 1 in each of 200 cycles"),
        lambda: Added(lambda rig: [rig.send(0x081, bytes.fromhex("1023 03 0000000000")) for _ in range(5)]),
        200,
        note="heard, named and bounded (2207h); the drive's statusword decides",
        proof=proofs.frames(1000, 0x081),
    ),
    Case(
        *(
            "29b",
            "EMCY short, end of errors, register only",
            "081h with 3 bytes, with 0000h, with 0000h and register 1",
        ),
        lambda: Added(
            lambda rig: [
                rig.send(0x081, bytes.fromhex(each)) for each in ("102303", "00" * 8, "000001" + "00" * 5)
            ]
        ),
        20,
        proof=proofs.all_of(
            proofs.of_length(20, 0x081, 3),
            proofs.frames(20, 0x081, b"\0\0\0"),
            proofs.frames(20, 0x081, b"\0\0\x01"),
        ),
    ),
    Case(
        *(
            "32a",
            "SDO: no answer from a node that comes back",
            "node 1 restarts, and does not receive 601h for 0.8 s",
        ),
        acts.mute_restart,
        800,
        one=GAP,
        emcy=LATE,
        may=codes("8130"),
        counters=("boot_ups",),
        notice_ms=3.0,
        recover_ms=3500.0,
        proof=proofs.all_of(
            proofs.frames(1, HEARTBEAT_1, b"\0"), proofs.frames(2, 0x601), proofs.silent(0.7, 0x581)
        ),
    ),
    Case(
        *("32b", "SDO: flood of unsolicited answers", "5 frames 581h and 582h in each of 200 cycles"),
        lambda: Added(
            lambda rig: [
                rig.send(can_id, b"\x43\x00\x10\x00\x92\x01\x02\x00") for can_id in (0x581, 0x582) * 5
            ]
        ),
        200,
        proof=proofs.all_of(proofs.frames(1000, 0x581), proofs.frames(1000, 0x582)),
    ),
    Case(
        *("33", "SDO in the 1 kHz run", "reads of jtqd's and node 1's objects in each of 300 cycles"),
        lambda: Added(acts.sdo_reads),
        300,
        proof=proofs.all_of(proofs.frames(200, 0x5A0), proofs.frames(290, 0x581, b"\x43\x18\x10\x01")),
    ),
    Case(
        *("36", "rated current changed after a restart", "node 1 restarts with half of 6075h for 0.8 s"),
        lambda: acts.returns_with(1, 0x6075, 0, None),
        800,
        one=GAP,
        emcy=LATE,
        may=codes("8130"),
        counters=("boot_ups",),
        notice_ms=3.0,
        recover_ms=3500.0,
        proof=proofs.all_of(proofs.frames(2, HEARTBEAT_1, b"\0"), proofs.two_answers(0x581, 0x6075, 0)),
    ),
    Case(
        *("36b", "rated current changed in service", "6075h of node 1 halved for 13 s, without a restart"),
        lambda: acts.changes(1, 0x6075, 0, 0.5),
        13_000,
        one=GAP,
        emcy=CHANGED,
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=12_500.0,
        recover_ms=10_000.0,
        long=True,
        note="found by reading the scaling again; the node stays out until it is as it was",
        proof=proofs.two_answers(0x581, 0x6075, 0),
    ),
    Case(
        *("35b", "decimals of the sensor changed in service", "6132h:1 of node 3 one less for 6 s"),
        lambda: acts.changes(3, 0x6132, 1, 2.0 / 3.0),
        6_000,
        emcy=CHANGED,
        may=LATE,
        counters=("stale_inputs",),
        notice_ms=6_000.0,
        long=True,
        note="the reference is not used until they are as they were; the estimates do not need it",
        proof=proofs.two_answers(0x583, 0x6132, 1),
    ),
    Case(
        *("37", "clock step", "CLOCK_REALTIME 1 h forward, after 0.1 s back"),
        lambda: Added(first=lambda rig: acts.step_clock(3600.0), last=lambda rig: acts.step_clock(-3600.0)),
        100,
        note="between two cycles; only differences of stamps within a cycle are used",
        proof=proofs.clock_stepped(3599.0),
    ),
    Case(
        *("38a", "loop stopped for 100 ms", "SIGSTOP to the loop"),
        Stopped,
        100,
        one=STARTING,
        two=STARTING,
        counters=("missed",),
        notice_ms=150.0,
        recover_ms=60.0,
        stall=True,
        proof=proofs.silent(0.09, 0x080),
        during=acts.loop_stands_still,
    ),
    Case(
        *("38b", "supervisor stopped for 1 s", "SIGSTOP to the supervisor"),
        lambda: Added(first=acts.stop_supervisor, last=acts.go_on_supervisor),
        1000,
        note="the loop does not need it",
        during=acts.supervisor_stands_still,
    ),
    Case(
        *("4", "interface down and up", "ip link set down, after 0.2 s up"),
        lambda: Added(first=lambda rig: acts.link(rig, "down"), last=lambda rig: acts.link(rig, "up")),
        200,
        one=GAP,
        two=GAP,
        may=LATE | codes("8130"),  # of a node whose heartbeat falls three times into the 0.21 s
        counters=("bus_errors",),
        notice_ms=60.0,
        recover_ms=_AGAIN_MS,
        proof=proofs.silent(0.19, 0x181),
        during=acts.link_is_down,
    ),
)
