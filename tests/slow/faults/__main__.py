"""Command line: `python -m tests.slow.faults [--case N ...] [--json | --markdown]`."""

from __future__ import annotations

import argparse
import json
import os
import sys

from jtqd.sim_can.bench_kernel import guest, vcan
from tests.slow.faults.cases_bus import CASES as BUS
from tests.slow.faults.cases_nodes import CASES as NODES
from tests.slow.faults.cases_pdos import CASES as PDOS
from tests.slow.faults.cases_values import CASES as VALUES
from tests.slow.faults.library import with_library
from tests.slow.faults.runner import Outcome, play
from tests.slow.faults.table import HEAD, as_json, cells, line, row

CASES = (*BUS, *PDOS, *NODES, *VALUES)
_EXAMPLES = """examples:
  python -m tests.slow.faults                 every case that is played on the bus, as a table
  python -m tests.slow.faults --case 16 12    only these (16: all its parts; 16a: this part)
  python -m tests.slow.faults --markdown      the table of docs/testing.md
  python -m tests.slow.faults --library       with nodes that share no code with jtqd or its bench

Where this machine has no SocketCAN, it runs in the bench kernel, with exact time. Exit status 1: a case does not hold.
"""


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.slow.faults",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--case", nargs="+", metavar="N", help="numbers of cases, with or without their letter"
    )
    parser.add_argument("--json", action="store_true", help="as JSON")
    parser.add_argument("--markdown", action="store_true", help="as the table of docs/testing.md")
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
    if not vcan.ensure(bus):
        command = [sys.executable, "-m", "tests.slow.faults", *(arguments or sys.argv[1:])]
        sinks = (sys.stdout.buffer, sys.stderr.buffer)
        return guest.run(command, time_travel=True, sinks=sinks).returncode

    def tell(outcome: Outcome) -> None:
        if options.markdown:
            print(row(cells(outcome)), flush=True)
        elif not options.json:
            print(line(outcome), flush=True)

    if options.markdown:
        print(row(HEAD), row("---" for _ in HEAD), sep="\n", flush=True)
    outcomes = play(chosen, bus, tell, library=options.library)
    if options.json:
        print(json.dumps([as_json(each) for each in outcomes], indent=1))
    return 1 if any(each.wrong for each in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
