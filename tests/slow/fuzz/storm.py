"""A running jtqd in a storm of frames: one run, quiet and stormy stretches by turns. Are its cycles the same in both?

Every figure is a ratio of neighbours, so that a machine that is busy with other things is so in both.
"""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.shared.snapshot import LATE_BIN_NS, WORK_BIN_NS
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_RTR_FLAG, FRAME
from jtqd.drivers.frame_socket import FrameSocket, open_frame_socket
from tests.slow.soak.rig import Rig, rss_kb

PAIRS = 30
STRETCH_S = 0.5
_SETTLE_S = 0.1
"""Between two stretches: what one has begun must not be counted in the other."""
_EACH_MS = 5
"""Frames of so many milliseconds are sent together: a bus at 1 Mbit/s carries no more than 8 in one."""
_FORBIDDEN = {0x000, 0x080, 0x181, 0x182, 0x183, 0x281, 0x282, 0x1A0}
"""NMT would stop the nodes, and the rest is the cycle itself: those are the faults of docs/testing.md."""
_OF_THE_LOOP = {0x080, 0x181, 0x182, 0x183, 0x281, 0x282, 0x381, 0x382, 0x701, 0x702, 0x703}
"""SYNC, inputs, temperatures, heartbeats of the shipped configuration."""
MOST_CPU, MOST_WORK = 1.10, 1.10
"""Ratios storm : quiet, median over the pairs, that are still "unchanged"; a busy machine scatters it by 0.03."""
_MISSED_PER_1000 = 5.0


@dataclass(frozen=True)
class Stretch:
    """What the loop did in one stretch: time, cycles, missed slots, frames taken that were none of its inputs, CPU time,
    histograms of work and SYNC lateness.
    """

    time_ns: int
    cycles: int
    missed: int
    complete: int
    foreign: int
    cpu_ns: int
    work: NDArray[np.int64]
    late: NDArray[np.int64]

    @property
    def cpu_us(self) -> float:
        """CPU time of the loop per cycle [us]."""
        return self.cpu_ns / 1000.0 / max(self.cycles, 1)


def storm_frames(source: random.Random, count: int) -> list[bytes]:
    """Frames of any identifier, format and length that mean nothing to anybody on the bench."""
    out: list[bytes] = []
    while len(out) < count:
        flags = source.choice((0, 0, 0, CAN_EFF_FLAG, CAN_RTR_FLAG))
        can_id = source.getrandbits(29 if flags & CAN_EFF_FLAG else 11) | flags
        base = can_id & 0x7FF
        # SDO requests to the bench's nodes would change their configuration, and boot-up messages take a joint away.
        if can_id in _FORBIDDEN or (
            not flags and (0x600 < base < 0x604 or 0x200 < base < 0x480 or base > 0x700)
        ):
            continue
        data = source.randbytes(source.randrange(9))
        out.append(FRAME.pack(can_id, len(data), data))
    return out


def looks_alike(frame: bytes) -> bool:
    """It has a number of the loop in another format: the loop is to see and to count it."""
    can_id, _, _ = FRAME.unpack(frame)
    return can_id & CAN_EFF_MASK in _OF_THE_LOOP


def _now(rig: Rig, pid: int) -> Stretch:
    counters = rig.counters()
    cpu_ns = int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
    work, late = (np.array(each, np.int64) for each in (rig.reader.work_bins(), rig.reader.late_bins()))
    foreign = counters["unknown_frames"] + counters["rejected_frames"]
    counted = (counters["cycles"], counters["missed"], counters["complete"], foreign)
    return Stretch(time.monotonic_ns(), *counted, cpu_ns, work, late)


def _stretch(rig: Rig, pid: int, socket: FrameSocket, frames: Sequence[bytes]) -> tuple[Stretch, int]:
    """One stretch with these frames spread over it (none: quiet); and how many of them the bus refused."""
    time.sleep(_SETTLE_S)
    before, begun, refused = _now(rig, pid), time.monotonic(), 0
    each = -(-len(frames) * _EACH_MS // round(1000 * STRETCH_S))
    for n, first in enumerate(range(0, len(frames), each or 1)):
        refused += sum(not socket.send(frame) for frame in frames[first : first + each])
        time.sleep(max(0.0, begun + (n + 1) * _EACH_MS * 1e-3 - time.monotonic()))
    time.sleep(max(0.0, begun + STRETCH_S - time.monotonic()))
    after = _now(rig, pid)
    return Stretch(
        *(now - was for now, was in zip(vars(after).values(), vars(before).values(), strict=True))
    ), refused


def quantile_us(bins: NDArray[np.int64], width_ns: int, share: float) -> float:
    """Upper edge of the bin in which the quantile lies [us]."""
    return float((np.searchsorted(np.cumsum(bins), share * bins.sum()) + 1) * width_ns / 1000.0)


def compare(quiet: Sequence[Stretch], stormy: Sequence[Stretch]) -> dict[str, Any]:
    """Both kinds side by side, and the ratios of neighbours: (median, least, most)."""

    def ratios(values: list[tuple[float, float]]) -> list[float]:
        found = [storm / calm for calm, storm in values if calm > 0.0]
        return [round(float(each), 3) for each in (np.median(found), min(found), max(found))]

    def figures(stretches: Sequence[Stretch]) -> dict[str, float]:
        work, late = sum(each.work for each in stretches), sum(each.late for each in stretches)
        cycles = sum(each.cycles for each in stretches)
        return {
            "cycles": cycles,
            "cpu_us": round(sum(each.cpu_ns for each in stretches) / 1000.0 / max(cycles, 1), 1),
            "work_p50_us": quantile_us(np.asarray(work), WORK_BIN_NS, 0.5),
            "late_p50_us": quantile_us(np.asarray(late), LATE_BIN_NS, 0.5),
            "missed_per_1000": round(1000.0 * sum(each.missed for each in stretches) / max(cycles, 1), 2),
            "foreign_frames_taken": sum(each.foreign for each in stretches),
            "complete": round(sum(each.complete for each in stretches) / max(cycles, 1), 4),
        }

    pairs = list(zip(quiet, stormy, strict=True))
    return {
        "quiet": figures(quiet),
        "storm": figures(stormy),
        "cpu_ratio": ratios([(calm.cpu_us, storm.cpu_us) for calm, storm in pairs]),
        "work_p50_ratio": ratios(
            [
                (quantile_us(calm.work, WORK_BIN_NS, 0.5), quantile_us(storm.work, WORK_BIN_NS, 0.5))
                for calm, storm in pairs
            ]
        ),
    }


def unchanged(result: dict[str, Any]) -> bool:
    """The loop costs the same, it misses no more of its slots, and what is none of its frames does not reach it."""
    quiet, stormy = result["quiet"], result["storm"]
    return bool(
        result["cpu_ratio"][0] <= MOST_CPU
        and result["work_p50_ratio"][0] <= MOST_WORK
        and stormy["foreign_frames_taken"] <= result.get("any_format", 0)
        and stormy["missed_per_1000"] <= 2.0 * quiet["missed_per_1000"] + _MISSED_PER_1000
    )


@contextmanager
def _in_time() -> Iterator[None]:
    """This process below bench and loop, but not behind other programs: what comes too late is no storm."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except PermissionError:
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def storm(seed: int, count: int, pairs: int = PAIRS) -> dict[str, Any]:
    """One run: `count` frames over all stormy stretches; what may be concluded is `ok`."""
    source = random.Random(seed)
    frames, quiet, stormy, refused = storm_frames(source, count), [], [], 0
    with tempfile.TemporaryDirectory(prefix="jf") as name, Rig(Path(name), record=False) as rig:
        time.sleep(1.0)
        pids = rig.processes()
        memory = {each: rss_kb(pid) for each, pid in pids.items()}
        socket, share = open_frame_socket(rig.bus, []), -(-count // pairs)
        with _in_time():
            for n in range(pairs):
                now, order = frames[n * share : (n + 1) * share], [quiet, stormy]
                for kind in order if source.random() < 0.5 else order[::-1]:
                    found, lost = _stretch(rig, pids["loop"], socket, now if kind is stormy else ())
                    kind.append(found)
                    refused += lost
        growth = {each: rss_kb(pid) - memory[each] for each, pid in pids.items()}
        before = rig.counters()["published"]
        time.sleep(0.5)
        alive = rig.counters()["published"] > before
        socket.close()
        rig.end()
        result = {
            "seed": seed,
            "frames": count,
            "frames_per_s": round(count / (sum(each.time_ns for each in stormy) * 1e-9)),
            "any_format": sum(map(looks_alike, frames)),
            "refused_by_bus": refused,
            **compare(quiet, stormy),
            "growth_kb": growth,
            "alive": alive,
            "exit_status": rig.status,
            "traceback": "Traceback" in rig.said(),
        }
    sound = alive and rig.status in (0, 3) and not result["traceback"] and max(growth.values()) < 8000
    return {**result, "ok": sound and unchanged(result)}
