"""`jtq plot`: a picture is written, and --json says where and what RMSE stands in its title."""

import json
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import LogError
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.estimator.status import DEGRADED, NAMES, STALE, STANDSTILL, VALID
from jtqd.sysid import plot as plot_command
from tests.daemon.logs.campaign_log import Joint, regular, write_log

pytest.importorskip("matplotlib")
ROWS = [  # status, estimate, sensor
    (VALID, 3.0, 1.0),
    (DEGRADED, 1.0, 2.0),
    (STANDSTILL, 9.0, 0.0),  # an interval: no error
    (STALE, np.nan, 5.0),
    (VALID, 4.0, np.nan),  # no reference
]


@pytest.fixture
def log(monkeypatch):
    names = ("sync_monotonic_ns", "status", "torque_nm", "sigma_nm", "reference_nm", "age_ms")
    table = np.array(
        [
            (n * 1_000_000, status, torque, 0.5, sensor, 1.25)
            for n, (status, torque, sensor) in enumerate(ROWS)
        ],
        dtype=[(name, "i8" if name == "sync_monotonic_ns" else "f8") for name in names],
    )
    asked = []

    def read_topic(path, topic):
        asked.append(topic)
        return table

    monkeypatch.setattr(plot_command, "read_topic", read_topic)
    monkeypatch.setattr(plot_command, "topics_of", lambda path: {})
    return asked


def test_json_names_the_picture_and_its_rmse(log, tmp_path, capsys):
    out = tmp_path / "joint2.png"
    assert plot_command.main(["run.mcap", "--joint", "2", "--out", str(out), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["paths"] == [str(out)]
    assert content["rmse_nm"] == {"joint_2": pytest.approx((2.5) ** 0.5)}
    assert log == ["/joint/2/state"]
    assert out.read_bytes().startswith(b"\x89PNG")


def test_without_json_the_path_alone_is_printed(log, tmp_path, capsys):
    out = tmp_path / "joint1.svg"
    assert plot_command.main(["run.mcap", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    assert out.read_text().startswith("<?xml")


def test_no_reference_at_all_is_null(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(plot_command, "draw", lambda *_: float("nan"))
    assert plot_command.main(["run.mcap", "--out", str(tmp_path / "a.png"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_nm"] == {"joint_1": None}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("p.xyz", "found the ending '.xyz', expected a picture: .png, .svg, .pdf"),
        ("p", "found no ending"),
        ("", "found no ending"),
        ("none/p.png", "none: found no such directory"),
    ],
)
def test_a_picture_that_cannot_be_written_is_refused_before_the_log_is_read(
    log, tmp_path, capsys, name, words
):
    assert plot_command.main(["run.mcap", "--out", str(tmp_path / name)]) == 1
    printed = capsys.readouterr().err
    assert words in printed
    assert printed.count("\n") == 1
    assert log == []


def test_a_log_that_cannot_be_read_is_one_line(tmp_path, capsys, monkeypatch):
    def refuse(path: Path, topic: str) -> None:
        raise LogError(f"{path}: not a log")

    monkeypatch.setattr(plot_command, "read_topic", refuse)
    assert plot_command.main(["run.mcap", "--out", str(tmp_path / "a.png"), "--json"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "jtq plot: run.mcap: not a log\n"


def test_every_status_has_a_colour_of_its_own(monkeypatch, tmp_path):
    """What was merely starting must not look like what was stale."""
    shades = plot_command._SHADES
    assert set(shades) == set(NAMES) - {VALID}
    assert len(set(shades.values())) == len(shades)


def test_the_legend_covers_no_data(log, tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    seen = []

    def look(figure, *_, **__):
        figure.canvas.draw()
        above = figure.axes[0]
        seen.append((above.get_window_extent(), above.get_legend().get_window_extent(), figure.bbox))

    monkeypatch.setattr(Figure, "savefig", look)
    assert plot_command.main(["run.mcap", "--out", str(tmp_path / "a.png")]) == 0
    ((axes, legend, whole),) = seen
    assert legend.x0 >= axes.x1
    assert legend.x1 <= whole.x1


def test_joint_four_without_a_reference_is_drawn(tmp_path, capsys):
    """From a log of four joints; there is nothing to compare with, and has no RMSE."""
    cycles = regular(30, lambda n: tuple(Joint(sensor_nm=float("nan")) for _ in range(4)))
    path = write_log(tmp_path / "a.mcap", cycles, 4)
    assert plot_command.main([str(path), "--joint", "4", "--out", str(tmp_path / "a.png"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_nm"] == {"joint_4": None}


def with_contacts(flags):
    names = ("sync_monotonic_ns", "status", "torque_nm", "sigma_nm", "reference_nm", "age_ms")
    more = ("contact_nm", "torque_rate_nm_s")
    table = np.zeros(len(flags), [(name, "f8") for name in (*names, *more)] + [("input_flags", "<u2")])
    table["sync_monotonic_ns"], table["status"] = np.arange(len(flags)) * 1e6, VALID
    table["contact_nm"], table["input_flags"] = 2.5, flags
    return table


def test_contacts_have_panels_where_they_were_watched(tmp_path):
    """Two contacts, reported in 3 of 6 cycles; the flags are those of the loop."""
    known, there = FLAG_CONTACT_KNOWN, FLAG_CONTACT_KNOWN | FLAG_CONTACT
    log = with_contacts([7, known, there, there, known, there])
    assert plot_command.contacts(log).tolist() == [False, False, True, True, False, True]
    assert plot_command.contacts(with_contacts([7, 7])) is None
    for name, flags in (("watched", log["input_flags"]), ("not", [7] * 6)):
        plot_command.draw(with_contacts(flags), 1, tmp_path / f"{name}.svg")
    texts = {name: (tmp_path / f"{name}.svg").read_text() for name in ("watched", "not")}
    for words in ("<!-- 2 contacts -->", "<!-- torque rate -->"):
        assert (words in texts["watched"], words in texts["not"]) == (True, False), words


def test_shadow_methods_are_in_the_picture_and_their_rmse_is_that_of_motion(
    log, tmp_path, capsys, monkeypatch
):
    """Each against the sensor as old as it; `network` is not computed. The cycle that only one topic has is left out."""
    names = [
        f"{name}_{what}" for name in ("tob", "network") for what in ("torque_nm", "reference_nm", "age_ms")
    ]
    values = [(3.0, 1.0, 5.0), (6.0, 2.0, 5.0), (9.0, 0.0, 5.0), (np.nan, 5.0, 5.0), (4.0, np.nan, 5.0)]
    shadow = np.array(
        [(n, *row, np.nan, np.nan, np.nan) for n, row in enumerate([*values, (99.0, 0.0, 5.0)])],
        dtype=[("cycle", "i8"), *((name, "f8") for name in names)],
    )
    state = plot_command.read_topic("run.mcap", "/joint/1/state")
    numbered = np.array(
        [(n, *row) for n, row in enumerate(state.tolist())], dtype=[("cycle", "i8"), *state.dtype.descr]
    )
    topics = {"/joint/1/state": numbered, "/joint/1/shadow": shadow}
    monkeypatch.setattr(plot_command, "read_topic", lambda path, topic: topics[topic])
    monkeypatch.setattr(plot_command, "topics_of", lambda path: topics)
    out = tmp_path / "p.svg"
    assert plot_command.main(["run.mcap", "--out", str(out), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["shadow_rmse_nm"] == {"tob": pytest.approx(10.0**0.5)}
    assert content["rmse_nm"] == {"joint_1": pytest.approx(2.5**0.5)}
    drawn = out.read_text()
    assert "<!-- classical TOB -->" in drawn
    assert "<!-- RMSE 3.16 Nm, 5 ms old -->" in drawn
    assert "chain" not in drawn
