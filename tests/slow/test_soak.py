"""The soak's own parts: what it injects is proved on the bus, and its account notices each thing that is missing."""

from __future__ import annotations

import random
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jtqd.drivers.frame import FRAME
from jtqd.models.files import shipped
from jtqd.sim_can.bench import Bench
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource
from tests.slow.faults.listener import SYNC
from tests.slow.heard_bus import BASE_NS, healthy, heard_of
from tests.slow.soak.account import ESTIMATE, OVERFLOW, EstimateTally, Records, SyncTally, account
from tests.slow.soak.bench import OrderedBench
from tests.slow.soak.faults import COMMON, ON_INTERFACE, Fault, NotInjectedError, Scene
from tests.slow.soak.run import MemoryWatch, SoakReport

MS = 1_000_000


def records_of(cycles: int) -> Records:
    index = np.arange(cycles)
    zeros = np.zeros(cycles, np.int64)
    return Records(
        index, index % OVERFLOW + 1, index * MS, BASE_NS + index * MS, zeros, np.ones(cycles, bool), 0
    )


def tally_of(frames: list[tuple[int, int, bytes]]) -> SyncTally:
    tally = SyncTally()
    tally.add(heard_of(frames[: len(frames) // 3]))
    tally.add(heard_of(frames[len(frames) // 3 :]))
    return tally


COUNTERS = {"cycles": 1000, "missed": 0, "sync_gaps": 0}


def without_syncs(first: int, last: int) -> list[tuple[int, int, bytes]]:
    return [each for each in healthy(1000) if not (each[1] == SYNC and first * MS <= each[0] < last * MS)]


def test_everything_is_there() -> None:
    found = account(records_of(1000), tally_of(healthy(1000)), COUNTERS, 0, 0)
    assert found.wrong == ()
    assert found.counts["SYNCs heard"] == found.counts["cycles"] == 1000


@pytest.mark.parametrize(("first", "last"), [(0, 3), (400, 401), (300, 800), (998, 1000), (0, 239)])
def test_a_sync_that_was_not_heard_needs_a_reason(first: int, last: int) -> None:
    """Also more than a round of the counter; either the listener lost it, or the record says that it was never sent."""
    count, tally = last - first, tally_of(without_syncs(first, last))
    assert any(
        "socket lost only 0" in each for each in account(records_of(1000), tally, COUNTERS, 0, 0).wrong
    )
    told = account(records_of(1000), tally, COUNTERS, 0, count)
    assert told.wrong == ()
    assert told.counts["SYNCs not heard"] == told.counts["SYNCs lost by the listener"] == count
    records = records_of(1000)
    records.confirmed[first:last] = False
    never = account(records, tally, COUNTERS, 0, 0)
    assert never.wrong == ()
    assert never.counts["SYNCs never sent"] == count


def test_a_cycle_that_is_not_counted_and_one_that_is_not_in_the_log() -> None:
    tally = tally_of(healthy(1000))
    assert account(records_of(1000), tally, COUNTERS | {"cycles": 999}, 0, 0).wrong
    shorter = records_of(1000)
    shorter = replace(
        shorter,
        **{name: np.delete(getattr(shorter, name), 500) for name in vars(shorter) if name != "double"},
    )
    assert any("written 999" in each for each in account(shorter, tally, COUNTERS, 0, 0).wrong)
    assert not account(shorter, tally, COUNTERS, 1, 0).wrong


def test_a_slot_that_nobody_counted() -> None:
    records = records_of(1000)
    late = replace(
        records,
        slot_ns=records.slot_ns + MS * (records.cycle >= 500),
        cycle=records.cycle + (records.cycle >= 500),
    )
    tally = tally_of([(at + MS * (at >= 500 * MS), can_id, data) for at, can_id, data in healthy(1000)])
    assert any("slots in the time" in each for each in account(late, tally, COUNTERS, 0, 0).wrong)
    counted = replace(late, missed=(records.cycle >= 500).astype(np.int64))
    assert not account(counted, tally, COUNTERS | {"missed": 1}, 0, 0).wrong


def test_a_sync_with_the_counter_of_another_and_one_that_came_twice() -> None:
    frames = healthy(1000)
    twice = sorted([*frames, (500 * MS + 1000, SYNC, bytes([500 % OVERFLOW + 1]))], key=lambda each: each[0])
    assert account(records_of(1000), tally_of(twice), COUNTERS, 0, 0).wrong
    records = records_of(1000)
    records.counter[700] = 7
    assert any("another counter" in each for each in account(records, tally_of(frames), COUNTERS, 0, 0).wrong)


def test_estimates_that_leak_or_are_old() -> None:
    tally = EstimateTally()
    tally.add(heard_of(healthy(300)))
    assert (tally.count, tally.valid, tally.leaked, tally.old) == (300, 600, 0, 0)
    tally.add(heard_of([(0, SYNC, b"\x05"), (1, ESTIMATE, bytes((1, 0, 0, 0x80, 1, 1, 0x24, 5)))]))
    assert (tally.leaked, tally.old) == (1, 0)
    tally.add(heard_of([(0, SYNC, b"\x09"), (1, ESTIMATE, bytes((1, 0, 1, 0, 1, 1, 0x22, 7)))]))
    assert (tally.leaked, tally.old) == (1, 2)


class _Idle(Scene):
    """A scene in which nothing is done, although everybody says that it was."""

    def send(self, can_id: int, data: bytes = b"") -> None:
        pass

    def order(self, kind: str, **more: Any) -> dict[str, Any]:
        return {"kind": kind, "frames": 10_000}


PROVED_BY_THE_KERNEL = {"recorder stopped", "recorder killed", "supervisor stopped", "bench stopped"}
ON_THE_BUS = [fault for fault in COMMON + ON_INTERFACE if fault.name not in PROVED_BY_THE_KERNEL]


@pytest.mark.parametrize("fault", ON_THE_BUS, ids=lambda fault: fault.name)
def test_no_fault_is_proved_by_a_bus_on_which_nothing_happens(
    fault: Fault, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.slow.soak.faults.time.sleep", lambda _: None)
    monkeypatch.setattr("tests.slow.soak.faults._link", lambda *_: None)
    monkeypatch.setattr("tests.slow.soak.faults._is_up", lambda _: False)
    scene = _Idle(SimpleNamespace(bus="vcan0"), None, random.Random(1))  # type: ignore[arg-type]
    seen = fault.act(scene)(heard_of(healthy(1500)))
    assert not seen.ok, seen.text


@pytest.mark.parametrize(
    "fault", [each for each in COMMON if each.name in PROVED_BY_THE_KERNEL], ids=lambda f: f.name
)
def test_a_process_that_goes_on_is_no_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signals do nothing: a process of our own goes on, and the scene asks the kernel."""
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        names = dict.fromkeys(("recorder", "supervisor", "bench"), process.pid)
        scene = Scene(SimpleNamespace(processes=lambda: names), None, random.Random(1))  # type: ignore[arg-type]
        with monkeypatch.context() as patch:
            patch.setattr("tests.slow.soak.faults.os.kill", lambda *_: None)
            patch.setattr("tests.slow.soak.faults._KILLED_S", 0.05)
            patch.setattr("tests.slow.soak.faults.time.sleep", lambda _: None)
            with pytest.raises(NotInjectedError):
                fault.act(scene)
        process.kill()


def _benches() -> tuple[Bench, OrderedBench]:
    plant = load_plant(shipped("campaign_plant.yaml"))
    return Bench(PlantSource(plant, 1), "demo"), OrderedBench(PlantSource(plant, 1), "demo")


def _run(bench: Bench, cycles: int, first: int = 0) -> list[tuple[int, int, bytes]]:
    """Frames of so many SYNCs as (cycle, identifier, data); what is due in between comes at its time."""
    out = []
    for n in range(first, first + cycles):
        for at in range(n * MS, (n + 1) * MS, MS // 4):
            frames = bench.on_frame(SYNC, bytes([n % OVERFLOW + 1]), at, at) if at == n * MS else []
            if at >= bench.due_ns:
                frames = frames + bench.tick(at)
            for frame in frames:
                can_id, length, data = FRAME.unpack(frame)
                out.append((n, can_id, data[:length]))
    return out


def _operational(*benches: Bench) -> None:
    for bench in benches:
        bench.tick(0)
        for node in bench.nodes:
            node.store.set_number(0x1800, 2, 1)  # TPDO1 with every SYNC, whatever it maps
        bench.on_frame(0x000, b"\x01\x00", 0, 0)


def test_a_bench_without_orders_is_the_bench() -> None:
    plain, ordered = _benches()
    _operational(plain, ordered)
    assert _run(plain, 200) == _run(ordered, 200)


def test_orders_do_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    _, bench = _benches()
    _operational(bench)
    watched = 0x181
    _run(bench, 20)

    def ordered(first: int, **order: Any) -> list[tuple[int, int, bytes]]:
        bench.orders.append(order)
        return _run(bench, 60, first)

    def cycles_with(found: list[tuple[int, int, bytes]]) -> list[int]:
        return [n for n, can_id, _ in found if can_id == watched]

    lost = cycles_with(ordered(20, kind="lost", ids=[watched], frames=1))
    every = cycles_with(_run(bench, 60, 80))
    assert len(lost) == len(every) - 1
    late = cycles_with(ordered(140, kind="late", ids=[watched], frames=1, delay_us=2500))
    assert len(late) == len(every)
    assert late != list(range(140, 200))
    fault = ordered(200, kind="drive fault", node=1, ms=20)
    assert [data[:2] for _, can_id, data in fault if can_id == 0x081] == [b"\x10\x23", b"\0\0"]
    assert [data for _, can_id, data in ordered(260, kind="restart", node=2, ms=1) if can_id == 0x702] == [
        b"\0"
    ]
    answers = capsys.readouterr().out.splitlines()
    assert [line.split('"')[3] for line in answers] == ["lost", "late", "drive fault", "restart"]
    assert '"frames": 1' in answers[0]
    assert '"frames": 1' in answers[1]


def test_memory_that_grows_is_a_finding() -> None:
    watch, report = MemoryWatch(), SoakReport(1)
    rate_kb_s = 20.0
    watch._samples[("loop", 1)] = [(float(t), round(50_000 + rate_kb_s * t)) for t in range(200)]
    watch._samples[("recorder", 2)] = [(float(t), 40_000 + t % 3) for t in range(200)]
    report.add_slopes(watch.slopes(0.0, 200.0))
    assert abs(report.slopes["loop"][0] - rate_kb_s) < 0.1
    assert report.findings == ["loop grows by 20.0 +- 0.0 kB/s"]
