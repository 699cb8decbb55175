"""Cases 16 to 22 of the list: process data objects."""

from __future__ import annotations

from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_RTR_FLAG
from tests.slow.faults import acts, proofs
from tests.slow.faults.case import STALE, STARTING, Case, codes
from tests.slow.faults.cases_bus import ALL, LATE, of_inputs
from tests.slow.faults.injections import Added, Changed, Late, Lost

NODE_1 = (0x181, 0x281)

CASES = (
    of_inputs(
        "16a",
        "TPDO1 of node 1 lost once",
        "181h suppressed",
        lambda: Lost(0x181),
        1,
        proof=proofs.withheld(1, 0x181),
    ),
    of_inputs(
        "16b",
        "TPDO1 of node 1 lost twice",
        "181h suppressed",
        lambda: Lost(0x181),
        2,
        proof=proofs.withheld(2, 0x181),
    ),
    of_inputs(
        *("16c", "TPDO1 of node 1 lost 20 times", "181h suppressed", lambda: Lost(0x181), 20),
        may=LATE,
        recover_ms=40.0,
        proof=proofs.withheld(20, 0x181),
    ),
    of_inputs(
        *("16d", "TPDO1 of node 1 lost for 0.5 s", "181h suppressed", lambda: Lost(0x181), 500),
        one=STALE | STARTING,
        emcy=LATE,
        recover_ms=60.0,
        proof=proofs.withheld(450, 0x181),
    ),
    of_inputs(
        *("16e", "all PDOs of node 1 lost for 0.5 s", "181h, 281h suppressed"),
        lambda: Lost(*NODE_1),
        500,
        one=STALE | STARTING,
        emcy=LATE,
        recover_ms=60.0,
        proof=proofs.withheld(450, *NODE_1),
    ),
    of_inputs(
        *("16f", "all PDOs of all nodes lost for 0.5 s", "181h..183h, 281h, 282h suppressed"),
        lambda: Lost(*ALL),
        500,
        one=STALE | STARTING,
        two=STALE | STARTING,
        emcy=LATE,
        recover_ms=60.0,
        proof=proofs.withheld(450, *ALL),
    ),
    Case(
        "18a",
        "TPDO twice in a cycle, equal",
        "181h sent twice, 20 cycles",
        lambda: Changed(lambda can_id, data: [(can_id, data), (can_id, data)], 0x181),
        20,
        counters=("duplicate_frames",),
        notice_ms=12.0,
        proof=proofs.doubled(20, 0x181),
    ),
    of_inputs(
        "18b",
        "TPDO twice in a cycle, different",
        "181h and another 181h, 20 cycles",
        lambda: Changed(lambda can_id, data: [(can_id, data), (can_id, bytes(8))], 0x181),
        20,
        counters=("duplicate_frames", "stale_inputs"),
        may=LATE,
        recover_ms=40.0,
        proof=proofs.doubled(20, 0x181),
    ),
    of_inputs(
        "18c",
        "two cycles merged",
        "181h of one cycle comes with that of the next",
        lambda: Late(995, 0x181),
        1,
        recover_ms=20.0,
        proof=proofs.withheld(1, 0x181),
    ),
    Case(
        "19",
        "TPDO1 after TPDO2",
        "181h 0.1 ms later, so after 281h, 50 cycles",
        lambda: Late(100, 0x181),
        50,
        proof=proofs.after(45, 0x181, 0x281),
    ),
    of_inputs(
        "20",
        "TPDO after the deadline",
        "181h 0.9 ms after SYNC, 20 cycles",
        lambda: Late(900, 0x181),
        20,
        counters=("late_frames", "stale_inputs"),
        may=LATE,
        recover_ms=40.0,
        proof=proofs.later(18, 0x181, 890.0),
    ),
    of_inputs(
        "21a",
        "wrong length 0..7",
        "181h with 0, 1, ... 7 bytes in eight cycles",
        acts.shorter,
        8,
        emcy=codes("8210"),
        counters=("rejected_frames", "stale_inputs"),
        proof=proofs.all_of(*(proofs.of_length(1, 0x181, length) for length in range(8))),
    ),
    Case(
        "21b",
        "longer than mapped",
        "183h (sensor, 5 bytes) with 8 bytes, 8 cycles",
        lambda: Changed(lambda can_id, data: [(can_id, data + b"\0\0\0")], 0x183),
        8,
        emcy=codes("8220"),
        counters=("rejected_frames",),
        notice_ms=60.0,
        proof=proofs.of_length(8, 0x183, 8),
    ),
    Case(
        "22",
        "29-bit and remote frames of the same number",
        "00000181h and a remote 181h in each of 20 cycles",
        lambda: Added(
            lambda rig: [rig.send(CAN_EFF_FLAG | 0x181, bytes(8)), rig.send(CAN_RTR_FLAG | 0x181, bytes(8))]
        ),
        20,
        counters=("rejected_frames",),
        notice_ms=12.0,
        proof=proofs.all_of(proofs.frames(20, CAN_EFF_FLAG | 0x181), proofs.frames(20, CAN_RTR_FLAG | 0x181)),
    ),
)
