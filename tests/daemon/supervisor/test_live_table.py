"""The live table at every width of a terminal: nothing is cut, and torque and status are always there."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.daemon.supervisor.display import LiveTable
from tests.daemon.snapshots import EstimateWriter

NAN = float("nan")
JOINTS = (
    (-117.94, 0.48, NAN, NAN, NAN, -118.48, 0x27, 2, 0, 7, 0, -118.48, 1.25, NAN, NAN),
    (
        3.0,
        0.5,
        NAN,
        NAN,
        NAN,
        NAN,
        0x08,
        5,
        0,
        7,
        0,
        NAN,
        1.25,
        NAN,
        NAN,
    ),  # drive_fault, the longest status: its torque must not show
)


@pytest.fixture
def table(tmp_path: Path) -> LiveTable:
    EstimateWriter(Snapshot(tmp_path / "s", 1e-3, 0.8)).write(8, 8, 1, JOINTS)
    reader = SnapshotReader(tmp_path / "s")
    view = reader.read()
    return LiveTable(reader, view, view, 1_000_000, "jtqd on sim, node 20h")


def lines(table: LiveTable, width: int) -> list[str]:
    file = io.StringIO()
    Console(file=file, width=width, force_terminal=False).print(table)
    return file.getvalue().splitlines()


def test_80_columns_show_everything(table: LiveTable) -> None:
    text = "\n".join(lines(table, 80))
    for wanted in ("sigma [Nm]", "sensor [Nm]", "error [Nm]", "-117.94", "0.48", "-118.48", "0.54", "valid"):
        assert wanted in text


@pytest.mark.parametrize("width", range(12, 82))
def test_torque_and_status_are_whole_at_any_width(table: LiveTable, width: int) -> None:
    shown = lines(table, width)
    assert max(map(len, shown)) <= width
    text = "\n".join(shown)
    assert "…" not in text
    assert "-117.94" in text
    assert "valid" in text
    assert "drive_fault" in text
    assert "3.00" not in text


def test_columns_go_in_the_order_of_their_worth(table: LiveTable) -> None:
    optional = ("sensor [Nm]", "error [Nm]", "sigma [Nm]")
    seen = []
    for width in range(80, 30, -1):
        text = "\n".join(lines(table, width))
        left = tuple(name for name in optional if name in text)
        if not seen or seen[-1] != left:
            seen.append(left)
    assert seen == [optional, optional[1:], optional[2:], ()]
