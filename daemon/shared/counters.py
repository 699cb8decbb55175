"""The loop's counters in one table: snapshot, object 2200h, diagnostics, metrics, summary and `jtq status` follow from it.

A row is one counter. The order of the rows is that of the words in the snapshot (`jtqd.daemon.shared.snapshot`); the
compiled loop finds a counter's word by its name (`word_of`). The table of docs/bus.md repeats the texts.
"""

from __future__ import annotations

from enum import Flag, auto
from typing import Final, NamedTuple

from jtqd.daemon.shared import faults


class Shown(Flag):
    """Views that show a counter, besides object 2200h, metrics, `--json` and `/diagnostics`, which have all."""

    NOWHERE = 0
    BUS = auto()
    """Status `jtqd: bus` of /diagnostics, in place of `jtqd: loop`."""
    STATUS = auto()
    """`jtq status`, where it is not zero."""
    SUMMARY_BUS = auto()
    """Line "bus" of the final summary, where it is not zero."""
    SUMMARY_TORQUE = auto()
    """Line "no torque" of the final summary, where it is not zero."""


class Counter(NamedTuple):
    """One counter, by the same name in every view."""

    name: str
    sub: int
    """Sub-index of object 2200h; 0: not there. Receivers know a counter by it: it never changes, a new one comes last."""
    text: str
    """What is counted."""
    shown: Shown = Shown.NOWHERE
    is_maximum: bool = False
    """A largest value in place of a count."""


_BUS_STATUS: Final = Shown.BUS | Shown.STATUS
_BUS_ALL: Final = _BUS_STATUS | Shown.SUMMARY_BUS
_FIRST_FAULT_SUB: Final = 27

TABLE: Final = (
    Counter("cycles", 1, "cycles with a SYNC"),
    Counter("missed", 2, "slots that could not begin within half a period"),
    Counter("complete", 12, "cycles with all inputs"),
    Counter("published", 13, "cycles whose estimate was sent"),
    Counter("published_late", 14, "estimates that were sent after the next SYNC was due", Shown.STATUS),
    Counter("stale_inputs", 3, "PDOs that were no input of their cycle", Shown.STATUS),
    Counter("late_frames", 4, "frames of an earlier cycle, discarded", _BUS_ALL),
    Counter("duplicate_frames", 5, "second frames of a PDO in one cycle", _BUS_ALL),
    Counter("rejected_frames", 6, "frames of a wrong length or format, impossible heartbeats", _BUS_ALL),
    Counter("unknown_frames", 15, "other frames that passed the filters", _BUS_STATUS),
    Counter("foreign_sync", 7, "SYNCs of another producer", _BUS_ALL),
    Counter("sync_errors", 16, "echoes of an earlier SYNC than that of the cycle", _BUS_ALL),
    Counter("sync_gaps", 17, "slots without SYNC that tell late frames from lost ones", _BUS_ALL),
    Counter("boot_ups", 18, "boot-up messages of nodes", _BUS_STATUS),
    Counter("temperatures_lost", 19, "times that a joint's temperature became older than 2 s"),
    Counter("tx_dropped", 8, "frames not sent because the transmit queue was full", _BUS_ALL),
    Counter("rx_dropped", 9, "frames lost because the socket was read too late", _BUS_ALL),
    Counter("bus_errors", 20, "calls that an interface refused because it was down", _BUS_STATUS),
    Counter("network_fallbacks", 10, "cycles of a joint that ask for status 3 (degraded)", Shown.STATUS),
    Counter("bits_worst_case", 21, "bits on the bus with the maximum of stuff bits", Shown.BUS),
    Counter("work_max_ns", 0, "longest work of a cycle [ns]", is_maximum=True),
    Counter("late_max_ns", 0, "largest lateness of a SYNC [ns]", is_maximum=True),
    Counter("network_not_finite", 24, "networks dropped: output not finite"),
    Counter("network_far", 25, "networks dropped: too far from physics"),
    Counter("network_outside", 26, "networks reduced: outside of their training range"),
    Counter("network_no_time", 23, "networks skipped: no time in the cycle"),
    Counter("overruns", 22, "estimates that were not ready in time", Shown.STATUS | Shown.SUMMARY_TORQUE),
    *(
        Counter(
            f"fault_{faults.NAMES[bit]}",
            sub,
            f"faults that began: {faults.MEANINGS[bit]}",
            Shown.SUMMARY_TORQUE,
        )
        for sub, bit in enumerate(faults.COUNTED, start=_FIRST_FAULT_SUB)
    ),
    Counter("latches", 35, "faults that were latched", Shown.STATUS | Shown.SUMMARY_TORQUE),
    Counter("latch_resets", 36, "joints whose latched faults a reset released", Shown.SUMMARY_TORQUE),
    Counter("contacts", 37, "contacts that began"),
    Counter("cob_id_conflicts", 38, "frames of others with COB-IDs that only the loop may use", _BUS_ALL),
)
"""The counters of the loop."""
RECORDER_LOST: Final = Counter("recorder_lost", 11, "cycles missing from the log")
"""The counter of the recorder; it has no word in the snapshot."""

COUNTERS: Final = tuple(each.name for each in TABLE)
"""Their names, in the order of their words."""
OBJECT_2200: Final = tuple(
    each.name for each in sorted((*TABLE, RECORDER_LOST), key=lambda each: each.sub) if each.sub
)
"""Names of the sub-indices 1.. of object 2200h."""


def word_of(name: str) -> int:
    """Return the index of a counter's word. Raises ValueError for an unknown name."""
    return COUNTERS.index(name)


def shown_in(view: Shown) -> tuple[str, ...]:
    """Return the names of the counters that a view shows."""
    return tuple(each.name for each in TABLE if each.shown & view)
