"""Live table at every width of a terminal, lines of a log, and the final summary."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN, SHADOW
from jtqd.daemon.shared.snapshot import JointView, Snapshot, SnapshotReader
from jtqd.daemon.supervisor.display import LiveTable, Summary, plain_line, summary_of
from jtqd.estimator.status import NAMES
from tests.daemon.snapshots import EstimateWriter
from tests.daemon.supervisor.watch_views import NAN, view

VALID = JointView(-117.94, 0.48, NAN, NAN, NAN, -118.48, 0x27, 2, 0, 7, 0, -118.48, 1.25)
FAULTY = JointView(3.0, 0.5, NAN, NAN, NAN, NAN, 0x08, 5, 0, 7, 0, NAN, 1.25)
"""drive_fault, the longest status: its torque must not show."""
PUSHED = VALID._replace(input_flags=7 | FLAG_CONTACT_KNOWN | FLAG_CONTACT, contact_nm=2.93)
QUIET = VALID._replace(input_flags=7 | FLAG_CONTACT_KNOWN, contact_nm=-0.31)
OPTIONAL = ("sensor [Nm]", "error [Nm]", "sigma [Nm]")


def reader_of(path: Path, *joints: JointView, contacts: int = 0) -> SnapshotReader:
    made = Snapshot(path, 1e-3, 0.8)
    made.counters[COUNTERS.index("contacts")] = contacts
    EstimateWriter(made).write(8, 8, 1, joints)
    return SnapshotReader(path)


def shown(reader: SnapshotReader, width: int, *, contacts: bool = False) -> list[str]:
    """Lines of the live table."""
    seen, file = reader.read(), io.StringIO()
    table = LiveTable(reader, seen, seen, 1_000_000, "jtqd on sim, node 20h", contacts=contacts)
    Console(file=file, width=width, force_terminal=False).print(table)
    return file.getvalue().splitlines()


def test_80_columns_show_everything(tmp_path: Path) -> None:
    text = "\n".join(shown(reader_of(tmp_path / "s", VALID, FAULTY), 80))
    for wanted in (*OPTIONAL, "-117.94", "0.48", "-118.48", "0.54", "valid"):
        assert wanted in text
    assert "contact" not in text


def test_torque_status_and_contact_are_whole_at_any_width(tmp_path: Path) -> None:
    reader = reader_of(tmp_path / "s", VALID, FAULTY)
    watched = reader_of(tmp_path / "w", PUSHED, QUIET, contacts=3)
    for width in range(12, 100):
        text = "\n".join(lines := shown(reader, width))
        assert max(map(len, lines)) <= width
        assert all(each in text for each in ("-117.94", "valid", "drive_fault")), width
        assert not any(each in text for each in ("3.00", "…")), width
    for width in range(24, 100):
        text = " ".join("\n".join(lines := shown(watched, width, contacts=True)).split())
        assert max(map(len, lines)) <= width
        assert all(each in text for each in ("-117.94", "valid", "+2.9 Nm")), width
        assert text.endswith("contacts 3")


def test_columns_go_in_the_order_of_their_worth(tmp_path: Path) -> None:
    reader, seen = reader_of(tmp_path / "s", VALID, FAULTY), []
    for width in range(80, 30, -1):
        text = "\n".join(shown(reader, width))
        there = tuple(name for name in OPTIONAL if name in text)
        if not seen or seen[-1] != there:
            seen.append(there)
    assert seen == [OPTIONAL, OPTIONAL[1:], OPTIONAL[2:], ()]


def test_lines_where_there_is_no_terminal(tmp_path: Path) -> None:
    reader = reader_of(tmp_path / "s", PUSHED, QUIET, contacts=1)
    seen = reader.read()
    line = plain_line(reader, seen, seen, 1_000_000, contacts=True)
    wanted = "joint 1 valid -117.94 +- 0.48 Nm, contact +2.9 Nm  joint 2 valid -117.94 +- 0.48 Nm  cycle"
    assert wanted in line
    assert line.endswith("contacts 1")


# The final summary

US = (1.0, 2.0, 3.0)


def lines_of(begin: str, counters: dict[str, int] | None = None, **fields: Any) -> list[str]:
    """Lines of the summary's text that begin so."""
    cycle = (counters or {}).get("cycles", 9)
    made = Summary(view(cycle, **{"cycles": cycle} | (counters or {})), US, US, **fields)
    return [line for line in made.text().splitlines() if line.startswith(begin)]


TITLE = "real time     not kept: "


@pytest.mark.parametrize(
    ("begin", "counters", "fields", "expected"),
    [
        ("no torque", {}, {}, ""),
        ("no torque", {"sync_gaps": 1, "boot_ups": 1}, {}, ""),
        (
            "no torque",
            {"fault_motor_jump": 2, "latches": 1, "overruns": 3},
            {},
            "no torque     overruns 3, motor jump 2, latches 1",
        ),
        ("processors", {}, {}, ""),
        ("processors", {}, {"stolen_s": 0.318}, "processors    0.32 s stolen by the hypervisor"),
        ("real time", {"cycles": 0, "missed": 0}, {}, ""),
        ("real time", {"cycles": 950, "missed": 50}, {}, ""),
        (
            "real time",
            {"cycles": 900, "missed": 100},
            {},
            f"{TITLE}10 % of the slots missed; jtq doctor looks at the machine",
        ),
        (
            "real time",
            {"cycles": 4054, "missed": 15936},
            {"refused": ("SCHED_FIFO",)},
            f"{TITLE}80 % of the slots missed (jtqd was not granted all that it asked for); "
            "jtq doctor looks at the machine",
        ),
        ("contacts", {"contacts": 2}, {"contacts": True}, "contacts      2"),
        ("contacts", {"contacts": 2}, {}, ""),
    ],
)
def test_lines_of_the_summary(
    begin: str, counters: dict[str, int], fields: dict[str, Any], expected: str
) -> None:
    assert lines_of(begin, counters, **fields) == ([expected] if expected else [])


@pytest.mark.parametrize(
    ("recording", "line", "status"),
    [
        (None, "none", 0),
        ({"path": "a.mcap", "paths": ["a.mcap"]}, "a.mcap", 0),
        ({"path": "b.mcap", "paths": ["a", "b"], "lost": 1}, "b.mcap (the last of 2 parts), 1 cycle lost", 3),
        ({"path": None, "flight_recordings": 0}, "none: no trigger", 0),
        ({"path": None, "error": "disk full", "lost": 7}, "none: disk full, 7 cycles lost", 3),
    ],
)
def test_what_became_of_the_log(recording: dict[str, Any] | None, line: str, status: int) -> None:
    assert lines_of("log ", recording=recording) == [f"log           {line}"]
    assert Summary(view(1), US, US, recording=recording).exit_status == status


@pytest.mark.parametrize(("watched", "contacts"), [(True, 2), (False, None)])
def test_the_summary_as_json(tmp_path: Path, watched: bool, contacts: int | None) -> None:
    reader = reader_of(tmp_path / "s", PUSHED, QUIET, contacts=2)
    found = summary_of(
        reader, {}, [], None, history=(), began_s=0.0, stolen_s=0.318, contacts=watched
    ).content()
    assert (found["contacts"], found["stolen_s"]) == (contacts, 0.32)


LATE = {"181h": {"late": 900, "lost": 3}, "281h": {"late": 40, "lost": 0}}


def of_statuses(**cycles: int) -> tuple[int, ...]:
    """Cycles of a joint by status."""
    return tuple(cycles.get(NAMES.get(code, ""), 0) for code in range(16))


@pytest.mark.parametrize(
    ("joints", "counters", "fields", "late"),
    [
        (({"stale": 900, "off": 100},) * 2, {}, {"bench": True}, "the emulated bench"),
        (({"stale": 900, "off": 100},) * 2, {}, {}, "the bus"),
        (({"stale": 900}, {"stale": 900}), {"missed": 60}, {"bench": True}, "this machine: 6 %"),
        (({"stale": 900}, {"stale": 900}), {}, {"late_us": (1.0, 900.0, 950.0)}, "this machine: 0 %"),
        (({"stale": 999, "valid": 1}, {"stale": 1000}), {}, {"bench": True}, ""),
        (({"stale": 10, "off": 990}, {"off": 1000}), {}, {}, ""),
        (({"off": 1000}, {"drive_fault": 1000}), {}, {}, ""),
    ],
)
def test_a_run_without_an_estimate_names_what_was_late(
    joints: tuple[dict[str, int], ...], counters: dict[str, int], fields: dict[str, Any], late: str
) -> None:
    counted = {"cycles": 940, **counters}
    seen = view(940, **counted)._replace(status_cycles=tuple(of_statuses(**each) for each in joints))
    options: dict[str, Any] = {"work_us": US, "late_us": US, "deadline_us": 850.0, "inputs": LATE} | fields
    made = Summary(seen, **options)
    assert made.exit_status == (1 if late else 0)
    [*lines] = [line for line in made.text().splitlines() if line.startswith("no estimate")]
    assert len(lines) == bool(late)
    if late:
        assert f"late was {late}" in lines[0]
        assert made.content()["no_estimate"] in lines[0]
    if "this machine" not in late and late:
        assert "850 us after SYNC 940 times, and 3 times not at all" in lines[0]


# Shadow methods


def with_shadows(path: Path) -> SnapshotReader:
    """Joint 1 has two shadow methods, joint 2 none."""
    made = Snapshot(path, 1e-3, 0.8)
    EstimateWriter(made).write(8, 8, 1, (VALID, VALID))
    unknown = 4 * (NAN,)
    values = (-121.5, 2.25, -118.5, 5.0, *unknown, -118.7, 0.6, -118.5, 5.0, *unknown, 2, 0, 3, 0)
    SHADOW.pack_into(made.shadows, 0, *values)
    made.shadow_errors[:3] = memoryview(struct.pack("<3d", 36.0, 64.0, 4.0)).cast("d")
    return SnapshotReader(path)


def test_shadow_methods_stand_below_their_joint(tmp_path: Path) -> None:
    reader = with_shadows(tmp_path / "s")
    for width in (80, 100):
        lines = [" ".join(line.replace("│", " ").split()) for line in shown(reader, width)]
        rows = [line.split()[0] for line in lines if line[:1] in "12" or line.startswith(("tob", "network"))]
        assert rows == ["1", "tob", "network", "2"]
        (tob,) = (line.split() for line in lines if line.startswith("tob"))
        (network,) = (line.split() for line in lines if line.startswith("network"))
        assert (tob[1], tob[2], tob[-2], tob[-1]) == ("-121.50", "2.25", "-3.00", "valid")
        assert (network[1], network[-2], network[-1]) == ("-118.70", "-0.20", "degraded")
        assert max(map(len, shown(reader, width))) <= width


def test_the_summary_has_the_error_of_each_shadow_method_beside_ours(tmp_path: Path) -> None:
    view = with_shadows(tmp_path / "s").read()
    lines = Summary(view, US, US).text().splitlines()
    at = lines.index("RMSE joint 1  no reference")
    assert lines[at + 1 : at + 4] == [
        "  tob         3.000 Nm against the sensor in motion, both 5.00 ms old (4.000 Nm against it now)",
        "  network     no reference",
        "RMSE joint 2  no reference",
    ]
    content = Summary(view, US, US).content()["shadow"]
    assert content["joint_2"] == {}
    assert content["joint_1"]["tob"] | {"status": ""} == {
        "torque_nm": -121.5,
        "sigma_nm": 2.25,
        "reference_nm": -118.5,
        "age_ms": 5.0,
        "rmse_nm": 3.0,
        "rmse_now_nm": 4.0,
        "status": "",
    }
    assert (content["joint_1"]["network"]["status"], content["joint_1"]["network"]["rmse_nm"]) == (
        "degraded",
        None,
    )
