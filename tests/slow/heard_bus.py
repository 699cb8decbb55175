"""What an independent listener hears on a bus on which nothing happens, for the tests of proofs and accounts."""

from __future__ import annotations

import numpy as np

from jtqd.drivers.frame import pack
from jtqd.estimator import status as st
from tests.slow.faults.listener import FRAME, SYNC, Heard

MS = 1_000_000
BASE_NS = 1_700_000_000_000_000_000
OVERFLOW = 240
ESTIMATE = 0x1A0


def heard_of(frames: list[tuple[int, int, bytes]]) -> Heard:
    """(time in ns, identifier, data) as the listener has it."""
    rows = np.zeros(len(frames), FRAME)
    for n, (_, can_id, data) in enumerate(frames):
        rows[n] = np.frombuffer(pack(can_id, data), FRAME)[0]
    return Heard(rows, np.array([BASE_NS + at for at, _, _ in frames], np.int64))


def healthy(cycles: int) -> list[tuple[int, int, bytes]]:
    """A bus on which nothing happens: SYNC, inputs, estimates, heartbeats."""
    out = []
    for n in range(cycles):
        counter, at = n % OVERFLOW + 1, n * MS
        out.append((at, SYNC, bytes([counter])))
        for k, can_id in enumerate((0x181, 0x281, 0x182, 0x282)):
            out.append((at + 200_000 + 1000 * k, can_id, 2 * (n + 1).to_bytes(4, "little")))
        out.append((at + 210_000, 0x183, bytes(5)))
        torque = bytes((1, 0, 1, 0, 1, 1, st.VALID * 0x11, counter))
        out.append((at + 500_000, ESTIMATE, torque))
        if n % 100 == 50:
            out += [(at + 600_000, 0x700 + node, b"\x05") for node in (1, 2, 3)]
    return out
