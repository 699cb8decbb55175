"""Runs out of logs: parts, stretches, lost cycles, where the state is known; and logs that cannot be used."""

from __future__ import annotations

import json
import weakref
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.logs import LogError, read_topic
from jtqd.daemon.replay import command, session
from jtqd.daemon.replay.logged import BEGINS, LOST, Run, lost_cycles, read_runs, steps_of
from jtqd.daemon.replay.session import Result, replay
from tests.daemon.replay.replay_helpers import CONFIG, MS, cut, cycles, records
from tests.paths import GOLDEN

LOG = GOLDEN / "network.mcap"


# ---- time steps ----


@pytest.mark.parametrize(
    ("log", "begins", "breaks", "dt_ms", "lost"),
    [
        (records(list(range(100))), [0], (), 1, 0),
        (records(list(range(50, 100))), [], ((0, BEGINS),), 1, 0),
        (records([*range(40), *range(60, 100)]), [0], ((40, LOST),), 21, 20),
        (records([*range(40), *range(41, 100)]), [0], ((40, LOST),), 2, 1),
    ],
    ids=["whole", "from the middle", "20 cycles lost", "one cycle lost"],
)
def test_where_the_state_is_known(
    log: Any, begins: list[int], breaks: tuple[tuple[int, str], ...], dt_ms: int, lost: int
) -> None:
    steps = steps_of(log, CONFIG)
    assert (steps.begins.tolist(), steps.breaks) == (begins, breaks)
    assert steps.dt_ns[40] == dt_ms * MS
    assert lost_cycles(log, CONFIG) == lost
    assert steps.part(30, 50).breaks == tuple((row - 30, why) for row, why in breaks if row >= 30)


def test_slots_without_sync_late_calls_and_missing_inputs_break_nothing() -> None:
    slots = records([*range(40), *range(60, 100)])  # the loop skipped them itself
    slots["dt_s"][40], slots["sync_counter"] = 0.021, np.arange(80) % 240 + 1
    call = records(list(range(100)))  # the call that sends was late by 0.7 ms; the SYNC was where its echo is
    call["sync_monotonic_ns"][30] -= 700_000
    stale = records(list(range(100)))  # cycles without inputs: the next step is longer
    stale["input_flags"][30:35], stale["dt_s"][30:35], stale["dt_s"][35] = 1, np.nan, 0.006
    for log in (slots, call, stale):
        assert steps_of(log, CONFIG).breaks == ()
        assert lost_cycles(log, CONFIG) == 0


@pytest.mark.parametrize(
    ("end", "last", "dt_s", "without_sync", "lost"),
    [(25_998, 26_100, None, 0, 25_958), (1000, 1100, 0.301, 300, 660), (1000, 1100, 0.961, 960, 0)],
)
def test_holes_longer_than_a_round_of_the_sync_counter_are_counted_in_full(
    end: int, last: int, dt_s: float | None, without_sync: int, lost: int
) -> None:
    log = records([*range(40), *range(end, last)])
    if dt_s is not None:
        log["dt_s"][40] = dt_s
        log["sync_counter"][40:] = (log["sync_counter"][40:].astype(int) - 1 - without_sync) % 240 + 1
    assert lost_cycles(log, CONFIG) == lost


# ---- parts and stretches ----


def joined(results: list[Result], number: int) -> np.ndarray:
    return np.concatenate([each.joints[number] for each in results])


def parts_of(directory: Path, *ends: int) -> list[Path]:
    """The log cut into parts that end before these rows."""
    numbers = cycles(LOG)
    limits = [numbers[0], *(numbers[end] for end in ends), numbers[-1] + 1]
    return [
        cut(LOG, directory / f"p-20260101T000000Z-{n:04d}.mcap", lambda c, a=a, b=b: a <= c < b)
        for n, (a, b) in enumerate(pairwise(limits), start=1)
    ]


@pytest.mark.parametrize("name", ["network", "faults", "parts"])
def test_stretches_give_what_the_whole_gives(name: str, tmp_path: Path) -> None:
    logs = parts_of(tmp_path, 400, 700, 1000)[::-1] if name == "parts" else [GOLDEN / f"{name}.mcap"]
    (whole,) = replay([LOG] if name == "parts" else logs)
    found = list(replay(logs, stretch=300))
    assert len(found) > 2
    assert all(each.run.cycles < 600 and each.run.logs == tuple(sorted(logs)) for each in found)
    assert sum(each.run.cycles for each in found) == whole.run.cycles
    for number in (0, 1):
        for field in whole.joints[number].dtype.names:
            one, other = joined(found, number)[field], whole.joints[number][field]
            assert np.array_equal(one, other, equal_nan=True), field
    assert all(each.good for each in found)
    assert all(each.identity is not None and not each.identity.unknown for each in found)
    if name == "faults":  # the other was recorded when ONNX Runtime evaluated the networks
        assert all(each.identity is not None and each.identity.whole for each in found)


def test_a_difference_in_a_later_stretch_is_found(tmp_path: Path) -> None:
    """A torque that is wrong by 1e-4 of itself in the last stretch, whose state continues the one before.

    The library's writer ends a chunk within a cycle: one joint of it is in the first chunk, the other in the second.
    """
    numbers = cycles(LOG)
    wrong = numbers[-10]
    at = 4 + 8 + 16 + 16 + 6 * 8  # encapsulation, stamp, frame_id, cycle and time, six quantities: torque_nm

    def payload(topic: str, cycle: int, data: bytes) -> bytes:
        if topic != "/joint/1/state" or cycle != wrong:
            return data
        return data[: at + 5] + bytes((data[at + 5] ^ 4,)) + data[at + 6 :]

    spoilt = cut(LOG, tmp_path / "a.mcap", payload=payload)
    found = list(replay([spoilt], stretch=400))
    assert sum(each.run.cycles for each in found) == len(numbers)
    assert [each.good for each in found] == [True] * (len(found) - 1) + [False]
    assert found[-1].identity is not None
    (difference,) = found[-1].identity.differences
    assert (difference.joint, difference.cycle, difference.field) == (1, wrong, "torque_nm")


def test_only_one_stretch_is_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays of a result are freed when the caller drops it, before the next one is made."""
    made: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []
    real = session._replay_run

    def counting(run: Run, inputs: Any, *rest: object, **more: Any) -> Result:
        alive.append(sum(each() is not None for each in made))
        result = real(run, inputs, *rest, **more)  # type: ignore[arg-type]
        arrays = (result.joints[0], run.joints[0], inputs.estimate)
        made.extend(weakref.ref(each if each.base is None else each.base) for each in arrays)
        return result

    monkeypatch.setattr(session, "_replay_run", counting)
    results = replay([LOG], stretch=300)
    while (result := next(results, None)) is not None:
        del result
    assert alive == [0, 0, 0]


def test_the_command_reports_every_stretch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "replay", partial(session.replay, stretch=500))
    target = tmp_path / "both.mcap"
    assert command.main([str(LOG), "--json", "--out", str(target)]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    numbers = cycles(LOG)
    assert [run["first_cycle"] for run in runs] == [numbers[0], *(run["last_cycle"] + 1 for run in runs[:-1])]
    assert runs[-1]["last_cycle"] == numbers[-1]
    for number in (1, 2):
        logged, replayed = (read_topic(target, f"/joint/{number}/{which}") for which in ("state", "replay"))
        assert logged["cycle"].tolist() == replayed["cycle"].tolist() == numbers
        assert np.array_equal(
            logged["torque_nm"], read_topic(LOG, f"/joint/{number}/state")["torque_nm"], equal_nan=True
        )


def test_several_runs_at_once_and_one_log_twice(tmp_path: Path) -> None:
    runs = [run for run, _ in read_runs([LOG, GOLDEN / "faults.mcap"], tmp_path)]
    assert [run.number for run in runs] == [0, 1]
    with pytest.raises(LogError, match="given twice"):
        list(replay([LOG, LOG]))


def test_cycles_of_two_parts_are_taken_once_and_must_be_the_same(tmp_path: Path) -> None:
    """A killed recorder leaves cycles that the next one writes once more; other ones show that it is not one run."""
    numbers = cycles(LOG)
    first = cut(LOG, tmp_path / "1.mcap", lambda cycle: cycle < numbers[700])
    second = cut(LOG, tmp_path / "2.mcap", lambda cycle: cycle >= numbers[650])
    (result,) = replay([first, second])
    assert result.run.cycles == len(numbers)
    assert result.good

    def payload(topic: str, cycle: int, data: bytes) -> bytes:
        spoilt = topic == "/joint/2/state" and cycle == numbers[660]
        return data[:92] + bytes((data[92] ^ 1,)) + data[93:] if spoilt else data

    other = cut(LOG, tmp_path / "3.mcap", lambda cycle: cycle >= numbers[650], payload=payload)
    with pytest.raises(LogError, match=f"/joint/2/state: found cycle {numbers[660]} .*given twice"):
        list(replay([first, other]))


# ---- logs that cannot be used ----


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        (b"motor_position_rad", b"position_of_motor_x", "found no field motor_position_rad"),
        (b"float64 dt_s", b"int64 dt_s", "found dt_s of type int64, expected float64"),
        (b"builtin_interfaces/Time stamp", b"float64 stamp", "found header.stamp of type float64"),
        (b"CanFrame[16] frames", b"CanFrame[16] fraims", "found no field frames.id"),
        (b"uint8[8] data", b"int8[8] data", "found frames.data of type"),
    ],
)
def test_logs_of_another_version(tmp_path: Path, old: bytes, new: bytes, found: str) -> None:
    """Fields with other names and types: one line, never numbers of something else."""
    path = cut(LOG, tmp_path / "a.mcap", schema=lambda text: text.replace(old, new))
    with pytest.raises(LogError, match=found):
        list(replay([path]))


@pytest.mark.parametrize(
    ("missing", "found"),
    [
        (lambda topic, row: topic != "/joint/1/state", "found no message on /joint/1/state"),
        (lambda topic, row: topic != "/can/frames", "found no message on /can/frames"),
        (lambda topic, row: topic != "/can/frames" or row != 500, "/can/frames: found 1.* of the 1.* cycles"),
        (lambda topic, row: topic != "/can/frames" or row < 1000, "/can/frames: found none from cycle 1"),
    ],
)
def test_logs_without_a_topic(tmp_path: Path, missing: Any, found: str) -> None:
    numbers = cycles(LOG)
    path = cut(LOG, tmp_path / "a.mcap", topics=lambda topic, cycle: missing(topic, cycle - numbers[0]))
    with pytest.raises(LogError, match=found):
        list(replay([path], stretch=200))
