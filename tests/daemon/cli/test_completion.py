"""Completion in bash, and what every command owes it: a parser with examples."""

import argparse
import importlib
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest

from jtqd.daemon import jtq, jtqd
from jtqd.daemon.cli.completion import SHELLS, complete_values, jtq_parser, main
from tests.paths import ROOT


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    below = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
    for action in below:
        for each in action.choices.values():
            yield from leaves(each)
    if not below:
        yield parser


@pytest.mark.parametrize("name", jtq.COMMANDS)
def test_every_command_has_a_parser_with_examples(name: str) -> None:
    module = importlib.import_module(jtq.COMMANDS[name][0])
    for leaf in leaves(module.parser()):
        assert leaf.prog.startswith(f"jtq {name}")
        assert "example" in (leaf.epilog or ""), f"{leaf.prog} --help has no example"
        assert f"jtq {name}" in (leaf.epilog or "")


def test_the_help_lists_every_command_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert jtq.main(["--help"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert [name for name in listed if name != "jtq"] == list(jtq.COMMANDS)
    assert all(len(text) < 80 and text[0].islower() for _, text in jtq.COMMANDS.values())


def test_values_are_files_directories_and_buses() -> None:
    parser = jtqd.parser()
    complete_values(parser, file="file", directory="directory", bus="bus")
    kinds = {each.dest: getattr(each, "complete", None) for each in parser._actions}
    assert {name: kind for name, kind in kinds.items() if kind} == {
        "bus": "bus",
        "config": "file",
        "record": "directory",
    }


@pytest.mark.parametrize("program", ["jtq", "jtqd"])
@pytest.mark.parametrize("shell", SHELLS)
def test_the_shell_accepts_the_script(shell: str, program: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([shell, program]) == 0
    script = capsys.readouterr().out
    assert len(script) > 500
    if shutil.which(shell) is None:
        return
    done = subprocess.run([shell, "-n"], input=script, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


CASES = [
    ("jtq sta", {"status"}),
    ("jtq fit lo", {"losses"}),
    ("jtq fit losses --joi", {"--joint"}),
    ("jtq status --o", {"--once"}),
    ("jtq status --bus s", {"sim"}),
    ("jtq sim --profile d", {"demo"}),
    ("jtq check --config pyproj", {"pyproject.toml"}),
    ("jtq doctor --record syst", {"systemd/"}),
    ("jtq completion z", {"zsh"}),
    ("jtqd --dur", {"--duration"}),
    ("jtqd --bus s", {"sim"}),
]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes(capsys: pytest.CaptureFixture[str]) -> None:
    lines = []
    for program in ("jtq", "jtqd"):
        assert main(["bash", program]) == 0
        lines.append(capsys.readouterr().out)
    for typed, _ in CASES:
        words = typed.split()
        lines += [
            f"COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; COMP_LINE='{typed}'; COMP_POINT={len(typed)}",
            f"COMPREPLY=(); _shtab_{words[0]} {words[0]} {words[-1]} {words[-2]} 2>/dev/null",
            'echo "${COMPREPLY[@]}"',
        ]
    done = subprocess.run(
        ["bash", "--norc", "-c", "\n".join(lines)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    found = {
        typed: set(answer.split()) for (typed, _), answer in zip(CASES, done.stdout.splitlines(), strict=True)
    }
    assert {typed: {each.rstrip("/") for each in answer} for typed, answer in found.items()} == {
        typed: {each.rstrip("/") for each in answer} for typed, answer in CASES
    }


def test_a_command_without_its_extra_is_left_without_options() -> None:
    parser = jtq_parser({"gone": ("jtqd.daemon.cli.no_such_module", "what it was")})
    (below,) = (each for each in parser._actions if isinstance(each, argparse._SubParsersAction))
    assert [action.dest for action in below.choices["gone"]._actions] == ["help"]


def test_without_shtab_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["bash"]) == 1
    assert "pip install 'jtqd[completion]'" in capsys.readouterr().err
