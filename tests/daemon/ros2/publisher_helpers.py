"""The publisher's process on a ring of its own, and a DDS reader in another process."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from tests.paths import ROOT

READER = Path(__file__).with_name("dds_reader.py")


def own_domain():
    """Two test runs at a time do not hear each other."""
    return 100 + os.getpid() % 100


def request_of(directory, **changes):
    content = {
        "ring": str(directory / "ring"),
        "snapshot": str(directory / "snapshot"),
        "domain_id": own_domain(),
        "interface": "lo",
        "rate_hz": 100.0,
        "joint_names": ["shoulder", "elbow"],
        "bus": "vcan7",
        "nodes": [[1, "drive 1"]],
        "gear_ratios": [100.0, 160.0],
        "shadow": False,
    }
    return content | changes


class Process:
    """A Python process whose standard output is lines of JSON; for a `with` statement."""

    def __init__(self, *arguments, environment=None):
        self.process = subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, **(environment or {})},
        )
        os.set_blocking(self.process.stdout.fileno(), False)
        self._pending, self.lines, self.errors = b"", [], ""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        _, errors = self.process.communicate(timeout=10)
        self.errors = errors.decode()
        assert "Traceback" not in self.errors, self.errors

    def read(self):
        self._pending += self.process.stdout.read() or b""
        *lines, self._pending = self._pending.split(b"\n")
        self.lines += map(json.loads, lines)

    def until(self, condition, timeout_s=20.0):
        """Read until `condition()` is true."""
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, self.lines[-3:]
            time.sleep(0.01)
            self.read()

    def first(self):
        """The first line; None where the process ended without one."""
        self.until(lambda: self.lines or self.process.poll() is not None)
        return self.lines[0] if self.lines else None


class Publisher(Process):
    def __init__(self, directory, environment=None, **changes):
        request = json.dumps(request_of(directory, **changes))
        super().__init__("-m", "jtqd.daemon.ros2.process", request, environment=environment)
        self.answer = self.first()


class Reader(Process):
    """Ready when it is made, so that nothing is published before it listens."""

    def __init__(self, domain=None, *more):
        super().__init__(READER, own_domain() if domain is None else domain, "3600", *more)
        self.first()

    def messages(self, topic):
        return [line["message"] for line in self.lines if line.get("topic") == f"rt/{topic}"]

    def writers(self):
        return {line["writer"]: line for line in self.lines if "writer" in line}

    def wait_for(self, topic, count=1, timeout_s=20.0):
        self.until(lambda: len(self.messages(topic)) >= count, timeout_s)
        return self.messages(topic)

    def watch(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.01)
            self.read()
