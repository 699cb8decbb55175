"""A contact is where a user looks: `jtq status`, the live table, the lines of a log, the summary; and never an old one."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from jtqd.daemon.cli import status
from jtqd.daemon.cli.running import Daemon, Watch
from jtqd.daemon.cli.status import Moment, Recent, StatusView, content
from jtqd.daemon.config import ContactSettings, load_config
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.daemon.supervisor.display import LiveTable, Summary, plain_line, summary_of
from jtqd.daemon.supervisor.process import about
from tests.daemon.cli import status_daemon
from tests.daemon.snapshots import EstimateWriter

WATCHED = ContactSettings(threshold_nm=1.5)
KNOWN, THERE = FLAG_CONTACT_KNOWN, FLAG_CONTACT_KNOWN | FLAG_CONTACT


def joint(flags: int, contact_nm: float, rate: float = -640.0) -> tuple[float, ...]:
    return (*status_daemon.ONE[:9], flags | 15, *status_daemon.ONE[10:13], rate, contact_nm)


PUSHED, QUIET, UNKNOWN = joint(THERE, 2.93), joint(KNOWN, -0.31), joint(0, float("nan"), float("nan"))


def daemon(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    joints: tuple[tuple[float, ...], tuple[float, ...]],
    contact: ContactSettings | None = WATCHED,
    *,
    cycling: bool = True,
) -> Daemon:
    """What a daemon that watches leaves for others to see."""
    config = replace(load_config(None), contact=contact)
    monkeypatch.setattr(
        status_daemon, "described", lambda bus, log: about(config, bus=bus, instance=bus, log_directory=log)
    )
    monkeypatch.setattr(status_daemon, "ONE", joints[0])
    monkeypatch.setattr(status_daemon, "TWO", joints[1])
    return status_daemon.running(root, cycling=cycling)


def snapshot(path: Path, *joints: tuple[float, ...], contacts: int = 0) -> SnapshotReader:
    made = Snapshot(path, 1e-3, 0.8)
    made.counters[COUNTERS.index("contacts")] = contacts
    EstimateWriter(made).write(8, 8, 1, joints)
    return SnapshotReader(path)


@pytest.mark.parametrize("width", [60, 80, 140])
def test_jtq_status_shows_size_threshold_and_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    text = status_daemon.picture(daemon(tmp_path, monkeypatch, (PUSHED, QUIET)), width)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    shown = " ".join(text.split())
    for wanted in (
        "contact 1 CONTACT: +2.93 Nm from outside (threshold 1.50), torque rate -640 Nm/s",
        "contact 2 none: -0.31 Nm from outside (threshold 1.50), torque rate -640 Nm/s",
        "contacts none since the start",
    ):
        assert wanted in shown


def test_what_is_not_known_is_said_and_what_is_not_watched_takes_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, contact, expected in (("a", ContactSettings(), True), ("b", None, False)):
        (tmp_path / name).mkdir()
        text = status_daemon.picture(daemon(tmp_path / name, monkeypatch, (UNKNOWN, UNKNOWN), contact), 80)
        assert ("contact 1 unknown" in text) == ("contacts" in text) == expected


def test_a_short_contact_between_two_readings_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch, recent = Watch(daemon(tmp_path, monkeypatch, (QUIET, QUIET))), Recent()
    for second, contacts in enumerate((4, 4, 6)):
        recent.add(Moment(float(second), (0.0, 0.0), (1,), (1,), contacts))
    watch.read()
    file = io.StringIO()
    Console(file=file, width=80).print(StatusView(watch.read(), recent))
    assert "since the start, 2 in the last 2 s" in file.getvalue()


def test_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(daemon(tmp_path, monkeypatch, (PUSHED, UNKNOWN)))
    watch.read()
    one, two = json.loads(json.dumps(content(watch.read())))["joints"]
    names = ("contact", "contact_nm", "contact_threshold_nm", "torque_rate_nm_s")
    assert [one[name] for name in names] == [True, 2.93, 1.5, -640.0]
    assert [two[name] for name in names] == [None, None, 1.5, None]


def test_a_loop_that_stands_still_says_nothing_of_contacts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = daemon(tmp_path, monkeypatch, (QUIET, PUSHED), cycling=False)
    watch = Watch(still)
    watch.read()
    for each in content(watch.read())["joints"]:
        assert (each["contact"], each["contact_nm"], each["torque_rate_nm_s"]) == (None, None, None)
    assert "contact" not in status_daemon.picture(still, 80)


def rows(reader: SnapshotReader, width: int, *, contacts: bool) -> list[str]:
    view, file = reader.read(), io.StringIO()
    table = LiveTable(reader, view, view, 1_000_000, "jtqd on sim", contacts=contacts)
    Console(file=file, width=width).print(table)
    return file.getvalue().splitlines()


@pytest.mark.parametrize("width", range(24, 100))
def test_the_live_table_shows_a_contact_at_any_width(tmp_path: Path, width: int) -> None:
    shown = rows(snapshot(tmp_path / "s", PUSHED, QUIET, contacts=3), width, contacts=True)
    assert max(map(len, shown)) <= width
    text = " ".join("\n".join(shown).split())
    assert "+2.9 Nm" in text
    assert "-117.94" in text
    assert "valid" in text
    assert text.endswith("contacts 3")


def test_without_watching_the_live_table_is_as_before(tmp_path: Path) -> None:
    text = "\n".join(rows(snapshot(tmp_path / "s", UNKNOWN, UNKNOWN), 80, contacts=False))
    assert "contact" not in text
    for wanted in ("sigma [Nm]", "sensor [Nm]", "error [Nm]"):
        assert wanted in text


def test_lines_where_there_is_no_terminal(tmp_path: Path) -> None:
    reader = snapshot(tmp_path / "s", PUSHED, QUIET, contacts=1)
    view = reader.read()
    line = plain_line(reader, view, view, 1_000_000, contacts=True)
    assert (
        "joint 1 valid -117.94 +- 0.48 Nm, contact +2.9 Nm  joint 2 valid -117.94 +- 0.48 Nm  cycle" in line
    )
    assert line.endswith("contacts 1")


def test_the_summary(tmp_path: Path) -> None:
    def made(*, watched: bool) -> Summary:
        return summary_of(
            snapshot(tmp_path / f"s{watched}", PUSHED, QUIET, contacts=2),
            {},
            [],
            None,
            history=(),
            began_s=0.0,
            stolen_s=0.0,
            contacts=watched,
        )

    assert "contacts      2" in made(watched=True).text().splitlines()
    assert made(watched=True).content()["contacts"] == 2
    assert "contacts" not in made(watched=False).text()
    assert made(watched=False).content()["contacts"] is None


def test_a_live_view_remembers_the_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = daemon(tmp_path, monkeypatch, (QUIET, QUIET))
    watch, recent = Watch(made), Recent()
    watch.read()
    status._remember(recent, watch.read())
    writer = SnapshotReader(made.directory / "snapshot", supervisor=True)
    writer._views.counters[COUNTERS.index("contacts")] = 2
    status._remember(recent, watch.read())
    assert recent.contacts == 2
