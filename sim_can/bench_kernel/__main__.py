"""Command line: python -m jtqd.sim_can.bench_kernel build | path | run."""

import argparse
import signal
import sys
from typing import NoReturn

from jtqd.sim_can.bench_kernel import build, guest

EXIT_TIMEOUT, EXIT_NO_GUEST = 124, 125  # as timeout(1) and env(1) have them

EXAMPLES = """examples:
  python -m jtqd.sim_can.bench_kernel build
  python -m jtqd.sim_can.bench_kernel run -- candump -n 1 vcan0
  python -m jtqd.sim_can.bench_kernel run --time-travel --out out -- jtqd --bus vcan0 --record out --duration 10
"""


def parser() -> argparse.ArgumentParser:
    """Return the command line's grammar."""
    top = argparse.ArgumentParser(
        prog="python -m jtqd.sim_can.bench_kernel",
        description="Real SocketCAN in a user-mode kernel, for machines whose own kernel has none.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = top.add_subparsers(dest="action", required=True)
    make = commands.add_parser("build", help="build the kernel unless it is cached, and print its path")
    make.add_argument("--unless-vcan", action="store_true", help="do nothing if the host has vcan0")
    commands.add_parser("path", help="print the cached kernel's path; status 1 when there is none")
    run = commands.add_parser("run", help="boot the kernel, run a command as root, return its exit status")
    run.add_argument(
        "--time-travel", action="store_true", help="guest time advances only when every process sleeps"
    )
    run.add_argument("--mem", default="2G", help="RAM of the guest (default: %(default)s)")
    run.add_argument(
        "--timeout", type=float, metavar="S", help="kill the guest after S seconds of wall time, status 124"
    )
    run.add_argument("--out", metavar="DIR", help="directory on the host that the guest can write")
    run.add_argument("command", nargs="+", metavar="COMMAND", help="after --: program and arguments")
    return top


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    options = parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, _terminated)
    try:
        return ACTIONS[options.action](options)
    except (RuntimeError, OSError) as error:  # every error of this package is a RuntimeError
        print(f"bench kernel: {error}", file=sys.stderr)
        if options.action != "run":
            return 1
        return EXIT_TIMEOUT if isinstance(error, guest.GuestTimeoutError) else EXIT_NO_GUEST
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _build(options: argparse.Namespace) -> int:
    there = options.unless_vcan and build.ensure_vcan()
    build.require(build.TESTS if there else build.TESTS | build.needs())  # asked for once
    if there:
        print("bench kernel: not needed, this host has vcan0", file=sys.stderr)
        return 0
    print(build.ensure())
    return 0


def _path(_options: argparse.Namespace) -> int:
    found = build.find()
    if found is None:
        print("bench kernel: not built yet; run: python -m jtqd.sim_can.bench_kernel build", file=sys.stderr)
        return 1
    print(found)
    return 0


def _run(options: argparse.Namespace) -> int:
    return guest.run(
        options.command,
        time_travel=options.time_travel,
        timeout_s=options.timeout,
        out_dir=options.out,
        memory=options.mem,
        sinks=(sys.stdout.buffer, sys.stderr.buffer),
    ).returncode


ACTIONS = {"build": _build, "path": _path, "run": _run}


def _terminated(number: int, _frame: object) -> NoReturn:
    sys.exit(128 + number)  # runs the clean-up, which kills the guest


if __name__ == "__main__":
    sys.exit(main())
