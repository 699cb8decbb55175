"""`jtq status`: the view at any width and its parts; no daemon, several, one that stands still."""

import io
import json
import os
import pty
import select
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from math import nan
from pathlib import Path

import pytest
from rich.console import Console, Group
from rich.text import Text

from jtqd.daemon.cli.running import find_daemons
from jtqd.daemon.cli.status import WINDOW_S, Recent, StatusView, histogram, main, paged, sparkline
from jtqd.daemon.live.reading import Reading, Watch, content
from jtqd.daemon.recording.run_files import Account, ProgressFile
from jtqd.daemon.shared.conditions import Condition, ConditionsFile
from jtqd.daemon.shared.cycle_record import SHADOW
from jtqd.daemon.shared.events import ERROR, WARNING, Notices
from jtqd.daemon.shared.runtime_dir import start_ticks, write_about
from jtqd.daemon.shared.snapshot import SnapshotReader
from tests.daemon.cli.status_daemon import picture, running
from tests.daemon.supervisor.watch_views import WELL, view

Status = Callable[..., tuple[int, str, str]]


@pytest.fixture
def status(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Status:
    """`jtq status` in this process: exit status, standard output, standard error."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.setattr("jtqd.daemon.cli.running._SHARED", ())
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("COLUMNS", "80")

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main(list(arguments))
        return code, *capsys.readouterr()

    return run


@pytest.mark.parametrize("width", [80, 100, 140])
def test_the_picture_shows_everything_and_fits(tmp_path: Path, width: int) -> None:
    log = tmp_path / "logs"
    log.mkdir()
    daemon = running(tmp_path, log=log)
    (log / "jtqd-vcan0-20260101T000000Z.mcap.active").write_bytes(bytes(1_500_000))
    (log / "jtqd-other-20260101T000000Z.mcap.active").write_bytes(bytes(9_000_000))
    ProgressFile(daemon.directory / "recorded").store(Account(8000, 7990, 10, 0))
    notices = Notices(daemon.directory / "notices")
    for n in range(6):
        notices.add(WARNING, "heartbeat", 2, f"node 2: no heartbeat for 0.{n} s")
    text = picture(daemon, width)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    assert "…" not in text
    for wanted in (
        *("-117.94 Nm", "0.48 Nm", "-118.48 Nm", "3.21 A", "31.5 °C", "valid"),
        "joint 2 stale for 8 ms: node 2 is silent: no heartbeat for 2.0 s",
        *("335 us", "330..360 us", "never", "2.3 s"),
        *(
            "p50 204  p99 204  max 301 us",
            "3 of 8003 cycles, an input missing in 10",
            "84.8 % by configuration",
        ),
        *("operational", "silent, last operational", "no heartbeat yet"),
        *("7990 cycles written, 10 lost, 1.5 MB in this file", "free of"),
        "stale inputs 12",
        "node 2: no heartbeat for 0.5 s",
    ):
        assert wanted in " ".join(text.split()) or wanted in text, wanted
    assert ("100.0 %" in text) == ("-155.2 rad/s" in text) == (width >= 100), "where there is room"
    reported = [line.strip() for line in text.splitlines() if line.startswith("no room for: ")]
    assert any(line.endswith("motor, with a torque") for line in reported) == (width < 100), (
        "and reported where not"
    )
    assert (reported == []) == (width >= 140)


@pytest.mark.parametrize("width", [54, 66, 78])
def test_nothing_is_cut_in_a_narrow_terminal(tmp_path: Path, width: int) -> None:
    text = picture(running(tmp_path), width)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    assert "…" not in text
    assert "-117.94 Nm" in text
    assert "stale" in text


def test_a_loop_that_stands_still_shows_no_old_torque(tmp_path: Path, status: Status) -> None:
    daemon = running(tmp_path, cycling=False)
    text = picture(daemon, 80)
    assert f"NOT RUNNING: the loop (process {os.getpid()}) is" in text
    assert "no cycle for 10.0 s" in text
    assert "-117.94" not in text
    code, out, _ = status("--json")
    content = json.loads(out)
    assert (code, content["state"], content["joints"][0]["torque_nm"]) == (3, "still", None)


def test_json_holds_what_the_picture_shows(tmp_path: Path, status: Status) -> None:
    running(tmp_path)
    code, out, _ = status("--json")
    content = json.loads(out)
    assert (code, content["schema"], content["state"]) == (0, "jtq.status/1", "running")
    one, two = content["joints"]
    assert (one["torque_nm"], one["status"], one["current_a"], one["temperature_c"]) == (
        -117.94,
        "valid",
        3.21,
        31.5,
    )
    assert (two["torque_nm"], two["status"], two["cycles"]) == (None, "stale", {"stale": 8000})
    assert "node 2 is silent" in two["reason"]
    assert [each["age_s"] for each in content["inputs"]] == [0.0, 0.0, None, pytest.approx(2.345), 0.0]
    assert content["recorder"] is None
    assert content["notices"] == []
    assert content["counters"]["missed"] == 3


def test_none_one_and_several(tmp_path: Path, status: Status) -> None:
    assert status("--once") == (1, "", "jtq status: no jtqd runs on this machine\n")
    running(tmp_path, "vcan0")
    assert status("--once")[0] == 0
    assert "vcan1" in status("--once", "--bus", "vcan1")[2]
    running(tmp_path, "vcan1")
    code, _, printed = status("--once")
    assert code == 2
    assert printed.splitlines()[0] == "jtq status: several daemons run; select one with --bus:"
    assert [line.split()[:2] for line in printed.splitlines()[1:]] == [["--bus", "vcan0"], ["--bus", "vcan1"]]
    assert status("--once", "--bus", "vcan1")[0] == 0


def test_a_daemon_that_is_booting_and_one_that_was_killed(tmp_path: Path, status: Status) -> None:
    daemon = running(tmp_path)
    (daemon.directory / "snapshot").unlink()
    code, out, _ = status("--once")
    assert code == 3
    assert "booting its nodes" in out
    content = json.loads((daemon.directory / "about.json").read_text())
    content["pid"] = subprocess.run(["true"], check=True).returncode + 2**22 - 3  # nobody's
    (daemon.directory / "about.json").write_text(json.dumps(content))
    found = find_daemons([tmp_path])
    assert (found.daemons, found.abandoned) == ((), (daemon.directory,))
    content |= {"pid": os.getpid(), "started_ticks": 1}
    (daemon.directory / "about.json").write_text(json.dumps(content))
    assert find_daemons([tmp_path]).daemons == (), "another process got its number"
    assert status("--once")[0] == 1


def test_lines_where_there_is_no_terminal(tmp_path: Path) -> None:
    running(tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "status", "--bus", "vcan0"],
        env={**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(2)]
    process.terminate()
    process.communicate()
    assert all(line.startswith("joint 1 valid -117.94 +- 0.48 Nm") for line in lines)
    assert not any("\x1b" in line for line in lines)


def test_the_live_view_on_a_terminal_outlives_its_daemon_and_ends_by_ctrl_c(tmp_path: Path) -> None:
    daemon = running(tmp_path)
    sleeper = subprocess.Popen(["sleep", "60"])
    write_about(
        daemon.directory, replace(daemon.about, pid=sleeper.pid, started_ticks=start_ticks(sleeper.pid) or 0)
    )
    child, terminal = pty.fork()
    if not child:
        os.environ |= {"RUNTIME_DIRECTORY": str(tmp_path), "TERM": "xterm", "COLUMNS": "90", "LINES": "40"}
        os.execv(sys.executable, [sys.executable, "-m", "jtqd.daemon.jtq", "status", "--bus", "vcan0"])
    shown = until(terminal, "-117.94 Nm")
    assert "\x1b[?1049h" in shown, "the alternate screen: what was there before comes back"
    assert "Ctrl-C ends this view" in shown or "Ctrl-C ends this view" in until(terminal, "Ctrl-C")
    sleeper.kill()
    sleeper.wait()
    until(terminal, "jtqd on vcan0 has ended; waiting for its restart")
    write_about(daemon.directory, daemon.about)
    until(terminal, "-117.94 Nm")
    os.write(terminal, b"\x03")
    until(terminal, "\x1b[?1049l")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    os.close(terminal)


def test_a_loop_that_died_in_its_first_write_stands_still_and_is_not_shown(tmp_path: Path) -> None:
    daemon = running(tmp_path)
    SnapshotReader(daemon.directory / "snapshot", supervisor=True)._views.sequence[0] = 1
    found = Watch(daemon).read()
    assert (found.state, found.view) == ("still", None)
    assert "not read" in found.why
    assert "in one write" in picture(daemon, 80)


def test_no_line_is_dropped_on_a_small_terminal(tmp_path: Path) -> None:
    """All pages together hold every line of the picture, each fits, and the line below states how many there are."""
    console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True)
    reading = Watch(running(tmp_path)).read()
    recent = Recent()
    recent.add(0.0, reading)
    picture = StatusView(replace(reading, earlier=reading.view), recent)
    console.print(picture)
    whole = Text.from_ansi(console.file.getvalue()).plain.splitlines()
    assert len(whole) > 24
    seen, number = [], 0
    while True:
        console.file = io.StringIO()
        shown, place = paged(console, picture, number)
        console.print(shown)
        lines = Text.from_ansi(console.file.getvalue()).plain.splitlines()
        if number and not place:
            break
        assert len(lines) <= 24
        assert f"page {number + 1} of " in lines[-1]
        assert "SPACE" in lines[-1]
        seen += lines[:-2]
        number += 1
    assert [line.rstrip() for line in seen] == [line.rstrip() for line in whole]


def test_space_turns_the_page_on_a_terminal(tmp_path: Path) -> None:
    daemon = running(tmp_path)
    write_about(daemon.directory, daemon.about)
    child, terminal = pty.fork()
    if not child:
        os.environ |= {"RUNTIME_DIRECTORY": str(tmp_path), "TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
        os.execv(sys.executable, [sys.executable, "-m", "jtqd.daemon.jtq", "status", "--bus", "vcan0"])
    until(terminal, "page 1 of ")
    os.write(terminal, b" ")
    until(terminal, "page 2 of ")
    os.write(terminal, b"\x03")
    until(terminal, "\x1b[?1049l")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    os.close(terminal)


def until(terminal: int, wanted: str) -> str:
    """What the terminal shows up to there; a wait of 60 s is a failure."""
    shown, deadline = "", time.monotonic() + 60
    while wanted not in shown:
        assert time.monotonic() < deadline, (wanted, shown[-2000:])
        if select.select([terminal], [], [], 1.0)[0]:
            shown += os.read(terminal, 65536).decode(errors="replace")
    return shown


def test_what_is_wrong_now_is_shown_with_its_age(tmp_path: Path, status: Status) -> None:
    daemon = running(tmp_path)
    since = time.monotonic_ns() - 3_000_000_000
    lost = Condition("node_lost", "node 2", ERROR, "no heartbeat for 0.3 s", since)
    ConditionsFile(daemon.directory).write([lost])
    assert "node 2: no heartbeat for 0.3 s (for 3" in picture(daemon, 100)
    (shown,) = json.loads(status("--json")[1])["conditions"]
    assert shown.pop("for_s") == pytest.approx(3.0, abs=1.0)
    assert shown == {
        "name": "node_lost",
        "subject": "node 2",
        "severity": "error",
        "text": "no heartbeat for 0.3 s",
    }


def test_the_controller_is_shown(tmp_path: Path) -> None:
    daemon = running(tmp_path)
    assert "bus state" not in picture(daemon, 80)
    counts = {"protocol_errors": 2, "no_acknowledge": 1, "overruns": 0, "bus_offs": 0}
    content = {"state": "error passive", "counts": counts}
    (daemon.directory / "bus.json").write_text(json.dumps(content))
    text = " ".join(picture(daemon, 80).split())
    assert "bus state error passive, 3 error frames" in text


def test_a_sparkline_spans_its_values_and_leaves_gaps():
    assert sparkline([0, 7], 10) == "▁█"
    assert sparkline([-1, nan, 1], 10) == "▁ █"
    assert sparkline([5, 5, 5], 10) == "▁▁▁"
    assert sparkline([nan, nan], 10) == "  "
    assert sparkline([], 10) == ""
    assert sparkline(range(100), 8) == "▁▂▃▄▅▆▇█", "the newest"


def reading(work, late=(0, 0, 0), torque=0.0):
    joints = (WELL._replace(torque_nm=torque),) * 2
    return Reading(None, "running", "", view(8)._replace(joints=joints), work=tuple(work), late=tuple(late))


def test_a_slow_cycle_of_long_ago_is_forgotten():
    recent = Recent()
    recent.add(0.0, reading([5, 0, 0]))
    recent.add(1.0, reading([9, 0, 1]))
    assert recent.largest_us(2.0, late=False) == 6.0
    recent.add(1.0 + WINDOW_S, reading([20, 0, 1]))
    recent.add(2.0 + WINDOW_S, reading([30, 1, 1]))
    assert recent.largest_us(2.0, late=False) == 4.0
    assert recent.largest_us(2.0, late=True) is None, "nothing was late"


def test_another_daemon_clears_the_window():
    recent = Recent()
    recent.add(0.0, reading([500, 1, 0], torque=3.0))
    recent.add(1.0, reading([2, 0, 0], torque=4.0))
    assert recent.torques(0) == [4.0]
    assert recent.torques(2) == []
    assert recent.largest_us(1.0, late=False) is None


@pytest.mark.parametrize("count", [1, 5, 6, 11])
def test_pages_hold_every_line_once(count):
    console = Console(file=io.StringIO(), width=80, height=7, force_terminal=True)
    view = Group(*(f"line {n}" for n in range(count)))

    def lines(number):
        console.file = io.StringIO()
        shown, place = paged(console, view, number)
        console.print(shown)
        text = Text.from_ansi(console.file.getvalue()).plain
        return [each.rstrip() for each in text.splitlines() if each.startswith("line")], place

    pages = -(-count // 5)
    assert [each for n in range(pages) for each in lines(n)[0]] == [f"line {n}" for n in range(count)]
    assert lines(pages)[1] == 0, "after the last page comes the first"
    assert lines(-1)[1] == pages - 1


def test_a_histogram_shows_one_cycle_in_a_million():
    bins = [0] * 100
    bins[10], bins[11], bins[30] = 1_000_000, 500, 1
    line = histogram(bins, 4.0, 60)
    assert line.startswith("40 █▄")
    assert line.endswith("▁ 124 us")
    assert line.count(" ") == 18 + 3, "bins without a cycle are empty"
    assert len(histogram(bins, 4.0, 10)) <= 10 + len("40  136 us")
    assert histogram([0] * 9 + [1], 4.0, 10).endswith("us and more")
    assert histogram([0] * 10, 4.0, 10) == ""


def test_shadow_methods_are_rows_below_their_joint_and_their_errors_a_line(tmp_path: Path) -> None:
    daemon = running(tmp_path)
    snapshot = SnapshotReader(daemon.directory / "snapshot", supervisor=True)
    SHADOW.pack_into(
        snapshot._views.shadows,
        0,
        *(-121.5, 2.25, -118.5, 5.0, *4 * (nan,), -118.7, 0.6, -118.5, 5.0, *4 * (nan,), 2, 0, 3, 0),
    )
    snapshot._views.shadow_errors[0], snapshot._views.shadow_errors[2] = 36.0, 4.0
    for width in (80, 140):
        lines = picture(daemon, width).splitlines()
        first = next(n for n, line in enumerate(lines) if line.startswith("1 joint1"))
        assert lines[first + 1].split()[:7] == ["tob", "valid", "-121.50", "Nm", "2.25", "Nm", "-118.50"]
        assert lines[first + 2].split()[:4] == ["network", "degraded", "-118.70", "Nm"]
        assert lines[first + 3].startswith("2 joint2")
        assert sum(line.startswith("RMSE 1    fused -, tob 3.00, network - Nm") for line in lines) == 1
        assert not any(line.startswith("RMSE 2") for line in lines)
    watch = Watch(daemon)
    watch.read()
    one, two = content(watch.read())["joints"]
    assert two["shadow"] == {}
    assert one["shadow"]["tob"]["rmse_nm"] == 3.0
    assert one["shadow"]["network"] | {"rmse_nm": 0} == {
        "torque_nm": -118.7,
        "sigma_nm": 0.6,
        "reference_nm": -118.5,
        "age_ms": 5.0,
        "status": "degraded",
        "rmse_nm": 0,
        "rmse_now_nm": None,
    }
    json.dumps(one, allow_nan=False)
