"""`jtq`, the toolbox: finds the subcommand's module and hands the arguments over; nothing else is loaded."""

from __future__ import annotations

import difflib
import importlib
import os
import sys

COMMANDS = {
    "sim": ("sim_can.cli", "emulate the bench on a bus, or play a measured run on it"),
    "campaign": ("sysid.campaign.command", "drive both joints through a campaign of runs, and keep them"),
    "excitation": ("sysid.excitation_command", "design excitation runs, or compare the ways to get them"),
    "fit": (
        "sysid.fit_command",
        "fit a section of a joint file to measured runs: efficiency, friction, losses",
    ),
    "reproduce": ("sysid.reproduce_command", "campaigns, fits, training and evaluation from nothing"),
    "train": ("sysid.train_command", "train networks on recorded runs (extra: train)"),
    "evaluate": (
        "sysid.evaluate.command",
        "all methods beside the torque sensor on runs never trained on: report and figures",
    ),
    "plot": ("sysid.plot_command", "draw a log: estimate beside the torque sensor"),
    "bus-load": ("daemon.bus_load_command", "worst-case load of the bus by a configuration"),
    "measured": (
        "sysid.measured",
        "estimate measured runs before and after fitting the joint file's friction",
    ),
}
"""Subcommand -> (module with `main(argv) -> int`, one line of help)."""


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items())
    return (
        f"usage: jtq COMMAND ...\n\nToolbox around jtqd.\n\ncommands:\n{rows}\n\n"
        "examples:\n  jtq sim --bus vcan0\n  jtq bus-load\n  jtq COMMAND --help\n"
    )


def main(argv: list[str] | None = None) -> int:
    """Run a subcommand; returns its exit status (0 done, 1 failure, 2 usage, 3 done with findings or loss)."""
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
    except OSError as error:  # a full disk, a directory that is not there, a pipe that was closed
        print(f"jtq {arguments[0]}: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return int(status or 0)


if __name__ == "__main__":
    sys.exit(main())
