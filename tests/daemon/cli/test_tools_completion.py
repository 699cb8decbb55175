"""Completion in the real shells, manual pages through groff, and examples in the help of every command."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jtqd.daemon import jtq, jtqd
from jtqd.daemon.cli.completion import bash, fish, zsh
from jtqd.daemon.cli.completion_command import main
from jtqd.daemon.cli.man_page import jtq_page, jtqd_page
from jtqd.daemon.cli.parsers import (
    BUSES,
    DIRECTORIES,
    FILES,
    NOTHING,
    WORDS,
    Command,
    command_tree,
    from_parser,
)
from tests.paths import ROOT


@pytest.fixture(scope="module")
def tree() -> tuple[Command, ...]:
    return command_tree(jtq.COMMANDS)


def leaves(commands: tuple[Command, ...]) -> list[Command]:
    return [leaf for each in commands for leaf in (leaves(each.commands) if each.commands else [each])]


def test_every_command_tells_its_options_and_has_examples(tree: tuple[Command, ...]) -> None:
    assert [each.name for each in tree] == list(jtq.COMMANDS)
    for command in leaves(tree):
        assert command.options, f"{command.name}: its main() does something before it parses its arguments"
        assert "example" in command.epilog, f"jtq {command.name} --help has no example"
        assert "jtq " in command.epilog


def test_options_know_what_their_values_are(tree: tuple[Command, ...]) -> None:
    named = {each.name: each for each in leaves(tree)}
    options = {flag: option for option in named["check"].options for flag in option.flags}
    assert options["--bus"].value == BUSES
    assert options["--config"].value == FILES
    assert options["--json"].value is None
    (positional,) = (each for each in named["check"].options if not each.flags)
    assert positional.value == NOTHING, "a number"
    (shell,) = (each for each in named["completion"].options if not each.flags)
    assert (shell.value, shell.choices) == (WORDS, ("bash", "zsh", "fish"))
    record = next(each for each in from_parser("jtqd", "", jtqd.parser()).options if "--record" in each.flags)
    assert record.value == DIRECTORIES


CASES = [
    ("jtq sta", {"status"}),
    ("jtq fit lo", {"losses"}),
    ("jtq fit losses --joi", {"--joint"}),
    ("jtq status --o", {"--once"}),
    ("jtq status --bus s", {"sim"}),
    ("jtq sim --profile d", {"demo"}),
    ("jtq check --config pyproj", {"pyproject.toml"}),
    ("jtq doctor --record syst", {"systemd"}),
    ("jtq completion z", {"zsh"}),
    ("jtqd --dur", {"--duration"}),
    ("jtq check --drive-sync --j", {"--json"}),
]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash(tmp_path: Path, tree: tuple[Command, ...]) -> None:
    script = tmp_path / "jtq.bash"
    script.write_text(bash(tree, from_parser("jtqd", "", jtqd.parser())))
    lines = [f"source {script}", "complete -p jtq jtqd"]
    for typed, _ in CASES:
        words = typed.split()
        lines += [
            f"COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; COMPREPLY=(); _jtq {words[0]}",
            'echo "${COMPREPLY[@]}"',
        ]
    done = subprocess.run(
        ["bash", "--norc", "-c", "\n".join(lines)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    registered, *answers = done.stdout.splitlines()[1:]
    assert registered == "complete -F _jtq jtqd"
    assert {typed: set(answer.split()) for (typed, _), answer in zip(CASES, answers, strict=True)} == dict(
        CASES
    )


@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish")
def test_fish(tmp_path: Path, tree: tuple[Command, ...]) -> None:
    script = tmp_path / "jtq.fish"
    script.write_text(fish(tree, from_parser("jtqd", "", jtqd.parser())))
    lines = [f"source {script}"] + [f'echo "@@"; complete -C "{typed}"' for typed, _ in CASES]
    done = subprocess.run(
        ["fish", "--no-config", "-c", "\n".join(lines)],
        cwd=ROOT,
        env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    answers = done.stdout.split("@@\n")[1:]
    found = {
        typed: {line.split("\t")[0].rstrip("/") for line in answer.splitlines()}
        for (typed, _), answer in zip(CASES, answers, strict=True)
    }
    assert found == dict(CASES)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh")
def test_zsh(tmp_path: Path, tree: tuple[Command, ...]) -> None:
    """zsh completes only where it edits a line: keys are typed into one through its own pseudo-terminal."""
    (tmp_path / "_jtq").write_text(zsh(tree, from_parser("jtqd", "", jtqd.parser())))
    cases = [(typed, " ".join([*typed.split()[:-1], *expected])) for typed, expected in CASES[:6]]
    driver = tmp_path / "driver.zsh"
    keys = "".join(
        f"zpty -w -n shell $'{typed}\\t'\nzpty -r -m shell line '*{whole}*' && print -r -- '{whole}'\n"
        "zpty -w -n shell $'\\x15'\n"
        for typed, whole in cases
    )
    driver.write_text(
        "zmodload zsh/zpty\nzpty shell zsh -f -i\n"
        f"zpty -w shell \"PS1='' ; cd {ROOT}; fpath=({tmp_path} \\$fpath); autoload -U compinit; compinit -D -u\"\n"
        "zpty -w shell 'print REA''DY'\nzpty -r -m shell line '*READY*'\n" + keys
    )
    done = subprocess.run(
        ["zsh", "-f", str(driver)],
        env={**os.environ, "TERM": "dumb", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,  # a completion that never comes ends here
        check=False,
    )
    assert done.stdout.splitlines() == [whole for _, whole in cases]


def test_the_command_prints_a_script_that_bash_accepts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bash"]) == 0
    script = capsys.readouterr().out
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
    with pytest.raises(SystemExit):
        main(["tcsh"])


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff")
@pytest.mark.parametrize("page", ["jtq", "jtqd"])
def test_manual_pages_are_roff_without_a_warning(page: str, tree: tuple[Command, ...]) -> None:
    text = jtq_page(tree, "0") if page == "jtq" else jtqd_page(from_parser("jtqd", "", jtqd.parser()), "0")
    done = subprocess.run(
        ["groff", "-man", "-ww", "-Tutf8", "-P-c"], input=text, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    for wanted in ("--bus BUS", "EXIT STATUS", "examples:"):
        assert wanted in " ".join(done.stdout.replace("\x08", "").split()) or wanted in unstruck(done.stdout)
    if page == "jtq":
        assert all(f"jtq {name}" in unstruck(done.stdout) for name in jtq.COMMANDS)


def unstruck(text: str) -> str:
    """Without the overstriking that stands for bold and underlined."""
    result: list[str] = []
    for char in text:
        if char == "\x08":
            result.pop()
        else:
            result.append(char)
    return "".join(result)


def test_a_command_whose_module_is_missing_is_left_without_options() -> None:
    (command,) = command_tree({"gone": ("jtqd.daemon.cli.no_such_module", "what it was")})
    assert (command.summary, command.options) == ("what it was", ())
    assert sys.modules.get("jtqd.daemon.cli.no_such_module") is None
