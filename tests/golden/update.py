"""Renew the stored outputs of the golden logs on purpose: `python -m tests.golden.update -m "why they change"`.

Says first what changes. `--logs` records the logs themselves anew, in the bench kernel (some minutes).
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from jtqd.sim_can.bench_kernel import guest
from tests.golden.reference import CASES, HERE, difference, replayed, store, stored
from tests.golden.scene import SCENES

CHANGES = HERE / "changes.md"


def record(names: list[str]) -> None:
    """Record the scenes into this folder."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "tests.golden.scene", out, *names]
        result = guest.run(
            command,
            time_travel=True,
            out_dir=out,
            timeout_s=1800,
            sinks=(sys.stdout.buffer, sys.stderr.buffer),
        )
        if result.returncode:
            sys.exit(f"golden: the scenes ended with exit status {result.returncode}")
        for name in names:
            shutil.copy(Path(out) / f"{name}.mcap", HERE)


def main() -> None:
    """Compare, say it, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SCENES)} (default: all)")
    parser.add_argument("-m", "--message", required=True, help="why: one line, kept in changes.md")
    parser.add_argument("--logs", action="store_true", help="record the logs anew, too")
    options = parser.parse_args()
    unknown = set(options.names) - set(SCENES)
    if unknown:
        parser.error(f"found {', '.join(sorted(unknown))}, expected {', '.join(SCENES)}")
    names = options.names or list(SCENES)
    if options.logs:
        record(names)
    said = []
    for name, case in CASES.items():
        if case.log not in names:
            continue
        now, _ = replayed(case)
        lines = ["recorded anew"] if options.logs else []
        if not options.logs:
            lines = difference(stored(name), now) if (HERE / f"{name}.csv").exists() else ["new"]
        for line in lines:
            print(f"{name}: {line}")
        if lines:
            store(name, now)
            said.append(name)
    if not said:
        print("golden: nothing differs, nothing stored")
        return
    with CHANGES.open("a") as file:
        file.write(f"- {', '.join(said)}: {options.message}\n")


if __name__ == "__main__":
    main()
