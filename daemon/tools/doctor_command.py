"""`jtq doctor`: is this machine fit for jtqd? Kernel, rights, CAN interface, files, directories, packages."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from daemon.config import load_config
from daemon.tools.doctor_can import can_findings
from daemon.tools.doctor_files import (
    directory_findings,
    file_findings,
    left_over_findings,
    package_findings,
    unit_finding,
)
from daemon.tools.doctor_kernel import kernel_findings
from daemon.tools.finding import FAIL, Finding, as_json, exit_status, show
from daemon.tools.running import find_daemons, places
from estimator.checked import ConfigError

SCHEMA = "jtq.doctor/1"
_EXAMPLES = """examples:
  jtq doctor                                          this machine, all its CAN interfaces, the shipped configuration
  jtq doctor --bus can0 --config /etc/jtqd/can0.yaml
  sudo -u jtqd jtq doctor --bus can0                  as the user that jtqd runs as: rights are those of the caller
  jtq doctor --json | jq '.items[] | select(.level == "FAIL")'

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_USUAL_LOGS = Path("/var/log/jtqd")


def parser() -> argparse.ArgumentParser:
    """Options of `jtq doctor`."""
    made = argparse.ArgumentParser(
        prog="jtq doctor",
        description="Is this machine fit for jtqd? GOOD, WARN or FAIL for each item, and what to do. It changes nothing.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--bus", help="interface, unix:PATH or sim (default: every CAN interface)")
    made.add_argument(
        "--config", type=Path, metavar="FILE", help="configuration (default: the bench that ships)"
    )
    made.add_argument("--record", type=Path, metavar="DIR", help="directory of the logs (default: as jtqd's)")
    made.add_argument("--json", action="store_true", help="print as JSON")
    return made


def main(argv: list[str]) -> int:
    """Examine; returns the exit status."""
    arguments = parser().parse_args(argv)
    findings = list(examine(arguments.bus, arguments.config, arguments.record or _log_directory()))
    if arguments.json:
        print(json.dumps(as_json(SCHEMA, findings, bus=arguments.bus)))
    else:
        show(Console(), findings)
    return exit_status(findings)


def examine(bus: str | None, path: Path | None, log: Path | None) -> Iterator[Finding]:
    """Every item. A configuration that cannot be read is one, and the shipped one then stands in for it."""
    broken = None
    try:
        config = load_config(path)
    except ConfigError as error:
        broken, config = str(error), load_config(None)
    needs_can = bus is None or not (bus == "sim" or bus.startswith("unix:"))
    yield from kernel_findings(config.realtime, can=needs_can)
    yield from can_findings(bus, config)
    if broken:
        yield Finding("configuration", FAIL, broken, "jtqd will not start with it")
    else:
        yield from file_findings(config)
    yield from directory_findings(log, places())
    yield from package_findings()
    yield unit_finding()
    yield from left_over_findings(log, find_daemons())


def _log_directory() -> Path | None:
    """Where jtqd would write, as far as that does not depend on the directory it is started in."""
    named = os.environ.get("LOGS_DIRECTORY", "").split(":")[0]
    if named:
        return Path(named)
    return _USUAL_LOGS if _USUAL_LOGS.exists() else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
