"""Run mutants inside of one pytest: every test once without one, then each mutant with the tests that reach it.

python -m tests.slow.mutants.run JOB RESULTS, in the copy of the tree: pytest collects the tests, so that all modules are
loaded. A run is a fork in which the shared memory has the number of the mutant, and executes tests until one fails. A mutant
of a statement of the module acts when the module is loaded: it gets a pytest of its own.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

MARKERS = "not (campaign or socketcan or boots or native)"
PYTEST = ("-p", "no:cacheprovider", "-m", MARKERS)
PATIENCE_S = 20.0
"""Beyond ten times the time of the tests: a mutant that does not end is killed."""
FRESH = 150
"""Tests of a mutant that needs a pytest of its own, the shortest that reach where it acts."""
NONE = -1


class Campaign:
    """Plugin whose loop runs the job.

    job: `memory` and `reach`, files; `mutants`: number -> numbers where it acts, and names of the module that it sets.
    """

    def __init__(self, job: dict[str, object], result: Path) -> None:
        self.job, self.result = job, result
        with open(str(job["memory"]), "r+b") as file:
            self.memory = mmap.mmap(file.fileno(), 0)
        self.failed = ""
        self.kills: Counter[str] = Counter()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.items = {item.nodeid: item for item in session.items}
        before = self.taken()  # by the imports
        path = Path(str(self.job["reach"]))
        self.forked(NONE, lambda: self.reach(path), 1e6)
        found = json.loads(path.read_text())
        self.reached = {
            name: (found[name][0], set(found[name][1])) for name in self.items if found[name][1] is not None
        }
        self.say(f"{len(self.reached)} of {len(self.items)} tests pass, imports reach {len(before)}")
        mutants = self.job["mutants"]
        assert isinstance(mutants, dict)
        results = {}
        for number, (places, names) in mutants.items():
            results[number] = self.judge(int(number), set(places), names)
            if results[number] != "killed":
                self.say(f"{results[number]}: {number}")
            self.result.write_text(json.dumps(results))
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.outcome != "passed":
            self.failed = report.nodeid

    @staticmethod
    def say(text: str) -> None:
        print(text, file=sys.__stdout__, flush=True)

    def choose(self, number: int) -> None:
        self.memory[:4] = struct.pack("<i", number)

    def taken(self) -> list[int]:
        """Return the numbers reached since the last call."""
        content = self.memory[4:]
        self.memory[4:] = bytes(len(content))
        return [number for number, hit in enumerate(content) if hit]

    def execute(self, name: str) -> bool:
        """Run one test; return whether it passed."""
        item, self.failed = self.items[name], ""
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        return not self.failed

    def reach(self, path: Path) -> int:
        """Note what each test reaches that passes without a mutant; what is known of an unchanged file stays."""
        found = json.loads(path.read_text()) if path.exists() else {}
        for name, item in self.items.items():
            digest = hashlib.sha256(item.path.read_bytes()).hexdigest()
            if name in found and found[name][2] == digest:
                continue
            self.taken()
            began = time.monotonic()
            passed, numbers = self.execute(name), self.taken()
            found[name] = (time.monotonic() - began, numbers if passed else None, digest)
        path.write_text(json.dumps(found))
        return 0

    def judge(self, number: int, places: set[int], names: list[str] | None) -> str:
        """Return "killed", "survived" or "not reached"; names: of the module, None for a mutant within a function."""
        mention = re.compile(rf"\b({'|'.join(names)})\b") if names else None
        tests = [
            name
            for name, (_, reached) in self.reached.items()
            if reached & places or (mention and mention.search(self.items[name].path.read_text()))
        ]
        if names is not None and not tests:  # it may only be seen while the module is loaded
            tests = list(self.reached)
        tests.sort(key=lambda name: (-self.kills[name], self.reached[name][0]))
        if not tests:
            return "not reached"
        seconds = sum(self.reached[name][0] for name in tests)
        run = (
            (lambda: self.fresh(tests[:FRESH])) if names is not None else (lambda: self.first_failing(tests))
        )
        code = self.forked(number, run, PATIENCE_S + 10.0 * seconds)
        if 0 < code <= len(tests):
            self.kills[tests[code - 1]] += 1
        return "killed" if code else "survived"

    def first_failing(self, tests: list[str]) -> int:
        """Return the place of the first test that fails, counted from 1 and at most 250; 0 for none."""
        return next((min(n, 250) for n, name in enumerate(tests, 1) if not self.execute(name)), 0)

    @staticmethod
    def fresh(tests: list[str]) -> int:
        """Run tests in a pytest of their own; return 251 where one fails or they cannot even be loaded."""
        command = [sys.executable, "-m", "pytest", "-x", *PYTEST, *tests]
        return 251 if subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode else 0

    def forked(self, number: int, run: Callable[[], int], patience_s: float) -> int:
        """Return the exit status of `run` in a fork with a mutant; 255 for one that crashes or does not end."""
        self.choose(number)
        child = os.fork()
        if not child:
            os.setsid()
            silence = os.open(os.devnull, os.O_RDWR)
            for descriptor in (0, 1, 2):
                os.dup2(silence, descriptor)
            code = 252
            try:
                code = run()
            finally:
                os._exit(code)
        deadline = time.monotonic() + patience_s
        status = None
        while status is None and time.monotonic() < deadline:
            pid, ended = os.waitpid(child, os.WNOHANG)
            status = ended if pid else time.sleep(0.005)
        try:
            os.killpg(child, signal.SIGKILL)  # what it has left behind as well
        except ProcessLookupError:
            pass
        if status is None:
            os.waitpid(child, 0)
        self.choose(NONE)
        return 255 if status is None else os.waitstatus_to_exitcode(status) % 256


def main() -> int:
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    options = (*PYTEST, "-p", "no:terminal", "-o", "addopts=--strict-markers", *job["tests"])
    return int(pytest.main([*options], plugins=[Campaign(job, Path(sys.argv[2]))]))


if __name__ == "__main__":
    sys.exit(main())
