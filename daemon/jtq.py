"""`jtq`, the toolbox: finds the subcommand's module and hands the arguments over; nothing else is loaded."""

from __future__ import annotations

import difflib
import importlib
import os
import sys

COMMANDS = {
    "sim": ("jtqd.sim_can.command", "emulate the bench on a bus, or play a measured run on it"),
    "campaign": (
        "jtqd.sysid.campaign.command",
        "drive both joints through a campaign of runs, and keep them",
    ),
    "excitation": (
        "jtqd.sysid.excitation.command",
        "design excitation runs, or compare the ways to get them",
    ),
    "fit": (
        "jtqd.sysid.fit.command",
        "fit a section of a joint file to measured runs: efficiency, friction, losses",
    ),
    "reproduce": ("jtqd.sysid.reproduce", "campaigns, fits, training and evaluation from nothing"),
    "train": ("jtqd.sysid.train.command", "train networks on recorded runs (extra: train)"),
    "evaluate": (
        "jtqd.sysid.evaluate.command",
        "all methods beside the torque sensor on runs never trained on: report and figures",
    ),
    "diagnose": (
        "jtqd.sysid.diagnosis.command",
        "what the simulation gets wrong on measured runs, its cause by name, the extended joint file",
    ),
    "export": ("jtqd.daemon.logs.export", "a log as CSV, Parquet or candump lines; the bus as a DBC"),
    "recover": ("jtqd.daemon.logs.recover_command", "repair logs left by a crash, or damaged"),
    "replay": (
        "jtqd.daemon.replay.command",
        "run the estimator over a log again: is it what was published, and what would another model say",
    ),
    "batch": (
        "jtqd.sysid.batch.command",
        "diagnose or replay many logs, here or on a dask cluster; one page over all",
    ),
    "plot": ("jtqd.sysid.plot", "draw a log: estimate beside the torque sensor"),
    "control": ("jtqd.daemon.cli.control", "orders to a running jtqd: ping, reload, reset, save"),
    "bus-load": ("jtqd.daemon.cli.bus_load", "worst-case load of the bus by a configuration"),
    "layout": ("jtqd.daemon.live.layout", "layout file for Foxglove and Lichtblick"),
    "status": ("jtqd.daemon.cli.status", "how a running jtqd is doing, live"),
    "check": ("jtqd.daemon.cli.check", "self-test of a bus and of this machine's timing"),
    "doctor": (
        "jtqd.daemon.cli.doctor",
        "is this machine fit for jtqd? kernel, rights, interface, files",
    ),
    "completion": ("jtqd.daemon.cli.completion_command", "completion for bash, zsh or fish"),
    "man": ("jtqd.daemon.cli.man_command", "manual page of jtq, made from its help"),
    "measured": (
        "jtqd.sysid.measured.offline",
        "estimate measured runs before and after fitting the joint file's friction",
    ),
}
"""Subcommand -> (module with `main(argv) -> int`, one line of help)."""


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items())
    return (
        f"usage: jtq COMMAND ...\n\nToolbox around jtqd.\n\ncommands:\n{rows}\n\n"
        "examples:\n"
        "  jtq sim --bus vcan0               emulated bench on a CAN interface\n"
        "  jtq status                        how the daemon here is doing\n"
        "  jtq COMMAND --help                options and examples of a command\n"
        "  source <(jtq completion bash)     completion in this shell\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns its exit status (0 done, 1 failure, 2 usage, 3 done with findings or loss, 130 Ctrl-C)."""
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help(), end="")
        return 0 if arguments else 2
    command = COMMANDS.get(arguments[0])
    if command is None:
        near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"jtq: no command {arguments[0]!r}{hint} (jtq --help lists them)", file=sys.stderr)
        return 2
    try:
        status = importlib.import_module(command[0]).main(arguments[1:])
        sys.stdout.flush()
    except KeyboardInterrupt:  # Ctrl-C: whoever pressed it knows
        return 130
    except OSError as error:  # a full disk, a directory that is not there, a pipe that was closed
        if not isinstance(error, BrokenPipeError):  # `| head` has what it wanted
            print(f"jtq {arguments[0]}: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return int(status or 0)


if __name__ == "__main__":
    sys.exit(main())
