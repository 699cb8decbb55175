"""Progress on standard error where that is a terminal: a bar over items or steps, a spinner while one thing is computed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, TypeVar

T = TypeVar("T")


def progress(items: Sequence[T], text: str) -> Iterable[T]:
    """Pass the items through, with a bar on standard error where that is a terminal."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track

    return track(items, description=text, console=Console(stderr=True), transient=True)


@contextmanager
def bar(text: str, total: int) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a bar of `total` steps by a number of steps."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(text, total=total)
        yield lambda steps: shown.advance(task, steps)


def waiting(text: str) -> AbstractContextManager[Any]:
    """Return a spinner on standard error where that is a terminal."""
    if not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console

    return Console(stderr=True).status(text)
