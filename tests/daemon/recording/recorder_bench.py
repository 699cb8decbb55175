"""Cycle records with known content, and the recorder as a process, for the tests of recording."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

from mcap.reader import make_reader

from jtqd.daemon.recording import messages
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile
from jtqd.daemon.recording.messages import CycleMessages, EventLog, JointStateMessage, definitions
from jtqd.daemon.recording.recorder import RecorderRequest, Recording, Session
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import Ring
from tests.daemon import ring_records as rr
from tests.daemon.recording.cdr_decoder import Definition
from tests.paths import ROOT

START_NS = 1_700_000_000_000_000_000
SCHEMAS = messages.schemas_of(2, shadow=True)
DEFINITIONS = {name: Definition(name, text) for name, text in SCHEMAS.items()}
SYNC = struct.pack("<IB3x8s", 0x080, 1, b"\x01")
TPDO = struct.pack("<IB3x8s", 0x181, 8, bytes(range(8)))


def joint_values(index, number, status=2):
    """The block of a joint: every field another function of the cycle."""
    return (*(number * 1000.0 + index + field / 16 for field in range(16)), 0x1237, status, 0, 7)


def record_of(index, *, statuses=(2, 2), missed=0, start_ns=START_NS):
    """The record of one cycle at 1 kHz, with two frames."""
    record = bytearray(rr.RECORD_SIZE)
    header = (
        index,
        index * 1_000_000,
        start_ns + index * 1_000_000,
        0xF,
        50_000,
        100,
        missed,
        index % 240 + 1,
        2,
    )
    joints = [joint_values(index, number, statuses[number - 1]) for number in (1, 2)]
    cr.PAIR.head.pack_into(record, 0, *header, 0, 0, 0, 0, 0, 0, *joints[0], *joints[1])
    record[cr.PAIR.frames_offset : cr.PAIR.frames_offset + 32] = SYNC + TPDO
    struct.pack_into("<2q", record, cr.PAIR.stamps_offset, header[2] + 1, header[2] + 2)
    cr.TAIL.pack_into(record, cr.PAIR.tail_offset, index)
    return bytes(record)


put = rr.append


class RecorderProcess:
    """`python -m jtqd.daemon.recording.recorder` on a ring of its own."""

    def __init__(self, directory, *, slots=4096, output=None, before=None, prepare=None, **request):
        self.output = directory / "logs" if output is None else output
        self.ring = Ring(directory / "ring", slots, rr.RECORD_SIZE)
        if prepare is not None:
            prepare(self.ring)
        request = {"ring": str(directory / "ring"), "directory": str(self.output), "prefix": "test"} | request
        (directory / "request.json").write_text(json.dumps(request))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "jtqd.daemon.recording.recorder", str(directory / "request.json")],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=before,  # noqa: PLW1509 - the tests have no threads
        )

    def wait_for(self, condition, timeout_s=10.0):
        """Poll until `condition()` is true."""
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.01)

    def files(self, pattern="*"):
        return sorted(self.output.glob(pattern))

    def wait_until_ready(self):
        """Until it takes signals (it has its own handler of SIGTERM) or has ended."""
        handlers = Path(f"/proc/{self.process.pid}/status")

        def ready():
            if self.process.poll() is not None:
                return True
            caught = handlers.read_text().split("SigCgt:\t")[1].split()[0]
            return int(caught, 16) >> (signal.SIGTERM - 1) & 1

        self.wait_for(ready)

    def wait_for_file(self):
        """Until the recorder has opened its file, so that it reads the ring from its beginning."""
        self.wait_for(lambda: self.files("*.active"))

    def paced(self, first, count, rate_hz):
        """Put records at a steady pace."""
        start = time.monotonic()
        for n in range(count):
            rr.append(self.ring, record_of(first + n))
            if n % 10 == 9:
                time.sleep(max(0.0, start + (n + 1) / rate_hz - time.monotonic()))

    def end(self, number=signal.SIGTERM):
        """Signal, wait; (exit status, summary, stderr)."""
        self.process.send_signal(number)
        return self.result()

    def result(self, timeout_s=20):
        output, errors = self.process.communicate(timeout=timeout_s)
        assert "Traceback" not in errors, errors
        return self.process.returncode, json.loads(output) if output else None, errors

    def kill(self):
        if self.process.poll() is None:
            os.kill(self.process.pid, signal.SIGCONT)
            self.process.kill()
        self.process.communicate()


def messages_of(*paths):
    """{topic: [(log time, decoded message)]} of finished files, by the library's reader, CRCs checked."""
    found = {topic.name: [] for topic in messages.topics_of(2, shadow=True)}
    for path in paths:
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema.data.decode() == SCHEMAS[schema.name]
                found[channel.topic].append((message.log_time, DEFINITIONS[schema.name].decode(message.data)))
    return found


def cycles_of(*paths):
    """Numbers of the recorded cycles in the order of the files, by the library's reader, CRCs checked."""
    found = []
    for path in paths:
        with open(path, "rb") as file:
            messages = make_reader(file, validate_crcs=True).iter_messages(
                ["/can/frames"], log_time_order=False
            )
            found += [message.sequence for _, _, message in messages]
    return found


def metadata_of(path):
    """The metadata record `jtqd` of a file."""
    with open(path, "rb") as file:
        return {item.name: item.metadata for item in make_reader(file).iter_metadata()}["jtqd"]


def statuses_of(message):
    """{name: (level, message, {key: value})} of a decoded /diagnostics."""
    return {
        status["name"]: (
            status["level"],
            status["message"].rstrip(),
            {item["key"]: item["value"].rstrip() for item in status["values"]},
        )
        for status in message["status"]
    }


def one_file(path, chunk_ns=99_000_000):
    """(recording into one file, that file)."""
    schema_records, channels = definitions()
    file = McapFile(path, Head(schema_records, channels, []), {"run": "test", "part": "1"}, 1)
    builder = ChunkBuilder(schema_records, channels, CycleMessages(2).parts, 60)
    overview = JointStateMessage(("a", "b"), (1.0, 1.0))
    sink = SimpleNamespace(write=lambda span, at_ns: file.append(span))
    events = EventLog(builder.add)
    return Recording(builder, events, sink, overview, chunk_ns=chunk_ns, account=Account()), file


def session_on(directory, warn=lambda _: None, **request):
    """A `Session` in this process, with files in DIRECTORY/logs and no repair."""
    values = {"ring": directory / "ring", "directory": directory / "logs", "prefix": "test", "repair": False}
    values |= {key: tuple(value) if key == "attachments" else value for key, value in request.items()}
    return Session(RecorderRequest(**values), Account(), warn)
