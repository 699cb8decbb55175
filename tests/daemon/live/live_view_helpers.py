"""The live view's process on a ring of its own, and a websocket client that speaks the viewers' protocol."""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from jtqd.daemon.config import load_config
from jtqd.daemon.recording import messages
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.events import FILE, Notices
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import Snapshot
from tests.daemon import ring_records as rr
from tests.daemon.recording.recorder_bench import DEFINITIONS, put, record_of
from tests.paths import ROOT

SUBPROTOCOL = "foxglove.sdk.v1"
TYPES = {topic.name: topic.schema for topic in messages.TOPICS}
_MESSAGE_DATA = 1


class Memory:
    """What a loop and its supervisor leave in the runtime directory; `feed` puts records at 1 kHz as a loop does."""

    def __init__(self, directory):
        self.directory = directory
        self.ring = Ring(directory / "ring", 4096, rr.RECORD_SIZE)
        self.snapshot = Snapshot(directory / "snapshot", 0.001, 0.5)
        self.notices = Notices(directory / FILE)
        self.count = 0

    def files(self):
        return [self.directory / name for name in ("ring", "snapshot", FILE)]

    def feed(self, cycles, statuses=lambda _: (2, 2), missed=lambda _: 0, rate_hz=1000):
        start = time.monotonic()
        for n in range(cycles):
            index = self.count
            self.count += 1
            put(self.ring, record_of(index, statuses=statuses(index), missed=missed(index)))
            wait = start + (n + 1) / rate_hz - time.monotonic()
            if wait > 0.002:
                time.sleep(wait)

    def feeding(self, cycles, **kinds):
        """The same in a thread."""
        thread = threading.Thread(target=self.feed, args=(cycles,), kwargs=kinds, daemon=True)
        thread.start()
        return thread


def request_of(directory, **changes):
    content = {
        "ring": str(directory / "ring"),
        "snapshot": str(directory / "snapshot"),
        "notices": str(directory / FILE),
        "host": "127.0.0.1",
        "port": 0,
        "bus": "vcan7",
        "nodes": [[1, "drive 1"]],
        "joint_names": ["joint_1", "joint_2"],
        "gear_ratios": [100.0, None],
        "shadow": False,
    }
    return content | changes


class Kept:
    """The supervisor's side of a side process, with real children on memory without a loop.

    make: start_child -> `SideProcess`.
    """

    def __init__(self, directory, capfd, make):
        self.memory = Memory(directory)
        self.children, self.capfd, self.text = [], capfd, ""
        self.keeper = make(self._child)
        self.keeper.start(replace(load_config(None), shadow=()), directory, "vcan7")

    def _child(self, module, arguments, name):
        self.children.append(Child(module, arguments, name=name))
        return self.children[-1]

    def until(self, pattern, timeout_s=15.0):
        """Watch as the supervisor does, until this was written."""
        end = time.monotonic() + timeout_s
        while not (found := re.search(pattern, self.text)):
            assert time.monotonic() < end, self.text
            self.keeper.watch()
            self.text += self.capfd.readouterr().err
            time.sleep(0.02)
        self.text = self.text[found.end() :]
        return found

    def kill(self):
        os.kill(self.keeper.pid, signal.SIGKILL)

    def end(self):
        for child in self.children:
            child.end()


class LiveProcess:
    """`python -m jtqd.daemon.live.process`; for a `with` statement."""

    def __init__(self, directory, **changes):
        request = request_of(directory, **changes)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "jtqd.daemon.live.process", json.dumps(request)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.answer = json.loads(self.process.stdout.readline() or "{}")
        found = re.search(r"ws://[^)]+:(\d+)", self.answer.get("listening", ""))
        self.url, self.port = (found[0], int(found[1])) if found else ("", 0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        _, self.errors = self.process.communicate(timeout=10)
        assert "Traceback" not in self.errors, self.errors

    def shared(self):
        """Permissions of its mappings of files, by the file's name."""
        lines = Path(f"/proc/{self.process.pid}/maps").read_text().splitlines()
        mapped = [line.split(maxsplit=5) for line in lines]
        return {Path(part[5]).name: part[1] for part in mapped if len(part) == 6 and part[5].startswith("/")}

    def cpu_s(self):
        ticks = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
        return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")

    def resident_mb(self):
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def asked(port, path, *headers, host="127.0.0.1", method="GET"):
    """The whole answer to a request whose connection the server closes."""
    lines = (f"{method} {path} HTTP/1.1", f"Host: {host}", *headers, "", "")
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        client.sendall("\r\n".join(lines).encode())
        parts = []
        while part := client.recv(65536):
            parts.append(part)
    return b"".join(parts)


class Viewer:
    """A websocket client: knows the information of the server, and collects messages by topic."""

    def __init__(self, url, topics=None, subprotocols=(SUBPROTOCOL,), **options):
        self._connection = connect(url, subprotocols=list(subprotocols), max_size=None, **options)
        self.socket = self._connection.__enter__()
        self.texts, self.channels, self.messages = [], {}, {}
        self._subscribed = {}
        self._until(lambda: len(self.channels) >= len(messages.TOPICS))  # one message names all
        wanted = [c for c in self.channels.values() if topics is None or c["topic"] in topics]
        self._subscribed = {n: channel["topic"] for n, channel in enumerate(wanted, start=100)}
        self.send(
            op="subscribe",
            subscriptions=[{"id": n, "channelId": c["id"]} for n, c in enumerate(wanted, start=100)],
        )

    def send(self, **content):
        self.socket.send(json.dumps(content))

    def take(self, timeout=0.2):
        """One thing from the server; False where there is none."""
        try:
            data = self.socket.recv(timeout=timeout)
        except TimeoutError:
            return False
        if isinstance(data, str):
            content = json.loads(data)
            self.texts.append(content)
            if content["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in content["channels"]}
            return True
        code, number, stamp = struct.unpack_from("<BIQ", data)
        if code == _MESSAGE_DATA:
            topic = self._subscribed[number]
            message = DEFINITIONS[TYPES[topic]].decode(data[13:])
            self.messages.setdefault(topic, []).append((stamp, message))
        return True

    def _until(self, condition, timeout_s=10.0):
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, f"waited in vain; the server sent {self.texts}"
            self.take()

    def wait_for(self, topic, count=1):
        self._until(lambda: len(self.messages.get(topic, [])) >= count)
        return self.messages[topic]

    def watch(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                self.take(left)
            except ConnectionClosed:
                return

    def leave(self):
        """Without a word."""
        self.socket.socket.shutdown(socket.SHUT_RDWR)
