"""`jtq`, the toolbox: finds the subcommand's module and hands the arguments over; nothing else is loaded.

Every command is a module with `main(argv) -> int` and `parser() -> argparse.ArgumentParser`.
"""

from __future__ import annotations

import difflib
import importlib
import os
import sys

from jtqd import __version__
from jtqd.estimator.command_line import printable_streams

GROUPS = {
    "run: the bus, the daemon and this machine": {
        "sim": ("jtqd.sim_can.command", "emulate the bench on a bus, or play a measured run"),
        "status": ("jtqd.daemon.cli.status", "show the state of a running jtqd, live"),
        "control": ("jtqd.daemon.cli.control", "send an order: ping, reset, save"),
        "init": ("jtqd.daemon.cli.init", "write a first configuration for the devices on a bus"),
        "probe": ("jtqd.daemon.cli.probe", "read a device on a bus: identity, scaling, TPDOs"),
        "check": ("jtqd.daemon.cli.check", "measure and rate a bus and the timing of this machine"),
        "doctor": (
            "jtqd.daemon.cli.doctor",
            "examine kernel, rights, CAN interface and files of this machine",
        ),
        "schema": ("jtqd.daemon.cli.schema", "print the JSON schema of a configuration, joint file or plan"),
        "bus-load": ("jtqd.daemon.cli.bus_load", "compute the worst-case bus load of a configuration"),
    },
    "look: figures and layouts": {
        "plot": ("jtqd.sysid.plot", "draw the estimate of a log and the torque sensor"),
        "layout": ("jtqd.daemon.live.layout", "write a layout file for Foxglove and Lichtblick"),
    },
    "log: recorded cycles": {
        "export": ("jtqd.daemon.logs.export", "write a log as CSV, Parquet or candump lines; a DBC"),
        "recover": ("jtqd.daemon.logs.recover", "repair unfinished or damaged logs"),
        "replay": ("jtqd.daemon.replay.command", "run the estimator again over a log, and compare"),
        "batch": ("jtqd.sysid.batch.command", "diagnose or replay many logs, here or on a dask cluster"),
    },
    "identify: parameters and networks from measured runs": {
        "campaign": ("jtqd.sysid.campaign.command", "move the joints of a bus, and record the runs"),
        "excitation": ("jtqd.sysid.planner.command", "design excitation trajectories"),
        "fit": (
            "jtqd.sysid.fit.command",
            "fit sections of a joint file to runs; links of an arm",
        ),
        "train": ("jtqd.sysid.train.command", "train a network per joint on runs (extra: train)"),
        "evaluate": (
            "jtqd.sysid.evaluate.command",
            "score all methods against the torque sensor on held-out runs",
        ),
        "diagnose": (
            "jtqd.sysid.diagnosis.command",
            "find the cause of a simulation error, and extend the joint file",
        ),
        "score": ("jtqd.sysid.score.command", "print the error of a joint file on runs, before and after"),
        "export-model": ("jtqd.sysid.simulators", "write a joint file for other simulators: MJCF, URDF"),
    },
    "shell: this terminal": {
        "completion": ("jtqd.daemon.cli.completion", "print a completion script for bash, zsh, tcsh or fish")
    },
}
"""Heading -> subcommand -> (module, one line of help)."""

FORMS = {("init", "--from-csv"): "jtqd.sysid.runs.from_csv", ("fit", "arm"): "jtqd.sysid.arm.command"}
"""Subcommand and the option, or the first word, with which another module is called."""

COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def _help() -> str:
    width = max(map(len, COMMANDS))
    groups = "\n".join(
        f"{heading}\n" + "".join(f"  {name:<{width}}  {text}\n" for name, (_, text) in group.items())
        for heading, group in GROUPS.items()
    )
    return (
        f"usage: jtq COMMAND ...\n       jtq --version\n\nToolbox around jtqd.\n\n{groups}\n"
        "examples:\n"
        "  jtq sim --bus vcan0               emulated bench on a CAN interface\n"
        "  jtq status                        state of the daemon on this machine\n"
        "  jtq COMMAND --help                options and examples of a command\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns its exit status (0 done, 1 failure, 2 usage, 3 done with findings or loss, 130 Ctrl-C)."""
    _open_streams()
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        return _run("--help", __name__, arguments)
    name = arguments[0]
    if name == "--version":
        print(f"jtqd {__version__}")
        return 0
    command = COMMANDS.get(name)
    if command is None:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"jtq: no command {name!r}{hint} (jtq --help lists them)", file=sys.stderr)
        return 2
    given = {each.partition("=")[0] for k, each in enumerate(arguments[1:]) if k == 0 or each.startswith("-")}
    module = next(
        (module for (of, option), module in FORMS.items() if of == name and option in given), command[0]
    )
    return _run(name, module, arguments[1:])


def _open_streams() -> None:
    """Give what the caller has closed (`>&-`) to /dev/null: no file of a command may take its number, and print() fails."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            os.dup2(null, number)
            if null != number:
                os.close(null)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
    printable_streams()


def _print_help(arguments: list[str]) -> int:
    print(_help(), end="")
    return 0 if arguments else 2


def _run(name: str, module: str, arguments: list[str]) -> int:
    """Run the command of a module; returns its exit status."""
    try:
        run = _print_help if module == __name__ else importlib.import_module(module).main
        status = run(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except ModuleNotFoundError as error:  # the packages of an extra; what belongs to jtqd is always there
        package = (error.name or "jtqd").partition(".")[0]
        if package == "jtqd":
            raise
        extra = "train" if package == "torch" else "analysis"
        print(f"jtq {name}: {package} is not installed: pip install 'jtqd[{extra}]'", file=sys.stderr)
        return 1
    except OSError as error:  # a full disk, a missing directory, a closed pipe
        if not isinstance(error, BrokenPipeError):  # `| head` has what it wanted
            print(f"jtq {name}: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return int(status or 0)


if __name__ == "__main__":
    sys.exit(main())
