"""The options of every jtq command, taken from the argument parsers that the commands themselves use.

A command is its module's `main(argv)`. It is called with no arguments while argparse hands the parser over instead of
parsing, so nothing runs, and nothing has to be declared twice. A command that only names modules of further commands
has a mapping `KINDS`. One whose module cannot be imported here (an extra that is not installed) is left without options.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn

FILES, DIRECTORIES, BUSES, WORDS, NOTHING = "files", "directories", "buses", "words", "nothing"
"""What the value of an option can be completed with; `NOTHING`: a number or a name that nobody can guess."""


@dataclass(frozen=True)
class Option:
    """One option, or a positional argument where there are no `flags`; `value` None where the option takes none."""

    flags: tuple[str, ...]
    metavar: str
    help: str
    value: str | None
    choices: tuple[str, ...] = ()
    many: bool = False


@dataclass(frozen=True)
class Command:
    """One command with its options and the commands below it; `usage`, `description` and `epilog` as in its help."""

    name: str
    summary: str
    usage: str = ""
    description: str = ""
    epilog: str = ""
    options: tuple[Option, ...] = ()
    commands: tuple[Command, ...] = ()


class _Found(BaseException):
    """Carries the parser out of `main`; not an error."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__()
        self.parser = parser


def command_tree(commands: Mapping[str, tuple[str, str]]) -> tuple[Command, ...]:
    """Every command of a mapping name -> (module, summary), as `jtqd.daemon.jtq.COMMANDS` is one."""
    return tuple(_command(name, module, summary) for name, (module, summary) in commands.items())


def from_parser(name: str, summary: str, parser: argparse.ArgumentParser) -> Command:
    """What an argument parser knows."""
    options, below = [], []
    formatter = argparse.HelpFormatter(parser.prog)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            texts = {each.dest: each.help or "" for each in action._choices_actions}
            below += [from_parser(key, texts.get(key, ""), each) for key, each in action.choices.items()]
        elif action.help != argparse.SUPPRESS:
            options.append(_option(action, formatter._expand_help(action) if action.help else ""))
    usage = parser.format_usage().removeprefix("usage: ")
    return Command(
        name, summary, usage, parser.description or "", parser.epilog or "", tuple(options), tuple(below)
    )


def _command(name: str, module_name: Any, summary: str) -> Command:
    if callable(module_name):
        parser = _parser_of(module_name)
        return Command(name, summary) if parser is None else from_parser(name, summary, parser)
    try:
        module: Any = importlib.import_module(module_name)
    except ImportError:
        return Command(name, summary)
    kinds = getattr(module, "KINDS", None)
    if isinstance(kinds, dict) and all(isinstance(each, tuple) and len(each) == 2 for each in kinds.values()):
        return Command(name, summary, epilog=_help_of(module.main), commands=command_tree(kinds))
    parser = _parser_of(module.main)
    return Command(name, summary) if parser is None else from_parser(name, summary, parser)


@contextmanager
def _handing_over() -> Iterator[None]:
    def hand_over(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        raise _Found(self)

    kept = argparse.ArgumentParser.parse_known_args
    argparse.ArgumentParser.parse_known_args = hand_over  # type: ignore[method-assign]
    try:
        yield
    finally:
        argparse.ArgumentParser.parse_known_args = kept  # type: ignore[method-assign]


def _parser_of(main: Callable[[list[str]], int]) -> argparse.ArgumentParser | None:
    try:
        with _handing_over(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            main([])
    except _Found as found:
        return found.parser
    except Exception:
        return None  # it does something else first, and fails: no options are better than no completion
    return None


def _help_of(main: Callable[[list[str]], int]) -> str:
    text = StringIO()
    with redirect_stdout(text):
        main(["--help"])
    return text.getvalue()


def _option(action: argparse.Action, text: str) -> Option:
    choices = tuple(map(str, action.choices)) if action.choices is not None else ()
    metavar = action.metavar if isinstance(action.metavar, str) else (action.dest or "").upper()
    takes_value = action.nargs != 0
    return Option(
        flags=tuple(action.option_strings),
        metavar=metavar if action.option_strings else (metavar if action.metavar else action.dest),
        help=" ".join(text.split()),
        value=_kind(action, metavar, choices) if takes_value else None,
        choices=choices,
        many=action.nargs in ("*", "+"),
    )


def _kind(action: argparse.Action, metavar: str, choices: tuple[str, ...]) -> str:
    if choices:
        return WORDS
    if action.dest == "bus":
        return BUSES
    if "DIR" in metavar.upper().split("_"):
        return DIRECTORIES
    is_path = action.type is Path or any(
        word in metavar.upper() for word in ("FILE", "RUN", "LOG", "YAML", "PATH")
    )
    return FILES if is_path or (not action.option_strings and action.type is None) else NOTHING
