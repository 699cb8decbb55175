"""`jtq export`, and the log as a file of python-can: real commands on logs written by the recorder's code."""

import csv
import gzip
import json
import math
import os
import re
import struct
import subprocess
import sys
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import can
import can.logconvert
import numpy as np
import pytest
from mcap.writer import Writer

from jtqd.daemon.logs import LogError, read_topic, topics_of
from jtqd.daemon.logs.can_io import McapCanReader, McapCanWriter
from jtqd.daemon.logs.export import RunTable, main
from jtqd.daemon.logs.recover import recover
from tests.daemon.logs.campaign_log import Cycle, Joint, regular, write_log
from tests.daemon.logs.log_files import ATTACHMENTS, ours
from tests.paths import GOLDEN, ROOT

ORDINARY = GOLDEN / "network.mcap"

CYCLES = 120


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    ours(path, CYCLES)
    return path


def run(*arguments, stdin=None):
    done = subprocess.run(
        [str(each) for each in arguments], cwd=ROOT, input=stdin, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def frames_of(path):
    with can.LogReader(path) as reader:
        return [
            (
                round(m.timestamp * 1e6),
                m.arbitration_id,
                m.is_extended_id,
                m.is_remote_frame,
                m.dlc,
                bytes(m.data),
            )
            for m in reader
        ]


def expected_frames():
    """As `log_files.cycles` wrote them; the recorder's test records have no stamp of the kernel, the cycle's counts."""
    found = []
    for n in range(CYCLES):
        micros = 1_700_000_007_000_000 + 1000 * n
        found.append(
            (
                micros,
                0x181,
                False,
                False,
                8,
                n.to_bytes(4, "little") + (-n).to_bytes(4, "little", signed=True),
            )
        )
        found.append((micros, 0x281, False, False, 8, n.to_bytes(4, "little") + b"\3\0" + b"\x37\x12"))
    return found


# ---- run table ----


def joints(n):
    one = Joint(0.1 * n, 10.0 + n, 20.0 + 2 * n, 0.01 * n, 3.0 + 0.5 * n)
    return one, Joint(-0.2 * n, -10.0 - n, -20.0 - 2 * n, -0.01 * n, 3.0 + 0.5 * n)


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz", "run.parquet"])
def test_run_table_is_what_the_diagnosis_reads(tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    from jtqd.sysid.runs.files import read_run

    log = write_log(tmp_path / "a.mcap", regular(50, joints))
    out = tmp_path / name
    assert main([name.split(".")[1], str(log), "--out", str(out)]) == 0
    table = read_run(out).table
    assert table.time_s.tolist() == pytest.approx([n * 1e-3 for n in range(50)], abs=1e-12)
    for number in (1, 2):
        wanted = [joints(n)[number - 1] for n in range(50)]
        columns = table.joints[number]
        assert columns.current_a.tolist() == [each.current_a for each in wanted]
        assert columns.torque_nm.tolist() == [each.sensor_nm for each in wanted]
        assert columns.link_position_rad.tolist() == [each.link_position_rad for each in wanted]
        assert columns.temperature_c is None


def test_cycles_with_missing_values_are_left_out_and_said(tmp_path, capsys):
    """No failure, as every log has some: they are counted."""

    def holes(n):
        one, two = joints(n)
        return (one._replace(current_a=math.nan), two) if n in (3, 4) else (one, two)

    log = write_log(tmp_path / "a.mcap", regular(20, holes))
    out = tmp_path / "run.csv"
    assert main(["csv", str(log), "--out", str(out), "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == {"path": str(out), "rows": 18, "columns": 13, "left_out": 2}
    assert "2 cycles with a missing value left out" in said.err
    assert main(["csv", str(log), "--out", str(out), "--all-cycles"]) == 0
    rows = list(csv.DictReader(out.open()))
    assert len(rows) == 20
    assert [row["j1.current_a"] for row in rows[2:6]] == ["0.2", "", "", "0.5"]


def test_an_ordinary_log_has_its_estimate_and_loses_no_cycle_to_what_comes_late(tmp_path, capsys):
    """The first temperature comes after some cycles, and the estimate is not there in all; neither costs a row."""
    state = read_topic(ORDINARY, "/joint/1/state")
    late = int(np.argmax(np.isfinite(state["temperature_c"])))
    known = np.isfinite(state["torque_nm"])
    assert 0 < late < known.sum() < len(state)
    whole = np.all(
        [np.isfinite(state[name]) for name in ("current_a", "link_position_rad", "sensor_torque_nm")], axis=0
    )
    assert main(["csv", str(ORDINARY), "--out", str(tmp_path / "a.csv"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["left_out"] <= np.count_nonzero(~whole) + 1
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert rows[0]["j1.temperature_c"] == str(state["temperature_c"][late])
    torques = state["torque_nm"][np.isfinite(state["torque_nm"])]
    assert {float(row["j1.estimate_nm"]) for row in rows if row["j1.estimate_nm"]} <= set(torques.tolist())
    assert sum(not row["j1.estimate_nm"] for row in rows) > 0
    assert {row["j1.status"] for row in rows} <= {str(each) for each in range(8)}
    assert main(["csv", str(ORDINARY), "--out", str(tmp_path / "b.csv"), "--all-cycles"]) == 0
    rows = list(csv.DictReader((tmp_path / "b.csv").open()))
    assert [row["j1.temperature_c"] for row in rows[: late + 1]].count("") == late, "nothing is filled in"


def test_a_dash_is_standard_output(log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["csv", str(log), "--out", "a.csv"]) == 0
    piped = run(sys.executable, "-m", "jtqd.daemon.jtq", "export", "csv", log, "--out", "-")
    assert piped.stdout == (tmp_path / "a.csv").read_text()
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]


def test_every_field_of_a_topic(log, tmp_path):
    pytest.importorskip("pyarrow")
    from pyarrow import parquet

    records = read_topic(log, "/joint/1/state")
    assert main(["csv", str(log), "--topic", "/joint/1/state", "--out", str(tmp_path / "j.csv.gz")]) == 0
    rows = list(csv.DictReader(gzip.decompress((tmp_path / "j.csv.gz").read_bytes()).decode().splitlines()))
    assert [float(row["current_a"]) for row in rows] == records["current_a"].tolist()
    assert rows[0]["header.frame_id"] == "joint_1"
    assert main(["parquet", str(log), "--topic", "/can/frames", "--out", str(tmp_path / "f.parquet")]) == 0
    table = parquet.read_table(tmp_path / "f.parquet")
    frames = read_topic(log, "/can/frames")
    assert table["frames.id[1]"].to_pylist() == frames["frames"]["id"][:, 1].tolist()
    assert table["stamps_ns[0]"].type == "int64"
    assert main(["csv", str(log), "--topic", "/joint_states", "--out", str(tmp_path / "s.csv")]) == 0
    first = next(csv.DictReader((tmp_path / "s.csv").open()))
    assert (first["name[0]"], first["name[1]"]) == ("a", "b")
    assert {"position[0]", "position[1]"} < first.keys()


def test_span_in_seconds(log, tmp_path, capsys):
    assert (
        main(
            ["csv", str(log), "--start", "0.02", "--end", "0.05", "--out", str(tmp_path / "a.csv"), "--json"]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["rows"] == 30


# ---- frames ----


def test_candump_lines_and_the_dbc_are_what_cantools_takes(tmp_path, capsys):
    """Lines out of the log, decoded by the DBC of the shipped configuration as plain integers."""
    pytest.importorskip("cantools")
    position = (1000).to_bytes(4, "little") + (-7).to_bytes(4, "little", signed=True)
    cycle = Cycle(1, 1_000_000, (Joint(), Joint()), [(0x181, position), (0x701, b"\5")])
    log = write_log(tmp_path / "a.mcap", [cycle])
    assert main(["candump", str(log)]) == 0
    lines = capsys.readouterr().out
    assert lines.splitlines() == [
        "(1700000000.001000) can0 181#E8030000F9FFFFFF",
        "(1700000000.001000) can0 701#05",
    ]
    dbc = tmp_path / "bus.dbc"
    config = ROOT / "models" / "bench.yaml"
    assert main(["dbc", "--config", str(config), "--out", str(dbc), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] > 10
    decoded = run(sys.executable, "-m", "cantools", "decode", "--single-line", dbc, stdin=lines).stdout
    assert re.search(r"drive_1_TPDO1\(motor_position: 1000, link_position: -7\)", decoded)
    assert "(nmt_state: operational)" in decoded


def test_dbc_of_the_log_is_its_attachment(log, tmp_path, capsys):
    assert main(["dbc", str(log)]) == 0
    assert capsys.readouterr().out.encode() == ATTACHMENTS[1].data
    bare = write_log(tmp_path / "b.mcap", regular(3, joints))
    assert main(["dbc", str(bare)]) == 1
    assert "expected bus.dbc (--config makes one without a log)" in capsys.readouterr().err


@pytest.mark.parametrize("text", [b"", b'VERSION ""\n'])
def test_dbc_without_a_message_is_none(tmp_path, capsys, text):
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(1, 1, "bus.dbc", "text/plain", text)
        writer.finish()
    assert main(["dbc", str(tmp_path / "a.mcap"), "--out", str(tmp_path / "bus.dbc")]) == 1
    assert f"found no message in its bus.dbc ({len(text)} characters)" in capsys.readouterr().err
    assert not (tmp_path / "bus.dbc").exists()


def test_reader_of_a_topic_without_frames_is_refused(log):
    with pytest.raises(LogError, match="found frames on /can/frames, expected them on /joint/1/state"):
        McapCanReader(log, topic="/joint/1/state")
    assert len(list(McapCanReader(log, topic="/can/frames"))) == 2 * CYCLES


@pytest.mark.parametrize("suffix", ["blf", "log", "asc"])
def test_can_logconvert_there_and_back(log, tmp_path, suffix, monkeypatch):
    there, back = tmp_path / f"a.{suffix}", tmp_path / "b.mcap"
    for source, target in ((log, there), (there, back)):
        monkeypatch.setattr(sys, "argv", ["can_logconvert", str(source), str(target)])
        can.logconvert.main()
    found, expected = frames_of(back), expected_frames()
    assert [frame[1:] for frame in found] == [frame[1:] for frame in expected]
    first = found[0][0] - expected[0][0] if suffix == "asc" else 0  # its time is relative
    assert all(abs(f[0] - e[0] - first) <= 1000 for f, e in zip(found, expected, strict=True))


CANDUMP = """(1700000000.000999) can0 181#E803
(1700000000.001001) can1 181#E903
(1700000000.001002) can0 080#
(1700000000.123457) vcan-2.a 1ABCDEF0#12345678
(1700000001.999999) can1 701#05
(1700000002.000000) can0 123#R4
"""


@pytest.mark.parametrize("names", [("can0", "can1", "vcan-2.a"), ("can0",), ("slcan7",)])
def test_a_log_of_several_interfaces_comes_back_to_the_microsecond(tmp_path, capsys, monkeypatch, names):
    """candump -> python-can -> MCAP -> candump: the same text, in the same order."""
    lines = [line for line in CANDUMP.splitlines() if line.split()[1] in names] or [
        line.replace("can0", names[0]) for line in CANDUMP.splitlines() if " can0 " in line
    ]
    (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(sys, "argv", ["can_logconvert", str(tmp_path / "a.log"), str(tmp_path / "b.mcap")])
    can.logconvert.main()
    capsys.readouterr()
    assert sorted(topics_of(tmp_path / "b.mcap")) == sorted(f"/{name}/frames" for name in names)
    assert main(["candump", str(tmp_path / "b.mcap")]) == 0
    assert capsys.readouterr().out.splitlines() == lines
    assert (
        main(["candump", str(tmp_path / "b.mcap"), "--topic", f"/{names[0]}/frames", "--interface", "x"]) == 0
    )
    one = [line.replace(f" {names[0]} ", " x ") for line in lines if f" {names[0]} " in line]
    assert capsys.readouterr().out.splitlines() == one
    assert [each.channel for each in McapCanReader(tmp_path / "b.mcap")] == [
        line.split()[1] for line in lines
    ]
    stamps = read_topic(tmp_path / "b.mcap", f"/{names[0]}/frames")["stamps_ns"]
    assert not (stamps % 1000).any(), "no more digits than the log has"


def test_microseconds_are_rounded(tmp_path, capsys):
    """As every other writer does; a stamp of the kernel has nanoseconds."""
    cycle = Cycle(1, 1_999_999_500, (Joint(), Joint()), [(0x181, b"")])
    log = write_log(tmp_path / "a.mcap", [cycle])
    assert main(["candump", str(log)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.endswith(".000000) can0 181#")


def test_every_kind_of_frame_comes_back(tmp_path):
    """29-bit, remote, error, empty, 40 in one millisecond, a clock that goes back; FD is left out and said."""
    path = tmp_path / "a.mcap"
    messages = [
        can.Message(timestamp=1.5, arbitration_id=0x1ABCDEF0, is_extended_id=True, data=b"12345678"),
        can.Message(timestamp=1.5, arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(
            timestamp=1.5, arbitration_id=0x20, is_extended_id=False, is_error_frame=True, data=bytes(8)
        ),
        *[
            can.Message(timestamp=2 + n * 1e-5, arbitration_id=n, is_extended_id=False, data=bytes([n]))
            for n in range(40)
        ],
        can.Message(timestamp=1.0, arbitration_id=0x7FF, is_extended_id=False, data=b""),
    ]
    with can.Logger(path) as writer:
        assert isinstance(writer, McapCanWriter)
        for message in messages:
            writer(message)
        writer(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))
    assert writer.left_out == 1
    found = list(McapCanReader(path))
    assert [m.timestamp for m in found] == pytest.approx([m.timestamp for m in messages], abs=1e-6)
    for one, other in zip(found, messages, strict=True):
        assert one.equals(other, timestamp_delta=1e-6, check_direction=False), (one, other)
    records = read_topic(path, "/can/frames")
    assert records["frame_count"].tolist() == [3, 16, 16, 8, 1]
    assert not recover(path).changed


def test_can_player_and_can_logger_on_a_bus(log, tmp_path):
    """Player -> the hub of `jtq sim`'s kind -> logger: python-can's own multicast interface carries the frames."""
    out = tmp_path / "heard.mcap"
    bus = ["-i", "udp_multicast", "-c", "239.74.163.2"]
    try:
        can.Bus(interface="udp_multicast", channel="239.74.163.2").shutdown()
    except (can.CanError, ImportError, OSError) as error:
        pytest.skip(f"no multicast: {error}")
    logger = subprocess.Popen(
        [sys.executable, "-m", "can.logger", *bus, "-f", out],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        logger.stdout.readline()
        logger.stdout.readline()
        player = run(sys.executable, "-m", "can.player", *bus, "--ignore-timestamps", log)
        assert player.returncode == 0, player.stderr
        import time

        end = time.monotonic() + 20
        while not out.exists() and time.monotonic() < end:
            time.sleep(0.05)
        time.sleep(0.5)
    finally:
        logger.send_signal(2)
        _, errors = logger.communicate(timeout=20)
    assert "Traceback" not in errors
    assert [frame[1:] for frame in frames_of(out)] == [frame[1:] for frame in expected_frames()]


# ---- use ----


def test_failures_are_one_line(tmp_path, capsys):
    (tmp_path / "a.mcap").write_bytes(b"x")
    assert main(["candump", str(tmp_path / "a.mcap")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["csv", str(tmp_path / "no.mcap"), "--out", str(tmp_path / "a.csv")]) == 1
    assert capsys.readouterr().err == f"jtq export: {tmp_path / 'no.mcap'}: No such file or directory\n"
    assert not (tmp_path / "a.csv").exists()
    with pytest.raises(LogError):
        can.LogReader(tmp_path / "a.mcap")
    for wrong in (
        ["csv", "a.mcap"],
        ["dbc"],
        ["dbc", "a.mcap", "--config", "b"],
        ["candump", "a.mcap", "--json"],
    ):
        with pytest.raises(SystemExit) as stop:
            main(wrong)
        assert stop.value.code == 2


@pytest.mark.parametrize("what", ["csv", "candump"])
def test_a_topic_that_is_not_there_is_said_with_those_that_are(log, tmp_path, capsys, what):
    assert main([what, str(log), "--topic", "nonsense", "--out", str(tmp_path / "a")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "nonsense, expected one of " in said
    assert "/can/frames" in said
    assert "in that time" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--start", "5", "--end", "2"], "--end: found 2, expected a time above 5 s"),
        (["--end", "-1"], "--end: found -1, expected a time above 0 s"),
        (["--start", "nan"], "found 'nan'"),
        (["LOG"], "twice, expected every part once"),
    ],
)
def test_what_cannot_be_meant_is_wrong_use(log, tmp_path, capsys, arguments, words):
    given = [str(log) if each == "LOG" else each for each in arguments]
    with pytest.raises(SystemExit) as stop:
        main(["csv", str(log), "--out", str(tmp_path / "a.csv"), *given])
    assert stop.value.code == 2
    assert words in capsys.readouterr().err


def test_nothing_is_left_of_a_table_that_could_not_be_written(log, tmp_path, monkeypatch):
    monkeypatch.setattr(
        os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    assert main(["csv", str(log), "--out", str(tmp_path / "a.csv")]) == 1
    assert list(tmp_path.iterdir()) == []
    assert np.isfinite(1.0)


# ---- chunk by chunk ----


def test_a_topic_whose_columns_change_on_the_way(tmp_path):
    """Sequences of one length in each chunk, of another in the next: as many columns as the longest has."""
    path, out = tmp_path / "a.mcap", tmp_path / "a.csv"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100)
        writer.start("x", "lib")
        schema = writer.register_schema("a/B", "ros2msg", b"int32[] a\n")
        channel = writer.register_channel("/t", "cdr", schema)
        for n in range(12):
            numbers = range(n, n + 1 + n // 6)
            data = b"\0\1\0\0" + struct.pack(f"<I{len(numbers)}i", len(numbers), *numbers)
            writer.add_message(channel, n, data, n, n)
        writer.finish()
    assert main(["csv", str(path), "--topic", "/t", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [row["a[0]"] for row in rows] == [*map(str, range(12))]
    assert [row["a[1]"] for row in rows] == [*[""] * 6, *(f"{n}.0" for n in range(7, 13))]


NESTED = """a/Arm[] arms
================================================================================
MSG: a/Arm
string name
a/Joint[] joints
================================================================================
MSG: a/Joint
float64 position
uint8[2] flags
"""
SEQUENCES = {
    "of numbers": (
        "float64[] position\nint64[] count\n",
        [{"position": [1.5, 2.0], "count": [1]}, {"position": [3.0, 4.5], "count": [2]}],
        {"position[0]": [1.5, 3.0], "position[1]": [2.0, 4.5], "count[0]": [1, 2]},
    ),
    "of texts and flags": (
        "string[] name\nbool[] on\n",
        [{"name": ["a", "b"], "on": [True]}, {"name": ["b"], "on": [False]}],
        {"name[0]": ["a", "b"], "name[1]": ["b", ""], "on[0]": [True, False]},
    ),
    "shorter, and empty at first": (
        "float64[] effort\nint32[] count\n",
        [{"effort": [], "count": []}, {"effort": [1.0, 2.0], "count": [3]}, {"effort": [5.0], "count": [4]}],
        {"effort[0]": [None, 1.0, 5.0], "effort[1]": [None, 2.0, None], "count[0]": [None, 3.0, 4.0]},
    ),
    "empty in every message": ("float64[] velocity\nint32 k\n", [{"velocity": [], "k": 1}] * 2, {"k": [1, 1]}),
    "bounded": ("float64[<=3] position\n", [{"position": [1.0]}, {"position": [2.0]}], {"position[0]": [1.0, 2.0]}),
    "of messages": (
        NESTED,
        [
            {"arms": [{"name": "l", "joints": [{"position": 1.0, "flags": [1, 2]}]}]},
            {
                "arms": [
                    {"name": "l", "joints": [{"position": 2.0, "flags": [3, 4]}] * 2},
                    {"name": "r", "joints": []},
                ]
            },
        ],
        {
            "arms.name[0]": ["l", "l"],
            "arms.name[1]": ["", "r"],
            "arms.joints[0].position[0]": [1.0, 2.0],
            "arms.joints[0].position[1]": [None, 2.0],
            "arms.joints[0].flags[0][0]": [1, 3],
            "arms.joints[0].flags[0][1]": [2, 4],
            "arms.joints[0].flags[1][0]": [None, 3.0],
            "arms.joints[0].flags[1][1]": [None, 4.0],
        },
    ),
    "longer than a table is wide": ("uint8[] data\n", [{"data": [7] * 300}] * 2, {"data": [" ".join("7" * 300)] * 2}),
}  # fmt: skip


@pytest.mark.parametrize("chunk_size", [10, 1 << 20])
@pytest.mark.parametrize("name", SEQUENCES)
def test_every_element_of_a_sequence_is_a_column(tmp_path, name, chunk_size):
    """Of bags of other programs (`mcap-ros2-support` writes them here), in one chunk or in many."""
    pytest.importorskip("pyarrow")
    from mcap_ros2.writer import Writer as Ros2Writer
    from pyarrow import parquet

    schema, messages, expected = SEQUENCES[name]
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Ros2Writer(file, chunk_size=chunk_size)
        kind = writer.register_msgdef("a/Msg", schema)
        for n, message in enumerate(messages):
            writer.write_message("/t", kind, message, log_time=n, publish_time=n)
        writer.finish()
    for ending in ("csv", "parquet"):
        out = tmp_path / f"t.{ending}"
        assert main([ending, str(tmp_path / "bag.mcap"), "--topic", "/t", "--out", str(out)]) == 0
    table = parquet.read_table(tmp_path / "t.parquet").to_pydict()
    assert table.pop("log_time_ns") == list(range(len(messages)))
    flat = {key: column.tolist() for key, column in read_topic(tmp_path / "bag.mcap", "/t").columns().items()}
    for each in (table, flat):
        whole = {
            key: [None if isinstance(one, float) and math.isnan(one) else one for one in column]
            for key, column in each.items()
        }
        assert whole == expected
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    assert list(rows[0]) == ["log_time_ns", *table]
    assert {key: [row[key] for row in rows] for key in table} == {
        key: ["" if each is None else str(each) for each in column] for key, column in expected.items()
    }


def test_a_table_takes_no_more_memory_than_some_chunks(tmp_path):
    """Five times the log, the same memory (bytes that Python and numpy hold at most while it is written)."""
    peaks = []
    for count in (3_000, 15_000):
        log = write_log(tmp_path / f"{count}.mcap", regular(count, joints))
        tracemalloc.start()
        assert main(["csv", str(log), "--out", str(tmp_path / "a.csv"), "--all-cycles"]) == 0
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    print(peaks)
    assert peaks[1] < 1.5 * peaks[0]


def test_what_is_no_file_is_written_to_and_never_replaced(log, tmp_path, capsys):
    """A pipe, as /dev/stdout may be; a link; the log itself."""
    pipe, link, target = tmp_path / "pipe", tmp_path / "link", tmp_path / "target.csv"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_bytes)
        assert main(["csv", str(log), "--out", str(pipe), "--all-cycles"]) == 0
        lines = read.result(20).count(b"\n")
    assert lines == 121
    assert pipe.is_fifo()
    link.symlink_to(target)
    assert main(["csv", str(log), "--out", str(link), "--all-cycles"]) == 0
    assert link.is_symlink()
    assert target.read_bytes().count(b"\n") == lines
    assert sorted(each.name for each in tmp_path.iterdir()) == ["link", "pipe", "target.csv"]
    capsys.readouterr()
    assert main(["csv", str(log), "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"jtq export: {tmp_path}: Is a directory\n"
    assert main(["csv", str(log), "--out", str(tmp_path / "no" / "a.csv")]) == 1
    assert capsys.readouterr().err == f"jtq export: {tmp_path}/no/a.csv: No such file or directory\n"
    before = log.read_bytes()
    for wrong in (["--out", str(log)], ["--out", "a", "--start", "nan"], ["--out", "a", "--end", "1e300"]):
        with pytest.raises(SystemExit) as stop:
            main(["csv", str(log), *wrong])
        assert stop.value.code == 2
    assert log.read_bytes() == before


def test_a_run_table_needs_two_cycles(tmp_path):
    for count in (1, 2):
        write_log(tmp_path / "a.mcap", regular(count, lambda n: (Joint(), Joint())))
        table = RunTable(tmp_path / "a.mcap")
        if count == 2:
            assert [len(block["time_s"]) for block in table.blocks()] == [2]
            continue
        with pytest.raises(LogError, match="found 1 cycle with every column, expected at least 2"):
            list(table.blocks())
        (tmp_path / "a.mcap").unlink()


def test_export_never_writes_over_its_log(tmp_path):
    data = ours(tmp_path / "a.mcap", 10)
    (tmp_path / "link.mcap").symlink_to(tmp_path / "a.mcap")
    for out in ("a.mcap", "link.mcap"):
        with pytest.raises(SystemExit, match="2"):
            main(["candump", str(tmp_path / "a.mcap"), "--out", str(tmp_path / out)])
    assert (tmp_path / "a.mcap").read_bytes() == data


def test_frames_of_half_a_second_ago_are_in_the_file_of_the_logger(tmp_path):
    writer = McapCanWriter(tmp_path / "a.mcap.active")
    for n in range(1200):
        writer.on_message_received(can.Message(timestamp=1.7e9 + n * 1e-3, arbitration_id=1, data=b"x"))
    kept = (tmp_path / "a.mcap.active").read_bytes()  # as a crash would leave it
    writer.stop()
    (tmp_path / "b.mcap.active").write_bytes(kept)
    assert len(list(McapCanReader(tmp_path / "b.mcap.active"))) >= 1000
