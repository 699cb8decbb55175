"""A short soak, and a jtqd in a storm: real processes, so they want a machine with time for them."""

from __future__ import annotations

import random
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.shared.snapshot import LATE_BINS, WORK_BIN_NS, WORK_BINS
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, FRAME
from tests.slow.fuzz.storm import Stretch, compare, looks_alike, quantile_us, storm, storm_frames, unchanged
from tests.slow.soak.run import soak


@pytest.mark.campaign
def test_a_minute_of_faults() -> None:
    with tempfile.TemporaryDirectory(prefix="js") as directory:  # short: it holds a socket
        report = soak(Path(directory), 75.0, seed=1)
    print(report.text())
    assert not report.findings, report.text()
    assert report.counts["SYNCs heard"] + report.counts["SYNCs not heard"] == report.counts["cycles"]


@pytest.mark.campaign
def test_a_storm() -> None:
    result = storm(1, 30_000, pairs=4)
    print(result)
    assert result["ok"], result


def _stretch(cpu_us: float, work_us: float, missed: int = 0, foreign: int = 0) -> Stretch:
    work = np.zeros(WORK_BINS, np.int64)
    work[int(work_us * 1000 // WORK_BIN_NS)] = 1000
    late = np.zeros(LATE_BINS, np.int64)
    late[1] = 1000
    return Stretch(10**9, 1000, missed, 1000, foreign, int(cpu_us * 1e6), work, late)


def test_a_loop_that_gets_dearer_in_a_storm_is_seen_on_any_machine() -> None:
    """The machine may be twice as slow in the second half: what is compared are neighbours."""
    quiet = [_stretch(200.0, 150.0)] * 3 + [_stretch(400.0, 300.0)] * 3
    assert unchanged(compare(quiet, quiet))
    dearer = [replace(each, cpu_ns=each.cpu_ns * 14 // 10) for each in quiet]
    assert compare(quiet, dearer)["cpu_ratio"] == [1.4, 1.4, 1.4]
    assert not unchanged(compare(quiet, dearer))
    longer = [_stretch(200.0, 250.0)] * 3 + [_stretch(400.0, 450.0)] * 3
    assert not unchanged(compare(quiet, longer))
    assert not unchanged(compare(quiet, [replace(each, missed=20) for each in quiet]))
    heard = compare(quiet, [replace(each, foreign=1) for each in quiet])
    assert not unchanged(heard)
    assert unchanged(heard | {"any_format": 6})


def test_frames_of_a_storm_that_reach_the_loop_are_those_that_look_like_its_own() -> None:
    frames = storm_frames(random.Random(1), 20_000)
    reached = [frame for frame in frames if looks_alike(frame)]
    assert 0 < len(reached) < 200
    assert all(FRAME.unpack(frame)[0] & (CAN_EFF_FLAG | CAN_RTR_FLAG) for frame in reached)


def test_quantiles_of_a_histogram() -> None:
    bins = np.zeros(WORK_BINS, np.int64)
    bins[10], bins[20] = 60, 40
    assert quantile_us(bins, WORK_BIN_NS, 0.5) == 11 * WORK_BIN_NS / 1000.0
    assert quantile_us(bins, WORK_BIN_NS, 0.9) == 21 * WORK_BIN_NS / 1000.0
