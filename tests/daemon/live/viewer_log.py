"""A log of the emulated bench as the daemon records it, made once per test run; and how viewers resolve message paths."""

import atexit
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from mcap.reader import make_reader

from jtqd.daemon.recording import messages
from tests.daemon.recording.cdr_decoder import Definition
from tests.paths import ROOT


@functools.cache
def bench_log():
    """Path of an MCAP file: 3 s of `jtqd --bus sim`."""
    directory = Path(tempfile.mkdtemp(prefix="jtqd-viewer-log-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(directory), "PYTHONPATH": str(ROOT)}
    arguments = ["--bus", "sim", "--record", str(directory / "logs"), "--duration", "3", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtqd", *arguments],
        env=environment,
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode in (0, 3), done.stderr
    (log,) = (directory / "logs").glob("*.mcap")
    assert json.loads(done.stdout)["cycles"] > 1000
    return log


class Topics:
    """What a viewer knows of the topics: their definitions, by name."""

    def __init__(self):
        self.definitions, self.texts = {}, {}

    @classmethod
    def of_bus(cls, joints):
        """Those in the log of a bus with so many joints."""
        made, texts = cls(), messages.schemas_of(joints, shadow=True)
        for topic in messages.topics_of(joints, shadow=True):
            made.define(topic.name, topic.schema, texts[topic.schema])
        return made

    def define(self, topic, name, text):
        self.texts[topic], self.definitions[topic] = text, Definition(name, text)

    def kind(self, path):
        """Type of what a message path selects, e.g. "float64"; ValueError where it selects nothing.

        Grammar of Foxglove and Lichtblick: topic, then .field, [index], [from:to] and {field==value}.
        """
        found = re.fullmatch(r"(/[\w/]+)((?:\.\w+|\[-?\d*:?-?\d*\]|\{\w+(?:==|!=|<=|>=|<|>)[^{}]+\})*)", path)
        if found is None:
            raise ValueError(f"{path}: not a message path")
        topic, rest = found.groups()
        if topic not in self.definitions:
            raise ValueError(f"{path}: no topic {topic}")
        types = self.definitions[topic].types
        kind, array = None, False
        for part in re.findall(r"\.\w+|\[[^\]]*\]|\{[^}]*\}", rest):
            if part[0] == "[":
                if not array:
                    raise ValueError(f"{path}: {part}: not an array")
                array = False
                continue
            name = part[1:] if part[0] == "." else re.match(r"\{(\w+)", part)[1]
            if array or kind not in types:
                raise ValueError(f"{path}: {part}: nothing below that")
            fields = {field: (of, count) for field, of, count in types[kind][0]}
            if name not in fields:
                raise ValueError(f"{path}: {part}: no such field in {kind or topic}")
            if part[0] == ".":
                kind, count = fields[name]
                array = count is not None
        if array:
            raise ValueError(f"{path}: an array, and no index")
        return kind

    def names_of_values(self, topic, field):
        """Names that viewers show for the values of a field: of the constants of its type right before it."""
        constants, last = {}, None
        for line in self.texts[topic].split("=" * 80)[0].splitlines():
            bare = line.split("#")[0].split()
            if not bare:
                continue
            if bare[0] != last:
                constants, last = {}, bare[0]
            if "=" in line.split("#")[0]:
                name, value = "".join(bare[1:]).split("=")
                constants[int(value)] = name
                continue
            if bare[1] == field:
                return constants
            constants = {}
        raise ValueError(f"{topic}: no field {field}")


class Log(Topics):
    """Topics and messages of a file."""

    def __init__(self, path):
        super().__init__()
        self.messages = {}
        with open(path, "rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                if channel.topic not in self.definitions:
                    self.define(channel.topic, schema.name, schema.data.decode())
                self.messages.setdefault(channel.topic, []).append(message.data)

    def decoded(self, topic, number=-1):
        return self.definitions[topic].decode(self.messages[topic][number])
