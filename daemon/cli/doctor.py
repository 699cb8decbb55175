"""`jtq doctor`: examine whether this machine is suitable for jtqd: kernel, rights, CAN interface, files, packages."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from jtqd.daemon.cli.checks import FAIL, CheckResult, report
from jtqd.daemon.cli.machine_checks import (
    check_can,
    check_directories,
    check_files,
    check_kernel,
    check_packages,
    check_remains,
    check_unit,
)
from jtqd.daemon.cli.running import find_daemons, places
from jtqd.daemon.config import load_config
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.errors import ConfigError

SCHEMA = "jtq.doctor/1"
_EXAMPLES = """examples:
  jtq doctor                                          all CAN interfaces of this machine, the shipped configuration
  jtq doctor --bus can0 --config /etc/jtqd/can0.yaml
  sudo -u jtqd jtq doctor --bus can0                  as jtqd's user: the rights of the caller are checked
  jtq doctor --json | jq '.items[] | select(.level == "FAIL")'

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_USUAL_LOGS = Path("/var/log/jtqd")


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq doctor`."""
    result = command_parser(
        "jtq doctor",
        "Examine whether this machine is suitable for jtqd: GOOD, WARN or FAIL for each item, with a remedy. "
        "Nothing is changed.",
        _EXAMPLES,
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
    results = list(_examine(arguments.bus, arguments.config, arguments.record or _log_directory()))
    return report(results, SCHEMA if arguments.json else None, bus=arguments.bus)


def _examine(bus: str | None, path: Path | None, log: Path | None) -> Iterator[CheckResult]:
    """Run every check. An unreadable configuration is one failure; the shipped one is used instead."""
    broken = ""
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
    yield from check_remains(log, find_daemons())


def _log_directory() -> Path | None:
    """Return the directory that jtqd would write to, as far as it does not depend on the working directory."""
    named = os.environ.get("LOGS_DIRECTORY", "").split(":")[0]
    return Path(named) if named else _USUAL_LOGS if _USUAL_LOGS.exists() else None
