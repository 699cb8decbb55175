"""The hand-over itself, over a real socket: what goes over, when it is put off, and that a loop nobody relieves goes on."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.reload import handover
from jtqd.daemon.reload.handover import Giver, Refused, Taker
from tests.daemon.loop.cycle_helpers import inputs, make, turn

PAUSE_NS = 3_000_000_000


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Cycle, Cycle]:
    """A loop that has run, and its successor."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    one, _, _ = make(tmp_path / "a", lambda _: inputs())
    other, _, _ = make(tmp_path / "b", lambda _: inputs())
    turn(one, 30)
    return one, other


def with_time(cycle: Cycle) -> None:
    """The next SYNC is far away: there is all the time of the world for a step."""
    cycle.grid.period_ns = PAUSE_NS
    cycle.grid.slot_ns = time.monotonic_ns()


def both_until_told(
    giver: Giver, taker: Taker, cycle: Cycle, before_step: Callable[[], None] = lambda: None
) -> list[bool | None]:
    """Step both sides until the giver waits for the last word (in a thread) and the taker has the bus."""
    said: list[bool | None] = []

    def give() -> None:
        for _ in range(200):
            with_time(cycle)
            before_step()
            done = giver.step()
            if done is not False:
                said.append(done)
                return
            time.sleep(0.002)

    thread = threading.Thread(target=give)
    thread.start()
    until = time.monotonic() + 20
    while not taker.step() and time.monotonic() < until:
        time.sleep(0.001)
    taker.taken()
    thread.join(20)
    return said


def test_the_bus_goes_over_with_all_that_is_known(tmp_path: Path, pair: tuple[Cycle, Cycle]) -> None:
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover", end_ns=123_456)
    giver.begin()
    before_ns = time.time_ns()
    assert both_until_told(giver, taker, one) == [True]
    assert (other.index, other.counter) == (one.index, one.counter) == (30, 30)
    assert other.grid.slot_ns == one.grid.slot_ns
    assert taker.end_ns == 123_456
    assert before_ns < taker.before_ns < time.time_ns()
    assert not (tmp_path / "handover").exists()


def test_the_socket_is_the_daemons_own(tmp_path: Path, pair: tuple[Cycle, Cycle]) -> None:
    taker = Taker(pair[1], tmp_path / "handover")
    assert (tmp_path / "handover").stat().st_mode & 0o777 == 0o600
    taker.close()


def test_a_successor_that_ends_before_its_last_word_leaves_the_loop_running(
    tmp_path: Path, pair: tuple[Cycle, Cycle]
) -> None:
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    said: list[bool | None] = []

    def give() -> None:
        while not said:
            with_time(one)
            done = giver.step()
            if done is not False:
                said.append(done)
            time.sleep(0.002)

    thread = threading.Thread(target=give)
    thread.start()
    while not taker.step():
        time.sleep(0.001)
    taker.close()  # as the kernel does for one that is killed
    thread.join(20)
    assert said == [None]
    assert giver.refused == "the new loop ended during the hand-over"
    turn(one, 5)
    assert one.index == 35


def test_nobody_there_is_no_reason_to_wait(tmp_path: Path, pair: tuple[Cycle, Cycle]) -> None:
    giver = Giver(pair[0], tmp_path / "nobody")
    giver.begin()
    with_time(pair[0])
    assert giver.step() is None
    assert "No such file" in (giver.refused or "")


def test_without_a_pause_nothing_is_done_and_after_a_while_it_is_said(
    tmp_path: Path, pair: tuple[Cycle, Cycle], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next SYNC is due at once in every cycle: no step may be taken, none is."""
    monkeypatch.setattr(handover, "_TRIES", 50)
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    one.grid.period_ns = 0
    steps = []
    for _ in range(51):
        one.grid.slot_ns = time.monotonic_ns()
        steps.append(giver.step())
        assert not taker.step()
    assert steps == [False] * 50 + [None]
    assert (giver.refused or "").startswith("no pause between two cycles was long enough to connect:")
    taker.close()


def test_where_no_pause_is_long_enough_handing_over_takes_a_slot_and_nothing_else_does(
    tmp_path: Path, pair: tuple[Cycle, Cycle], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a third of the tries on a tenth of a period more, for the last step from two thirds on a whole period."""
    monkeypatch.setattr(handover, "_TRIES", 300)
    now = time.monotonic_ns()
    monkeypatch.setattr(handover.time, "monotonic_ns", lambda: now)
    giver = Giver(pair[0], tmp_path / "handover")
    grid = pair[0].grid
    grid.period_ns, grid.slot_ns = 1_000_000, now - 600_000
    left = {}
    for tries in (1, 100, 101, 200, 201, 300):
        giver._tries = tries
        left[tries] = giver._pause_ns(), giver._pause_ns(last=True)
    early, later = (360_000, 360_000), (500_000, 500_000)
    assert left == {1: early, 100: early, 101: later, 200: later, 201: (500_000, 1_400_000), 300: left[201]}


def test_a_slot_that_handing_over_took_is_counted_and_the_grid_is_kept(
    tmp_path: Path, pair: tuple[Cycle, Cycle], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pause is 0 in every cycle, the step needs two thirds of a period: the successor's first SYNC is one slot later."""
    monkeypatch.setattr(handover, "_TRIES", 90)
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()

    def no_pause() -> None:
        if giver._stage == giver._hand_over:
            one.grid.slot_ns -= PAUSE_NS
            giver._tell_ns = PAUSE_NS * 2 // 3
            one.grid.missed = 4

    assert both_until_told(giver, taker, one, no_pause) == [True]
    assert 60 < giver._tries <= 90
    slot_ns = other.grid.slot_ns
    assert other.grid.advance(slot_ns + PAUSE_NS + PAUSE_NS * 2 // 3) == 1
    assert (other.grid.slot_ns, other.grid.missed) == (slot_ns + 2 * PAUSE_NS, 5)


def test_a_cycle_without_all_inputs_is_not_the_one(
    tmp_path: Path, pair: tuple[Cycle, Cycle], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a frame missing, one may still be under way: it would reach neither loop, or both."""
    monkeypatch.setattr(handover, "_TRIES", 300)
    one, other = pair
    one.socket.script = lambda _: inputs()[1:]  # type: ignore[attr-defined]
    turn(one, 1)
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    done: bool | None = False
    while done is False:
        with_time(one)
        done = giver.step()
        if done is False:
            assert not taker.step()
    assert done is None
    assert giver.refused == "inputs are missing: a hand-over needs a cycle with all of them"
    taker.close()


def test_a_frame_that_waits_unread_puts_it_off(tmp_path: Path, pair: tuple[Cycle, Cycle]) -> None:
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    waiting = True
    one.socket.wait = lambda timeout_s: waiting  # type: ignore[method-assign]
    for _ in range(50):
        with_time(one)
        assert giver.step() is False
        assert not taker.step()
    waiting = False
    assert both_until_told(giver, taker, one) == [True]


def test_a_successor_of_another_version_refuses_and_says_why(
    tmp_path: Path, pair: tuple[Cycle, Cycle]
) -> None:
    one, other = pair
    one.configured_nodes.something_new = 5  # type: ignore[attr-defined]
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    refused = ""
    done: bool | None = False
    while done is False:
        with_time(one)
        done = giver.step()
        try:
            taker.step()
        except Refused as error:
            refused = refused or str(error)
    assert done is None
    assert giver.refused is not None
    assert giver.refused in refused
    assert "the program has changed since jtqd started" in refused
    assert "ConfiguredNodes has no something_new" in refused


def test_messages_are_small_against_the_sockets_buffer(pair: tuple[Cycle, Cycle]) -> None:
    walk = handover.Walk(pair[0])
    while walk.step(10):
        pass
    assert len(json.dumps(handover.state_of(pair[0], walk))) < 20_000


@pytest.mark.parametrize("moment", ["fill", "rehearse", "hand over"])
def test_a_node_that_begins_again_meanwhile_refuses_and_the_loop_goes_on(
    tmp_path: Path, pair: tuple[Cycle, Cycle], moment: str
) -> None:
    one, other = pair
    taker = Taker(other, tmp_path / "handover")
    giver = Giver(one, tmp_path / "handover")
    giver.begin()
    stage = {
        "fill": giver._fill,
        "rehearse": giver._rehearse,
        "hand over": giver._hand_over,
    }[moment]
    done, began, ended = False, False, ""
    for _ in range(500):
        with_time(one)
        if giver._stage == stage and not began:
            began = True
            one.joints[0].begin_again()
            turn(one, 1)
        assert began or giver._stage != giver._hand_over, f"there is no moment to {moment}"
        done = giver.step()  # type: ignore[assignment]
        try:
            if not ended:
                taker.step()
        except Refused as error:
            ended = str(error)
        if done is None:
            break
    assert began
    assert done is None
    assert ended in ("", "the running loop has cancelled the hand-over")
    assert giver.refused == "a node appeared or restarted meanwhile; send the order again"
    turn(one, 5)
    assert one.index == 36
    taker.close()


def test_a_step_that_was_interrupted_does_not_ask_for_longer_pauses_for_ever(
    tmp_path: Path, pair: tuple[Cycle, Cycle]
) -> None:
    giver = Giver(pair[0], tmp_path / "handover")
    usual_ns = giver._list_ns
    giver._listed(1000 * usual_ns)
    assert giver._list_ns < 3 * usual_ns
    for _ in range(20):
        giver._listed(2 * usual_ns)
    assert giver._list_ns == pytest.approx(2.5 * usual_ns, abs=2), "but it follows what all take"
