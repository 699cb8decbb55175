"""What a crash costs: every case with the real recorder, and what of the cycles is in the files afterwards.

`python -m tests.daemon.recording.crash_table` prints the table of docs/logs.md.
Cycles come at 1 kHz of real time. Each case ends with
the next start of a recorder in the same directory, which repairs what was left; then the mcap library reads every file.
Cases that mount a file system need root.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.recording.run_files import part_files
from tests.daemon.recording.recorder_bench import START_NS, RecorderProcess, cycles_of, put, record_of
from tests.paths import ROOT

_NEXT = 1_000_000
"""Number of the first cycle after the next start."""


class Row(NamedTuple):
    """One case.

    Attributes:
        case: what happened.
        cycles: that the loop ran through.
        lost: of those, in no file afterwards.
        lasted: of the lost ones, those for as long as the cause lasted (a full disk), or that somebody removed.
        files: that the mcap library opens afterwards, all of them with CRCs.
        said: lines of the recorder, shortened.
    """

    case: str
    cycles: int
    lost: int
    lasted: int
    files: int
    said: list[str]

    @property
    def lost_s(self) -> float:
        """Lost by the crash itself [s]."""
        return (self.lost - self.lasted) / 1000.0


class Bench:
    """A directory for logs, and recorders one after the other that write to it."""

    def __init__(self, directory: Path, logs: Path | None = None) -> None:
        self._directory = directory
        self.logs = directory / "logs" if logs is None else logs
        self.cycles = 0
        self.said: list[str] = []
        self.recorder: Any = None

    def start(self, **request: Any) -> None:
        """A recorder with a ring of its own."""
        place = Path(tempfile.mkdtemp(dir=self._directory))
        self.recorder = RecorderProcess(place, output=self.logs, **request)
        self.recorder.wait_until_ready()

    def run(self, seconds: float, **record: Any) -> None:
        """The loop runs at 1 kHz."""
        begin, count = time.monotonic(), round(seconds * 1000)
        for n in range(count):
            put(self.recorder.ring, record_of(self.cycles, **record))
            self.cycles += 1
            if n % 10 == 9:
                time.sleep(max(0.0, begin + (n + 1) / 1000 - time.monotonic()))

    def run_to_a_write(self) -> Path:
        """The loop runs until a chunk has just been written; the file."""
        path = self.active()
        size = path.stat().st_size
        deadline = time.monotonic() + 5.0
        while path.stat().st_size == size:
            assert time.monotonic() < deadline
            self.run(0.01)
        return path

    def active(self) -> Path:
        """The file that is being written."""
        self.recorder.wait_for(lambda: list(self.logs.glob("*.active")))
        (path,) = self.logs.glob("*.active")
        return Path(path)

    def kill(self) -> None:
        """kill -9."""
        self.recorder.process.send_signal(signal.SIGKILL)
        self._hear(self.recorder.process.communicate()[1])

    def end(self) -> None:
        """In order."""
        self._hear(self.recorder.end()[2])

    def _hear(self, errors: str) -> None:
        self.said += [line.removeprefix("recorder: ") for line in errors.splitlines()]

    def result(self, case: str, lasted: int = 0) -> Row:
        """The next start, and what is in the files then."""
        kept, self.cycles = self.cycles, _NEXT
        self.start()
        self.run(0.6)
        self.recorder.wait_for(lambda: len(list(self.logs.glob("*.active"))) <= 1)
        self.end()
        files = part_files(self.logs, "test")
        assert not any(file.active for file in files)
        found = [n for file in files for n in cycles_of(file.path) if n < _NEXT]
        assert len(found) == len(set(found)), "a cycle is there twice"
        assert all(n < kept for n in found)
        return Row(case, kept, kept - len(found), lasted, len(files), self.said)


@contextmanager
def tmpfs(directory: Path, options: str) -> Iterator[Path]:
    """A file system of its own."""
    place = directory / "mount"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def killed_recorder(directory: Path) -> Row:
    """The supervisor starts another one, which goes on in the ring."""
    bench = Bench(directory)
    bench.start(run="20260102T030405Z", progress=str(directory / "recorded"), repair=False)
    bench.run(1.3)
    bench.kill()
    first = bench.recorder
    bench.run(0.2)
    request = directory / "again.json"
    request.write_text(Path(first.process.args[-1]).read_text())
    first.process = subprocess.Popen(
        [*first.process.args[:-1], str(request)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    first.wait_until_ready()
    bench.run(1.0)
    bench.end()
    return bench.result("kill -9 of the recorder")


def killed_everything(directory: Path) -> Row:
    """Nobody goes on; the ring is gone with the machine."""
    bench = Bench(directory)
    bench.start()
    bench.run(2.2)
    bench.kill()
    return bench.result("kill -9 of everything")


def _cut(directory: Path, case: str, harm: Callable[[Path, int], None]) -> Row:
    """Power goes while a chunk is on its way to the disk; `harm` gets the file and where that chunk begins."""
    bench = Bench(directory)
    bench.start()
    bench.run(1.2)
    path = bench.active()
    before = path.stat().st_size
    path = bench.run_to_a_write()
    bench.kill()
    harm(path, before)
    return bench.result(case)


def torn_chunk(directory: Path) -> Row:
    """Half of the last chunk arrived."""

    def harm(path: Path, start: int) -> None:
        os.truncate(path, (start + path.stat().st_size) // 2)

    return _cut(directory, "power cut: last chunk torn", harm)


def zeros_at_the_end(directory: Path) -> Row:
    """The file has its length, but what was not written reads as zeros, beyond the last chunk too."""

    def harm(path: Path, start: int) -> None:
        size = path.stat().st_size
        os.truncate(path, (start + size) // 2)
        os.truncate(path, size + 4096)

    return _cut(directory, "power cut: zeros at the end", harm)


def full_disk(directory: Path) -> Row:
    """Somebody fills the file system for 1.5 s, below the reserve; then there is room again."""
    with tmpfs(directory, "size=12m") as place:
        bench = Bench(directory, place / "logs")
        bench.start(reserve_mb=4.0)
        bench.run(1.2)
        filler = place / "filler"
        filler.write_bytes(bytes(9_000_000))
        begin = bench.cycles
        bench.run(1.5)
        filler.unlink()
        lasted = bench.cycles - begin
        bench.run(2.5)
        bench.end()
        row = bench.result("disk full for 1.5 s (reserve of 4 MB)")
    return row._replace(lasted=min(row.lost, lasted))


def full_to_the_last_byte(directory: Path) -> Row:
    """The same without a reserve, and without a block left: the summary has its room all the same."""
    with tmpfs(directory, "size=4m") as place:
        bench = Bench(directory, place / "logs")
        bench.start()
        bench.run(1.2)
        filler = place / "filler"
        with open(filler, "wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                pass
        begin = bench.cycles
        bench.run(2.5)
        finished = [each for each in part_files(bench.logs, "test") if not each.active]
        assert finished, "the part was not ended on the full disk"
        filler.unlink()
        lasted = bench.cycles - begin
        bench.run(2.5)
        bench.end()
        row = bench.result("disk full to the last byte for 2.5 s")
    return row._replace(lasted=min(row.lost, lasted))


def read_only(directory: Path) -> Row:
    """The directory cannot be written at the start; 1 s later it can."""
    with tmpfs(directory, "size=12m,ro") as place:
        bench = Bench(directory, place / "logs")
        bench.start()
        begin = bench.cycles
        bench.run(1.0)
        subprocess.run(["mount", "-o", "remount,rw", str(place)], check=True)
        lasted = bench.cycles - begin
        bench.run(2.5)
        bench.end()
        row = bench.result("read-only directory for 1 s")
    return row._replace(lasted=min(row.lost, lasted))


def removed_directory(directory: Path) -> Row:
    """What was in it is gone with it."""
    return _removed(directory, "directory removed", lambda bench: shutil.rmtree(bench.logs))


def removed_file(directory: Path) -> Row:
    """Likewise."""
    return _removed(directory, "file removed", lambda bench: bench.active().unlink())


def _removed(directory: Path, case: str, harm: Callable[[Bench], None]) -> Row:
    bench = Bench(directory)
    bench.start()
    bench.run(1.2)
    harm(bench)
    bench.run(1.2)
    bench.end()
    told = re.search(r"cycles lost with it: (\d+)", " ".join(bench.said))
    assert told, bench.said
    return bench.result(case, int(told[1]))


def clock_back(directory: Path) -> Row:
    """CLOCK_REALTIME steps back by an hour."""
    return _clock(directory, -3600, "clock set back by 1 h")


def clock_forward(directory: Path) -> Row:
    """... and forward."""
    return _clock(directory, 3600, "clock set forward by 1 h")


def _clock(directory: Path, step_s: int, case: str) -> Row:
    bench = Bench(directory)
    bench.start(rotate_s=1.0)
    bench.run(1.2)
    bench.run(1.2, start_ns=START_NS + step_s * 10**9)
    bench.end()
    return bench.result(case)


CASES: dict[str, Callable[[Path], Row]] = {
    case.__name__: case
    for case in (
        killed_recorder,
        killed_everything,
        torn_chunk,
        zeros_at_the_end,
        full_disk,
        full_to_the_last_byte,
        read_only,
        removed_directory,
        removed_file,
        clock_back,
        clock_forward,
    )
}
NEED_ROOT = {"full_disk", "full_to_the_last_byte", "read_only"}


def main() -> int:
    """Print the table."""
    print(f"{'case':<42}{'cycles':>7}{'lost':>6}{'cause':>9}{'by the crash':>15}{'files':>7}")
    for name, case in CASES.items():
        if name in NEED_ROOT and os.geteuid():
            print(f"{name:<42} not run: needs root to mount a file system")
            continue
        with tempfile.TemporaryDirectory(prefix="jtqd-crash-") as directory:
            row = case(Path(directory))
        lost = f"{row.lost:>6}{row.lasted:>9}{row.lost_s:>13.2f} s"
        print(f"{row.case:<42}{row.cycles:>7}{lost}{row.files:>7}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
