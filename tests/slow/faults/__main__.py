"""Command line: `python -m tests.slow.faults [--case N ...] [--json]`."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

from jtqd.sim_can.bench_kernel import build, guest
from tests.slow.faults.cases import CASES, with_library
from tests.slow.faults.runner import Outcome, play

_EXAMPLES = """examples:
  python -m tests.slow.faults                 every case that is played on the bus, as a table
  python -m tests.slow.faults --case 16 12    only these (16: all its parts; 16a: this part)
  python -m tests.slow.faults --library       with nodes that share no code with jtqd or its bench

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
        prog="python -m tests.slow.faults",
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
        command = [sys.executable, "-m", "tests.slow.faults", *(arguments or sys.argv[1:])]
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
