"""A run table that is written is the run table that is read."""

import gzip
import os
import random
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.runs.files import read_run, write_run


def random_table(rng: np.random.Generator, rows: int) -> RunTable:
    """Any columns of any joints, of very different sizes; time with jitter."""
    scales = {"motor_position_rad": 6000.0, "motor_velocity_rad_s": 300.0, "temperature_c": 40.0}
    joints = {}
    for number in rng.permutation([1, 2, 3])[: rng.integers(1, 4)]:
        names = [name for name in COLUMN_NAMES if rng.random() < 0.7] or ["current_a"]
        joints[int(number)] = JointColumns(
            **{name: scales.get(name, 10.0) * rng.normal(size=rows) for name in names}
        )
    return RunTable(np.cumsum(rng.uniform(0.0009, 0.0011, rows)), joints)


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz"])
def test_any_table_comes_back_to_1e_9(tmp_path: Path, name: str) -> None:
    for seed in range(15):
        table = random_table(np.random.default_rng(seed), 60)
        sha256 = write_run(tmp_path / name, table)
        read = read_run(tmp_path / name)
        assert read.sha256 == sha256
        assert read.notes == ()
        assert set(read.table.joints) == set(table.joints), f"seed {seed}"
        assert np.abs(read.table.time_s - table.time_s).max() < 1e-10
        for number, columns in table.joints.items():
            for column in COLUMN_NAMES:
                wanted, found = getattr(columns, column), getattr(read.table.joints[number], column)
                assert (wanted is None) == (found is None), f"seed {seed}, {column}"
                if wanted is not None:
                    assert np.abs(found - wanted).max() < 1e-9, f"seed {seed}, {column}"


def test_the_same_table_is_the_same_file(tmp_path: Path) -> None:
    table = random_table(np.random.default_rng(7), 100)
    one, two = (write_run(tmp_path / name, table) for name in ("a.csv.gz", "b.csv.gz"))
    assert one == two
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    assert (tmp_path / "a.csv.gz").read_bytes()[4:8] == bytes(4), "no time of writing in the gzip header"
    header = gzip.decompress((tmp_path / "a.csv.gz").read_bytes()).decode().splitlines()[0].split(",")
    assert header[0] == "time_s"
    assert [name.split(".")[0] for name in header[1:]] == sorted(name.split(".")[0] for name in header[1:])


def test_a_disk_that_is_full_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = random_table(np.random.default_rng(1), 50)
    write_run(tmp_path / "run.csv", table)
    before = (tmp_path / "run.csv").read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_run(tmp_path / "run.csv", random_table(np.random.default_rng(2), 50))
    assert (tmp_path / "run.csv").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["run.csv"]


def test_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected \.csv or \.csv\.gz"):
        write_run(tmp_path / "run.parquet", random_table(np.random.default_rng(1), 10))


def test_numbers_a_text_could_get_wrong_survive(tmp_path: Path) -> None:
    rng = random.Random(3)
    hard = [1e-10, -1e-10, 123456.7890123456, -0.0, 1e15, -2.5e-9, 0.1 + 0.2, 5e-324]
    values = np.array([*hard, *(rng.uniform(-1, 1) * 10 ** rng.randint(-9, 6) for _ in range(200))])
    table = RunTable(np.arange(len(values)) * 1e-3, {1: JointColumns(current_a=values)})
    write_run(tmp_path / "run.csv", table)
    found = read_run(tmp_path / "run.csv").table.joints[1].current_a
    assert found is not None
    assert np.all(np.abs(found - values) <= 1e-9 + 1e-15 * np.abs(values))
