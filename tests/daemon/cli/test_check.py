"""`jtq check`: counting and judging of traffic that is known frame by frame, and the command on a real hub."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from io import StringIO
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from jtqd.daemon.cli.bus_checks import check_bus, check_conditions, check_own_timing, check_stolen_time
from jtqd.daemon.cli.check import main
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult, show
from jtqd.daemon.cli.traffic import TimeHistogram, Timing, Traffic, identifier_text
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.loop.realtime import stolen_s
from jtqd.daemon.shared.conditions import Condition
from jtqd.daemon.shared.notices import ERROR, WARNING
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, stuffed_bits
from tests.drivers.hub_helpers import until_it_listens
from tests.shipped_bench import shipped_bench

pytestmark = pytest.mark.native

MS = 1_000_000
US = 1_000
ORDER = {0x181: (8, 335), 0x182: (8, 470), 0x183: (5, 575), 0x281: (8, 710), 0x282: (8, 845)}
"""Input PDO -> bytes, and arrival after SYNC [us]."""
ESTIMATE = bytes.fromhex("e803 18fc 0505 22 01")  # 10 Nm, -10 Nm, both valid


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None)


Check = Callable[..., tuple[int, str, str]]
Change = Callable[[int, int, bytes, int], list[tuple[int, bytes, int]]]
"""(cycle, COB-ID, data, delay in us) -> what is on the bus in its place."""


def bus(
    cycles: int, change: Change | None = None, sync: Callable[[int], list[bytes]] | None = None
) -> Iterator:
    """(can_id, data, stamp) of `cycles` cycles, heartbeats every 100, and the SYNC that ends the last cycle."""
    for n in range(cycles + 1):
        start = 1_000_000 * MS + n * MS
        for data in sync(n) if sync else [bytes((n % 240 + 1,))]:
            yield 0x080, data, start
        if n == cycles:
            return
        frames = [(can_id, bytes(length), delay) for can_id, (length, delay) in ORDER.items()]
        frames.append((0x1A0, ESTIMATE, 980))
        if n % 100 == 0:
            frames += [(0x700 + node, b"\x05", 990) for node in (1, 2, 3, 0x20)]
        changed = [each for frame in frames for each in (change(n, *frame) if change else [frame])]
        for can_id, data, delay in sorted(changed, key=lambda each: each[2]):
            yield can_id, data, start + delay * US


def judged(config: Config, frames: Iterator, lost: int = 0) -> dict[str, CheckResult]:
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
    def without(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        return [] if can_id == 0x281 and n < lost else [(can_id, data, delay)]

    found = judged(config, bus(1000, without))
    assert found["success rate"].level == level
    assert f"missing {lost} of 1000 cycles" in found["281h drive 1 TPDO2"].text
    assert found["281h drive 1 TPDO2"].level == (FAIL if lost > 100 else WARN), (
        "no frame may be lost on a wire"
    )
    assert found["181h drive 1 TPDO1"].level == GOOD


def test_late_twice_and_wrong_frames_are_told_apart(config: Config) -> None:
    def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        if can_id == 0x181 and n % 4 == 0:
            return [(can_id, data, 900)]
        if can_id == 0x182 and n % 50 == 0:
            return [(can_id, data, delay), (can_id, data, delay + 1)]
        if can_id == 0x183:
            return [(can_id, data[:4], delay)]
        return [(can_id, data, delay)]

    found = judged(config, bus(1000, change))
    assert "late 250 of 1000" in found["181h drive 1 TPDO1"].text
    assert found["181h drive 1 TPDO1"].level == FAIL
    assert "after the deadline of 850 us" in found["181h drive 1 TPDO1"].hint
    assert "twice 20 of 1000" in found["182h drive 2 TPDO1"].text
    assert found["182h drive 2 TPDO1"].level == WARN
    assert found["183h sensor 3 channel 1"].level == FAIL
    assert "1000 of a wrong length" in found["183h sensor 3 channel 1"].text
    assert found["success rate"].text.startswith("0.0000: 0 of 1000")


def by_itself(tmp_path: Path) -> Config:
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


def test_what_a_drive_sends_by_itself_is_judged_by_its_age(tmp_path: Path) -> None:
    """Every fourth cycle and twice then: good within 5 ms; every twelfth: too old in six of twelve cycles."""
    config = by_itself(tmp_path)

    def every(cycles: int) -> Change:
        def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
            if can_id != 0x181:
                return [(can_id, data, delay)]
            return [(can_id, data, delay), (can_id, data, delay + 30)] if n % cycles == 0 else []

        return change

    name = "181h drive 1 TPDO1"
    good = judged(config, bus(1200, every(4)))
    assert good[name].level == GOOD, good[name]
    assert "500 per s, sent by the drive itself; age at SYNC" in good[name].text
    assert good["success rate"].level == GOOD
    old = judged(config, bus(1200, every(12)))
    assert old[name].level == FAIL
    assert "older than 5 ms in 60" in old[name].text
    assert "max_age_ms" in old[name].hint
    assert old["success rate"].level == FAIL


def test_a_few_late_frames_are_within_the_success_rate(config: Config) -> None:
    def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        return [(can_id, data, 900 if can_id == 0x282 and n < 3 else delay)]

    found = judged(config, bus(1000, change))
    assert found["282h drive 2 TPDO2"].level == GOOD
    assert "late 3 of 1000" in found["282h drive 2 TPDO2"].text


def test_sync_missing_and_sync_from_two(config: Config) -> None:
    found = judged(config, bus(1000, sync=lambda n: [] if n in (400, 401) else [bytes((n % 240 + 1,))]))
    assert found["SYNC"].level == FAIL, "a gap in the counter"
    counter = iter(range(2000))
    found = judged(
        config, bus(1000, sync=lambda n: [] if n in (400, 401) else [bytes((next(counter) % 240 + 1,))])
    )
    assert found["SYNC"].level == WARN
    assert "2 of 1000 slots without one" in found["SYNC"].text
    found = judged(config, bus(1000, sync=lambda n: [bytes((n % 240 + 1,)), b""]))
    assert found["SYNC"].level == FAIL
    assert "second SYNC producer" in found["SYNC"].hint
    found = judged(config, (frame for frame in bus(1000) if frame[0] != 0x080))
    assert found["SYNC"].level == FAIL
    assert "--drive-sync" in found["SYNC"].hint
    assert found["success rate"].level == SKIP


def test_heartbeats_states_restarts_and_emergencies(config: Config) -> None:
    def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        if can_id == 0x701 and 200 <= n < 400:
            return []
        if can_id == 0x702:
            return [(can_id, b"\x00" if n == 500 else b"\x7f", delay)]
        if can_id == 0x703:
            return []
        if can_id == 0x720 and n == 300:
            return [(can_id, data, delay), (0x0A0, bytes.fromhex("5082110300000000"), 995)]
        return [(can_id, data, delay)]

    found = judged(config, bus(1000, change))
    assert found["heartbeat drive 1"].level == WARN
    assert "longest silence 300 ms" in found["heartbeat drive 1"].text
    assert found["heartbeat drive 2"].text.endswith("; 1 restart")
    assert found["heartbeat drive 2"].text.startswith("pre-operational")
    assert found["heartbeat sensor 3"].level == FAIL
    assert found["heartbeat jtqd"].text.endswith("1 EMCY, last 8250h")


def test_strangers_look_alikes_and_error_messages(config: Config) -> None:
    def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        more = [(0x321, bytes(2), 30)] if can_id == 0x181 and n % 10 == 0 else []
        return [(can_id, data, delay), *more]

    found = judged(config, bus(1000, change))
    assert found["foreign frames"].level == WARN
    assert found["foreign frames"].text == "321h 100 per s"
    for mocking in (0x181 | CAN_EFF_FLAG, 0x183 | CAN_RTR_FLAG, 0x080 | CAN_RTR_FLAG):
        found = judged(config, iter([*bus(100), (mocking, b"", 1_000_101 * MS)]))
        assert found["foreign frames"].level == FAIL, hex(mocking)
    assert identifier_text(0x18FF0181 | CAN_EFF_FLAG) == "18FF0181h (29 bit)"
    found = judged(config, iter([*bus(100), (CAN_ERR_FLAG | 0x044, bytes(8), 1_000_101 * MS)]))
    assert (found["error frames"].level, found["error frames"].text) == (
        FAIL,
        "controller warning or passive 1, bus-off 1",
    )
    assert found["foreign frames"].level == GOOD, "an error message is no frame"


def test_a_full_bus_and_a_check_that_was_too_slow(config: Config) -> None:
    def change(n: int, can_id: int, data: bytes, delay: int) -> list[tuple[int, bytes, int]]:
        return [(can_id, data, delay)] + (
            [(0x381, bytes(8), 100 + each) for each in range(3)] if can_id == 0x181 else []
        )

    found = judged(config, bus(300, change), lost=7)
    assert found["bus load"].level == FAIL, found["bus load"].text
    assert "lost 7 frames" in found["this check"].text


def test_own_timing() -> None:
    def timing(late_us: int, missed: int) -> Timing:
        found = Timing(missed=missed)
        for n in range(1000):
            found.lateness.add((late_us if n % 50 == 0 else 5) * US)
            found.echo.add(70 * US)
        return found

    assert [each.level for each in check_own_timing(timing(50, 0), MS, [], driven=True)] == [GOOD, GOOD]
    assert [each.level for each in check_own_timing(timing(200, 0), MS, [], driven=False)] == [WARN]
    assert [each.level for each in check_own_timing(timing(50, 1), MS, [], driven=False)] == [WARN]
    assert [each.level for each in check_own_timing(timing(50, 11), MS, [], driven=False)] == [FAIL]
    assert [each.level for each in check_own_timing(timing(600, 0), MS, [], driven=False)] == [FAIL]
    for echoes, level in ((999, GOOD), (998, FAIL)):  # the last one may still be on its way
        found = timing(50, 0)
        found.echo = TimeHistogram()
        for _ in range(echoes):
            found.echo.add(70 * US)
        assert [each.level for each in check_own_timing(found, MS, [], driven=True)] == [GOOD, level]
    (one,) = check_own_timing(timing(50, 0), MS, ["SCHED_FIFO priority 80: refused"], driven=False)
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
    for ns in (*[1_500] * 98, 7_001, 23_456_789):
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
    for arguments, said in (
        (("--bus", "unix:/nowhere"), "/nowhere"),
        (("--bus", "nocan9"), "nocan9"),
        (("--config", "/nowhere.yaml"), "/nowhere.yaml"),
    ):
        code, _, error = check("0.1", *arguments)
        assert code == 1
        assert error.startswith("jtq check: ")
        assert said in error
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
