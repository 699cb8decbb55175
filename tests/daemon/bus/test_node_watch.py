"""Heartbeat consumers: lost, late, strange, and two producers with one node-ID."""

import pytest

from jtqd.daemon.bus.nodes import ACTIVE as HEARD
from jtqd.daemon.bus.nodes import LOST, WAITING, NodeWatch


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


BEAT = 0.1


def make_watch() -> NodeWatch:
    watch = NodeWatch((1, 2, 3), (0x20, 0x21), BEAT, 0.3)
    for node in (1, 2, 3):
        watch.watch(node, 0.0)
    return watch


def kinds(events: list) -> list[tuple[str, int]]:
    return [(event.kind, event.node) for event in events]


def test_a_node_that_never_comes_and_one_that_stops_are_told() -> None:
    watch = make_watch()
    watch.receive(1, b"\x05", 0.05)
    watch.receive(2, b"\x05", 0.05)
    assert watch.tick(0.29) == []
    assert kinds(watch.tick(0.31)) == [("never", 3)]
    watch.receive(1, b"\x05", 0.32)
    (lost,) = watch.tick(0.36)
    assert lost == ("lost", 2, "0.3 s", 0.05)
    assert [watch.state(node) for node in (1, 2, 3)] == [HEARD, LOST, LOST]
    (back,) = watch.receive(2, b"\x05", 2.05)
    assert back == ("back", 2, "", 2.05)
    assert watch.lost_count == 2


def test_late_beats_within_the_time_are_no_loss() -> None:
    watch = make_watch()
    for n in range(1, 40):
        for node in (1, 2, 3):
            assert watch.receive(node, b"\x05", 0.28 * n) == []
        assert watch.tick(0.28 * n) == []


@pytest.mark.parametrize("data", [b"", b"\x05\x00", b"\x85", b"\x06", b"\xff"])
def test_what_is_no_heartbeat_does_not_keep_a_node_alive(data: bytes) -> None:
    watch = make_watch()
    for n in range(10):
        watch.receive(1, data, 0.1 * n)
    assert watch.malformed == 10
    assert ("never", 1) in kinds(watch.tick(0.95))


def test_a_toggling_state_is_few_lines() -> None:
    watch, lines = make_watch(), []
    for n in range(1000):
        events = watch.receive(1, b"\x05" if n % 2 else b"\x7f", 0.1 * n)
        lines += [event.text for event in events if event.text]
    assert 2 <= len(lines) <= 25, "100 s of toggling"


def test_two_producers_with_one_node_id_show_by_the_rate() -> None:
    watch, seen = make_watch(), []
    for n in range(100):
        seen += kinds(watch.receive(1, b"\x05", BEAT * n))
        if n > 40:
            seen += kinds(watch.receive(1, b"\x05", BEAT * n + 0.03))
    assert seen == [("doubled", 1)]
    for n in range(100, 150):
        seen += kinds(watch.receive(1, b"\x05", BEAT * n))
    assert seen == [("doubled", 1), ("single", 1)]


def test_a_restart_and_a_node_that_is_not_in_the_configuration() -> None:
    watch = make_watch()
    assert kinds(watch.receive(1, b"\x00", 0.1)) == [("restarted", 1)]
    (foreign,) = watch.receive(9, b"\x00", 0.1)
    assert foreign.text == "node 9: it is on the bus and not in the configuration (status A)"
    assert watch.receive(9, b"\x7f", 0.2) == [], "once"
    assert watch.receive(0x20, b"\x05", 0.2) == watch.receive(0x21, b"\x05", 0.2) == []
    for node in range(40, 127):  # somebody tries them all: bounded
        watch.receive(node, b"\x00", 0.3)
    assert len(watch._known) < 30


def test_a_node_is_not_watched_before_it_is_configured() -> None:
    watch = NodeWatch((3,), (), BEAT, 0.3)
    assert watch.tick(100.0) == []
    watch.watch(3, 100.0)
    assert watch.state(3) == WAITING
    assert kinds(watch.tick(100.31)) == [("never", 3)]


def test_what_queued_up_while_the_reader_was_away_is_no_second_node() -> None:
    """A supervisor that was stopped for 10 s reads all heartbeats in one moment; two nodes that follow are told."""
    watch = make_watch()
    for node in (1, 2, 3):
        watch.watch(node, 0.0)
    now = 0.0
    for _ in range(30):
        now += BEAT
        watch.receive(1, frame("05"), now)
        watch.tick(now)
    now += 100 * BEAT
    events = [event for _ in range(100) for event in watch.receive(1, frame("05"), now)]
    assert [event.kind for event in events] == []
    watch.tick(now)
    seen = []
    for _ in range(60):
        now += BEAT / 2
        seen += [event.kind for event in watch.receive(1, frame("05"), now)]
        watch.tick(now)
    assert seen == ["doubled"]
