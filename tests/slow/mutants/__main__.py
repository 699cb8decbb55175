"""Command line: `make mutants`, or `python -m tests.slow.mutants`: the mutants that no test fails on."""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from tests.slow.mutants import DONE, ROOMS, SPAN, TESTS
from tests.slow.mutants.build import PLACE, TREE, make_copy
from tests.slow.mutants.table import load

EQUIVALENT = Path(__file__).with_name("equivalent.txt")
_EXAMPLES = """examples:
  python -m tests.slow.mutants                              the rooms of which every mutant is killed
  python -m tests.slow.mutants --room intake --function second
  python -m tests.slow.mutants --room joint --list

exit status: 0 every mutant is killed or listed as equivalent, 1 some survived, 2 usage"""


def equivalent() -> dict[str, str]:
    """Return key -> reason of the mutants that change nothing which a receiver or a log can show."""
    found, reason = {}, ""
    for line in EQUIVALENT.read_text(encoding="utf-8").splitlines():
        if line.startswith("# "):
            reason = line[2:]
        elif line:
            found[line] = reason
    return found


def run(mutants: dict[int, tuple[list[int], tuple[str, ...] | None]], tests: list[str]) -> dict[int, str]:
    """Run mutants in the copy; return the result of each."""
    memory, job, results = (PLACE / name for name in ("memory", "job.json", "results.json"))
    memory.write_bytes(struct.pack("<i", -1) + bytes(SPAN * len(ROOMS)))
    content = {"memory": str(memory), "reach": str(PLACE / "reach.json"), "tests": tests, "mutants": mutants}
    job.write_text(json.dumps(content), encoding="utf-8")
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    environment = os.environ | threads | {"PYTHONPATH": str(TREE / "src"), "JTQD_MUTANTS": str(memory)}
    command = [sys.executable, "-m", "tests.slow.mutants.run", str(job), str(results)]
    results.unlink(missing_ok=True)
    subprocess.run(command, cwd=TREE, env=environment, check=False)
    found = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
    return {int(number): result for number, result in found.items()}


def main() -> int:
    """Build, run and report."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.slow.mutants",
        description=(__doc__ or "").partition("\n")[0],
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--room", nargs="+", choices=list(ROOMS), default=list(DONE), help=f"default {' '.join(DONE)}")
    add("--function", default="", help="only the mutants of functions whose name contains this")
    add("--number", nargs="+", type=int, help="only these mutants")
    add("--tests", nargs="+", default=list(TESTS), help="directories and files of tests")
    add("--built", action="store_true", help="take the copy of the last run, with the tests of now")
    add("--list", action="store_true", help="list the mutants, and run none")
    options = parser.parse_args()
    began = time.monotonic()
    make_copy(options.room, built=options.built)
    everything = {number: each for room in options.room for number, each in load(room).items()}
    wanted = {
        number: each
        for number, each in everything.items()
        if (options.number is None or number in options.number) and options.function in each.function
    }
    if options.list:
        print(*(f"{number} {each.key}" for number, each in wanted.items()), sep="\n")
        return 0
    reasons = equivalent()
    judged = {number: each for number, each in wanted.items() if each.key not in reasons}
    print(f"{len(wanted)} mutants, {len(wanted) - len(judged)} of them equivalent: compiled after", end=" ")
    print(f"{time.monotonic() - began:.0f} s", flush=True)
    found = run(
        {
            number: (sorted(each.acts), None if each.function else each.names)
            for number, each in judged.items()
        },
        options.tests,
    )
    for number, each in judged.items():
        if found.get(number) != "killed":
            print(f"{found.get(number, 'not run').upper()} {number} {each}")
    keys = Counter(each.key for each in everything.values())
    files = {ROOMS[room] for room in options.room}
    gone = [key for key in reasons if key.partition(" | ")[0] in files and keys[key] != 1]
    for key in gone:
        print(f"EQUIVALENT, but of {keys[key]} mutants: its line was edited, judge it again: {key}")
    for room in options.room:
        counts = Counter(
            found.get(number, "not run") for number, each in judged.items() if each.file == ROOMS[room]
        )
        known = sum(each.file == ROOMS[room] and each.key in reasons for each in wanted.values())
        print(
            f"{room}: {', '.join(f'{count} {result}' for result, count in sorted(counts.items()))}, {known} equivalent"
        )
    print(f"{len(judged)} mutants in {time.monotonic() - began:.0f} s")
    return 0 if not gone and set(found.values()) <= {"killed"} and len(found) == len(judged) else 1


if __name__ == "__main__":
    sys.exit(main())
