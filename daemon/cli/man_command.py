"""`jtq man`: prints a manual page, made from the help of this version's commands."""

from __future__ import annotations

import argparse

from jtqd.daemon import jtq, jtqd
from jtqd.daemon.cli.man_page import jtq_page, jtqd_page
from jtqd.daemon.cli.parsers import command_tree, from_parser
from jtqd.daemon.shared.runtime_dir import installed

_EXAMPLES = """examples:
  jtq man | man -l -                                   read it
  jtq man > /usr/local/share/man/man1/jtq.1            install it; then: man jtq
  jtq man jtqd > /usr/local/share/man/man1/jtqd.1"""


def parser() -> argparse.ArgumentParser:
    """Options of `jtq man`."""
    made = argparse.ArgumentParser(
        prog="jtq man",
        description="Print a manual page in roff: all commands with their options and examples.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "page", nargs="?", choices=("jtq", "jtqd"), default="jtq", help="which one (default jtq)"
    )
    return made


def main(argv: list[str]) -> int:
    """Print it; returns the exit status."""
    arguments = parser().parse_args(argv)
    version = installed("jtqd") or "unknown"
    if arguments.page == "jtqd":
        print(jtqd_page(from_parser("jtqd", "", jtqd.parser()), version), end="")
    else:
        print(jtq_page(command_tree(jtq.COMMANDS), version), end="")
    return 0
