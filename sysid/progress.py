"""Progress on standard error where that is a terminal: a bar over items, a spinner while one thing is computed."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

T = TypeVar("T")


def progress(items: Sequence[T], text: str) -> Iterable[T]:
    """Pass the items through, with a bar on standard error where that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track

    return track(items, description=text, console=Console(stderr=True), transient=True)


def waiting(text: str) -> AbstractContextManager[Any]:
    """Return a spinner on standard error where that is a terminal."""
    if not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console

    return Console(stderr=True).status(text)
