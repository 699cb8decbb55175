"""`jtq completion`: print a completion script for a shell, made by shtab from the argument parsers of the commands.

The script is static: pressing a key starts no Python.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping
from pathlib import Path

from jtqd.estimator.command_line import command_parser

SHELLS = ("bash", "zsh", "tcsh", "fish")
_EXAMPLES = """examples:
  source <(jtq completion bash)                                   this shell
  jtq completion bash > /etc/bash_completion.d/jtq                every shell of this machine
  jtq completion bash jtqd > /etc/bash_completion.d/jtqd          the daemon's own options
  jtq completion zsh > ~/.zfunc/_jtq                              with fpath+=~/.zfunc before compinit

The script completes commands, options, their choices, files and directories. Generate it again after an update of jtqd.
Without its extra, a command is completed without its options."""
_FILE_WORDS = ("FILE", "RUN", "LOG", "YAML", "PATH")
_BUSES = "grep -lx 280 /sys/class/net/*/type 2>/dev/null | cut -d/ -f5; echo sim"
"""Shell command that lists the CAN interfaces (ARPHRD_CAN) and the emulated bench."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq completion`."""
    result = command_parser(
        "jtq completion",
        "Print a completion script for the commands and options of the installed version.",
        _EXAMPLES,
    )
    result.add_argument("shell", choices=SHELLS, help="shell that the script is for")
    program = "program to complete (default: jtq)"
    result.add_argument("program", nargs="?", choices=("jtq", "jtqd"), default="jtq", help=program)
    return result


def main(argv: list[str]) -> int:
    """Print the script; exit status 0 done, 1 shtab is missing, 2 usage."""
    arguments = parser().parse_args(argv)
    try:
        import shtab
    except ImportError:
        print("jtq completion: shtab is not installed: pip install 'jtqd[completion]'", file=sys.stderr)
        return 1
    from jtqd.daemon import jtq, jtqd

    program = jtq_parser(jtq.COMMANDS) if arguments.program == "jtq" else jtqd.parser()
    complete_values(program, file=shtab.FILE, directory=shtab.DIRECTORY, bus=shtab.cmd(_BUSES))
    print(shtab.complete(program, arguments.shell))
    return 0


def jtq_parser(commands: Mapping[str, tuple[str, str]]) -> argparse.ArgumentParser:
    """Return one parser of `jtq` whose subcommands are the parsers of the commands' modules.

    Args:
        commands: name -> (module with `parser()`, one line of help). A module that cannot be imported, because an extra is
            not installed, gets a parser without options.
    """
    result = argparse.ArgumentParser(prog="jtq", description="Toolbox around jtqd.")
    below = result.add_subparsers(metavar="COMMAND")
    for name, (module, text) in commands.items():
        try:
            made = importlib.import_module(module).parser()
        except ImportError:
            made = argparse.ArgumentParser(prog=f"jtq {name}", description=text)
        below.add_parser(name, help=text, parents=[made], add_help=False)
    return result


def complete_values(parser: argparse.ArgumentParser, **completions: object) -> None:
    """Mark every argument that takes a `file`, a `directory` or a `bus` with its completion (shtab's `complete`)."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                complete_values(each, **completions)
        elif action.choices is None and action.nargs != 0 and (kind := _kind(action)) is not None:
            action.complete = completions[kind]  # type: ignore[attr-defined]


def _kind(action: argparse.Action) -> str | None:
    """Return the kind of an argument's value, by its name and type."""
    metavar = (action.metavar if isinstance(action.metavar, str) else action.dest).upper()
    if action.dest == "bus":
        return "bus"
    if metavar == "DIR" or metavar.endswith("_DIR"):
        return "directory"
    return "file" if action.type is Path or any(word in metavar for word in _FILE_WORDS) else None


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
