"""Losses and returns in few lines: a flicker is none, a flapping contact is told once in a while."""

from itertools import pairwise

from jtqd.daemon.supervisor.health import Presence

STEP = 1.0 / 16.0  # exact in binary; two of them are longer than what counts as a flicker


def told(*spans: tuple[float, float], until: float) -> list[tuple[float, str]]:
    """What is said, and when, of something that is lost from .. to; the cause is the time it is asked for."""
    presence, lines = Presence(), []
    for n in range(round(until / STEP) + 1):
        now = n * STEP
        lost = any(start <= now < end for start, end in spans)
        line = presence.update(lost, now, lambda now=now: f"asked at {now}")
        if line:
            lines.append((now, line))
    return lines


def test_nothing_lost_nothing_said():
    assert told(until=10) == []


def test_a_loss_and_its_end_are_one_line_each_at_once():
    assert told((1.0, 3.25), until=10) == [(1.125, "lost: asked at 1.125"), (3.375, "back after 2.2 s")]


def test_what_does_not_last_is_not_told():
    assert told(*((1.0 + 0.25 * n, 1.125 + 0.25 * n) for n in range(20)), until=10) == []
    assert told((1.0, 2.0), (2.0625, 3.0), until=10) == [
        (1.125, "lost: asked at 1.125"),
        (3.125, "back after 2.0 s"),
    ]


def test_a_flapping_contact_is_two_lines_in_five_seconds_and_nothing_is_left_out():
    lines = told(*((1.0 + 0.5 * n, 1.25 + 0.5 * n) for n in range(40)), until=30)
    assert lines[:2] == [(1.125, "lost: asked at 1.125"), (1.375, "back after 0.2 s")]
    assert all(later - earlier >= 5.0 for earlier, later in pairwise(at for at, _ in lines[::2]))
    assert len(lines) <= 2 * 5
    ends = [line for _, line in lines if line.startswith("back")]
    assert sum(int(line.split("lost ")[1].split()[0]) if "times" in line else 1 for line in ends) == 40


def test_a_loss_that_was_too_soon_to_be_told_is_told_with_its_end_and_cause():
    assert told((1.0, 1.5), (2.0, 2.5), until=10)[2:] == [(6.125, "back after 0.5 s: asked at 2.125")]


def test_a_loss_too_soon_that_lasts_is_told_as_soon_as_allowed():
    assert told((1.0, 1.5), (2.0, 9.0), until=10)[2:] == [
        (6.125, "lost: asked at 2.125"),
        (9.125, "back after 7.0 s"),
    ]


def test_two_losses_are_two_and_the_next_line_waits_for_its_time():
    lines = told((1.0, 1.5), (2.0, 2.5), (3.0, 3.5), (7.0, 7.5), until=20)
    assert lines[2] == (6.125, "back after 1.0 s, lost 2 times: asked at 3.125")
    assert lines[3] == (11.125, "back after 0.5 s: asked at 7.125")
