"""What is learned of the zeros is shown: conditions, reasons, objects of the own node, metrics, /diagnostics, summary."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from jtqd.daemon.bus.own_node import OwnNode
from jtqd.daemon.config import load_config
from jtqd.daemon.recording.diagnostics import Diagnostics
from jtqd.daemon.shared.reasons import degraded_reason
from jtqd.daemon.shared.snapshot import LEARNED, NO_ZEROS, Snapshot, SnapshotReader
from jtqd.daemon.supervisor.display import summary_of
from jtqd.daemon.supervisor.service import metrics_text
from jtqd.drivers.object_dictionary import ObjectStore, read_eds
from jtqd.estimator import status
from jtqd.estimator.status import DEGRADED, Zeros
from tests.daemon.snapshots import EstimateWriter
from tests.daemon.supervisor.watch_views import WELL, Observer, view
from tests.paths import ROOT

FOUND = Zeros(1.02e-4, 9e-6, 9.8e-5, 0.01, 0.02, 0.005, 2e-3, status.TRACKED | status.LEARNED, 0)
FAR = FOUND._replace(link_rad=2.31e-3, flags=FOUND.flags | status.BEYOND)


@pytest.fixture
def snapshot(tmp_path: Path) -> SnapshotReader:
    """One in which joint 1 has zeros and joint 2 none."""
    made = Snapshot(tmp_path / "snapshot", 1e-3, 0.8)
    values = (*FOUND[:7], FOUND.flags, FOUND.jumps, 4, b"past")
    made.learned[: LEARNED.size] = LEARNED.pack(*values)
    EstimateWriter(made).write(8, 8, 1, (WELL, WELL))
    return SnapshotReader(tmp_path / "snapshot", supervisor=True)


def test_a_zero_beyond_its_limit_is_a_condition_with_its_numbers() -> None:
    watch = Observer()
    (line,) = watch.lines(view(8, zeros=(FAR, NO_ZEROS)), 0.05)
    assert line.startswith(
        "joint 1: the link encoder's zero is +2.31 mrad, limit 2.00 mrad: the encoder has slipped"
    )
    assert watch.present() == [("zero_implausible", "joint 1")]
    (line,) = watch.lines(view(16, zeros=(FOUND, NO_ZEROS)), 6.0)
    assert "plausible again" in line


def test_a_zero_that_jumps_is_reported_until_it_is_known_again() -> None:
    watch = Observer()
    assert watch.lines(view(8, zeros=(FOUND, NO_ZEROS)), 0.0) == []
    lost = FOUND._replace(flags=status.TRACKED, jumps=1)
    (line,) = watch.lines(view(16, zeros=(lost, NO_ZEROS)), 0.05)
    assert line == "joint 1: the link encoder's zero has jumped, from +98 µrad, and is not known again yet"
    assert watch.lines(view(24, zeros=(lost, NO_ZEROS)), 3.0) == []
    (line,) = watch.lines(view(32, zeros=(FOUND._replace(jumps=1), NO_ZEROS)), 9.0)
    assert "learned again" in line
    assert watch.present() == []


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (status.BEYOND, r"zero is \+0.10 mrad, limit 2.00 mrad"),
        (status.LEFT, r"\+4 µrad of it are not yet taken off"),
        (status.APART, "current and torsion disagree"),
        (0, "network output is not finite"),
    ],
)
def test_the_reason_of_a_degraded_joint(flags: int, reason: str) -> None:
    seen = WELL._replace(status=DEGRADED)
    assert re.search(reason, degraded_reason(seen, 10.0, FOUND._replace(flags=FOUND.flags | flags)))


def test_they_are_objects_of_the_own_node(snapshot: SnapshotReader) -> None:
    store = ObjectStore(read_eds(ROOT / "drivers/eds/jtqd.eds", 0x20).entries, 0x20)
    OwnNode(store, load_config(None), snapshot)
    floats = [struct.unpack("<f", store.read(0x220A, sub))[0] for sub in range(1, 8)]
    assert floats == pytest.approx(list(FOUND[:7]))
    assert [store.read(0x220B, sub) for sub in range(1, 8)] == [bytes(4)] * 7
    assert (store.read(0x220E, 1), store.read(0x220E, 2)) == (b"\x03", b"\x00")
    assert store.read(0x220F, 1) == bytes(4)


def test_they_are_metrics_of_the_joints_that_track_them(snapshot: SnapshotReader) -> None:
    text = metrics_text(snapshot.read(), snapshot, "can0", 0)
    assert 'jtqd_link_zero_rad{bus="can0",joint="1"} 0.000102' in text
    assert 'jtqd_link_zero_sigma_rad{bus="can0",joint="1"} 9e-06' in text
    assert 'jtqd_link_zero_jumps_total{bus="can0",joint="1"} 0' in text
    assert not re.search(r'jtqd_link_zero.*joint="2"', text)


def test_they_are_in_diagnostics_and_in_the_summary(snapshot: SnapshotReader, tmp_path: Path) -> None:
    reading = snapshot.read()
    assert reading.pasts == (b"past", b"")
    _, statuses = Diagnostics(tmp_path / "snapshot", "can0", ["a", "b"], []).of_loop(0)
    one, two = (each.values for each in statuses if each.name.startswith("jtqd: joint"))
    assert (one["link_zero_rad"], one["zero_learned"]) == (FOUND.link_rad, "yes")
    assert "link_zero_rad" not in two
    summary = summary_of(snapshot, {}, [], None, history=(), began_s=0.0, stolen_s=0.0)
    assert f"zeros joint 1 {FOUND.text}" in summary.text()
    assert "zeros joint 2" not in summary.text()
    assert summary.content()["zeros"]["joint_1"]["link_rad"] == FOUND.link_rad
    assert summary.content()["zeros"]["joint_2"] is None
