"""Command line: `python -m tests.slow.faults.on_bus [--case N ...] [--json]`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jtqd.sim_can.bench_kernel import build, guest
from tests.slow.faults.cases import CASES, STARTING, Case, with_library
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


_EXAMPLES = """examples:
  python -m tests.slow.faults.on_bus                 every case that is played on the bus, as a table
  python -m tests.slow.faults.on_bus --case 16 12    only these (16: all its parts; 16a: this part)
  python -m tests.slow.faults.on_bus --library       with nodes that share no code with jtqd or its bench

Where this machine has no SocketCAN, it runs in the bench kernel, with exact time. Exit status 1: a case does not hold.
"""


def as_json(outcome: Outcome) -> dict[str, Any]:
    return {
        "case": outcome.case.key,
        "title": outcome.case.title,
        "injected": outcome.case.injected,
        "proof": outcome.proof,
        "status": [sorted(outcome.one), sorted(outcome.two)],
        "emcy": [f"{code:04X}h" for code in sorted(outcome.emcy)],
        "counters": outcome.counters,
        "noticed_ms": outcome.noticed_ms,
        "recovered_ms": outcome.recovered_ms,
        "quiet_ms": outcome.quiet_ms,
        "ok": not outcome.wrong,
        "wrong": list(outcome.wrong),
        "note": outcome.case.note,
    }


def line(outcome: Outcome) -> str:
    """One line for a terminal, and one for each thing that is wrong."""
    case, seen = outcome.case, as_json(outcome)
    status = " / ".join(",".join(map(str, each)) or "-" for each in seen["status"]).replace("- / -", "-")
    expected = {name: n for name, n in outcome.counters.items() if name in case.counters}
    counters = ", ".join(f"{name} {n}" for name, n in (expected or outcome.counters).items()) or "-"
    recovered = _ms(outcome.recovered_ms) if outcome.one or outcome.two else "-"
    text = (
        f"{case.key:>4} {case.title:46.46} {status:12} {' '.join(seen['emcy']) or '-':22} "
        f"{_ms(outcome.noticed_ms):>9} {recovered:>9} {'OK' if seen['ok'] else 'NOT':3} {counters}"
    )
    return "\n".join([text, *(f"       {each}" for each in (outcome.proof, *outcome.wrong))])


def _ms(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.1f} ms" if value < 100.0 else f"{value / 1000.0:.2f} s"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.slow.faults.on_bus",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--case", nargs="+", metavar="N", help="numbers of cases, with or without their letter"
    )
    parser.add_argument("--json", action="store_true", help="as JSON")
    parser.add_argument(
        "--library",
        action="store_true",
        help="with nodes of the canopen library instead of the emulated bench",
    )
    options = parser.parse_args(arguments)
    wanted = options.case
    played = with_library(CASES) if options.library else CASES
    chosen = [each for each in played if not wanted or each.key in wanted or str(each.number) in wanted]
    unknown = set(wanted or ()) - {each.key for each in CASES} - {str(each.number) for each in CASES}
    if unknown:
        parser.error(
            f"no case {', '.join(sorted(unknown))} is played on the bus (docs/testing.md says where it is shown)"
        )
    bus = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
    if not build.ensure_vcan(bus):
        command = [sys.executable, "-m", "tests.slow.faults.on_bus", *(arguments or sys.argv[1:])]
        sinks = (sys.stdout.buffer, sys.stderr.buffer)
        return guest.run(command, time_travel=True, sinks=sinks).returncode

    def tell(outcome: Outcome) -> None:
        if not options.json:
            print(line(outcome), flush=True)

    outcomes = play(chosen, bus, tell, library=options.library)
    if options.json:
        print(json.dumps([as_json(each) for each in outcomes], indent=1))
    return 1 if any(each.wrong for each in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
