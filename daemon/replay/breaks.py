"""Where the state of an estimator is known and where it is not: a log may begin in the middle, or have lost cycles. Pure.

The time step that a joint used is the time since its last inputs. A step of 0 says that it began anew: from there on
everything about it is known. A step that is not the time since the last inputs *in the log* says that inputs are
missing from the log.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from daemon.config import Config
from daemon.loop.joint_cycle import FLAG_MOTION, FLAG_POSITION

Records = npt.NDArray[np.void]
_BOTH = FLAG_POSITION | FLAG_MOTION
BEGINS, LOST = "the log begins in the middle of the run", "cycles are missing from the log"
CUT = "a long run is replayed in stretches"


@dataclass(frozen=True)
class Steps:
    """Time steps of one joint over n cycles.

    Attributes:
        used: cycles with both inputs [n].
        dt_ns: time since the last inputs, by the log [n]; 0: began anew or not used.
        begins: rows where it began anew.
        breaks: rows before which inputs are missing, with the reason.
    """

    used: npt.NDArray[np.bool_]
    dt_ns: npt.NDArray[np.int64]
    begins: npt.NDArray[np.intp]
    breaks: tuple[tuple[int, str], ...]

    def part(self, first: int, end: int) -> Steps:
        """The same of rows `first` to `end` only, counted from `first`."""
        begins = self.begins[(self.begins >= first) & (self.begins < end)] - first
        breaks = tuple((row - first, why) for row, why in self.breaks if first <= row < end)
        return Steps(self.used[first:end], self.dt_ns[first:end], begins, breaks)


def cut_before(steps: Steps) -> Steps:
    """The same where the state at the first row is not quite known."""
    return replace(steps, breaks=((0, CUT), *(each for each in steps.breaks if each[0])))


def steps_of(records: Records, config: Config) -> Steps:
    """Time steps of one joint's states (/joint/N/state), in the order of the cycles."""
    used = (records["input_flags"] & _BOTH) == _BOTH
    rows = np.flatnonzero(used)
    dt_ns = np.zeros(len(records), np.int64)
    told = np.rint(records["dt_s"][rows] * 1e9)
    dt_ns[rows] = np.where(np.isfinite(told), told, 0.0).astype(np.int64)
    begins = rows[dt_ns[rows] == 0]
    if not len(rows):
        return Steps(used, dt_ns, begins, ())
    breaks: list[tuple[int, str]] = []
    if dt_ns[rows[0]] != 0:
        breaks.append((int(rows[0]), BEGINS))
        dt_ns[rows[0]] = 0
    # The call that sends a SYNC may be late, the other clock may be stepped: the step was measured by one of them.
    between = np.diff(records["sync_monotonic_ns"][rows])
    stamps = np.diff(_stamps(records)[rows])
    here = dt_ns[rows[1:]]
    apart = np.minimum(np.abs(between - here), np.abs(stamps - here)) > config.period_ns // 2
    holes = np.diff(np.cumsum(_holes(records, config.counter_overflow))[rows]) > 0
    for at in np.flatnonzero((here != 0) & apart & holes).tolist():
        row = int(rows[at + 1])
        breaks.append((row, LOST))
        dt_ns[row] = max(int(between[at]), 0)
    return Steps(used, dt_ns, begins, tuple(breaks))


def _stamps(records: Records) -> npt.NDArray[np.int64]:
    """Send time of each SYNC [ns], CLOCK_REALTIME [n]."""
    stamp = records["header"]["stamp"]
    seconds: npt.NDArray[np.int64] = stamp["sec"].astype(np.int64)
    return seconds * 1_000_000_000 + stamp["nanosec"].astype(np.int64)


def _holes(records: Records, overflow: int) -> npt.NDArray[np.int64]:
    """Cycles that are missing before each row [n], as many at least: whole rounds of the SYNC counter do not show.

    Slots without SYNC do not count; but a pause of a whole round and more may be a hole, and counts as one cycle.
    """
    counter: npt.NDArray[np.int64] = records["sync_counter"].astype(np.int64)
    cycle: npt.NDArray[np.int64] = records["cycle"].astype(np.int64)
    found = np.zeros(len(records), np.int64)
    slots = cycle[1:] - cycle[:-1]
    lost = np.remainder(counter[1:] - counter[:-1] - 1, overflow)
    found[1:] = np.where(slots > overflow, np.maximum(lost, 1), np.minimum(lost, slots - 1))
    return found


def lost_cycles(records: Records, overflow: int) -> int:
    """Cycles that are missing between those in the log, by the SYNC counter (1..overflow)."""
    return int(_holes(records, overflow).sum())
