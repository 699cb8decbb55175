"""Damaged files into their readers: each case in a process of its own, with limits of time and memory."""

from __future__ import annotations

import copy
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from jtqd.models.files import shipped


def damage_bytes(source: random.Random, data: bytes) -> tuple[str, bytes]:
    kind = source.choice(("flip", "flips", "cut", "zeros", "noise", "repeat", "insert", "ends", "text"))
    out = bytearray(data)
    at = source.randrange(len(out) or 1)
    length = min(source.choice((1, 2, 8, 100, 3000)), len(out) - at)
    if kind == "flip":
        out[at] ^= 1 << source.randrange(8)
    elif kind == "flips":
        for _ in range(source.randrange(2, 50)):
            out[source.randrange(len(out))] = source.randrange(256)
    elif kind == "cut":
        del out[at:]
    elif kind == "zeros":
        out[at : at + length] = bytes(length)
    elif kind == "noise":
        out[at : at + length] = source.randbytes(length)
    elif kind == "repeat":
        out[at:at] = out[at : at + length] * source.choice((1, 3, 50))
    elif kind == "insert":
        out[at:at] = source.randbytes(source.choice((1, 4, 64)))
    elif kind == "ends":
        out = bytearray(source.choice((b"", b"\0", b"\xff" * 100, bytes(10_000), source.randbytes(1000))))
    else:
        word = source.choice(
            (b"\t", b"&a ", b"*a", b"!!python/object:os.system ", b"- ", b": ", b"\x85", b"0x", b"-1", b"nan")
        )
        out[at:at] = word
    return f"{kind} at {at}", bytes(out)


def bombs() -> dict[str, bytes]:
    """Small YAML texts that are large or endless where a reader is not careful."""
    lol = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9)
    )
    keys = ",".join(f"k{n}: 1" for n in range(500))
    merge = f"a: &a {{{keys}}}\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} {{<<: [{','.join(['*' + chr(97 + n)] * 99)}]}}\n" for n in range(9)
    )
    return {
        "aliases": lol.encode(),
        "merged aliases": merge.encode(),
        "itself": b"a: &a\n  b: *a\n",
        "nested lists": b"a: " + b"[" * 20_000,
        "nested mappings": b"{a: " * 5_000,
        "indented": b"".join(b" " * n + b"a:\n" for n in range(1_000)),
        "digits": b"node_id: " + b"9" * 100_000,
        "sexagesimal": b"node_id: 1" + b":59" * 20_000,
        "documents": b"---\na: 1\n" * 1_000,
        "megabytes": b"# " + b"x" * 2_000_000,
        "python": b"a: !!python/object/apply:os.system ['true']\n",
    }


_HUGE = (10**400, -(10**400), 1e308, 5e-324, float("inf"), float("-inf"), float("nan"), -1, 0, 2**63, 1.5)


def _multiplied(levels: int) -> list[Any]:
    """A list of lists of the same lists: few objects, 9 ** levels values."""
    inner: list[Any] = ["x"]
    for _ in range(levels):
        inner = [inner] * 9
    return inner


_ODD = (
    _multiplied(9),
    None,
    True,
    False,
    "",
    "x" * 10_000,
    "nan",
    "1e400",
    "../../../dev/zero",
    "\0",
    [],
    {},
    [[]],
    {"a": 1},
    b"\0",
)


def _places(tree: Any, seen: set[int] | None = None) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every value; what is in the tree twice is entered once."""
    seen = set() if seen is None else seen
    if id(tree) in seen:
        return
    seen.add(id(tree))
    for key, value in list(tree.items() if isinstance(tree, dict) else enumerate(tree)):
        yield tree, key
        if isinstance(value, dict | list):
            yield from _places(value, seen)


def damage_tree(source: random.Random, tree: Any, *, aliases: bool = True) -> tuple[str, Any]:
    """(what was done, the damaged tree): one to three values changed, removed, moved or nested.

    `aliases`: the file can say them.
    """
    out = copy.deepcopy(tree)
    said = []
    for _ in range(source.choice((1, 1, 1, 2, 3))):
        places = list(_places(out))
        if not places:
            break
        parent, key = source.choice(places)
        kind = source.choice(("huge", "odd", "remove", "swap", "nest", "unknown", "list"))
        said.append(f"{kind} {key}")
        if kind == "huge":
            parent[key] = source.choice(_HUGE)
        elif kind == "odd":
            parent[key] = copy.deepcopy(source.choice(_ODD[not aliases :]))
        elif kind == "remove":
            del parent[key]
        elif kind == "swap":
            other, name = source.choice(places)
            parent[key] = copy.deepcopy(other[name])
        elif kind == "nest":
            for _ in range(source.choice((1, 30))):
                parent[key] = [parent[key]] if source.random() < 0.5 else {"a": parent[key]}
        elif kind == "unknown" and isinstance(parent, dict):
            parent[source.choice(("x", "", 1, None, -0.5, "node_id"))] = 1
        else:
            parent[key] = [parent[key]] * source.choice((0, 2, 1000))
    return "; ".join(said), out


LARGEST = 100_000
"""Bytes of a damaged YAML file: PyYAML takes a second for 50 to 100 kB, and the reader's own limit is 1 MB."""


def damage_yaml(source: random.Random, data: bytes) -> tuple[str, bytes]:
    """Bytes of a YAML file, damaged in one way or the other."""
    chance = source.random()
    if chance < 0.1:
        name, text = source.choice(sorted(bombs().items()))
        return f"bomb: {name}", text
    if chance < 0.4:
        said, text = damage_bytes(source, data)
        return said, text[:LARGEST]
    said, tree = damage_tree(source, yaml.safe_load(data))
    return said, yaml.safe_dump(tree, sort_keys=False).encode()[:LARGEST]


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


# Readers of files: how each is given a file, and the errors it may raise.

Damage = Callable[[random.Random, bytes], tuple[str, bytes]]


@dataclass(frozen=True)
class Target:
    """One kind of file.

    Attributes:
        name: in the table.
        original: a file that is good.
        suffix: of the damaged copy's name.
        damage: how it is damaged.
        read: takes the path of the copy.
        errors: exceptions that are a clear refusal.
    """

    name: str
    original: Path
    suffix: str
    damage: Damage
    read: Callable[[Path], object]
    errors: tuple[type[Exception], ...]


def _json_tree(source: random.Random, data: bytes) -> tuple[str, bytes]:
    said, tree = damage_tree(source, json.loads(data), aliases=False)
    return said, json.dumps(tree, default=str).encode()


def _command(main: Callable[[list[str]], int], *arguments: str) -> Callable[[Path], None]:
    """Run a command in this process; its words are judged by the fuzzer, its status here."""

    def run(path: Path) -> None:
        status = main([*arguments, str(path)])
        if status not in (0, 1, 3):
            raise AssertionError(f"exit status {status}, expected 0, 1 or 3")

    return run


def _network(method: str) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        from jtqd.estimator.estimator import make_estimator
        from jtqd.estimator.network import load_network
        from jtqd.estimator.settings import recommended
        from jtqd.models.files import load_joint

        network = load_network(method, path.read_bytes())
        joint = load_joint(shipped("trained/joint1.yaml"))
        estimator = make_estimator(joint, recommended(method), network)
        for n in range(5):
            estimator.step(1e-3, 1.0, 0.1 * n, 100.0, 0.001 * n, 25.0)

    return read


def _read_log(path: Path) -> None:
    from jtqd.daemon.logs import read_attachments, read_topics, topics_of

    read_attachments(path)
    seldom = ("/diagnostics", "/events", "/log", "/joint/1/zeros", "/joint/2/zeros")
    read_topics(path, [each for each in topics_of(path) if each not in seldom])


def _read_request(path: Path) -> None:
    from jtqd.drivers.boot import parse_request

    parse_request(json.loads(path.read_bytes()))


def _configuration(directory: Path) -> Path:
    """The shipped one, with absolute paths of what it names."""
    models = shipped("bench.yaml").parent
    text = shipped("bench.yaml").read_text()
    for name in ("trained", "joint1.yaml", "joint2.yaml"):
        text = text.replace(f"file: {name}", f"file: {models}/{name}")
    path = directory / "configuration.yaml"
    path.write_text(text)
    return path


def targets(directory: Path) -> list[Target]:
    """All of them; good files are put into `directory`."""
    from jtqd.daemon.bus.boot import boot_request
    from jtqd.daemon.config import load_config
    from jtqd.daemon.logs import LogError, export, recover
    from jtqd.daemon.replay import command as replay_command
    from jtqd.drivers.boot import RequestError
    from jtqd.drivers.object_dictionary import EdsError, read_eds
    from jtqd.estimator.errors import ConfigError
    from jtqd.estimator.network import NetworkError
    from jtqd.models.files import load_joint
    from jtqd.sim_can.plant_file import load_plant
    from jtqd.sysid.planner.campaigns import Scale, make_plan
    from jtqd.sysid.planner.plan import load_plan
    from jtqd.sysid.runs.column_map import ColumnMap
    from jtqd.sysid.runs.files import read_run
    from jtqd.sysid.runs.run_file import RunError

    configuration = _configuration(directory)
    request = directory / "request.json"
    request.write_text(json.dumps(boot_request(load_config(configuration), "vcan0").as_json()))
    plan = directory / "plan.yaml"
    plan.write_text(make_plan("efficiency", Scale()).to_yaml())
    log = directory / "log.mcap"
    from tests.daemon.logs import log_files
    from tests.estimator.fused_configuration import network_of

    log_files.ours(log)
    run = directory / "run.csv"
    run.write_text(
        "time_s,j1.current_a,j1.motor_position_rad,j1.link_position_rad,j1.torque_nm\n"
        + "".join(f"{n / 1000},{n % 7},{n * 0.1},{n * 0.001},{n % 5}\n" for n in range(200))
    )
    eds = Path(sys.modules["jtqd.drivers.object_dictionary"].__file__ or "").parent / "eds" / "jtqd.eds"
    models = shipped("bench.yaml").parent
    network = directory / "joint1.fused.onnx"
    network.write_bytes(network_of(1))
    logs = (LogError,)
    return [
        Target("configuration", configuration, ".yaml", damage_yaml, load_config, (ConfigError,)),
        Target("joint file", shipped("joint1.yaml"), ".yaml", damage_yaml, load_joint, (ConfigError,)),
        Target("plant file", shipped("plant.yaml"), ".yaml", damage_yaml, load_plant, (ConfigError,)),
        Target("plan", plan, ".yaml", damage_yaml, load_plan, (ConfigError,)),
        Target(
            "column map",
            models / "kinova_gen3" / "columns.yaml",
            ".yaml",
            damage_yaml,
            ColumnMap.load,
            (ConfigError,),
        ),
        Target("run table", run, ".csv", damage_bytes, read_run, (RunError,)),
        Target("boot request", request, ".json", _json_tree, _read_request, (RequestError,)),
        Target("EDS", eds, ".eds", damage_bytes, lambda path: read_eds(path, 0x20), (EdsError,)),
        Target(
            "network, ours", network, ".onnx", damage_bytes, _network("fused"), (NetworkError, ConfigError)
        ),
        Target(
            "network, paper",
            models / "trained" / "joint1.onnx",
            ".onnx",
            damage_bytes,
            _network("network"),
            (NetworkError, ConfigError),
        ),
        Target("log, read", log, ".mcap", damage_bytes, _read_log, logs),
        Target("log, recover", log, ".mcap", damage_bytes, _command(recover.main), ()),
        Target("log, export", log, ".mcap", damage_bytes, _command(export.main, "candump"), ()),
        Target("log, replay", log, ".mcap", damage_bytes, _command(replay_command.main, "--json"), ()),
    ]


def place(target: Target, directory: Path, data: bytes) -> Path:
    """The damaged copy, in a directory of its own with the joint files that a plant file names."""
    case = directory / "case"
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    path = case / f"damaged{target.suffix}"
    for number in (1, 2):
        shutil.copy(shipped(f"joint{number}.yaml"), case)
    path.write_bytes(data)
    return path
