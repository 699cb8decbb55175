"""What the estimate PDO, EMCY and the counters say, and what must hold in every cycle whatever is injected. No clock."""

from __future__ import annotations

from typing import NamedTuple

from jtqd.daemon.core.estimate_pdo import LAYOUT, NO_TORQUE, PUBLISHED_STATUSES

GOOD = frozenset({2, 3, 6})
RECOVERED_FROM_BUS_OFF = 0x8140
ALL_IN_TIME = (True, True)
_FLOWING = frozenset({"cycles", "complete", "published", "bits_worst_case", "work_max_ns", "late_max_ns"})
"""Counters that rise in good health too."""


class Seen(NamedTuple):
    """One estimate PDO: when it came [ns, monotonic] and both statuses."""

    at_ns: int
    status: tuple[int, int]


class Told(NamedTuple):
    """One EMCY of jtqd: when [ns, monotonic], the code, and the code that has gone where the code is 0."""

    at_ns: int
    code: int
    gone: int


class Watcher:
    """Call `sync`, `delivered`, `estimate` and `emcy` in the order of the bus.

    Attributes:
        seen, told: estimates and EMCY since `begin`.
        present: errors of jtqd that have come and not gone: (code, detail).
        broken: invariants that did not hold, one line each (the first ten).
    """

    def __init__(self) -> None:
        self.seen: list[Seen] = []
        self.told: list[Told] = []
        self.present: set[tuple[int, int]] = set()
        self.broken: list[str] = []
        self.counter = 0
        self._complete = ALL_IN_TIME
        self._answered = True

    def begin(self) -> None:
        """A new case: forget what was seen; errors that are present stay."""
        self.seen, self.told, self.broken = [], [], []

    def sync(self, counter: int) -> None:
        """A SYNC of jtqd; until `delivered` says otherwise its cycle has no inputs."""
        self.counter, self._complete, self._answered = counter, (False, False), False

    def delivered(self, joints: tuple[bool, bool]) -> None:
        """Which joints' inputs were sent in this cycle: whole, unchanged in length, before the deadline."""
        self._complete = joints

    def spoil(self) -> None:
        """Something makes every input of this cycle doubtful (a foreign SYNC)."""
        self._complete = (False, False)

    def estimate(self, data: bytes, at_ns: int) -> None:
        """An estimate PDO."""
        if len(data) != LAYOUT.size:
            self._break(f"an estimate of {len(data)} bytes")
            return
        torque_1, torque_2, _, _, both, sequence = LAYOUT.unpack(data)
        status = (both & 0x0F, both >> 4)
        self.seen.append(Seen(at_ns, status))
        for n, (torque, code) in enumerate(zip((torque_1, torque_2), status, strict=True)):
            if code not in PUBLISHED_STATUSES:
                if torque != NO_TORQUE:
                    self._break(f"joint {n + 1}: torque {torque} with status {code}")
                continue
            if sequence != self.counter:
                self._break(f"joint {n + 1}: status {code} with sequence {sequence}, SYNC was {self.counter}")
            elif not self._complete[n]:
                self._break(f"joint {n + 1}: status {code} in cycle {sequence}, whose input was withheld")
        if self._answered and any(code in PUBLISHED_STATUSES for code in status):
            self._break(f"two estimates for SYNC {self.counter}")
        self._answered = True

    def emcy(self, data: bytes, at_ns: int) -> None:
        """An EMCY of jtqd."""
        code, ended = int.from_bytes(data[0:2], "little"), int.from_bytes(data[3:5], "little")
        detail = int.from_bytes(data[5:7], "little")
        self.told.append(Told(at_ns, code, ended))
        if code == RECOVERED_FROM_BUS_OFF:
            return  # tells an end itself, and is not taken back
        if code:
            self.present.add((code, detail))
        else:
            self.present.discard((ended, detail))

    def well(self, count: int) -> bool:
        """Both joints had a torque in the last `count` estimates."""
        last = self.seen[-count:]
        return len(last) == count and all(each in GOOD for one in last for each in one.status)

    def bad(self) -> tuple[frozenset[int], frozenset[int]]:
        """Statuses without torque that each joint has had."""
        one, two = (frozenset(each.status[n] for each in self.seen) - GOOD for n in (0, 1))
        return one, two

    def first_bad_ns(self) -> int | None:
        """When the first estimate without a torque came."""
        return next((each.at_ns for each in self.seen if not GOOD.issuperset(each.status)), None)

    def well_again_ns(self) -> int | None:
        """When the first estimate came after which both joints had a torque in each."""
        bad = [n for n, each in enumerate(self.seen) if not GOOD.issuperset(each.status)]
        if not bad or bad[-1] + 1 == len(self.seen):
            return None
        return self.seen[bad[-1] + 1].at_ns

    def _break(self, text: str) -> None:
        if len(self.broken) < 10:
            self.broken.append(text)


def rises(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    """Counters that have risen, but those that always do."""
    return {name: after[name] - n for name, n in before.items() if after[name] > n and name not in _FLOWING}
