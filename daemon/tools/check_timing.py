"""Judgement of timing: this process's wake-ups, SYNC's echo, or the loop of a daemon that runs. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from daemon.shared.snapshot import LATE_BIN_NS, View
from daemon.tools.check_bus import arrival
from daemon.tools.finding import FAIL, GOOD, WARN, Finding
from daemon.tools.listener import Timing
from daemon.tools.tally import Tally

LATE_WARN, LATE_FAIL = 0.1, 0.5
"""Of the period, p99: noticeable, and as much as makes the loop skip a slot."""
MISSED_FAIL = 0.01
ECHO_WARN = 0.3
"""Of the period, p99: at 1 Mbit/s SYNC and a frame that is just being sent take up to 200 us."""
STOLEN_WARN = 0.001
_STOLEN_HINT = (
    "no setting in this machine helps: give it processors of its own, or a machine without a hypervisor"
)
_HINT = "`jtq doctor` says what real time lacks on this machine"


def own_timing(timing: Timing, period_ns: int, refused: Sequence[str], *, driven: bool) -> Iterator[Finding]:
    """Findings of this process's own loop; `refused`: what real-time means it did not get."""
    granted = (
        "without real-time scheduling" if any("SCHED_FIFO" in line for line in refused) else "SCHED_FIFO"
    )
    yield _judged("timer wake-up", timing.lateness, timing.missed, period_ns, granted)
    if driven:
        text = f"from send to echo: {arrival(timing.echo)}"
        if timing.unsent:
            yield Finding(
                "SYNC echo",
                FAIL,
                f"{text}; {timing.unsent} not sent",
                "transmit queue full: txqueuelen, bus load",
            )
        elif timing.echo.count < timing.lateness.count - 1:
            lost = timing.lateness.count - timing.echo.count
            yield Finding(
                "SYNC echo",
                FAIL,
                f"{text}; {lost} without an echo",
                "the interface sends late, or not at all",
            )
        else:
            level = WARN if timing.echo.quantile_us(0.99) > ECHO_WARN * period_ns / 1000 else GOOD
            hint = (
                "SYNC waits in the transmit queue: who else sends on this machine?" if level == WARN else ""
            )
            yield Finding("SYNC echo", level, text, hint)


def loop_timing(before: tuple[int, ...], after: tuple[int, ...], first: View, last: View) -> Finding:
    """Finding of the running loop, from its histogram of SYNC's lateness before and after."""
    tally = Tally()
    for n, (old, new) in enumerate(zip(before, after, strict=True)):
        for _ in range(new - old):
            tally.add((n + 1) * LATE_BIN_NS)
    missed = last.counters["missed"] - first.counters["missed"]
    return _judged("jtqd's timing", tally, missed, round(last.period_s * 1e9), "SYNC's lateness in the loop")


def stolen_time(stolen_s: float, seconds: float) -> Finding:
    """Finding of the processor time that a hypervisor took (`daemon/shared/stolen_time.py`) in `seconds`."""
    share = stolen_s / max(seconds, 1e-3)
    text = f"{share:.1%} of a processor taken away by a hypervisor (stolen time)"
    return (
        Finding("processors", WARN, text, _STOLEN_HINT)
        if share >= STOLEN_WARN
        else Finding("processors", GOOD, text)
    )


def _judged(item: str, tally: Tally, missed: int, period_ns: int, how: str) -> Finding:
    slots = tally.count + missed
    text = f"{how}: late {arrival(tally)}; {missed} of {slots} slots missed"
    p99_us, period_us = tally.quantile_us(0.99), period_ns / 1000
    if not tally.count or missed > MISSED_FAIL * slots or p99_us > LATE_FAIL * period_us:
        return Finding(item, FAIL, text, _HINT)
    if missed or p99_us > LATE_WARN * period_us:
        return Finding(item, WARN, text, _HINT)
    return Finding(item, GOOD, text)
