"""Ask before something is written into a device for good."""

from __future__ import annotations

import sys


class NotConfirmed(Exception):  # noqa: N818
    """Nobody has agreed; the message is one line, empty where the operator has said no."""


def confirm(question: str, yes: bool) -> None:
    """Ask on a terminal; `yes`: the command line has agreed. Raises NotConfirmed."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise NotConfirmed(f"{question}: not confirmed: standard input is no terminal, --yes agrees")
    print(f"{question}? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise NotConfirmed("nothing was written")
