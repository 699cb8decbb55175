"""What a loop has learned goes into another loop, which then goes on to the byte as the first one would have."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.reload.carry import CarryError, Changed, Fill, Walk
from jtqd.daemon.reload.handover import install, state_of
from jtqd.daemon.shared.ring import Ring, RingError
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from tests.daemon.loop.cycle_helpers import ExactTime, estimates, inputs, make, turn


def moving(sync: int) -> list[bytes]:
    """Every cycle is different, some frames are missing or late."""
    frames = inputs(velocity=5000 + 7 * sync, current=200 + sync, torque=9000 - sync)
    if sync % 41 == 0:
        del frames[1]
    if sync % 97 == 0:
        frames.append(frames[0])
    return frames


def walked(one: Cycle, other: Cycle) -> tuple[Walk, Fill]:
    walk, fill = Walk(one), Fill(other)
    while found := walk.step(6):
        fill.learn(json.loads(json.dumps(found)))
    return walk, fill


def carry(one: Cycle, other: Cycle) -> None:
    walk, fill = walked(one, other)
    install(other, fill, json.loads(json.dumps(state_of(one, walk))))


def estimators_of(cycle: Cycle) -> Any:
    """Their state is not carried; in place of a shadow, the other loop simply gets the same ones."""
    return [joint.estimator for joint in cycle.joints]


@pytest.mark.parametrize("before", [1, 30, 260, 1000])
def test_the_other_loop_goes_on_as_the_first_one_would_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: int
) -> None:
    clock = ExactTime().install(monkeypatch)
    begin_ns = clock.now_ns
    for name in ("whole", "first", "second"):
        (tmp_path / name).mkdir()
    whole, whole_socket, _ = make(tmp_path / "whole", moving)
    clock.turn(whole, before + 200)
    clock.now_ns = begin_ns
    first, first_socket, _ = make(tmp_path / "first", moving)
    clock.turn(first, before)
    end_ns = clock.now_ns
    second, second_socket, _ = make(tmp_path / "second", moving, estimators=estimators_of(first))
    carry(first, second)
    second_socket.syncs, second_socket.pending = first_socket.syncs, first_socket.pending
    clock.now_ns = end_ns
    clock.turn(second, 200)
    assert [*first_socket.sent, *second_socket.sent] == whole_socket.sent
    assert len(estimates(whole_socket)) == before + 200
    for counter in ("late_frames", "duplicate_frames", "stale_inputs"):
        assert getattr(second.intake, counter) == getattr(whole.intake, counter), counter


def test_a_second_telling_brings_only_what_has_changed(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    one, _, _ = make(tmp_path / "a", moving)
    other, _, _ = make(tmp_path / "b", moving)
    turn(one, 50)
    walk, fill = walked(one, other)
    everything = state_of(one, walk)
    install(other, fill, json.loads(json.dumps(everything)))
    turn(one, 1)
    news = state_of(one, walk)
    assert 0 < len(news[0]) < len(everything[0])
    assert state_of(one, walk)[0] == []
    install(other, fill, json.loads(json.dumps(news)))
    assert str(state_of(other, _listed(other))) == str(state_of(one, _listed(one)))


class _Thing:
    """Something that a loop could have learned in."""

    __module__ = "jtqd.daemon.something"

    def __init__(self) -> None:
        self.number: Any = 0
        self.text = "a"
        self.row: list[Any] = [1, 2.5, True]
        self.table: dict[int, Any] = {1: "x"}
        self.nodes = {1, 2}
        self.pair: tuple[Any, ...] = (1, b"ab")
        self.nested: list[Any] = [[1], [2]]


_CHANGES: dict[str, Any] = {
    "another": lambda thing: setattr(thing, "number", 7),
    "an equal one of another kind": lambda thing: setattr(thing, "number", False),
    "minus zero": lambda thing: setattr(thing, "number", -0.0),
    "not a number": lambda thing: setattr(thing, "number", math.nan),
    "text": lambda thing: setattr(thing, "text", "b"),
    "in place": lambda thing: thing.row.__setitem__(1, -0.0),
    "in place, equal": lambda thing: thing.row.__setitem__(2, 1),
    "longer": lambda thing: thing.row.append(4),
    "shorter": lambda thing: thing.row.clear(),
    "value": lambda thing: thing.table.update({1: "y"}),
    "key": lambda thing: thing.table.update({2: "x"}),
    "another key": lambda thing: (thing.table.clear(), thing.table.update({3: "x"})),
    "member": lambda thing: thing.nodes.add(9),
    "tuple": lambda thing: setattr(thing, "pair", (1, b"ac")),
    "deep": lambda thing: thing.nested[1].append(3),
}


@pytest.mark.parametrize("change", _CHANGES.values(), ids=list(_CHANGES))
def test_whatever_changes_is_told_and_nothing_else(change: Callable[[Any], Any]) -> None:
    one, other = _Thing(), _Thing()
    walk, fill = Walk(one), Fill(other)
    fill.learn(walk.step(9))
    fill.put(json.loads(json.dumps(walk.changes())))
    assert json.dumps(walk.changes()) == '[[0, [], [4, ["l", [["l", [1]], ["l", [2]]]]]]]', "told each time"
    change(one)
    (news,) = walk.changes()
    assert len(news[1]) + len(news[2]) in (2, 4)
    fill.put(json.loads(json.dumps([news])))
    assert repr(vars(other)) == repr(vars(one))


def test_what_cannot_be_told_any_more_is_noticed() -> None:
    thing = _Thing()
    walk = Walk(thing)
    walk.step(9)
    walk.changes()
    thing.row.extend(range(200))
    with pytest.raises(Changed, match="row"):
        walk.changes()
    thing.number = [1]
    with pytest.raises(Changed, match="number"):
        walk.changes()


def _listed(cycle: Cycle) -> Walk:
    walk = Walk(cycle)
    while walk.step(100):
        pass
    return walk


def test_a_replaced_object_is_noticed(tmp_path: Path) -> None:
    """A drive that restarts begins its positions anew: the list made before does not hold any more."""
    cycle, _, _ = make(tmp_path, moving)
    turn(cycle, 5)
    walk = _listed(cycle)
    walk.changes()
    cycle.joints[0].begin_again()
    with pytest.raises(Changed):
        walk.changes()


def test_estimators_limits_and_sockets_stay_those_of_the_new_loop(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    one, _, _ = make(tmp_path / "a", moving)
    other, other_socket, _ = make(tmp_path / "b", moving)
    turn(one, 20)
    kept = [(joint.estimator, joint.safety, joint.safety.torque_limit_nm) for joint in other.joints]
    carry(one, other)
    assert [(j.estimator, j.safety, j.safety.torque_limit_nm) for j in other.joints] == kept
    assert other.socket is other_socket


@pytest.mark.parametrize(
    ("found", "error"),
    [
        ([[["no_such_part"], ["x"], []]], "there is no no_such_part"),
        ([[["intake"], ["no_such_thing"], []]], "Intake has no no_such_thing"),
        ([[["intake", "states", 99], ["fresh"], []]], "there is no intake.states.99"),
    ],
)
def test_a_loop_of_another_version_is_refused(tmp_path: Path, found: Any, error: str) -> None:
    cycle, _, _ = make(tmp_path, moving)
    with pytest.raises(CarryError, match=error):
        Fill(cycle).learn(found)


def test_values_of_an_object_nobody_has_listed_are_refused(tmp_path: Path) -> None:
    cycle, _, _ = make(tmp_path, moving)
    with pytest.raises(CarryError, match="found object 3, expected 0 of them"):
        Fill(cycle).put([(3, [1], [])])


def test_a_ring_goes_on_where_the_first_writer_left_it(tmp_path: Path) -> None:
    ring = Ring(tmp_path / "ring", 8, 64)
    for _ in range(11):
        ring.commit()
    again = Ring(tmp_path / "ring", 8, 64, attach=True)
    assert again.count == 11
    with pytest.raises(RingError, match="not a ring of 9 records of 64 bytes"):
        Ring(tmp_path / "ring", 9, 64, attach=True)


def test_a_snapshot_keeps_its_counters_and_changes_its_owner(tmp_path: Path) -> None:
    first = Snapshot(tmp_path / "snapshot", 1e-3, 0.5)
    first.counters[0] = 77
    second = Snapshot(tmp_path / "snapshot", 1e-3, 0.5, attach=True)
    assert second.counters[0] == 77
    reader = SnapshotReader(tmp_path / "snapshot", supervisor=True)
    assert reader.ask_reset() == 1
    assert list(second.orders[:2]) == [1, 0]
    first.orders[1] = 1
    assert reader.resets_done == 1
