"""Plays cases one after the other on one running jtqd, and judges what was seen."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.slow.faults.cases import STARTING, Case
from tests.slow.faults.listener import Heard, joined
from tests.slow.faults.rig import Rig, rises

MS = 1_000_000
_LONGEST_SETTLE_S = 5.0
_LONGEST_WAIT_S = 20.0
"""For the demo motion to do what a case needs."""
_HEALTHY = 30
"""Cycles for which a proof is tried without the fault."""
_AFTER_MS = 120
"""Watched after all is well, so that what comes late is seen."""


@dataclass(frozen=True)
class Outcome:
    """What one case showed.

    Attributes:
        one, two: statuses without torque of joint 1 and 2.
        emcy: codes sent.
        counters: which rose, by how much.
        noticed_ms: from the begin to the first status, EMCY or counter that shows it; None: nothing did.
        recovered_ms: from the end to the first estimate from which on both joints had a torque.
        quiet_ms: from the end until jtqd had taken back every EMCY.
        proof: what the independent observation saw of the fault, in words.
        wrong: what was not as expected, one line each; empty: the case holds.
    """

    case: Case
    one: frozenset[int]
    two: frozenset[int]
    emcy: frozenset[int]
    counters: dict[str, int]
    noticed_ms: float | None
    recovered_ms: float | None
    quiet_ms: float | None
    proof: str
    wrong: tuple[str, ...]


def play(
    cases: Iterable[Case],
    bus: str,
    tell: Callable[[Outcome], None] = lambda outcome: None,
    *,
    library: bool = False,
) -> list[Outcome]:
    """Play them with one jtqd; each outcome is told as soon as it is known. library: with the nodes of the library.

    Raises:
        DaemonEndedError: jtqd did not start, or ended in a case.
    """
    outcomes = []
    with (
        tempfile.TemporaryDirectory(prefix="jtq") as directory,
        Rig(bus, Path(directory), library=library) as rig,
    ):
        for case in cases:
            outcome = _play_one(rig, case)
            tell(outcome)
            outcomes.append(outcome)
        if "Traceback" in rig.said():
            raise AssertionError(rig.said())
    return outcomes


def _play_one(rig: Rig, case: Case) -> Outcome:
    watcher = rig.watcher
    settled = rig.until(
        lambda: watcher.well(case.settle) and not watcher.present and rig.rested(), _LONGEST_SETTLE_S
    )
    if case.wait is not None:
        settled = rig.until(lambda: case.wait(rig), _LONGEST_WAIT_S) and settled  # type: ignore[misc]
    watcher.begin()
    count = len(watcher.seen)
    rig.until(lambda: len(watcher.seen) > count, 0.1)
    healthy, last = _healthy(rig, case)
    watcher.begin()
    before, told = rig.counters(), len(rig.said())
    counted: list[int] = []

    def look() -> None:
        if not counted and rises(before, rig.counters()):
            counted.append(time.monotonic_ns())

    fault = rig.fault = case.fault()
    begin_ns, first = time.monotonic_ns(), rig.cycle
    fault.begin(rig)
    last_ns = begin_ns + (case.cycles + 5) * MS

    def over() -> bool:
        look()
        return rig.cycle - first >= case.cycles or time.monotonic_ns() >= last_ns

    rig.until(over, case.cycles / 1000 + 10.0)
    during = [] if case.during is None else [case.during(rig)]
    end_ns = time.monotonic_ns()
    rig.fault = rig.healthy
    fault.end(rig)

    def well() -> bool:
        look()
        return watcher.well(20) and rig.configured()

    back = rig.until(well, case.recover_ms / 1000 + 5.0)
    rig.until(lambda: time.monotonic_ns() >= end_ns + _AFTER_MS * MS, 1.0)
    quiet = rig.until(lambda: not watcher.present, 5.0)
    quiet_ns = watcher.told[-1].at_ns if watcher.told else None
    counters = rises(before, rig.counters())
    one, two = watcher.bad()
    firsts = [watcher.first_bad_ns(), watcher.told[0].at_ns if watcher.told else None, *counted]
    noticed = [at for at in firsts if at is not None]
    again_ns = watcher.well_again_ns()
    recovered = max(0, (again_ns or 0) - end_ns) / MS if back else None
    rig.ears.listen()
    heard = joined([last, rig.ears.heard()])
    seen = [*during, *([] if case.proof is None else [case.proof(heard)])]
    outcome = Outcome(
        case,
        one,
        two,
        frozenset(each.code for each in watcher.told if each.code),
        counters,
        (min(noticed) - begin_ns) / MS if noticed else None,
        recovered,
        None if quiet_ns is None else max(0, quiet_ns - end_ns) / MS,
        ", ".join(each.text for each in seen),
        (),
    )
    wrong = [*watcher.broken, *healthy]
    wrong += [f"not injected: {each.text}" for each in seen if not each.ok]
    if not settled:
        wrong.append("the bench was not well before it")
    if not quiet:
        wrong.append(f"errors not taken back: {sorted(f'{c:04X}h' for c, _ in watcher.present)}")
    wrong += judge(outcome)
    if wrong:
        wrong.append("said: " + rig.said()[told:][-1500:])
    return Outcome(**{**outcome.__dict__, "wrong": tuple(wrong)})


def _healthy(rig: Rig, case: Case) -> tuple[list[str], Heard]:
    """Without the fault its proof must not hold: one line for each that does; and the last frames before it."""
    rig.ears.listen()
    rig.ears.heard()
    count = len(rig.watcher.seen)
    rig.until(lambda: len(rig.watcher.seen) >= count + _HEALTHY, 1.0)
    rig.ears.listen()
    heard = rig.ears.heard()
    seen = [] if case.during is None else [case.during(rig)]
    if case.proof is not None:
        seen.append(case.proof(heard))
    return [f"its proof holds before it begins: {each.text}" for each in seen if each.ok], heard.tail()


def judge(outcome: Outcome) -> list[str]:
    case, wrong = outcome.case, []
    for joint, expected, found in ((1, case.one, outcome.one), (2, case.two, outcome.two)):
        if not (expected - STARTING <= found <= expected) or bool(expected) != bool(found):
            wrong.append(f"joint {joint}: statuses {sorted(found)}, expected {sorted(expected)}")
    if missing := case.emcy - outcome.emcy:
        wrong.append(f"no EMCY {_hex(missing)}")
    if more := outcome.emcy - case.emcy - case.may:
        wrong.append(f"EMCY {_hex(more)} not expected")
    wrong += [f"{name} did not rise" for name in case.counters if not outcome.counters.get(name)]
    if outcome.counters.get("missed") and not case.stall:
        wrong.append(f"{outcome.counters['missed']} cycles missed")
    if case.notice_ms is None:
        if outcome.noticed_ms is not None and (case.emcy or outcome.one or outcome.two):
            wrong.append("noticed")
    elif outcome.noticed_ms is None or outcome.noticed_ms > case.notice_ms:
        wrong.append(f"noticed after {outcome.noticed_ms} ms, expected at most {case.notice_ms} ms")
    if outcome.recovered_ms is None or outcome.recovered_ms > case.recover_ms:
        wrong.append(f"recovered after {outcome.recovered_ms} ms, expected at most {case.recover_ms} ms")
    return wrong


def _hex(found: frozenset[int]) -> str:
    return " ".join(f"{code:04X}h" for code in sorted(found))
