"""A long run in stretches: the same numbers as in one piece, memory for one of them only."""

from __future__ import annotations

import json
import weakref
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import LogError, read_topic
from jtqd.daemon.replay import command, session
from jtqd.daemon.replay.runs import Run, in_order, read_part, stretches
from jtqd.daemon.replay.session import ReplayOptions, Result, replay, replay_each
from tests.daemon.replay.replay_helpers import cut, cycles
from tests.paths import GOLDEN

LOGS = ("network", "faults")


def joined(results: list[Result], number: int) -> np.ndarray:
    return np.concatenate([each.joints[number] for each in results])


def parts_of(log: Path, directory: Path, *ends: int) -> list[Path]:
    """The log cut into parts that end before these rows."""
    directory.mkdir(exist_ok=True)
    numbers = cycles(log)
    limits = [numbers[0], *(numbers[end] for end in ends), numbers[-1] + 1]
    return [
        cut(log, directory / f"p-20260101T000000Z-{n:04d}.mcap", lambda c, a=a, b=b: a <= c < b)
        for n, (a, b) in enumerate(pairwise(limits), start=1)
    ]


@pytest.mark.parametrize("name", LOGS)
def test_pieces_of_one_log_give_what_the_whole_gives(name: str) -> None:
    log = GOLDEN / f"{name}.mcap"
    (whole,) = replay([log], ReplayOptions())
    pieces = list(replay_each([log], ReplayOptions(), stretch=300))
    assert len(pieces) > 2
    assert all(each.run.cycles < 600 for each in pieces)
    assert sum(each.run.cycles for each in pieces) == whole.run.cycles
    for number in (0, 1):
        for field in whole.joints[number].dtype.names:
            one, other = joined(pieces, number)[field], whole.joints[number][field]
            assert np.array_equal(one, other, equal_nan=True), field
    assert all(each.good for each in pieces)
    assert all(each.identity is not None and not each.identity.unknown for each in pieces)
    if name != "network":  # recorded when ONNX Runtime evaluated the networks
        assert all(each.identity is not None and each.identity.whole for each in pieces)


def test_parts_of_a_run_are_joined_up_to_the_limit(tmp_path: Path) -> None:
    """Parts of 400, 300, 300 and the rest with a limit of 700: two stretches or three, in any order of the files."""
    log = GOLDEN / "network.mcap"
    parts = parts_of(log, tmp_path / "p", 400, 700, 1000)
    (whole,) = replay([log], ReplayOptions())
    found = list(replay_each(parts[::-1], ReplayOptions(), stretch=700))
    assert [[part.path.name[-6] for part in each.run.parts] for each in found] == [["1", "2"], ["3", "4"]]
    assert [each.run.cycles for each in found] == [700, len(cycles(log)) - 700]
    for number in (0, 1):
        one, other = joined(found, number)["torque_nm"], whole.joints[number]["torque_nm"]
        assert np.array_equal(one, other, equal_nan=True)
    assert all(each.good for each in found)


def test_a_difference_in_a_later_stretch_is_found(tmp_path: Path) -> None:
    """A torque that is wrong by 1e-4 of itself in the last stretch, whose state goes on from the one before.

    The library's writer ends a chunk within a cycle: one joint of it is in the first chunk, the other in the second.
    """
    log = GOLDEN / "network.mcap"
    numbers = cycles(log)
    wrong = numbers[-10]
    at = 4 + 8 + 16 + 16 + 6 * 8  # encapsulation, stamp, frame_id, cycle and time, six quantities: torque_nm

    def payload(topic: str, cycle: int, data: bytes) -> bytes:
        if topic != "/joint/1/state" or cycle != wrong:
            return data
        return data[: at + 5] + bytes((data[at + 5] ^ 4,)) + data[at + 6 :]

    spoilt = cut(log, tmp_path / "a.mcap", payload=payload)
    found = list(replay_each([spoilt], ReplayOptions(), stretch=400))
    assert sum(each.run.cycles for each in found) == len(numbers)
    assert [each.good for each in found] == [True] * (len(found) - 1) + [False]
    assert found[-1].identity is not None
    (difference,) = found[-1].identity.differences
    assert (difference.joint, difference.cycle, difference.field) == (1, wrong, "torque_nm")


def test_only_one_stretch_is_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a result holds goes when it is let go, before the next one is made."""
    made: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []
    real = session._replay_run

    def counting(run: Run, *rest: object) -> Result:
        alive.append(sum(each() is not None for each in made))
        result = real(run, *rest)  # type: ignore[arg-type]
        made.append(weakref.ref(result.joints[0]))
        return result

    monkeypatch.setattr(session, "_replay_run", counting)
    results = replay_each([GOLDEN / "network.mcap"], ReplayOptions(), stretch=300)
    while (result := next(results, None)) is not None:
        del result
    assert alive == [0, 0, 0]


def test_the_command_tells_every_stretch(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = GOLDEN / "network.mcap"
    real = session.replay_each
    monkeypatch.setattr(command, "replay_each", lambda *given: real(*given, stretch=500))
    target = tmp_path / "both.mcap"
    assert command.main([str(log), "--json", "--out", str(target)]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    numbers = cycles(log)
    assert [run["first_cycle"] for run in runs] == [numbers[0], *(run["last_cycle"] + 1 for run in runs[:-1])]
    assert runs[-1]["last_cycle"] == numbers[-1]
    for number in (1, 2):
        logged, again = (read_topic(target, f"/joint/{number}/{which}") for which in ("state", "replay"))
        assert logged["cycle"].tolist() == again["cycle"].tolist() == numbers
        assert np.array_equal(
            logged["torque_nm"], read_topic(log, f"/joint/{number}/state")["torque_nm"], equal_nan=True
        )


def test_several_runs_at_once_and_one_log_twice(tmp_path: Path) -> None:
    one, two = GOLDEN / "network.mcap", GOLDEN / "faults.mcap"
    read = []
    for n, path in enumerate((one, two)):
        (tmp_path / str(n)).mkdir()
        read.append(read_part(path, tmp_path / str(n)))
    assert [run.number for run in stretches(read, 300)] == [0, 1]
    with pytest.raises(LogError, match="given twice"):
        list(replay_each([one, one], ReplayOptions(), stretch=300))
    first, second = parts_of(one, tmp_path / "p", 600)
    assert in_order([second, first]) == [first, second]
