"""`jtq doctor`: examine whether this machine is suitable for jtqd: kernel, rights, CAN interface, files, packages."""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from jtqd import __version__
from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult, report, share, size
from jtqd.daemon.cli.machine_checks import check_can, check_kernel
from jtqd.daemon.cli.running import DaemonSearch, find_daemons, places
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.loop.process import build_estimator
from jtqd.daemon.shared.runtime_dir import installed
from jtqd.drivers.bus_load import BusLoadError, check_bus_load
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.onnx_graph import NetworkError

_UNITS = (
    "/etc/systemd/system",
    "/run/systemd/system",
    "/usr/local/lib/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
)
_UNIT = "jtqd@.service"
_LOG_FREE = 10 << 30
"""A working day of recording."""
_SHM_FREE = 64 << 20
_BYTES_AN_HOUR = 1.1e9
SCHEMA = "jtq.doctor/1"
_EXAMPLES = """examples:
  jtq doctor                                          all CAN interfaces of this machine, the shipped configuration
  jtq doctor --bus can0 --config /etc/jtqd/can0.yaml
  sudo -u jtqd jtq doctor --bus can0                  as jtqd's user: the rights of the caller are checked
  jtq doctor --json | jq '.items[] | select(.level == "FAIL")'

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_USUAL_LOGS = Path("/var/log/jtqd")


def check_files(config: Config) -> Iterator[CheckResult]:
    """Check configuration, joint files, models and their hashes; the configuration has been read already."""
    load = bus_load_of(config)
    yield CheckResult(
        "configuration", GOOD, f"{config.path}, sha256 {config.sha256[:12]}, method {config.estimator.method}"
    )
    try:
        check_bus_load(load)
        yield CheckResult("bus load", GOOD, f"{share(load.worst)} in the worst case (`jtq bus-load`)")
    except BusLoadError as error:
        yield CheckResult("bus load", FAIL, str(error), "`jtq bus-load` shows the share of each sender")
    for joint in config.joints:
        item = f"joint {joint.number}"
        shown = f"{joint.joint_path.name} {hashlib.sha256(joint.joint_path.read_bytes()).hexdigest()[:12]}"
        network = (
            f", {joint.network.path.name} {joint.network.sha256[:12]}" if joint.network else ", no network"
        )
        try:
            build_estimator(config, joint).step(1e-3, 0.1, 0.0, 1.0, 0.0, 25.0)
        except (ConfigError, NetworkError) as error:
            yield CheckResult(item, FAIL, str(error), "jtqd will not start with it")
        else:
            yield CheckResult(item, GOOD, f"{joint.joint.name}: {shown}{network}: loads and runs")


def check_directories(log: Path | None, roots: list[Path]) -> Iterator[CheckResult]:
    """Check the directories of logs and shared memory for this user; `log` None: none is named."""
    if log is None:
        yield CheckResult(
            "log directory", SKIP, "jtqd writes to ./logs without --record DIR or $LOGS_DIRECTORY"
        )
    else:
        yield _directory(
            "log directory", log, _LOG_FREE, f"an hour takes up to {size(round(_BYTES_AN_HOUR))}"
        )
    yield _directory("shared memory", roots[0], _SHM_FREE, "ring and snapshot of a daemon take 3 MB")


def _directory(item: str, path: Path, wanted: int, what: str) -> CheckResult:
    existing = next(
        each for each in (path, *path.absolute().parents) if os.path.exists(each)
    )  # not in a closed one
    free = shutil.disk_usage(existing).free
    text = f"{path}: {size(free)} free, {what}"
    if not os.access(existing, os.W_OK | os.X_OK):
        return CheckResult(
            item, FAIL, f"{path}: not writable for this user", "owner and mode; LogsDirectory= in the unit"
        )
    if existing != path:
        text += "; it will be created"
    if free < wanted:
        return CheckResult(
            item, WARN, text, f"less than {size(wanted)}: recording pauses when the disk is full"
        )
    return CheckResult(item, GOOD, text)


def check_packages() -> Iterator[CheckResult]:
    """Compare installed versions with the requirements of jtqd's package."""
    try:
        wanted = [each for each in requires("jtqd") or () if "extra ==" not in each]
    except PackageNotFoundError:
        yield CheckResult(
            "packages",
            WARN,
            "jtqd is not installed as a package: its requirements are unknown",
            "pip install .",
        )
        return
    versions, wrong = [], []
    for line in wanted:
        name, limits = requirement(line)
        version = installed(name)
        versions.append(f"{name} {version}")
        if version is None:
            wrong.append(f"{name} is missing")
        elif not all(fits(version, *limit) for limit in limits):
            wrong.append(f"{name} {version}, expected {line.removeprefix(name)}")
    text = f"jtqd {__version__}, " + ", ".join(versions)
    if wrong:
        yield CheckResult(
            "packages", FAIL, "; ".join(wrong), "pip install --upgrade jtqd, in its own environment"
        )
    else:
        yield CheckResult("packages", GOOD, text)


def requirement(line: str) -> tuple[str, list[tuple[str, str]]]:
    """Split a requirement into name and limits: "mcap>=1.3,<2" is ("mcap", [(">=", "1.3"), ("<", "2")])."""
    name = re.split(r"[^A-Za-z0-9_.-]", line, maxsplit=1)[0]
    return name, re.findall(r"(>=|<=|==|<|>)\s*([0-9][0-9A-Za-z.]*)", line.partition(";")[0])


def fits(version: str, operator: str, limit: str) -> bool:
    """Compare the numbers of two versions; the first part that is not a number ends them."""
    have, want = _numbers(version), _numbers(limit)
    length = max(len(have), len(want))
    have, want = have + (0,) * (length - len(have)), want + (0,) * (length - len(want))
    return {">=": have >= want, "<=": have <= want, "==": have == want, "<": have < want, ">": have > want}[
        operator
    ]


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(map(int, match[0].split("."))) if match else ()


def check_unit() -> CheckResult:
    """Check the systemd unit."""
    if not Path("/run/systemd/system").exists():
        return CheckResult("systemd unit", SKIP, "systemd does not run here")
    for directory in _UNITS:
        path = Path(directory) / _UNIT
        if path.exists():
            return CheckResult("systemd unit", GOOD, str(path))
    return CheckResult(
        "systemd unit",
        WARN,
        "not installed",
        "see docs/deployment.md; without the unit jtqd does not start at boot",
    )


def check_leftovers(log: Path | None, search: DaemonSearch) -> Iterator[CheckResult]:
    """Check for unfinished logs and runtime directories of killed daemons."""
    running = [each.about for each in search.daemons]
    text = ", ".join(f"{each.instance} (process {each.pid})" for each in running) or "none"
    yield CheckResult("running jtqd", GOOD, text)
    directories = {Path(each.log_directory) for each in running if each.log_directory} | (
        {log} if log else set()
    )
    growing = tuple(each.log_prefix for each in running)
    files = [
        path
        for directory in sorted(directories)
        for path in sorted(directory.glob("*.mcap.active"))
        if not (growing and path.name.startswith(growing))
    ]
    if files:
        names = ", ".join(str(path) for path in files[:3]) + (
            f" and {len(files) - 3} more" if len(files) > 3 else ""
        )
        yield CheckResult("unfinished logs", WARN, names, "left by a crash: jtq recover FILE")
    else:
        yield CheckResult("unfinished logs", GOOD, "none")
    if search.left_over:
        yield CheckResult(
            "left over",
            WARN,
            ", ".join(map(str, search.left_over)),
            "from killed daemons; removed by the next start, or remove it manually",
        )


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq doctor`."""
    result = argparse.ArgumentParser(
        prog="jtq doctor",
        description="Examine whether this machine is suitable for jtqd: GOOD, WARN or FAIL for each item, with a remedy. "
        "Nothing is changed.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--bus", help="interface, unix:PATH or sim (default: every CAN interface)")
    result.add_argument(
        "--config", type=Path, metavar="FILE", help="configuration (default: the shipped bench)"
    )
    result.add_argument(
        "--record", type=Path, metavar="DIR", help="directory of the logs (default: that of jtqd)"
    )
    result.add_argument("--json", action="store_true", help="print as JSON")
    return result


def main(argv: list[str]) -> int:
    """Examine and report; return the exit status."""
    arguments = parser().parse_args(argv)
    results = list(examine(arguments.bus, arguments.config, arguments.record or _log_directory()))
    return report(results, SCHEMA if arguments.json else None, bus=arguments.bus)


def examine(bus: str | None, path: Path | None, log: Path | None) -> Iterator[CheckResult]:
    """Run every check. An unreadable configuration is one failure; the shipped one is used instead."""
    broken = None
    try:
        config = load_config(path)
    except ConfigError as error:
        broken, config = str(error), load_config(None)
    needs_can = bus is None or not (bus == "sim" or bus.startswith("unix:"))
    yield from check_kernel(config.realtime, can=needs_can)
    yield from check_can(bus, config)
    if broken:
        yield CheckResult("configuration", FAIL, broken, "jtqd will not start with it")
    else:
        yield from check_files(config)
    yield from check_directories(log, places())
    yield from check_packages()
    yield check_unit()
    yield from check_leftovers(log, find_daemons())


def _log_directory() -> Path | None:
    """Return the directory that jtqd would write to, as far as it does not depend on the working directory."""
    named = os.environ.get("LOGS_DIRECTORY", "").split(":")[0]
    if named:
        return Path(named)
    return _USUAL_LOGS if _USUAL_LOGS.exists() else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
