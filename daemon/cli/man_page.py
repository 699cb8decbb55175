"""Manual pages in roff from the tree of commands. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from jtqd.daemon.cli.parsers import Command, Option

_EXIT = (
    ("0", "done"),
    ("1", "failure; the line on standard error says which"),
    ("2", "usage"),
    ("3", "done, with findings, warnings or loss"),
)
_ENVIRONMENT = (
    (
        "RUNTIME_DIRECTORY, XDG_RUNTIME_DIR",
        "where jtqd keeps its shared memory (else /dev/shm), and jtq looks for it",
    ),
    ("LOGS_DIRECTORY", "where logs go unless --record says so (set by systemd)"),
)


def jtq_page(commands: Sequence[Command], version: str) -> str:
    """The page of jtq with every command."""
    parts = [
        *_head("JTQ", version, "jtq", "toolbox around jtqd, the joint torque estimator"),
        ".SH SYNOPSIS\n.B jtq\n.I COMMAND\n.RI [ options ]",
        ".SH DESCRIPTION\nEmulate the bench, run campaigns, fit and train models, replay and diagnose logs, and look",
        "after a running jtqd. Results go to standard output, everything else to standard error.",
        ".SH COMMANDS",
    ]
    for command in commands:
        parts += _section(command, "jtq")
    return "\n".join([*parts, *_tail("jtqd")]) + "\n"


def jtqd_page(command: Command, version: str) -> str:
    """The page of jtqd."""
    parts = [
        *_head("JTQD", version, "jtqd", "estimate the torque of two harmonic-drive joints on a CAN bus"),
        f".SH SYNOPSIS\n{_usage(command)}",
        f".SH DESCRIPTION\n{_text(command.description)}",
        ".SH OPTIONS",
        *map(_option, command.options),
        *_examples(command.epilog),
    ]
    return "\n".join([*parts, *_tail("jtq")]) + "\n"


def _head(title: str, version: str, name: str, purpose: str) -> list[str]:
    return [f'.TH {title} 1 "" "jtqd {version}" "jtqd manual"', f".SH NAME\n{name} \\- {purpose}"]


def _tail(other: str) -> list[str]:
    statuses = "\n".join(f".TP\n.B {code}\n{_text(meaning)}" for code, meaning in _EXIT)
    variables = "\n".join(f".TP\n.B {_text(name)}\n{_text(meaning)}" for name, meaning in _ENVIRONMENT)
    return [f".SH EXIT STATUS\n{statuses}", f".SH ENVIRONMENT\n{variables}", f".SH SEE ALSO\n.BR {other} (1)"]


def _section(command: Command, above: str) -> Iterator[str]:
    name = f"{above} {command.name}"
    yield f".SS {_text(name)}"
    yield _text(command.description or f"{command.summary[:1].upper()}{command.summary[1:]}.")
    if command.usage:
        yield f".PP\n{_usage(command)}"
    yield from map(_option, command.options)
    if command.commands:
        for each in command.commands:
            yield from _section(each, name)
    else:
        yield from _examples(command.epilog)


def _usage(command: Command) -> str:
    words = " ".join(command.usage.split())
    program = " ".join(words.split(" [", 1)[0].split(" -", 1)[0].split())
    return f".B {_text(program)}\n{_text(words.removeprefix(program).strip())}"


def _option(option: Option) -> str:
    value = f" \\fI{_text(option.metavar)}\\fR" if option.value is not None else ""
    names = (
        ", ".join(f"\\fB{_text(flag)}\\fR{value}" for flag in option.flags)
        or f"\\fI{_text(option.metavar)}\\fR"
    )
    choices = f" One of {', '.join(option.choices)}." if option.choices and "{" not in option.metavar else ""
    return f".TP\n{names}\n{_text(option.help + choices)}"


def _examples(epilog: str) -> Iterator[str]:
    if epilog.strip():
        body = "\n".join(_text(line) or "\\&" for line in epilog.strip().splitlines())
        yield f".PP\n.EX\n{body}\n.EE"


def _text(text: str) -> str:
    """Nothing in it is a request or an escape to roff."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\n".join(f"\\&{line}" if line[:1] in (".", "'") else line for line in text.splitlines())
