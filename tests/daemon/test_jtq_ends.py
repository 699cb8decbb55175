"""How `jtq` ends when somebody does not want more of it: a closed pipe, Ctrl-C; and options before a log."""

import itertools
import os
import select
import signal
import subprocess
import sys
import time

from tests.paths import GOLDEN

LOG = GOLDEN / "network.mcap"


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )


def test_a_closed_pipe_is_no_word():
    with started("export", "candump", LOG) as process:
        lines = list(itertools.islice(process.stdout, 2))
        process.stdout.close()
        assert len(lines) == 2
        assert process.stderr.read() == b""
        assert process.wait(30) == 1


def test_ctrl_c_is_no_word(tmp_path):
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
