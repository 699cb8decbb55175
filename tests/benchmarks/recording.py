"""`recording`: what one hour of two joints with their raw frames takes on the disk, and what the recorder takes of a core.

The daemon runs on the emulated bench, whose motion and noise make the data; its recorder is watched from outside. Then the
cycles that were in its ring go through the recorder's code and through the mcap library's Writer, in turns.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from jtqd.daemon.recording.messages import CycleMessages
from jtqd.daemon.recording.recorder import RecorderRequest, Session
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import RingReader
from tests.benchmarks.contender import ROOT
from tests.benchmarks.measure import mark, table
from tests.daemon import ring_records as rr
from tests.processes import of_module
from tests.shipped_bench import shipped_bench

SIZE_LIMIT_GB, CORE_LIMIT_PERCENT = 1.2, 3.0
_PARTS_PER_HOUR = 6
"""`rotate_s` is 600."""
_HOUR = 3_600_000
_SETTLE_S = 2.0
_LAPS = 5
_TIMES = struct.Struct("<Qqq")


def run(directory: Path, *, seconds: float = 30.0, rounds: int = 3) -> dict[str, Any]:
    """Measure for `seconds` of the daemon. Raises RuntimeError where it does not come up."""
    # The files go where files go, not to memory: what the disk takes of the processor counts.
    with tempfile.TemporaryDirectory(prefix="jtqd-bench-") as disk:
        daemon, records = _daemon(directory, Path(disk), seconds)
        ours, library = [], []
        for number in range(rounds):
            ours.append(_ours(records, Path(disk) / f"ours{number}"))
            library.append(_library(records, Path(disk) / f"library{number}.mcap"))
    per_cycle = len(records) * _LAPS
    return daemon | {
        "ours_us": median(ours) * 1e6 / per_cycle,
        "library_us": median(library) * 1e6 / per_cycle,
        "ratio": median(library) / median(ours),
    }


def _daemon(directory: Path, disk: Path, seconds: float) -> tuple[dict[str, Any], list[bytes]]:
    environment = {key: value for key, value in os.environ.items() if key != "RUNTIME_DIRECTORY"}
    environment |= {"XDG_RUNTIME_DIR": str(directory), "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    command = [sys.executable, "-P", "-m", "jtqd.daemon.jtqd", "--bus", "sim", "--json"]
    bench = shipped_bench()
    bench["estimator"]["shadow"] = []
    (directory / "bench.yaml").write_text(yaml.safe_dump(bench), encoding="utf-8")
    command += ["--config", str(directory / "bench.yaml")]
    command += ["--duration", f"{seconds + _SETTLE_S + 1.0:g}", "--record", str(disk / "logs")]
    daemon = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        pid = _recorder(daemon)
        time.sleep(_SETTLE_S)
        begin, cpu = time.monotonic(), _cpu_s(pid)
        time.sleep(seconds)
        share = (_cpu_s(pid) - cpu) / (time.monotonic() - begin)
        (ring,) = directory.glob("*/ring")
        records = RingReader(ring, rr.RECORD_SIZE).read(4000).records
        output, _ = daemon.communicate(timeout=60.0)
    finally:
        daemon.kill()
        daemon.wait()
    recording = json.loads(output)["recording"]
    chunks = head = 0
    for path in recording["paths"]:
        with open(path, "rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        part = sum(each.chunk_length + each.message_index_length for each in summary.chunk_indexes)
        chunks += part
        head = max(head, Path(path).stat().st_size - part)
    per_cycle = chunks / recording["written"]
    return {
        "cycles": recording["written"],
        "lost": recording["lost"],
        "bytes_per_cycle": per_cycle,
        "head_bytes": head,
        "gb_per_hour": (per_cycle * _HOUR + head * _PARTS_PER_HOUR) / 1e9,
        "core_percent": 100.0 * share,
    }, records


def _recorder(daemon: subprocess.Popen[str]) -> int:
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline and daemon.poll() is None:
        if (pid := of_module(daemon.pid, "jtqd.daemon.recording.recorder")) is not None:
            return pid
        time.sleep(0.05)
    raise RuntimeError("the daemon started no recorder")


def _cpu_s(pid: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _laps(records: list[bytes]) -> list[bytes]:
    """The records several times over, with times that go on."""
    first, last = _TIMES.unpack_from(records[0]), _TIMES.unpack_from(records[-1])
    spans = [
        after - before + step for before, after, step in zip(first, last, (1, 10**6, 10**6), strict=True)
    ]
    result = []
    for lap in range(_LAPS):
        for record in records:
            times = (
                value + lap * span for value, span in zip(_TIMES.unpack_from(record), spans, strict=True)
            )
            result.append(_TIMES.pack(*times) + record[_TIMES.size :])
    return result


def _ours(records: list[bytes], directory: Path) -> float:
    """Processor time of recording them [s]."""
    request = RecorderRequest(ring=directory, directory=directory, repair=False)
    session = Session(request, Account(), lambda _: None)
    laps = _laps(records)
    begin = time.process_time()
    for record in laps:
        session.recording.add(record)
    session.finish()
    return time.process_time() - begin


def _library(records: list[bytes], path: Path) -> float:
    """The same messages of the cycles by the library, chunks of the same length [s]."""
    laps, messages = _laps(records), CycleMessages(2)
    with open(path, "wb") as file:
        writer = Writer(
            file, chunk_size=500 * len(_block(messages, laps[0])), compression=CompressionType.ZSTD
        )
        writer.start("ros2")
        channels = {}
        for topic in (messages.JOINTS[0], messages.JOINTS[1], messages.CAN_FRAMES):
            text = messages.SCHEMAS[topic.schema].encode()
            schema = writer.register_schema(topic.schema, "ros2msg", text)
            channels[topic.number] = writer.register_channel(topic.name, "cdr", schema)
        begin = time.process_time()
        for record in laps:
            header = cr.header_of(record)
            block, stamp = _block(messages, record), header.sync_realtime_ns
            for number, payload in messages.payloads(block):
                writer.add_message(channels[number], stamp, payload, stamp, header.cycle)
        writer.finish()
        return time.process_time() - begin


def _block(messages: CycleMessages, record: bytes) -> bytes:
    header = cr.header_of(record)
    return messages.block(
        record,
        header.cycle,
        header.sync_realtime_ns,
        flags=header.flags,
        sync_counter=header.sync_counter,
        frames=header.frame_count,
    )


def text(result: dict[str, Any]) -> str:
    size, share = result["gb_per_hour"], result["core_percent"]
    library = "... by mcap's Writer, without overview, events, fdatasync"
    rows = [
        ["one hour, two joints with raw frames", f"{size:.3f} GB", mark(size, SIZE_LIMIT_GB)],
        ["recorder process", f"{share:.2f} % of a core", mark(share, CORE_LIMIT_PERCENT)],
        ["bytes of a cycle", f"{result['bytes_per_cycle']:.1f}", ""],
        ["head and summary of a part", f"{result['head_bytes'] / 1e3:.0f} kB", ""],
        ["cycle into the file: ours", f"{result['ours_us']:.2f} us", ""],
        [library, f"{result['library_us']:.2f} us", f"{result['ratio']:.1f} times ours"],
    ]
    title = f"recording: {result['cycles']} cycles of jtqd on the emulated bench, {result['lost']} lost"
    return f"{title}\n{table(['', 'found', 'target'], rows)}"
