"""Cycle records with known content, and the recorder as a process, for the tests of recording."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

from cdr_decoder import Definition
from mcap.reader import make_reader

from daemon import cycle_record as cr
from daemon import mcap_schemas as schemas
from daemon.ring import Ring

ROOT = Path(__file__).resolve().parent.parent
START_NS = 1_700_000_000_000_000_000
DEFINITIONS = {name: Definition(name, text) for name, text in schemas.SCHEMAS.items()}
SYNC = struct.pack("<IB3x8s", 0x080, 1, b"\x01")
TPDO = struct.pack("<IB3x8s", 0x181, 8, bytes(range(8)))


def joint_values(index, number, status=2):
    """The block of a joint: every field another function of the cycle."""
    return (*(number * 1000.0 + index + field / 16 for field in range(12)), 0x1237, status, 0, 7)


def record_of(index, *, statuses=(2, 2), missed=0, start_ns=START_NS):
    """The record of one cycle at 1 kHz, with two frames."""
    record = bytearray(cr.RECORD_SIZE)
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
    cr.HEAD.pack_into(record, 0, *header, 0, 0, 0, 0, 0, 0, *joints[0], *joints[1])
    record[cr.FRAMES_OFFSET : cr.FRAMES_OFFSET + 32] = SYNC + TPDO
    struct.pack_into("<2q", record, cr.STAMPS_OFFSET, header[2] + 1, header[2] + 2)
    cr.TAIL.pack_into(record, cr.TAIL_OFFSET, index)
    return bytes(record)


def put(ring, record):
    """What the loop does with a record."""
    ring.slot()[:] = record
    ring.commit()


class RecorderProcess:
    """`python -m daemon.recorder` on a ring of its own."""

    def __init__(self, directory, *, slots=4096, output=None, before=None, prepare=None, **request):
        self.output = directory / "logs" if output is None else output
        self.ring = Ring(directory / "ring", slots, cr.RECORD_SIZE)
        if prepare is not None:
            prepare(self.ring)
        request = {"ring": str(directory / "ring"), "directory": str(self.output), "prefix": "test"} | request
        (directory / "request.json").write_text(json.dumps(request))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "daemon.recorder", str(directory / "request.json")],
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
            put(self.ring, record_of(first + n))
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


def messages_of(path):
    """{topic: [(log time, decoded message)]} of a finished file, by the library's reader, CRCs checked."""
    found = {topic.name: [] for topic in schemas.TOPICS}
    with open(path, "rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema.data.decode() == schemas.SCHEMAS[schema.name]
            found[channel.topic].append((message.log_time, DEFINITIONS[schema.name].decode(message.data)))
    return found
