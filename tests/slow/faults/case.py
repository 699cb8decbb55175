"""One case: what is injected, and what must be seen of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from tests.slow.faults.injections import Fault
from tests.slow.faults.proofs import Proof, Seen


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
"""The observer begins anew after a longer gap in its inputs."""
