"""`jtq check`: results and their report, judging of traffic that is known frame by frame, and the command on a real hub."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Container, Iterable, Iterator
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from rich.console import Console

from jtqd.daemon.cli.check import main
from jtqd.daemon.cli.checks import (
    FAIL,
    GOOD,
    SKIP,
    WARN,
    CheckResult,
    check_bus,
    check_conditions,
    check_own_timing,
    check_stolen_time,
    report,
    show,
    worst,
)
from jtqd.daemon.cli.traffic import TimeHistogram, Timing, Traffic, identifier_text
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.loop.realtime import stolen_s
from jtqd.daemon.shared.conditions import Condition
from jtqd.daemon.shared.events import ERROR, WARNING
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, stuffed_bits
from jtqd.estimator.text import duration, number, percent, size
from tests.drivers.hub_helpers import until_it_listens
from tests.shipped_bench import shipped_bench

MS = 1_000_000
US = 1_000
ORDER = {0x181: (8, 335), 0x182: (8, 470), 0x183: (5, 575), 0x281: (8, 710), 0x282: (8, 845)}
"""Input PDO -> bytes, and arrival after SYNC [us]."""
ESTIMATE = bytes.fromhex("e803 18fc 0505 22 01")  # 10 Nm, -10 Nm, both valid


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None)


Check = Callable[..., tuple[int, str, str]]


class Frame(NamedTuple):
    """A frame of a cycle: COB-ID, data, arrival after SYNC [us]."""

    can_id: int
    data: bytes
    delay_us: int


Change = Callable[[int, Frame], list[Frame]]
"""(cycle, frame) -> frames on the bus in its place."""


def bus(
    cycles: int, change: Change | None = None, sync: Callable[[int], list[bytes]] | None = None
) -> Iterator[tuple[int, bytes, int]]:
    """(can_id, data, stamp) of `cycles` cycles, heartbeats every 100, and the SYNC that ends the last cycle."""
    for n in range(cycles + 1):
        start = 1_000_000 * MS + n * MS
        for data in sync(n) if sync else [bytes((n % 240 + 1,))]:
            yield 0x080, data, start
        if n == cycles:
            return
        frames = [Frame(can_id, bytes(length), delay) for can_id, (length, delay) in ORDER.items()]
        frames.append(Frame(0x1A0, ESTIMATE, 980))
        if n % 100 == 0:
            frames += [Frame(0x700 + node, b"\x05", 990) for node in (1, 2, 3, 0x20)]
        changed = [each for frame in frames for each in (change(n, frame) if change else [frame])]
        for can_id, data, delay in sorted(changed, key=lambda each: each.delay_us):
            yield can_id, data, start + delay * US


def judged(config: Config, frames: Iterable[tuple[int, bytes, int]], lost: int = 0) -> dict[str, CheckResult]:
    traffic = Traffic(config)
    stamp = 0
    for can_id, data, stamp in frames:
        traffic.feed(can_id, data, stamp)
    traffic.end(stamp)
    return {each.item: each for each in check_bus(traffic, config, lost=lost)}


def test_a_bus_as_configured_is_good_in_every_item(config: Config) -> None:
    found = judged(config, bus(1000))
    assert {each.level for each in found.values()} == {GOOD}, found
    assert found["SYNC"].text == "1000.0 per s, expected 1000; off the period: p50 0, p99 0, max 0 us"
    assert (
        found["181h drive 1 TPDO1"].text == "1 per SYNC, expected 1; after SYNC: p50 335, p99 335, max 335 us"
    )
    assert found["success rate"].text.startswith("1.0000: 1000 of 1000 cycles")
    assert found["1A0h jtqd estimate"].text == "1 per SYNC; with a torque: joint 1 100.0 %, joint 2 100.0 %"
    bits = sum(stuffed_bits(can_id, data) for can_id, data, _ in bus(1000)) / 1.0 / 1e6
    assert found["bus load"].text.startswith(
        f"{100 * bits:.1f} % by the bits of every frame; by configuration 69.1 %"
    )


def test_the_cycles_that_were_cut_off_count_for_nothing(config: Config) -> None:
    frames = list(bus(100))
    found = judged(config, iter(frames[3:-4]))  # begins and ends in the middle of a cycle
    assert found["success rate"].text.startswith("1.0000: 98 of 98 cycles")


@pytest.mark.parametrize(
    ("lost", "level"),
    [(5, GOOD), (11, WARN), (80, WARN), (101, FAIL)],
    ids=["0.995", "0.989", "0.92", "0.899"],
)
def test_success_rate(config: Config, lost: int, level: str) -> None:
    found = judged(config, bus(1000, lambda n, f: [] if f.can_id == 0x281 and n < lost else [f]))
    assert found["success rate"].level == level
    assert f"missing {lost} of 1000 cycles" in found["281h drive 1 TPDO2"].text
    assert found["281h drive 1 TPDO2"].level == (FAIL if lost > 100 else WARN), (
        "no frame may be lost on a wire"
    )
    assert found["181h drive 1 TPDO1"].level == GOOD


def at(can_id: int, *frames: Frame | None) -> Change:
    """Other frames in place of a COB-ID; None: the frame itself."""
    return lambda n, f: [each or f for each in frames] if f.can_id == can_id else [f]


def every(cycles: int, change: Change) -> Change:
    """A change of every so many cycles."""
    return lambda n, f: change(n, f) if n % cycles == 0 else [f]


def numbered(cycles: Container[int] = (400, 401), first: int = 0) -> Callable[[int], list[bytes]]:
    """SYNC with its counter, without those of some cycles; first: the counter goes on behind the gap."""
    return lambda n: [] if n in cycles else [bytes(((n - first * (n > 401)) % 240 + 1,))]


HEARTBEATS: Change = lambda n, f: {  # noqa: E731
    0x701: [] if 200 <= n < 400 else [f],
    0x702: [f._replace(data=b"\x00" if n == 500 else b"\x7f")],
    0x703: [],
    0x720: [f, Frame(0x0A0, bytes.fromhex("5082110300000000"), 995)] if n == 300 else [f],
}.get(f.can_id, [f])


@pytest.mark.parametrize(
    ("change", "sync", "expected"),
    [
        (every(4, at(0x181, Frame(0x181, bytes(8), 900))), None, {
            "181h drive 1 TPDO1": (FAIL, "late 250 of 1000", "after the deadline of 850 us"),
        }),
        (every(50, at(0x182, None, Frame(0x182, bytes(8), 471))), None, {
            "182h drive 2 TPDO1": (WARN, "twice 20 of 1000", "two nodes with one node-ID"),
        }),
        (at(0x183, Frame(0x183, bytes(4), 575)), None, {
            "183h sensor 3 channel 1": (FAIL, "1000 of a wrong length", "transmission type 1"),
            "success rate": (FAIL, "0.0000: 0 of 1000", ""),
        }),
        (lambda n, f: [f._replace(delay_us=900)] if f.can_id == 0x282 and n < 3 else [f], None, {
            "282h drive 2 TPDO2": (GOOD, "late 3 of 1000", ""),
        }),
        (None, numbered(), {"SYNC": (FAIL, "1 jump of its counter", "")}),
        (None, numbered(first=2), {"SYNC": (WARN, "2 of 1000 slots without one", "")}),
        (None, lambda n: [bytes((n % 240 + 1,)), b""], {"SYNC": (FAIL, "", "second SYNC producer")}),
        (None, lambda n: [], {"SYNC": (FAIL, "", "--drive-sync"), "success rate": (SKIP, "", "")}),
        (HEARTBEATS, None, {
            "heartbeat drive 1": (WARN, "longest silence 300 ms", ""),
            "heartbeat drive 2": (WARN, "pre-operational; longest silence 100 ms, expected 100 ms; 1 restart", ""),
            "heartbeat sensor 3": (FAIL, "none", ""),
            "heartbeat jtqd": (WARN, "1 EMCY, last 8250h", ""),
        }),
        (every(10, at(0x181, None, Frame(0x321, bytes(2), 30))), None, {
            "foreign frames": (WARN, "321h 100 per s", ""),
        }),
        (at(0x181, None, *(Frame(0x381, bytes(8), 100 + n) for n in range(3))), None, {
            "bus load": (FAIL, "", ""),
        }),
    ],
    ids=[
        *("late", "twice", "wrong length", "few late", "counter jumps", "slots missed", "two SYNC", "no SYNC"),
        *("heartbeats", "foreign", "full bus"),
    ],
)  # fmt: skip
def test_deviations_of_the_traffic(
    config: Config, change: Change | None, sync: Any, expected: dict[str, tuple[str, str, str]]
) -> None:
    found = judged(config, bus(1000, change, sync))
    for item, (level, text, hint) in expected.items():
        assert found[item].level == level, found[item]
        assert text in found[item].text
        assert hint in found[item].hint


def test_a_check_that_was_too_slow(config: Config) -> None:
    assert "lost 7 frames" in judged(config, bus(30), lost=7)["this check"].text


def acyclic(tmp_path: Path) -> Config:
    """Drive 1 sends its positions by itself; they count for 5 ms."""
    content = shipped_bench()
    content["joint_1"] |= {
        "max_age_ms": 5,
        "tpdos": [
            {"number": 1, "cob_id": 0x181, "objects": [0x60640020, 0x60E40120], "type": 255},
            {"number": 2, "cob_id": 0x281, "objects": [0x606C0020, 0x60780010, 0x60410010]},
        ],
    }
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    return load_config(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("cycles", "level", "text"),
    [(4, GOOD, "500 per s, sent by the drive itself; age at SYNC"), (12, FAIL, "older than 5 ms in 60")],
)
def test_an_acyclic_pdo_is_judged_by_its_age(tmp_path: Path, cycles: int, level: str, text: str) -> None:
    """Every fourth cycle and twice then: good within 5 ms; every twelfth: too old in six of twelve cycles."""

    def change(n: int, f: Frame) -> list[Frame]:
        if f.can_id != 0x181:
            return [f]
        return [f, f._replace(delay_us=f.delay_us + 30)] if n % cycles == 0 else []

    found = judged(acyclic(tmp_path), bus(1200, change))
    one = found["181h drive 1 TPDO1"]
    assert (one.level, found["success rate"].level) == (level, level)
    assert text in one.text
    assert ("max_age_ms" in one.hint) == (level == FAIL)


@pytest.mark.parametrize(
    ("can_id", "item", "text"),
    [
        (0x181 | CAN_EFF_FLAG, "foreign frames", "00000181h (29 bit)"),
        (0x183 | CAN_RTR_FLAG, "foreign frames", "183h (remote)"),
        (0x080 | CAN_RTR_FLAG, "foreign frames", "080h (remote)"),
        (CAN_ERR_FLAG | 0x044, "error frames", "controller warning or passive 1, bus-off 1"),
    ],
)
def test_look_alikes_and_error_messages(config: Config, can_id: int, item: str, text: str) -> None:
    found = judged(config, [*bus(100), (can_id, bytes(8), 1_000_101 * MS)])
    assert found[item].level == FAIL
    assert text in found[item].text
    failed = {name for name, each in found.items() if each.level == FAIL}
    assert failed == {item}, "an error message is no frame"
    assert identifier_text(0x18FF0181 | CAN_EFF_FLAG) == "18FF0181h (29 bit)"


def timing(late_us: int, missed: int, echoes: int = 1000) -> Timing:
    found = Timing(missed=missed)
    found.lateness.add(5 * US, 980)
    found.lateness.add(late_us * US, 20)
    found.echo.add(70 * US, echoes)
    return found


@pytest.mark.parametrize(
    ("made", "driven", "levels"),
    [
        (timing(50, 0), True, [GOOD, GOOD]),
        (timing(200, 0), False, [WARN]),
        (timing(50, 1), False, [WARN]),
        (timing(50, 11), False, [FAIL]),
        (timing(600, 0), False, [FAIL]),
        (timing(50, 0, echoes=999), True, [GOOD, GOOD]),  # the last one may still be on its way
        (timing(50, 0, echoes=998), True, [GOOD, FAIL]),
    ],
)
def test_own_timing(made: Timing, driven: bool, levels: list[str]) -> None:
    assert [each.level for each in check_own_timing(made, MS, [], driven=driven)] == levels
    one, *_ = check_own_timing(made, MS, ["SCHED_FIFO priority 80: refused"], driven=driven)
    assert one.text.startswith("without real-time scheduling")


def test_stolen_time_is_judged_by_its_share_of_one_processor() -> None:
    found = [check_stolen_time(stolen, 10.0) for stolen in (0.0, 0.009, 0.01, 3.0)]
    assert [each.level for each in found] == [GOOD, GOOD, WARN, WARN]
    assert [bool(each.hint) for each in found] == [False, False, True, True]
    assert found[-1].text.startswith("30.0 % of a processor")


def test_stolen_time_is_the_eighth_field_in_ticks(tmp_path: Path) -> None:
    for text, expected in (
        ("cpu  1 2 3 4 5 6 7 250 9 10\ncpu0 1 2 3 4 5 6 7 8 9 10\n", 250 / os.sysconf("SC_CLK_TCK")),
        ("cpu  1 2 3 4\n", 0.0),
        ("", 0.0),
    ):
        (tmp_path / "stat").write_text(text)
        assert stolen_s(tmp_path / "stat") == expected
    assert stolen_s(tmp_path / "none") == 0.0


def test_tally_quantiles_are_upper_edges_and_the_maximum_is_exact() -> None:
    tally = TimeHistogram()
    tally.add(1_500, 98)
    for ns in (7_001, 23_456_789):
        tally.add(ns)
    assert (tally.quantile_us(0.5), tally.quantile_us(0.99), tally.quantile_us(1.0)) == (2.0, 8.0, 23456.789)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.drivers.hub", f"unix:{tmp_path / 'bus'}"], stderr=subprocess.PIPE
    )
    until_it_listens(f"unix:{tmp_path / 'bus'}", process)
    yield f"unix:{tmp_path / 'bus'}"
    process.terminate()
    process.communicate(timeout=10)


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Check:
    """`jtq check` in this process: exit status, standard output, standard error."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "80")

    def run(*arguments: str) -> tuple[int, str, str]:
        try:
            code = main(list(arguments))
        except SystemExit as leave:
            code = int(leave.code or 0)
        return code, *capsys.readouterr()

    return run


def test_the_command_on_a_silent_bus_listens_and_says_what_to_do(tmp_path: Path, hub: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "check", "0.3", "--bus", hub, "--json"],
        env={**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    content = json.loads(done.stdout)
    assert (done.returncode, content["result"], content["schema"]) == (1, "FAIL", "jtq.check/1")
    assert {each["item"]: each["level"] for each in content["items"]}["SYNC"] == "FAIL"


@pytest.mark.parametrize("width", [80, 140])
def test_the_table_fits_the_terminal(config: Config, width: int) -> None:
    frames = (frame for frame in bus(100) if frame[0] not in (0x282, 0x703))
    file = StringIO()
    show(Console(file=file, width=width), list(judged(config, frames).values()))
    text = file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert text.splitlines()[-1] == "FAIL: 12 good, 0 warnings, 3 failures"


def test_what_cannot_be_checked_is_one_line(check: Check) -> None:
    for arguments, printed in (
        (("--bus", "unix:/nowhere"), "/nowhere"),
        (("--bus", "nocan9"), "nocan9"),
        (("--config", "/nowhere.yaml"), "/nowhere.yaml"),
    ):
        code, _, error = check("0.1", *arguments)
        assert code == 1
        assert error.startswith("jtq check: ")
        assert printed in error
        assert len(error.splitlines()) == 1
    assert check("-5")[0] == 2


def test_conditions_of_the_daemon_are_results() -> None:
    (good,) = check_conditions([])
    assert good.level == GOOD
    two = [
        Condition("bus_off", "bus", ERROR, "bus-off", 1),
        Condition("sensor_lost", "joint 1", WARNING, "no torque sensor", 1),
    ]
    assert [(each.item, each.level, each.text) for each in check_conditions(two)] == [
        ("bus off", FAIL, "jtqd reports: bus: bus-off"),
        ("sensor lost", WARN, "jtqd reports: joint 1: no torque sensor"),
    ]


NAN = float("nan")


def test_the_result_is_the_worst_level() -> None:
    items = {level: CheckResult("x", level, "") for level in (GOOD, WARN, FAIL, SKIP)}
    assert worst([items[GOOD], items[SKIP]]) == GOOD
    assert worst([items[GOOD], items[WARN]]) == WARN
    assert worst([items[WARN], items[FAIL]]) == FAIL


def test_the_report_is_a_table_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    results = [
        CheckResult("one", GOOD, "fine"),
        CheckResult("two", WARN, "first", "do this"),
        CheckResult("three", WARN, "second", "do this"),
    ]
    assert report(results, None) == 3
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[:3]] == [
        ["GOOD", "one", "fine"],
        ["WARN", "two", "first"],
        ["WARN", "three", "second"],
    ]
    assert lines[3].strip() == "> do this", "one hint for both"
    assert lines[4] == "WARN: 1 good, 2 warnings, 0 failures"
    assert report(results[:1], "jtq.x/1", bus="can0") == 0
    assert json.loads(capsys.readouterr().out) == {
        "schema": "jtq.x/1",
        "result": "GOOD",
        "bus": "can0",
        "items": [{"item": "one", "level": "GOOD", "text": "fine", "hint": ""}],
    }


def test_numbers_for_people() -> None:
    assert [duration(each) for each in (0.0451, 2.34, 59.94, 59.96, 751.2, 11_100.0, 187_300.0, NAN)] == [
        *("45 ms", "2.3 s", "59.9 s", "1 min 00 s", "12 min 31 s", "3 h 05 min", "2 d 04 h", "-")
    ]
    assert [size(each) for each in (0, 999, 1000, 123_456, 1_230_000_000, None)] == [
        *("0 B", "999 B", "1 kB", "123 kB", "1.23 GB", "-")
    ]
    assert (number(-1.005), number(NAN), percent(0.8476), percent(NAN)) == ("-1.00", "-", "84.8 %", "-")


@pytest.mark.parametrize("options", [["--bus", "sim"], ["--bus", "unix:nowhere", "--drive-sync"]])
def test_sync_of_another_master_is_not_sent(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "guest.yaml"
    path.write_text(yaml.safe_dump(shipped_bench() | {"role": "guest"}))
    assert main(["1", "--config", str(path), *options]) == 1
    assert "role guest: another master sends SYNC" in capsys.readouterr().err
