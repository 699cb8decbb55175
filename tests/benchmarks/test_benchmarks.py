"""Smoke tests of the benchmark: the contenders compute the same, and the tables come out. No time is asserted."""

import json
import math
import shutil
import struct
import subprocess
import sys
from types import SimpleNamespace

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.core import cycle as cycle_module
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.schedule import PythonClock
from jtqd.daemon.loop import process as loop
from jtqd.drivers.frame import FRAME, pack
from tests.benchmarks import c_program, long_run, traffic
from tests.benchmarks.fixture import make_fixture
from tests.benchmarks.measure import SETTLE_CYCLES, Samples, mark, mark_beside_error, quantile
from tests.paths import ROOT

pytestmark = pytest.mark.native

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
PERIOD_NS = 1_000_000


class Bus:
    """Clock and frame socket in one: after each SYNC its echo and the five TPDOs of that cycle are there."""

    def __init__(self, jitter_ns):
        self.jitter_ns = jitter_ns
        self.clock_ns = 10**9
        self.cycle = -1
        self.waiting, self.sent, self.syncs = [], [], []
        self.frames, self.stamps_ns, self.own = bytearray(512), (), ()
        self.tx_dropped = self.rx_dropped = 0

    def fileno(self):
        return -1

    def monotonic_ns(self):
        return self.clock_ns

    def sleep(self, seconds):
        self.clock_ns += round(seconds * 1e9)

    def send(self, frame):
        can_id, length, data = FRAME.unpack(frame)
        if can_id == 0x080:
            self.cycle += 1
            stamp = self.clock_ns + self.jitter_ns[self.cycle % len(self.jitter_ns)]
            self.syncs.append(stamp)
            answer = [pack(0x080, data[:length]), *traffic.cycle_frames(self.cycle)]
            self.waiting = [(frame, stamp + 1000 * n, n == 0) for n, frame in enumerate(answer)]
        elif can_id == 0x1A0:
            self.sent.append(data)
        return True

    def receive(self):
        frames, self.waiting = self.waiting, []
        for n, (frame, _, _) in enumerate(frames):
            self.frames[16 * n : 16 * n + 16] = frame
        self.stamps_ns = [stamp for _, stamp, _ in frames]
        self.own = [own for _, _, own in frames]
        return len(frames)


def python_estimates(fixture, tmp_path, monkeypatch, cycles):
    """Estimate PDOs of the real Cycle on the traffic of the benchmark, and the SYNC stamps it saw."""
    bus = Bus(
        [0, 700, -400, 250, -9000, 40_000]
    )  # on both sides of what the loop takes for accuracy of a stamp
    clock = SimpleNamespace(monotonic_ns=bus.monotonic_ns, time_ns=bus.monotonic_ns, sleep=bus.sleep)
    monkeypatch.setattr(cycle_module, "clock", PythonClock(clock))
    config = load_config(fixture.config)
    estimators = [loop.build_estimator(config, joint) for joint in config.joints]
    request = {"ring": str(tmp_path / "ring"), "snapshot": str(tmp_path / "snapshot"), "worst_load": 0.0}
    cycle, grid = loop.build_cycle(config, request, fixture.report, bus, estimators)
    for n in range(cycles):
        grid.slot_ns = 2 * 10**9 + n * PERIOD_NS
        bus.clock_ns = grid.slot_ns
        for stage in (cycle.begin, cycle.gather, cycle.observe, cycle.publish, cycle.record):
            stage()
    return bus.sent, bus.syncs


@needs_gcc
def test_the_c_program_computes_what_the_python_loop_computes(tmp_path, monkeypatch):
    fixture = make_fixture(tmp_path)
    program = c_program.build(fixture)
    expected, syncs = python_estimates(fixture, tmp_path, monkeypatch, traffic.CYCLES)
    records = [struct.pack("<q", stamp) + b"".join(traffic.cycle_frames(n)) for n, stamp in enumerate(syncs)]
    (tmp_path / "in").write_bytes(b"".join(records))
    subprocess.run([program, "replay", tmp_path / "in", tmp_path / "out"], check=True)
    data = (tmp_path / "out").read_bytes()
    found = [data[n : n + 8] for n in range(0, len(data), 8)]
    assert len(found) == len(expected) == traffic.CYCLES
    statuses = set()
    for n, (a, b) in enumerate(zip(expected, found, strict=True)):
        one, two = estimate_pdo.LAYOUT.unpack(a), estimate_pdo.LAYOUT.unpack(b)
        assert one[4:] == two[4:], f"cycle {n}: status and sequence"
        # Different orders of summation may end on two sides of one rounding limit.
        differences = [abs(x - y) for x, y in zip(one[:4], two[:4], strict=True)]
        assert max(differences) <= 1, f"cycle {n}: {one} and {two}"
        statuses |= {one[4] & 0x0F, one[4] >> 4}
    # starting, valid, degraded, standstill: every branch has been compared
    assert statuses == {1, 2, 3, 6}
    equal = sum(a == b for a, b in zip(expected, found, strict=True))
    assert equal > 0.999 * len(expected)


def test_traffic_closes_without_a_jump():
    def counts(cycle):
        return [struct.unpack("<ii", frame[8:16]) for frame in traffic.cycle_frames(cycle)[:2]]

    steps = [
        max(
            abs(a - b)
            for x, y in zip(counts(n), counts(n + 1), strict=True)
            for a, b in zip(x, y, strict=True)
        )
        for n in (0, traffic.CYCLES - 1)
    ]
    assert steps[1] == pytest.approx(steps[0], rel=0.05)
    assert traffic.cycle_frames(traffic.CYCLES) == traffic.cycle_frames(0)


def test_samples_take_differences_after_settling():
    samples = Samples()
    ends = [1000 * n for n in range(SETTLE_CYCLES)] + [10**6, 10**6 + 50_000, 10**6 + 120_000]
    samples.add({"cpu_ns": ends, "answer_ns": [7000] * len(ends), "published": 3, "missed": 1, "switches": 2})
    assert samples.cpu_us == [50.0, 70.0]
    assert samples.figures()["cycles"] == len(ends)
    assert math.isnan(quantile([], 0.5))
    assert mark(61.0, 60.0).startswith("over")
    assert mark(4.9, 5.0, at_least=True).startswith("under")
    assert mark(60.0, 60.0).startswith("PASS")


_LOOPS = {"jtqd", "bare sleep", "bare, twice", "bare, waking"}


def test_missed_slots_are_compared_round_by_round():
    """A stall of the machine that takes slots from both loops is in neither figure nor error."""
    assert long_run.beyond([403, 1, 2], [400, 0, 0], 1000) == {
        "per_million": pytest.approx(2000.0),
        "error": pytest.approx(1000.0 / math.sqrt(3.0)),
    }
    assert math.isnan(long_run.beyond([3], [1], 1000)["error"])


def test_a_figure_that_its_error_does_not_hold_is_not_marked():
    assert mark_beside_error(20.0, 14.0, 50.0).startswith("PASS")
    assert mark_beside_error(20.0, 16.0, 50.0) == "cannot be told from 50"
    assert mark_beside_error(80.0, 16.0, 50.0) == "cannot be told from 50"
    assert mark_beside_error(80.0, 14.0, 50.0).startswith("over")
    assert mark_beside_error(50.0, 0.0, 50.0) == "cannot be told from 50"
    assert mark_beside_error(20.0, math.nan, 50.0) == "not measured"


def test_the_text_says_of_each_pair_what_one_misses_more():
    loop = {"slots": 1000, "late_median_us": 1.0, "late_p99_us": 1.0, "late_p999_us": 1.0, "late_max_us": 1.0}
    result = {
        "minutes": 1.0,
        "rounds": 5,
        "cpus_busy": 1.0,
        "loops": {name: loop | {"missed": 1} for name in _LOOPS},
        "beyond": {
            "jtqd beyond bare sleep": {"per_million": 60.0, "error": 40.0},
            "jtqd beyond bare, twice": {"per_million": 6.0, "error": 3.0},
            "bare, twice beyond bare sleep": {"per_million": 54.0, "error": 30.0},
            "bare, waking beyond bare sleep": {"per_million": 1.0, "error": 3.0},
        },
    }
    first, second, third, fourth = long_run.text(result).splitlines()[-4:]
    assert " ".join(first.split()) == "jtqd beyond bare sleep 60 +- 40 per million cannot be told from 50"
    assert " ".join(second.split()) == "jtqd beyond bare, twice 6 +- 3 per million"
    assert third.startswith("bare, twice beyond bare sleep")
    assert fourth.startswith("bare, waking beyond bare sleep")


def benchmark(*arguments):
    result = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks", *arguments],
        cwd=ROOT, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


@needs_gcc
@pytest.mark.campaign
def test_quick_prints_the_table_and_the_ratios():
    text = benchmark("cycle", "--quick")
    for wanted in (
        "jtqd",
        "usual way",
        "C  ",
        "C, following",
        "usual way / jtqd",
        "jtqd / C, p99",
        "after last",
        "points against",
        "quiet core",
    ):
        assert wanted in text


@needs_gcc
def test_results_as_json_hold_every_stage_and_all_loops():
    content = json.loads(
        benchmark("stages", "grid", "--rounds", "2", "--seconds", "0.6", "--minutes", "0.01", "--json")
    )
    stages = content["stages"]["stages"]
    assert set(stages) >= {"begin", "gather", "observe", "publish", "record"}
    assert all(each["median_us"] > 0.0 for each in stages.values())
    assert set(content["grid"]["loops"]) == _LOOPS
    assert {len(each["missed_by_round"]) for each in content["grid"]["loops"].values()} == {6}
    assert all(math.isfinite(each["error"]) for each in content["grid"]["beyond"].values())


def test_an_unknown_name_is_a_usage_error():
    result = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks", "cycles"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert "found 'cycles', expected one of" in result.stderr
