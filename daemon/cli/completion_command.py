"""`jtq completion`: prints a completion script for a shell."""

from __future__ import annotations

import argparse

from jtqd.daemon import jtq, jtqd
from jtqd.daemon.cli.completion import bash, fish, zsh
from jtqd.daemon.cli.parsers import command_tree, from_parser

SHELLS = {"bash": bash, "zsh": zsh, "fish": fish}
_EXAMPLES = """examples:
  source <(jtq completion bash)                                        this shell
  jtq completion bash > /etc/bash_completion.d/jtq                     every shell of this machine
  jtq completion zsh > ~/.zfunc/_jtq                                   with fpath+=~/.zfunc before compinit
  jtq completion fish > ~/.config/fish/completions/jtq.fish

The script is complete in itself and starts no Python. Make it again after an update of jtqd."""


def parser() -> argparse.ArgumentParser:
    """Options of `jtq completion`."""
    made = argparse.ArgumentParser(
        prog="jtq completion",
        description="Print a completion script for jtq and jtqd, made from the options of this version's commands.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("shell", choices=SHELLS, help="the shell")
    return made


def main(argv: list[str]) -> int:
    """Print it; returns the exit status."""
    arguments = parser().parse_args(argv)
    print(SHELLS[arguments.shell](command_tree(jtq.COMMANDS), from_parser("jtqd", "", jtqd.parser())), end="")
    return 0
