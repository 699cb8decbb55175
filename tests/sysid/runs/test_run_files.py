"""Run files: what is read is what was written, and everything wrong is one clear line."""

import gzip
import random
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.checked import ConfigError
from jtqd.models.files import shipped
from jtqd.sysid.runs.files import ColumnMap, RunError, read_run

KINOVA = shipped("kinova_gen3/columns.yaml").parent
GOOD = "time_s,j1.current_a,j1.torque_nm\n0.000,1.5,-2\n0.001,2.5,-3\n0.002,3.5,-4\n"


def _file(folder: Path, content: str | bytes, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def _map(**targets: object) -> ColumnMap:
    return ColumnMap.from_mapping(
        {name.replace("__", "."): value for name, value in targets.items()}, "m.yaml", Path()
    )


def test_own_names_are_read_without_a_map_and_absent_columns_are_none(tmp_path: Path) -> None:
    run = read_run(_file(tmp_path, GOOD))
    joint = run.table.joints[1]
    assert run.table.time_s.tolist() == [0.0, 0.001, 0.002]
    assert joint.current_a is not None
    assert joint.current_a.tolist() == [1.5, 2.5, 3.5]
    assert joint.torque_nm is not None
    assert joint.torque_nm.tolist() == [-2.0, -3.0, -4.0]
    assert joint.motor_position_rad is None
    assert list(run.table.joints) == [1]
    assert run.notes == ()


def test_gzip_gives_the_same_table_and_its_own_hash(tmp_path: Path) -> None:
    plain = read_run(_file(tmp_path, GOOD))
    packed = read_run(_file(tmp_path, gzip.compress(GOOD.encode()), "run.csv.gz"))
    assert np.array_equal(plain.table.time_s, packed.table.time_s)
    assert plain.sha256 != packed.sha256


def test_map_renames_scales_shifts_and_flips(tmp_path: Path) -> None:
    path = _file(tmp_path, "ms,amps,unused,pos\n0,10,x,0.5\n1,20,nan,0.25\n")
    columns = _map(
        time_s={"column": "ms", "scale": 0.001, "offset": 5.0},
        j7__current_a={"column": "amps", "scale": -0.1},
        j7__motor_position_rad={"column": "pos", "scale": 100.0},
        j7__link_position_rad="pos",
    )
    table = read_run(path, columns).table
    joint = table.joints[7]
    assert table.time_s.tolist() == [5.0, 5.001]
    assert joint.current_a is not None
    assert joint.current_a.tolist() == [-1.0, -2.0]
    assert joint.motor_position_rad is not None
    assert joint.motor_position_rad.tolist() == [50.0, 25.0]
    assert joint.link_position_rad is not None
    assert joint.link_position_rad.tolist() == [0.5, 0.25]


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ({"j1.current_a": "A"}, "key 'time_s': missing"),
        ({"time_s": "t", "j1.curent_a": "A"}, "did you mean 'j1.current_a'"),
        ({"time_s": "t", "j8.current_a": "A"}, "j8.current_a"),
        ({"time_s": {"column": "t", "scael": 2.0}}, "did you mean 'scale'"),
        ({"time_s": {"column": "t", "scale": 0}}, "other than 0"),
        ({"time_s": {"column": "t", "scale": float("nan")}}, "a number"),
        ({"time_s": {"column": "t", "scale": "2"}}, "a number"),
        ({"time_s": {"scale": 2.0}}, "time_s.column': missing"),
        ({"time_s": 3}, "key 'time_s': found 3"),
        ({"time_s": "t", "j1.current_a": None}, "key 'j1.current_a': found None"),
    ],
)
def test_wrong_maps_are_named(mapping: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ColumnMap.from_mapping(mapping, "m.yaml", Path())
    assert said in str(caught.value)
    assert "m.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "empty file"),
        (" \n\n", "empty file"),
        ("time_s,j1.current_a\n", "0 samples"),
        ("time_s,j1.current_a\n0,1\n", "1 samples"),
        ("t,j1.current_a\n0,1\n1,2\n", "no column 'time_s'"),
        ("time_s,speed\n0,1\n1,2\n", "no joint's columns"),
        ("time_s,j1.current_a\n0,1\n1,fast\n", "line 3, column 'j1.current_a': found 'fast'"),
        ("time_s,j1.current_a\n0,1\n\n1,nan\n", "line 4, column 'j1.current_a': found 'nan'"),
        ("time_s,j1.current_a\n0,1\n1,inf\n", "line 3, column 'j1.current_a': found 'inf'"),
        ("time_s,j1.current_a\n0,\n1,2\n", "line 2, column 'j1.current_a': found ''"),
        ("time_s,j1.current_a\n0,1\n1\n", "line 3: found 1 cells, expected 2"),
        ("time_s,j1.current_a\n0,1\n1,2,3\n", "line 3: found 3 cells, expected 2"),
        ("time_s,time_s\n0,1\n1,2\n", "'time_s' twice"),
        ("time_s,j1.current_a\n0,1\n1,2\n1,3\n", "line 4: found time 1 s after 1 s"),
        ("time_s,j1.current_a\n0,1\n\n2,2\n1,3\n", "line 5: found time 1 s after 2 s"),
        ("time_s,j1.current_a\n0,1\n1,2\n2,3\n20,3\n21,3\n22,3\n", "line 5: found a gap of 18 s"),
        (b"time_s,j1.current_a\n0,\xff\n1,2\n", "byte 22 that is not UTF-8"),
        ('time_s,j1.current_a\n0,"1\n1,2\n', "found"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, content: str | bytes, said: str) -> None:
    path = _file(tmp_path, content)
    with pytest.raises(RunError) as caught:
        read_run(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0, 5, 30])
def test_broken_gzip_is_named(tmp_path: Path, keep: int) -> None:
    path = _file(tmp_path, gzip.compress(GOOD.encode())[:keep], "run.csv.gz")
    with pytest.raises(RunError, match=r"gzip|empty file"):
        read_run(path)
    path = _file(tmp_path, GOOD, "run.csv.gz")
    with pytest.raises(RunError, match="broken gzip"):
        read_run(path)


def test_other_formats_missing_files_and_missing_columns_are_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"'\.mcap', expected \.csv or \.csv\.gz"):
        read_run(_file(tmp_path, b"\x89MCAP", "run.mcap"))
    with pytest.raises(RunError, match="No such file"):
        read_run(tmp_path / "none.csv")
    with pytest.raises(RunError, match=r"no column 'Cur9', expected it for j2\.current_a"):
        read_run(_file(tmp_path, GOOD), _map(time_s="time_s", j2__current_a="Cur9"))


def test_a_scale_that_leaves_the_floats_is_named(tmp_path: Path) -> None:
    columns = _map(time_s="time_s", j1__current_a={"column": "j1.current_a", "scale": 1e308})
    with pytest.raises(RunError, match=r"run\.csv: j1\.current_a: found inf"):
        read_run(_file(tmp_path, GOOD.replace("2.5", "250")), columns)


def test_short_gaps_are_noted_not_refused(tmp_path: Path) -> None:
    content = "time_s,j1.current_a\n" + "".join(f"{t},1\n" for t in (0, 1, 2, 4, 5, 6, 9, 10))
    notes = read_run(_file(tmp_path, content)).notes
    assert len(notes) == 1
    assert notes[0].startswith("2 steps are longer")


def test_a_torque_channel_of_exact_zeros_is_dead_and_a_nearly_zero_one_is_not(tmp_path: Path) -> None:
    rows = [f"{k},1,0,{1e-9 if k == 77 else 0}" for k in range(100)]
    run = read_run(_file(tmp_path, "time_s,j1.current_a,j1.torque_nm,j2.torque_nm\n" + "\n".join(rows)))
    assert run.table.joints[1].torque_nm is None
    assert run.table.joints[1].current_a is not None
    assert run.table.joints[2].torque_nm is not None
    assert len(run.notes) == 1
    assert run.notes[0].startswith("j1.torque_nm is exactly zero in all 100 rows")


def test_shipped_runs_have_the_digits_of_the_source() -> None:
    columns = ColumnMap.load(KINOVA / "columns.yaml")
    opti = read_run(KINOVA / "opti_traj_testing1.csv.gz", columns)
    run1 = read_run(KINOVA / "RunTrajectory1.csv.gz", columns)
    assert len(opti.table.time_s) == 4741
    assert len(run1.table.time_s) == 1942
    assert np.allclose(np.diff(opti.table.time_s), 0.001, atol=1e-12)
    joint2 = opti.table.joints[2]
    assert joint2.link_position_rad is not None
    assert joint2.motor_position_rad is not None
    assert joint2.current_a is not None
    assert joint2.torque_nm is not None
    # First row of the source: Position2 1.19094, Cur2 -2.85206, TorqueSm2 -25.8335.
    assert (joint2.link_position_rad[0], joint2.current_a[0], joint2.torque_nm[0]) == (
        1.19094,
        -2.85206,
        -25.8335,
    )
    assert joint2.motor_position_rad[0] == pytest.approx(119.094)
    # The one known dead channel, and no other.
    assert opti.notes == ()
    assert [note.split()[0] for note in run1.notes] == ["j1.torque_nm"]
    assert run1.table.joints[1].torque_nm is None
    assert sorted(columns.joint_files) == [2, 4]


def test_damaged_files_never_raise_anything_else(tmp_path: Path) -> None:
    seed = 20
    print("seed", seed)
    random_ = random.Random(seed)
    for _ in range(400):
        data = bytearray(GOOD.encode())
        for _ in range(random_.randint(1, 4)):
            where = random_.randrange(len(data))
            data[where : where + random_.randint(0, 3)] = random_.randbytes(random_.randint(0, 3))
        packed = random_.random() < 0.3
        said = ""
        try:
            read_run(
                _file(tmp_path, gzip.compress(data) if packed else bytes(data), "x.csv" + ".gz" * packed)
            )
        except RunError as error:
            said = str(error)
        assert "\n" not in said
