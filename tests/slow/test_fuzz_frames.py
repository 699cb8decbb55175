"""Frames of every kind through the loop's and the supervisor's path; the long campaigns are `make fuzz`."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as hst

from jtqd.daemon.core.cycle import Cycle
from tests.slow.fuzz.frames import (
    INPUT_IDS,
    STRICT,
    BusInTime,
    FrameReport,
    Oracle,
    Script,
    frame,
    fuzz_frames,
    genuine,
    make_cycle,
)
from tests.slow.fuzz.service import fuzz_service

MS = 1_000_000


def clean(report: FrameReport) -> None:
    print(report.as_json())
    assert report.ok, report.as_json()


def test_50_000_frames(tmp_path: Path) -> None:
    report = fuzz_frames(tmp_path, 1, 50_000)
    clean(report)
    assert report.growth_kb < 2000
    assert set(report.episodes) >= set(STRICT)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", [1, 2])
def test_a_million_frames(tmp_path: Path, seed: int) -> None:
    report = fuzz_frames(tmp_path, seed, 1_000_000)
    clean(report)
    assert report.growth_kb < 2000


def test_the_same_seed_is_the_same_traffic(tmp_path: Path) -> None:
    one, two = (fuzz_frames(tmp_path, 7, 5_000).as_json() for _ in range(2))
    for each in (one, two):
        del each["seconds"], each["growth_kb"]
    assert one == two


def broken(monkeypatch: pytest.MonkeyPatch, fault: Callable[[Cycle, BusInTime], None]) -> None:
    """The next campaigns run with this fault between cycle and bus."""

    def make(directory: Path, script: Script) -> tuple[Cycle, BusInTime]:
        cycle, bus = make_cycle(directory, script)
        fault(cycle, bus)
        return cycle, bus

    monkeypatch.setattr("tests.slow.fuzz.frames.make_cycle", make)


def test_the_oracle_finds_an_intake_that_believes_what_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forget_debts(cycle: Cycle, bus: BusInTime) -> None:
        def receive() -> int:
            for node in (1, 2, 3):
                cycle.intake.configured(node)
            return whole()

        whole, bus.receive = bus.receive, receive  # type: ignore[method-assign]

    broken(monkeypatch, forget_debts)
    assert fuzz_frames(tmp_path, 1, 50_000, kinds=("stall", "lossy")).oracle.believed > 0


def test_the_oracle_finds_a_torque_beside_a_status_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leak(_cycle: Cycle, bus: BusInTime) -> None:
        def send(data: bytes) -> bool:
            sent = whole(data)
            bus.estimate = struct.pack("<h", 7) + bus.estimate[2:]
            return sent

        whole, bus.send = bus.send, send  # type: ignore[method-assign]

    broken(monkeypatch, leak)
    assert fuzz_frames(tmp_path, 1, 5_000).oracle.leaked > 0


_FRAMES = hst.tuples(
    hst.integers(-10, 1500),  # us after SYNC
    hst.one_of(
        hst.sampled_from(INPUT_IDS), hst.sampled_from((0x080, 0x701, 0x381)), hst.integers(0, 0xFFFF_FFFF)
    ),
    hst.binary(min_size=8, max_size=8),
    hst.integers(0, 255),
)
_CYCLE = hst.tuples(
    hst.lists(hst.integers(0, 4), max_size=2),  # genuine frames that are lost
    hst.lists(
        hst.tuples(hst.integers(0, 4), hst.sampled_from((860, 1050, 1700))), max_size=2
    ),  # that are late
    hst.lists(_FRAMES, max_size=5),
)


@settings(derandomize=True, max_examples=150, deadline=None, database=None)
@given(hst.lists(_CYCLE, min_size=1, max_size=30))
def test_minimal_examples(tmp_path_factory: pytest.TempPathFactory, cycles: list) -> None:
    """Any frames at all, also under the inputs' identifiers with other lengths; Hypothesis shrinks what fails."""

    def script(number: int, now_ns: int, counter: int) -> list:
        lost, late, others = cycles[number - 101] if 100 < number <= 100 + len(cycles) else ((), (), ())
        delays = dict(late)
        out = [(now_ns + 4000, frame(0x080, bytes((counter,))), True)]
        for n, data in enumerate(genuine(number)):
            if n not in lost:
                out.append((now_ns + delays.get(n, 150 + 50 * n) * 1000, data, False))
        for delay_us, can_id, data, length in others:
            if can_id in INPUT_IDS and length == (5 if can_id == 0x183 else 8):
                length = 7  # noqa: PLW2901 - another sender with the right length is in the episodes of `impostor`
            out.append((now_ns + delay_us * 1000, frame(can_id, data, length), False))
        return out

    cycle, bus = make_cycle(tmp_path_factory.mktemp("cycle"), script)
    oracle = Oracle()
    left = 160 + len(cycles)

    def after() -> None:
        nonlocal left
        left -= 1
        oracle.judge(cycle, bus, "example", strict=True)

    from jtqd.daemon.loop.process import run

    with bus.installed_in_loop():
        run(cycle, cycle.grid, lambda: left <= 0, duties=after, slots=1)
    assert not oracle.findings, oracle
    assert oracle.valid > 150


@pytest.mark.parametrize("seed", [1, 2])
def test_the_supervisors_path(tmp_path: Path, seed: int) -> None:
    result = fuzz_service(tmp_path, seed, 30_000)
    print(result)
    assert result["ok"], result
    assert result["sdo_replies"] > 200
    assert result["emcys_heard"] > 1000


@pytest.mark.campaign
def test_a_million_frames_for_the_supervisor(tmp_path: Path) -> None:
    result = fuzz_service(tmp_path, random.Random(1).randrange(1000), 1_000_000)
    assert result["ok"], result
