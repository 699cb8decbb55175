"""Damaged files into their readers: each case in a process of its own, with limits of time and memory."""

from __future__ import annotations

import os
import random
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.slow.fuzz.targets import Target, place, targets

LIMIT_S = 20.0
"""A case that takes longer hangs; the slowest good file takes below a second."""
MEMORY = 1_500_000_000
"""Bytes of address space that a case may take on top of what the process has."""
LONGEST_LINE = 2_000


@dataclass
class FileReport:
    """Counts of one target: accepted, refused (one clear line), and what was wrong."""

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


def fuzz_files(seed: int, count: int, only: str = "") -> list[FileReport]:
    """`count` cases of each target (of those whose name contains `only`)."""
    reports = []
    with tempfile.TemporaryDirectory(prefix="jtqfuzz") as name:
        directory = Path(name)
        for target in targets(directory):
            if only in target.name:
                source = random.Random(f"{seed} {target.name}")
                print(f"... {target.name}", file=sys.stderr, flush=True)
                reports.append(_one(target, directory, source, count))
    return reports


def _one(target: Target, directory: Path, source: random.Random, count: int) -> FileReport:
    report = FileReport(target.name)
    good = target.original.read_bytes()
    outcome, _ = _case(target, place(target, directory, good), directory)
    if outcome != "accepted" and target.name != "log, replay":  # that one has no provenance: refused
        report.counts["wrong"] += 1
        report.wrong.append(f"the undamaged file: {outcome}")
    for number in range(count):
        said, data = target.damage(source, good)
        outcome, seconds = _case(target, place(target, directory, data), directory)
        report.slowest_s = max(report.slowest_s, seconds)
        kind = outcome if outcome in ("accepted", "refused") else "wrong"
        report.counts[kind] += 1
        if kind == "wrong":
            report.wrong.append(f"case {number} ({said}): {outcome}")
    return report


def _case(target: Target, path: Path, directory: Path) -> tuple[str, float]:
    """(accepted, refused, or what was wrong; seconds)."""
    begun = time.perf_counter()
    sys.stdout.flush()
    reading, writing = os.pipe()
    errors = directory / "stderr"
    child = os.fork()
    if not child:
        os.close(reading)
        _child(target, path, errors, writing)
    os.close(writing)
    answer = b""
    if select.select([reading], [], [], LIMIT_S)[0]:
        answer = os.read(reading, 100_000)
    else:
        os.kill(child, signal.SIGKILL)
    os.close(reading)
    _, status = os.waitpid(child, 0)
    seconds = time.perf_counter() - begun
    if answer:
        return answer.decode(errors="replace"), seconds
    ended = (
        f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit status {os.WEXITSTATUS(status)}"
    )
    return ("hangs" if seconds >= LIMIT_S else f"ended by {ended}"), seconds


def _child(target: Target, path: Path, errors: Path, writing: int) -> None:
    """Read the file, say what happened, and be gone; never returns."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    file = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 2)
    have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (have + MEMORY, have + MEMORY))
    try:
        try:
            target.read(path)
            outcome = _said(errors)
        except target.errors as error:
            line = str(error)
            clear = line.strip() and "\n" not in line and len(line) < LONGEST_LINE
            outcome = "refused" if clear else f"not one clear line: {line[:200]!r}"
        except BaseException as error:
            where = "".join(traceback.format_tb(error.__traceback__)[-2:]).replace("\n", " | ")
            outcome = f"{type(error).__name__}: {str(error)[:200]} {where}"
        os.write(writing, outcome.encode(errors="replace"))
    finally:
        os._exit(0)


def _said(errors: Path) -> str:
    """What a command has said on standard error: nothing, or lines that all are its own."""
    sys.stderr.flush()
    text = errors.read_text(errors="replace")
    if "Traceback" in text:
        return f"traceback: {text[-300:]!r}"
    lines = text.splitlines()
    strange = [line for line in lines if not line.startswith("jtq ") or len(line) >= LONGEST_LINE]
    if strange:
        return f"strange line: {strange[0][:200]!r}"
    return "refused" if lines else "accepted"
