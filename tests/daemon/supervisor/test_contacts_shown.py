"""A contact in `jtq status`; never an old one."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from jtqd.daemon.cli.status import Recent, StatusView
from jtqd.daemon.config import ContactSettings, load_config
from jtqd.daemon.live.reading import Daemon, Watch, content
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.daemon.supervisor.process import about
from tests.daemon.cli import status_daemon

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


def test_unknown_is_shown_and_what_is_not_watched_takes_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, contact, expected in (("a", ContactSettings(), True), ("b", None, False)):
        (tmp_path / name).mkdir()
        text = status_daemon.picture(daemon(tmp_path / name, monkeypatch, (UNKNOWN, UNKNOWN), contact), 80)
        assert ("contact 1 unknown" in text) == ("contacts" in text) == expected


def test_a_short_contact_between_two_readings_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = daemon(tmp_path, monkeypatch, (QUIET, QUIET))
    watch, recent = Watch(made), Recent()
    writer = SnapshotReader(made.directory / "snapshot", supervisor=True)
    for second, contacts in enumerate((4, 4, 6)):
        writer._views.counters[COUNTERS.index("contacts")] = contacts
        recent.add(float(second), watch.read())
    assert recent.contacts == 2
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


def test_a_loop_that_stands_still_has_no_contacts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = daemon(tmp_path, monkeypatch, (QUIET, PUSHED), cycling=False)
    watch = Watch(still)
    watch.read()
    for each in content(watch.read())["joints"]:
        assert (each["contact"], each["contact_nm"], each["torque_rate_nm_s"]) == (None, None, None)
    assert "contact" not in status_daemon.picture(still, 80)
