"""Joint files written back: the same joint comes out, with where it came from, or the old file stays."""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import (
    AdditiveLoss,
    Effect,
    Friction,
    Fused,
    FusedSigma,
    Joint,
    LossSide,
    QuadrantPolynomial,
    Torsion,
)
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit import joint_writer
from jtqd.sysid.fit.joint_writer import joint_text, with_fit, write_joint
from tests.estimator.estimator_helpers import joint1

HASHES = {"forward_1_p0.2.csv.gz": "ab" * 32, "back_1_n3.0.csv.gz": "cd" * 32}


def fused() -> Fused:
    nodes, losses = (tuple(np.linspace(*ends, 25).tolist()) for ends in ((-36.0, 50.0), (0.1, 3.0)))
    side = LossSide(losses, losses, nodes, 0.7)
    loss = AdditiveLoss(nodes, side, side, 0.05, 3.0, 25.0, 2.0, 0.02)
    torsion = Torsion(12000.0, 1e9, -1.2e-5, (1.0, 2.0), (1e-5, 2e-5), (-1e-5, 0.1 + 0.2))
    return Fused(loss, torsion, FusedSigma(0.1, 0.2, 0.03, 0.4, 0.05, 0.3, (1.0, 1.1, 1.2, 1.3)))


EFFECTS = (
    Effect("torque_ripple", {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": -0.1}),
    Effect("lost_motion", {"width_rad": 1.5e-4}),
)
PROVENANCE = {
    "source": "a: b # no comment, äöü",
    "date": dt.date(2026, 1, 2),
    "lines": ["- one", "two: 3"],
    "log_sha256": "12" * 32,
    "deep": {"x": {"y": [1, 2.5e-7, None, True]}},
}


@pytest.mark.parametrize(
    ("joint", "lines"),
    [
        *((load_joint(shipped(n)), []) for n in ("joint1.yaml", "joint2.yaml", "kinova_gen3/joint2.yaml")),
        (replace(joint1(), effects=EFFECTS, provenance=PROVENANCE), ["  deep:"]),
        (replace(joint1(), fused=fused()), ["    orders_per_motor_rev: [1.0, 2.0]"]),
        (replace(joint1(), efficiency=None, provenance={}), []),
    ],
)
def test_a_joint_comes_back_equal(joint: Joint, lines: list[str], tmp_path: Path) -> None:
    write_joint(tmp_path / "j.yaml", joint, "title")
    assert load_joint(tmp_path / "j.yaml") == joint
    text = (tmp_path / "j.yaml").read_text().splitlines()
    assert set(lines) <= set(text)
    assert len(text) < 100, "a row per list"
    assert ("efficiency:" in text) == (joint.efficiency is not None)
    assert [path.name for path in tmp_path.iterdir()] == ["j.yaml"]


positive = st.floats(1e-9, 1e9)
any_float = st.floats(-1e30, 1e30)  # what a file may hold


@settings(deadline=None, max_examples=40)
@given(positive, positive, any_float, any_float, st.floats(0.0, 1e12))
def test_numbers_of_any_size_come_back_exactly(a: float, b: float, p: float, q: float, c: float) -> None:
    """YAML 1.1 takes 7e-5 for text and 1_0 for a number; what is written must be neither."""
    joint = joint1()
    assert joint.efficiency is not None
    quadrant = QuadrantPolynomial(p, q, a, b, -p, -q, rmse=c)
    joint = replace(
        joint,
        rotor_inertia_kgm2=a,
        stiffness_nm_per_rad=b,
        friction=Friction(c, c),
        efficiency=replace(joint.efficiency, i_neg_w_pos=quadrant),
    )
    text = joint_text(joint, "t")
    assert Joint.from_mapping(yaml.safe_load(text), "text") == joint


def test_the_text_is_made_to_be_read() -> None:
    lines = joint_text(joint1(), "Written by\njtq fit efficiency.").splitlines()
    assert lines[0] == "# Written by jtq fit efficiency."
    assert lines[1].startswith("# SI units.")
    rows = [line for line in lines if line.startswith("  i_pos_w_pos: {p00: 0.253, p10: 0.1493,")]
    assert len(rows) == 1
    assert rows[0].endswith("rmse: 0.01963}")
    assert max(map(len, lines)) <= 160


def test_provenance_of_a_fit_joins_what_was_there() -> None:
    joint = with_fit(
        joint1(),
        "efficiency",
        by="jtq fit efficiency",
        runs=HASHES,
        date="2026-11-21",
        temperature_c=31.26,
        notes={"plateaus": 164},
    )
    assert joint.provenance["source"] == joint1().provenance["source"]
    assert joint.provenance["efficiency"] == {
        "by": "jtq fit efficiency",
        "date": "2026-11-21",
        "temperature_c": 31.3,
        "plateaus": 164,
        "sha256": HASHES,
    }
    again = with_fit(joint, "friction", by="x", runs={}, date="2026-11-22", temperature_c=math.nan)
    assert set(again.provenance) == {"source", "temperature_c", "efficiency", "friction"}
    assert "temperature_c" not in again.provenance["friction"]
    assert replace(again, provenance=joint1().provenance) == joint1()


def test_the_old_file_stays_when_writing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "j.yaml"
    path.write_text("old")

    other = replace(joint1(), gear_ratio=50.0).to_mapping()
    monkeypatch.setattr(joint_writer, "parse_yaml", lambda data, name: other)
    with pytest.raises(ConfigError, match="reads back differently from the joint joint1"):
        write_joint(path, joint1(), "t")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["j.yaml"]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent/j.yaml: cannot be written: No such file"):
        write_joint(tmp_path / "absent" / "j.yaml", joint1(), "t")
