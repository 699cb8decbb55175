"""Completion scripts for bash, zsh and fish from the tree of commands. Static: no key starts Python. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from jtqd.daemon.cli.parsers import BUSES, DIRECTORIES, FILES, WORDS, Command, Option

_BUSES = (
    'for each in /sys/class/net/*; do [ "$(cat $each/type 2>/dev/null)" = 280 ] && echo ${each##*/}; done; '
    "echo sim; echo unix:"
)
"""Names of the CAN interfaces (ARPHRD_CAN), and what else --bus takes."""
_HEAD = "# {shell} completion of jtq and jtqd; made by `jtq completion {shell}`"


def bash(jtq: Sequence[Command], jtqd: Command) -> str:
    """Script for bash 4 or later; needs no other package."""
    cases = [_bash_case(path, command) for path, command in _leaves(jtq)]
    return f"""{_HEAD.format(shell="bash")}
_jtq_buses() {{
    {_BUSES}
}}

_jtq_values() {{  # KIND CURRENT [WORDS]
    case "$1" in
        files) local IFS=$'\\n'; compopt -o filenames 2>/dev/null; COMPREPLY=( $(compgen -f -- "$2") ) ;;
        directories) local IFS=$'\\n'; compopt -o filenames 2>/dev/null; COMPREPLY=( $(compgen -d -- "$2") ) ;;
        buses) COMPREPLY=( $(compgen -W "$(_jtq_buses)" -- "$2") ) ;;
        words) COMPREPLY=( $(compgen -W "$3" -- "$2") ) ;;
    esac
}}

_jtq() {{
    local IFS=$' \\t\\n' current="${{COMP_WORDS[COMP_CWORD]}}" previous="${{COMP_WORDS[COMP_CWORD-1]}}" path="" word
    COMPREPLY=()
    if [ "${{1##*/}}" = jtqd ]; then
        path="jtqd"
    else
        for word in "${{COMP_WORDS[@]:1:COMP_CWORD-1}}"; do
            case "$path $word" in
{_bash_paths(jtq)}
            esac
        done
    fi
    case "$path" in
        "") _jtq_values words "$current" "{_names(jtq)} --help" ;;
{chr(10).join(_bash_group(path, command) for path, command in _groups(jtq))}
{chr(10).join(cases)}
{_bash_case("jtqd", jtqd)}
    esac
}}
complete -F _jtq jtq jtqd
"""


def zsh(jtq: Sequence[Command], jtqd: Command) -> str:
    """Script for zsh: a file `_jtq` in a directory of $fpath, or `source <(jtq completion zsh)` after compinit."""
    functions = [_zsh_function("_jtq", jtq)]
    functions += [_zsh_function(f"_jtq_{_word(path)}", command.commands) for path, command in _groups(jtq)]
    functions += [_zsh_leaf(f"_jtq_{_word(path)}", command) for path, command in _leaves(jtq)]
    functions.append(_zsh_leaf("_jtqd", jtqd))
    return f"""#compdef jtq jtqd
{_HEAD.format(shell="zsh")}
_jtq_buses() {{
    local -a buses
    buses=( $({_BUSES.replace("sim; echo unix:", "sim")}) )
    compadd -- $buses
    compadd -S '' -- unix:
}}
{chr(10).join(functions)}
_jtq_any() {{
    case $service in
        jtqd) _jtqd "$@" ;;
        *) _jtq "$@" ;;
    esac
}}
if [ "$funcstack[1]" = _jtq ]; then
    _jtq_any "$@"
else
    compdef _jtq_any jtq jtqd
fi
"""


def fish(jtq: Sequence[Command], jtqd: Command) -> str:
    """Script for fish: ~/.config/fish/completions/jtq.fish."""
    lines = [
        _HEAD.format(shell="fish"),
        "function __jtq_buses",
        "    for each in /sys/class/net/*",
        "        test (cat $each/type 2>/dev/null; or echo 0) = 280; and path basename $each",
        "    end",
        "    echo sim",
        "    echo unix:",
        "end",
        "complete -c jtq -f",
    ]
    lines += [
        f"complete -c jtq -n __fish_use_subcommand -a {each.name} -d {_quoted(each.summary)}" for each in jtq
    ]
    for path, command in _groups(jtq):
        names = _names(command.commands)
        under = f"'__fish_seen_subcommand_from {path}; and not __fish_seen_subcommand_from {names}'"
        lines += [
            f"complete -c jtq -n {under} -a {each.name} -d {_quoted(each.summary)}"
            for each in command.commands
        ]
    for path, command in _leaves(jtq):
        words = path.split()
        under = "'" + "; and ".join(f"__fish_seen_subcommand_from {word}" for word in words) + "'"
        lines += [_fish_line("jtq", under, option) for option in command.options]
    lines += [_fish_line("jtqd", "", option) for option in jtqd.options]
    return "\n".join(lines) + "\n"


def _leaves(commands: Sequence[Command], above: str = "") -> Iterator[tuple[str, Command]]:
    for command in commands:
        path = f"{above} {command.name}".strip()
        if command.commands:
            yield from _leaves(command.commands, path)
        else:
            yield path, command


def _groups(commands: Sequence[Command], above: str = "") -> Iterator[tuple[str, Command]]:
    for command in commands:
        if command.commands:
            path = f"{above} {command.name}".strip()
            yield path, command
            yield from _groups(command.commands, path)


def _names(commands: Sequence[Command]) -> str:
    return " ".join(command.name for command in commands)


def _word(path: str) -> str:
    return path.replace(" ", "_").replace("-", "_")


def _quoted(text: str) -> str:
    """For a POSIX shell's and fish's single quotes."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _flags(command: Command) -> str:
    return " ".join(flag for option in command.options for flag in option.flags) or "--help"


def _positional(command: Command) -> Option | None:
    return next((option for option in command.options if not option.flags and option.value), None)


# bash -------------------------------------------------------------------------------------------------------


def _bash_paths(commands: Sequence[Command], above: str = "") -> str:
    lines = []
    for command in commands:
        path = f"{above} {command.name}".strip()
        lines.append(f'                "{above} {command.name}") path="{path}" ;;')
        if command.commands:
            lines.append(_bash_paths(command.commands, path))
    return "\n".join(lines)


def _bash_group(path: str, command: Command) -> str:
    return f'        "{path}") _jtq_values words "$current" "{_names(command.commands)} --help" ;;'


def _bash_case(path: str, command: Command) -> str:
    lines = [f'        "{path}")', '            case "$previous" in']
    for option in command.options:
        if option.flags and option.value is not None:
            words = f' "{" ".join(option.choices)}"' if option.choices else ""
            lines.append(
                f'                {"|".join(option.flags)}) _jtq_values {option.value} "$current"{words}; return ;;'
            )
    positional = _positional(command)
    lines += [
        "            esac",
        '            case "$current" in',
        f'                -*) _jtq_values words "$current" "{_flags(command)}" ;;',
    ]
    if positional is not None:
        words = f' "{" ".join(positional.choices)}"' if positional.choices else ""
        lines.append(f'                *) _jtq_values {positional.value} "$current"{words} ;;')
    else:
        lines.append(f'                "") _jtq_values words "" "{_flags(command)}" ;;')
    return "\n".join([*lines, "            esac ;;"])


# zsh --------------------------------------------------------------------------------------------------------


def _zsh_text(text: str) -> str:
    for special in "\\[]:":
        text = text.replace(special, "\\" + special)
    return text.replace("'", "'\\''")


def _zsh_function(name: str, commands: Sequence[Command]) -> str:
    entries = "\n".join(
        f"        '{_zsh_text(each.name)}:" + each.summary.replace("'", "'\\''") + "'" for each in commands
    )
    cases = "\n".join(f"        {each.name}) {name}_{_word(each.name)} ;;" for each in commands)
    return f"""{name}() {{
    local -a commands
    commands=(
{entries}
    )
    if (( CURRENT == 2 )); then
        _describe -t commands command commands
        return
    fi
    shift words
    (( CURRENT-- ))
    case $words[1] in
{cases}
    esac
}}"""


def _zsh_action(option: Option) -> str:
    return {
        FILES: "_files",
        DIRECTORIES: "_files -/",
        BUSES: "_jtq_buses",
        WORDS: "(" + " ".join(option.choices) + ")",
    }.get(option.value or "", " ")


def _zsh_leaf(name: str, command: Command) -> str:
    lines = []
    for option in command.options:
        value = f":{_zsh_text(option.metavar)}:{_zsh_action(option)}" if option.value is not None else ""
        if option.flags:
            exclusive = f"({' '.join(option.flags)})" if len(option.flags) > 1 else ""
            lines += [f"'{exclusive}{flag}[{_zsh_text(option.help)}]{value}'" for flag in option.flags]
        else:
            lines.append(f"'{'*' if option.many else ''}{value}'" if option.many else f"'{value}'")
    body = " \\\n        ".join(["_arguments -s", *lines])
    return f"{name}() {{\n    {body}\n}}"


# fish -------------------------------------------------------------------------------------------------------


def _fish_line(program: str, under: str, option: Option) -> str:
    parts = ["complete", "-c", program] + (["-n", under] if under else [])
    for flag in option.flags:
        parts += ["-l", flag[2:]] if flag.startswith("--") else ["-s", flag[1:]]
    if option.value == FILES:
        parts += ["-r", "-F"]
    elif option.value == DIRECTORIES:
        parts += ["-x", "-a", "'(__fish_complete_directories)'"]
    elif option.value == BUSES:
        parts += ["-x", "-a", "'(__jtq_buses)'"]
    elif option.value == WORDS:
        parts += ["-x", "-a", _quoted(" ".join(option.choices))]
    elif option.value is not None and option.flags:
        parts.append("-x")
    return " ".join([*parts, "-d", _quoted(option.help)])
