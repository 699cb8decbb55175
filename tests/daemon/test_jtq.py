"""`jtq`: version, unknown commands, and how it ends: a closed pipe, Ctrl-C; options before a log."""

import argparse
import importlib
import importlib.util
import itertools
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import jtqd
from jtqd.daemon import jtq
from jtqd.daemon import jtqd as daemon
from jtqd.estimator.command_line import command_parser
from tests.paths import GOLDEN

LOG = GOLDEN / "network.mcap"


@pytest.mark.parametrize("main", [jtq.main, daemon.main], ids=["jtq", "jtqd"])
def test_both_programs_print_one_version(main, capsys):
    try:
        status = main(["--version"])
    except SystemExit as ended:
        status = ended.code
    assert (status, capsys.readouterr().out) == (0, f"jtqd {jtqd.__version__}\n")


@pytest.mark.parametrize("module", sorted({*(m for m, _ in jtq.COMMANDS.values()), *jtq.FORMS.values()}))
def test_the_module_of_a_command_is_a_program(module):
    """`python -m` of a module that does nothing and exits with 0 would look like success."""
    path = importlib.util.find_spec(module).origin
    assert 'if __name__ == "__main__":\n' in Path(path).read_text()


def test_a_module_that_is_run_without_arguments_is_a_usage_error():
    command = [sys.executable, "-m", "jtqd.sysid.diagnosis.command"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")


def test_an_unknown_command_is_answered_with_its_neighbour(capsys):
    assert jtq.main(["stauts"]) == 2
    assert (
        capsys.readouterr().err
        == "jtq: no command 'stauts'; did you mean 'status'? (jtq --help lists them)\n"
    )
    assert jtq.main([]) == 2


HELP = """
import contextlib, importlib, io, sys
import jtqd.daemon.jtq as jtq
heavy = {"scipy", "matplotlib", "torch", "onnxruntime", "pyarrow", "jinja2", "distributed", "foxglove", "cyclonedds"}
for name, (module, _) in [*jtq.COMMANDS.items(), *((form, (module, "")) for form, module in jtq.FORMS.items())]:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        importlib.import_module(module).main(["--help"])
    if not out.getvalue().startswith("usage: jtq ") or heavy & set(sys.modules):
        sys.exit(f"{name}: {heavy & set(sys.modules)}")
"""


def test_no_help_loads_a_large_library():
    """They take a second of processor; arguments are parsed before what needs them is imported."""
    done = subprocess.run(
        [sys.executable, "-c", HELP], capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")


def _parsers():
    """The parsers of all commands, and of all below them."""
    modules = [module for module, _ in jtq.COMMANDS.values()] + [*jtq.FORMS.values()]
    waiting = [daemon.parser(), *(importlib.import_module(module).parser() for module in modules)]
    for parser in waiting:
        yield parser
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                waiting += action.choices.values()


def test_no_help_is_wider_than_a_terminal(monkeypatch):
    """Of 80 columns, which nobody has drawn larger; the lines of examples too."""
    columns = 80
    monkeypatch.setenv("COLUMNS", str(columns))
    helps = [(parser.prog, parser.format_help()) for parser in _parsers()]
    assert len(helps) > len(jtq.COMMANDS) + 5, "subcommands are among them"
    wide = [f"{prog}: {line}" for prog, text in helps for line in text.splitlines() if len(line) > columns]
    assert wide == []
    assert max(map(len, jtq._help().splitlines())) <= columns


def test_no_command_takes_an_empty_name_for_the_directory_it_is_in():
    """What `--out "$OUT"` gives where OUT is not set."""
    files = [(each, action) for each in _parsers() for action in each._actions if action.type is Path]
    assert len(files) > 40
    for each, action in files:
        with pytest.raises(argparse.ArgumentError):
            print(each.prog, action.dest, each._get_value(action, ""))
        assert each._get_value(action, "a/b") == Path("a/b")


def test_a_command_that_goes_on_below_is_still_one_command():
    folded = command_parser(
        "x", "", "  jtq init --bus can0 " + "--node 1 " * 12 + "  all of them\n"
    ).format_help()
    command = folded.partition("  jtq")[2].rpartition("\n")[0]
    assert (
        "jtq" + command.replace(" \\\n      ", " ").partition("\n")[0]
        == "jtq init --bus can0" + " --node 1" * 12
    )
    assert command.endswith("\n      all of them")


def test_an_option_can_have_a_module_of_its_own(capsys):
    for arguments, words in (
        (["--help"], "--bus BUS"),
        (["--from-csv", "x", "--help"], "usage: jtq init --from-csv"),
    ):
        with pytest.raises(SystemExit):
            jtq.main(["init", *arguments])
        assert words in capsys.readouterr().out
    assert jtq.main(["init", "--from-c", "x", "--out", "y"]) == 2
    assert "--from-csv: write it in full" in capsys.readouterr().err


def test_a_missing_extra_is_one_line_and_a_missing_module_of_ours_is_not(monkeypatch, capsys):
    for package, extra in (("torch", "train"), ("scipy", "analysis")):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.setitem(jtq.COMMANDS, "fit", (f"{package}.command", ""))
        assert jtq.main(["fit"]) == 1
        assert (
            capsys.readouterr().err == f"jtq fit: {package} is not installed: pip install 'jtqd[{extra}]'\n"
        )
    monkeypatch.setitem(jtq.COMMANDS, "fit", ("jtqd.no_such_module", ""))
    with pytest.raises(ModuleNotFoundError):
        jtq.main(["fit"])


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def test_a_closed_pipe_ends_it_silently():
    with started("export", "candump", LOG) as process:
        lines = list(itertools.islice(process.stdout, 2))
        process.stdout.close()
        assert len(lines) == 2
        assert process.stderr.read() == b""
        assert process.wait(30) == 1


def test_ctrl_c_ends_it_silently(tmp_path):
    """While it waits for a pipe that nobody empties."""
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with started("export", "csv", LOG, "--out", pipe, "--all-cycles") as process:
        assert select.select([end], [], [], 30)[0]
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)
        os.close(end)
        assert process.communicate(timeout=30) == (b"", b"")
        assert process.returncode == 130


def test_options_may_stand_before_the_log(tmp_path):
    out = tmp_path / "a.csv"
    with started("export", "csv", "--out", out, "--all-cycles", LOG) as process:
        assert process.communicate(timeout=30)[1] == b""
        assert process.returncode == 0
    assert out.stat().st_size > 1000


@pytest.mark.parametrize(
    "command", [["--help"], ["bus-load"], ["campaign", "validate", "--quick", "--dry-run"]]
)
def test_closed_or_full_output_is_no_traceback(command):
    jtq = [sys.executable, "-m", "jtqd.daemon.jtq", *command]
    for place, status in ((">&-", 0), ("> /dev/full", 1)):
        done = subprocess.run(
            ["sh", "-c", f'"$@" {place}', "sh", *jtq], capture_output=True, text=True, check=False
        )
        assert done.returncode == status, done.stderr
        assert done.stderr == ("" if status == 0 else f"jtq {command[0]}: output: No space left on device\n")
