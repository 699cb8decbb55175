"""Run files: reading, writing, segments, duplicates; every error is one line."""

import doctest
import gzip
import math
import os
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import export
from jtqd.estimator import text
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.models.files import shipped
from jtqd.sysid import runs
from jtqd.sysid.diagnosis import command as diagnose
from jtqd.sysid.runs import column_names
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run, read_runs, run_paths, same_run, windows
from jtqd.sysid.runs.run_file import RunError
from jtqd.sysid.runs.tables import write_run
from tests.paths import ROOT
from tests.sysid.runs.spoiled_runs import column

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


def test_own_names_are_read_without_a_map_and_absent_columns_are_none(tmp_path):
    run = read_run(_file(tmp_path, GOOD))
    assert run.table.time_s.tolist() == [0.0, 0.001, 0.002]
    assert column(run.table, "current_a").tolist() == [1.5, 2.5, 3.5]
    assert column(run.table, "torque_nm").tolist() == [-2.0, -3.0, -4.0]
    assert run.table.joints[1].motor_position_rad is None
    assert list(run.table.joints) == [1]
    assert run.notes == ()


def test_gzip_gives_the_same_table_and_its_own_hash(tmp_path):
    plain = read_run(_file(tmp_path, GOOD))
    packed = read_run(_file(tmp_path, gzip.compress(GOOD.encode()), "run.csv.gz"))
    assert np.array_equal(plain.table.time_s, packed.table.time_s)
    assert plain.sha256 != packed.sha256


def test_map_renames_scales_shifts_and_flips(tmp_path):
    path = _file(tmp_path, "ms,amps,unused,pos\n0,10,x,0.5\n1,20,nan,0.25\n")
    columns = _map(
        time_s={"column": "ms", "scale": 0.001, "offset": 5.0},
        j7__current_a={"column": "amps", "scale": -0.1},
        j7__motor_position_rad={"column": "pos", "scale": 100.0},
        j7__link_position_rad="pos",
    )
    table = read_run(path, columns).table
    assert table.time_s.tolist() == [5.0, 5.001]
    assert column(table, "current_a", 7).tolist() == [-1.0, -2.0]
    assert column(table, "motor_position_rad", 7).tolist() == [50.0, 25.0]
    assert column(table, "link_position_rad", 7).tolist() == [0.5, 0.25]


@pytest.mark.parametrize(
    ("mapping", "expected"),
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
        ({"j1.current_a": "A"}, "missing, expected a column of the file, an expression of columns, or {column:"),
        ({"time_s": ["a"]}, "found ['a'], expected a column of the file, an expression of columns, or {column:"),
        ({"time_s": {"scale": 2.0}}, "missing, expected a column of the file, or an expression of columns"),
        ({"time_s": {"column": 3}}, "found 3, expected a column of the file, or an expression of columns"),
    ],
)  # fmt: skip
def test_wrong_maps_are_named(mapping, expected):
    with pytest.raises(ConfigError) as caught:
        ColumnMap.from_mapping(mapping, "m.yaml", Path())
    assert expected in str(caught.value)
    assert "m.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "empty file"),
        (" \n\n", "empty file"),
        ("time_s,j1.current_a\n", "0 samples"),
        ("time_s,j1.current_a\n0,1\n", "1 sample below"),
        ("t,j1.current_a\n0,1\n1,2\n", "no column 'time_s'"),
        ("time_s,speed\n0,1\n1,2\n", "no joint's columns"),
        ("time_s,j1.current_a\n0,1\n1,fast\n", "line 3, column 'j1.current_a': found 'fast'"),
        ("time_s,j1.current_a\n0,1\n\n1,nan\n", "line 4, column 'j1.current_a': found 'nan'"),
        ("time_s,j1.current_a\n0,1\n1,inf\n", "line 3, column 'j1.current_a': found 'inf'"),
        ("time_s,j1.current_a\n0,\n1,2\n", "line 2, column 'j1.current_a': found ''"),
        ("time_s,j1.current_a\n0,1\n1\n", "line 3: found 1 cell, expected 2"),
        ("time_s,j1.current_a\n0,1\n1,2,3\n", "line 3: found 3 cells, expected 2"),
        ("time_s,time_s\n0,1\n1,2\n", "'time_s' twice"),
        ("time_s,j1.current_a\n0,1\n1,2\n1,3\n", "line 4: found time 1 s after 1 s"),
        ("time_s,j1.current_a\n0,1\n\n2,2\n1,3\n", "line 5: found time 1 s after 2 s"),
        ("time_s,j1.current_a\n0,1\n1,2\n2,3\n20,3\n21,3\n22,3\n", "line 5: found a gap of 18 s"),
        (b"time_s,j1.current_a\n0,\xff\n1,2\n", "byte 22 that is not UTF-8"),
        (bytes(4096), "an empty file"),
        ('time_s,j1.current_a\n0,"1\n1,2\n', "found"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, content, expected):
    path = _file(tmp_path, content)
    with pytest.raises(RunError) as caught:
        read_run(path)
    assert expected in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


T = np.arange(0.0, 4.0, 0.01)


def _table(path: Path, columns: dict[str, object], separator: str = ",") -> Path:
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    lines = [separator.join(columns), *(separator.join(str(cell) for cell in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_time_that_starts_again_is_another_run(tmp_path):
    noise = np.random.default_rng(0).normal(size=3 * len(T))
    gap = np.concatenate((T[T < 1.5], T[T > 2.1]))
    time_s = np.concatenate((T, gap, 100.0 + T))
    cells = {"time_s": time_s, "j1.current_a": noise[: len(time_s)], "j1.motor_position_rad": time_s}
    path = _table(tmp_path / "a.csv", cells)
    [first, *others] = read_runs([path], segments=True)
    names = [run.name for run in (first, *others)]
    assert names == ["a.csv (run 1 of 2)", "a.csv (run 2 of 2) (1 of 3)"] + [
        f"a.csv (run 2 of 2) ({k} of 3)" for k in (2, 3)
    ]
    assert "the time starts again 1 time: 2 runs in one file" in first.notes
    assert "run 2: 2 steps are longer than 1.5 times the median of 0.01 s" in first.notes
    assert all(run.notes == () for run in others)
    assert first.table.time_s.tolist() == T.tolist()
    with pytest.raises(RunError, match="one run in a file here"):
        read_run(path)


def test_one_wrong_stamp_is_no_other_run(tmp_path):
    for row, stamp in ((250, 0.3), (250, 2.4)):
        time_s = T.copy()
        time_s[row] = stamp
        path = _table(tmp_path / "a.csv", {"time_s": time_s, "j1.current_a": T})
        with pytest.raises(RunError, match=f"line {row + 2}: found time .*expected rising time"):
            read_runs([path], segments=True)


@pytest.mark.parametrize("stamp", [0.0, 1.7e9])
def test_a_time_that_stands_is_refused(tmp_path, stamp):
    path = _table(tmp_path / "a.csv", {"time_s": np.full(len(T), stamp), "j1.current_a": T})
    with pytest.raises(RunError, match=r"line 3: found time .* after .*, expected rising time"):
        read_runs([path], segments=True)


def test_rows_written_twice_are_left_out_with_a_note(tmp_path):
    t = 0.002 * np.arange(2000.0)
    rows = np.sort(np.concatenate((np.arange(2000), [700, 900, 900])))
    cells = {"time_s": t[rows], "j1.current_a": np.sin(t)[rows]}
    path = _table(tmp_path / "twice.csv", cells)
    [run] = read_runs([path], segments=True)
    assert run.table.time_s.tolist() == t.tolist()
    assert run.notes == ("3 of 2003 rows left out: they are the row before once more",)
    with pytest.raises(RunError, match=r"line 703: found time 1\.4 s after 1\.4 s, expected rising time"):
        read_run(path)
    cells["j1.current_a"][701] += 0.1  # one of both has a wrong time
    with pytest.raises(RunError, match=r"line 703: found time 1\.4 s after 1\.4 s, expected rising time"):
        read_runs([_table(tmp_path / "stamp.csv", cells)], segments=True)


def test_stamps_that_were_rounded_to_the_same_number_are_spread(tmp_path):
    """1 kHz of a clock that goes to and fro, rounded to ms: no row is too many, and the stamps then jitter."""
    late = 4e-3 * np.sin(4.0 * math.pi * np.arange(3000) / 3000) + 1e-3 * np.random.default_rng(1).uniform(
        -0.1, 0.7, 3000
    )
    t = np.round(0.001 * np.arange(3000.0) + late, 3)
    assert np.any(np.diff(t) == 0.0)
    [run] = read_runs(
        [_table(tmp_path / "a.csv", {"time_s": t, "j1.current_a": np.sin(t + late)})], segments=True
    )
    assert np.all(np.diff(run.table.time_s) > 0.0)
    assert run.table.time_s == pytest.approx(t, abs=1.01e-3)
    count = np.count_nonzero(np.diff(t) == 0.0)
    assert f"{count} stamps not after the one before: spread between neighbours" in run.notes


def test_stamps_that_jitter_by_a_step_are_spread(tmp_path):
    """A host stamps what it receives: now and then two rows come late, the first more than the second."""
    t = 0.001 * np.arange(3000.0)
    t[[500, 1700]] += 1.3e-3
    [run] = read_runs([_table(tmp_path / "a.csv", {"time_s": t, "j1.current_a": np.sin(t)})], segments=True)
    assert np.all(np.diff(run.table.time_s) > 0.0)
    assert run.table.time_s == pytest.approx(0.001 * np.arange(3000.0), abs=1.4e-3)
    assert "2 stamps not after the one before: spread between neighbours" in run.notes
    t[500] += 0.1  # no jitter: one wrong stamp
    with pytest.raises(RunError, match=r"line 503: found time .*expected rising time"):
        read_runs([_table(tmp_path / "a.csv", {"time_s": t, "j1.current_a": np.sin(t)})], segments=True)


def test_an_unfinished_last_row_is_left_out_with_a_note(tmp_path):
    path = _table(tmp_path / "a.csv", {"time_s": T, "j1.current_a": T + 1.0, "j1.motor_position_rad": T})
    whole = path.read_text()
    path.write_text(whole + "5.0,6.")
    [run] = read_runs([path], segments=True)
    assert run.table.time_s.tolist() == T.tolist()
    assert run.notes == ("the last row left out: it ends after '5.0,6.'",)
    with pytest.raises(RunError, match="found 2 cells, expected 3"):
        read_run(path)
    path.write_text(whole.rstrip())  # whole, without its line's end
    assert read_runs([path], segments=True)[0].notes == ()
    path.write_text(whole + "5.0,6.0\n")
    with pytest.raises(RunError, match="found 2 cells, expected 3"):
        read_runs([path], segments=True)


def test_one_run_twice_in_a_file_is_refused(tmp_path):
    current = np.random.default_rng(1).normal(size=len(T))
    cells = {"time_s": T, "j1.current_a": current, "j1.motor_position_rad": np.cumsum(current)}
    path = _table(tmp_path / "a.csv", {name: np.tile(column, 2) for name, column in cells.items()})
    with pytest.raises(RunError, match=r"same run \(a.csv \(run 2 of 2\)\) as in a.csv \(run 1 of 2\)"):
        read_runs([path], segments=True)


def test_gaps_make_segments_that_keep_their_time(tmp_path):
    """Gaps of 0.5 and 0.1 s; one of three rows is bridged; a segment of half a second is left out."""
    t = np.arange(0.0, 6.0, 0.004)
    keep = np.ones(len(t), bool)
    for start, end in ((1.0, 1.014), (2.0, 2.5), (4.0, 4.1), (4.6, 4.7)):
        keep &= ~((t > start) & (t < end))
    t = t[keep]
    path = _table(tmp_path / "a.csv", {"time_s": t, "j1.current_a": np.sin(t), "j1.torque_nm": np.cos(t)})
    with pytest.raises(RunError, match="found a gap of 0"):
        read_run(path)
    segments = read_runs([path], segments=True)
    assert [run.name for run in segments] == ["a.csv (1 of 3)", "a.csv (2 of 3)", "a.csv (3 of 3)"]
    assert [float(run.table.time_s[0]) for run in segments] == pytest.approx([0.0, 2.5, 4.7])
    assert len({run.sha256 for run in segments}) == 1
    assert "3 gaps of more than 0.025 s: used as 3 segments of one recording" in " ".join(segments[0].notes)
    assert segments[1].notes == ()


def test_segments_that_are_all_too_short_are_refused(tmp_path):
    t = np.arange(0.0, 6.0, 0.004)
    t = t[(t % 0.5) < 0.4]
    path = _table(tmp_path / "a.csv", {"time_s": t, "j1.current_a": np.sin(t)})
    with pytest.raises(
        RunError,
        match=r"found 12 segments between gaps, the longest of 0\.\d+ s, expected one of at least 1 s",
    ):
        read_runs([path], segments=True)


def test_a_short_whole_recording_is_one_segment(tmp_path):
    path = _table(tmp_path / "a.csv", {"time_s": T[:50], "j1.current_a": np.sin(T[:50])})
    [run] = read_runs([path], segments=True)
    assert run.name == "a.csv"


def test_rows_with_a_blank_cell_are_gaps(tmp_path):
    current, warm = np.round(np.sin(T), 3).astype(object), np.full(len(T), "", object)
    current[[50, 51]], current[200:220] = "", "NaN"
    path = _table(tmp_path / "a.csv", {"time_s": T, "j1.current_a": current, "j1.temperature_c": warm})
    first, second = read_runs([path], segments=True)
    assert "22 of 400 rows left out for a blank cell ('j1.current_a' in 22)" in first.notes
    assert "column 'j1.temperature_c' is blank in every row: taken as absent" in first.notes
    assert first.table.joints[1].temperature_c is None
    assert (len(first.table.time_s), float(second.table.time_s[0])) == (198, 2.2)
    with pytest.raises(RunError, match=r"line 2, column 'j1.temperature_c': found ''"):
        read_run(path)
    current[7] = "inf"
    with pytest.raises(RunError, match=r"line 9, column 'j1.current_a': found 'inf'"):
        read_runs([_table(path, {"time_s": T, "j1.current_a": current})], segments=True)


def test_a_column_of_a_known_load_cannot_be_blank(tmp_path):
    path = _table(tmp_path / "a.csv", {"t": T, "q": np.full(len(T), "", object), "i": T})
    load = {"inertia_kgm2": 0.1}
    columns = _map(time_s="t", j1__link_position_rad="q", j1__current_a="i", j1__load=load)
    with pytest.raises(RunError, match="column 'q': found it blank in every row"):
        read_runs([path], columns, segments=True)


def test_a_comma_separates_wherever_the_header_has_one(tmp_path):
    path = _file(tmp_path, '"t; x; y",i\n0.0,1\n0.1,2\n')
    assert read_run(path, _map(time_s="t; x; y", j1__current_a="i")).table.time_s.tolist() == [0.0, 0.1]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_comma_in_a_name_separates_nothing_where_the_rows_have_none(tmp_path, separator):
    path = _table(tmp_path / "a.csv", {"Zeit, ms": 1e3 * T, "Strom, A": T + 1.0}, separator)
    columns = _map(time_s={"column": "Zeit, ms", "scale": 1e-3}, j1__current_a="Strom, A")
    assert np.allclose(read_run(path, columns).table.time_s, T)
    path.write_text(path.read_text().replace(".", ","))
    run = read_run(path, columns)
    assert np.allclose(run.table.time_s, T)
    assert np.allclose(column(run.table, "current_a"), T + 1.0)
    assert "numbers have decimal commas" in run.notes
    path.write_text(path.read_text().replace("3,99", "3.99"))
    with pytest.raises(RunError, match="expected a finite number with a decimal comma"):
        read_run(path, columns)


def test_thousands_apart_by_commas_are_no_decimal_commas(tmp_path):
    path = _file(tmp_path, 'time_s,j1.current_a\n0.5,"1,000"\n1.5,"2,000"\n')
    with pytest.raises(RunError, match=r"found '1,000', expected a finite number with a decimal point"):
        read_run(path)


def test_motions_that_a_diagnosis_wrote_beside_runs_are_none(tmp_path):
    _file(tmp_path, GOOD)
    _file(tmp_path, "run,time_s,position_rad\na,0,0\n", "next_experiment.motion.csv")
    assert [path.name for path in run_paths([tmp_path])] == ["run.csv"]


def test_endings_in_capitals_are_read(tmp_path):
    for name, content in (("LOG001.CSV", GOOD.encode()), ("LOG002.CSV.GZ", gzip.compress(GOOD.encode()))):
        _file(tmp_path, content, name)
    assert [path.name for path in run_paths([tmp_path])] == ["LOG001.CSV", "LOG002.CSV.GZ"]
    plain = read_run(_file(tmp_path, GOOD)).table.time_s.tolist()
    assert all(
        read_run(tmp_path / name).table.time_s.tolist() == plain for name in ("LOG001.CSV", "LOG002.CSV.GZ")
    )


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_are_read(tmp_path, separator):
    path = _table(tmp_path / "a.csv", {"time_s": T, "j1.current_a": T + 1.0}, separator)
    assert column(read_run(path).table, "current_a").tolist() == (T + 1.0).tolist()
    path.write_text(path.read_text().replace("3.0", "3,0"))
    with pytest.raises(RunError, match="expected a finite number with a decimal point"):
        read_run(path)


@pytest.mark.parametrize("keep", [0, 5, 30])
def test_broken_gzip_is_named(tmp_path, keep):
    path = _file(tmp_path, gzip.compress(GOOD.encode())[:keep], "run.csv.gz")
    with pytest.raises(RunError, match=r"gzip|empty file"):
        read_run(path)
    path = _file(tmp_path, GOOD, "run.csv.gz")
    with pytest.raises(RunError, match="broken gzip"):
        read_run(path)


def test_other_formats_missing_files_and_missing_columns_are_named(tmp_path):
    with pytest.raises(RunError, match=r"'\.xlsx', expected \.csv, \.csv\.gz, \.parquet, \.mcap"):
        read_run(_file(tmp_path, GOOD, "run.xlsx"))
    with pytest.raises(RunError, match="not a readable MCAP file"):
        read_run(_file(tmp_path, b"\x89MCAP", "run.mcap"))
    with pytest.raises(RunError, match=r"none\.csv: found no such file"):
        read_run(tmp_path / "none.csv")
    with pytest.raises(RunError, match="found a directory, expected a run file"):
        read_run(tmp_path)
    with pytest.raises(RunError, match=r"no column 'Cur9', expected it for j2\.current_a"):
        read_run(_file(tmp_path, GOOD), _map(time_s="time_s", j2__current_a="Cur9"))


def test_a_scale_that_leaves_the_floats_is_named(tmp_path):
    columns = _map(time_s="time_s", j1__current_a={"column": "j1.current_a", "scale": 1e30})
    with pytest.raises(RunError, match=r"run\.csv: j1\.current_a: found inf"):
        read_run(_file(tmp_path, GOOD.replace("2.5", "1e300")), columns)


def test_short_gaps_are_noted_not_refused(tmp_path):
    content = "time_s,j1.current_a\n" + "".join(f"{t},1\n" for t in (0, 1, 2, 4, 5, 6, 9, 10))
    notes = read_run(_file(tmp_path, content)).notes
    assert len(notes) == 1
    assert notes[0].startswith("2 steps are longer")


def test_a_torque_channel_of_exact_zeros_is_dead_and_a_nearly_zero_one_is_not(tmp_path):
    rows = [f"{k},1,0,{1e-9 if k == 77 else 0}" for k in range(100)]
    run = read_run(_file(tmp_path, "time_s,j1.current_a,j1.torque_nm,j2.torque_nm\n" + "\n".join(rows)))
    assert run.table.joints[1].torque_nm is None
    assert run.table.joints[1].current_a is not None
    assert run.table.joints[2].torque_nm is not None
    assert len(run.notes) == 1
    assert run.notes[0].startswith("j1.torque_nm is exactly zero in every row")


def test_shipped_runs_have_the_digits_of_the_source():
    columns = ColumnMap.load(KINOVA / "columns.yaml")
    opti = read_run(KINOVA / "opti_traj_testing1.csv.gz", columns)
    run1 = read_run(KINOVA / "RunTrajectory1.csv.gz", columns)
    assert len(opti.table.time_s) == 4741
    assert len(run1.table.time_s) == 1942
    assert np.allclose(np.diff(opti.table.time_s), 0.001, atol=1e-12)
    names = ("link_position_rad", "current_a", "torque_nm", "motor_position_rad")
    # first row of the source: Position2 1.19094, Cur2 -2.85206, TorqueSm2 -25.8335
    first = [column(opti.table, name, 2)[0] for name in names]
    assert first == [1.19094, -2.85206, -25.8335, pytest.approx(119.094)]
    # the one known dead channel
    assert opti.notes == ()
    assert [note.split()[0] for note in run1.notes] == ["j1.torque_nm"]
    assert run1.table.joints[1].torque_nm is None
    assert sorted(columns.joint_files) == [2, 4]


def test_damaged_files_never_raise_anything_else(tmp_path):
    random_ = random.Random(20)
    for _ in range(400):
        data = bytearray(GOOD.encode())
        for _ in range(random_.randint(1, 4)):
            where = random_.randrange(len(data))
            data[where : where + random_.randint(0, 3)] = random_.randbytes(random_.randint(0, 3))
        packed = random_.random() < 0.3
        content = gzip.compress(data) if packed else bytes(data)
        message = ""
        try:
            read_run(_file(tmp_path, content, "x.csv" + ".gz" * packed))
        except RunError as error:
            message = str(error)
        assert "\n" not in message


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
def test_any_table_comes_back_to_1e_9(tmp_path, name):
    for seed in range(15):
        table = random_table(np.random.default_rng(seed), 60)
        sha256 = write_run(tmp_path / name, table)
        read = read_run(tmp_path / name)
        assert read.sha256 == sha256
        assert read.notes == ()
        assert set(read.table.joints) == set(table.joints), f"seed {seed}"
        assert np.abs(read.table.time_s - table.time_s).max() < 1e-10
        for number, columns in table.joints.items():
            for each in COLUMN_NAMES:
                wanted, found = getattr(columns, each), getattr(read.table.joints[number], each)
                assert (wanted is None) == (found is None), f"seed {seed}, {each}"
                if wanted is not None:
                    assert np.abs(found - wanted).max() < 1e-9, f"seed {seed}, {each}"


def test_the_same_table_is_the_same_file(tmp_path):
    table = random_table(np.random.default_rng(7), 100)
    one, two = (write_run(tmp_path / name, table) for name in ("a.csv.gz", "b.csv.gz"))
    assert one == two
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    assert (tmp_path / "a.csv.gz").read_bytes()[4:8] == bytes(4), "no time of writing in the gzip header"
    header = gzip.decompress((tmp_path / "a.csv.gz").read_bytes()).decode().splitlines()[0].split(",")
    assert header[0] == "time_s"
    assert [name.split(".")[0] for name in header[1:]] == sorted(name.split(".")[0] for name in header[1:])


def test_a_disk_that_is_full_leaves_the_earlier_file(tmp_path, monkeypatch):
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


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"expected \.csv or \.csv\.gz"):
        write_run(tmp_path / "run.parquet", random_table(np.random.default_rng(1), 10))


def test_numbers_a_text_could_get_wrong_survive(tmp_path):
    rng = random.Random(3)
    hard = [1e-10, -1e-10, 123456.7890123456, -0.0, 1e15, -2.5e-9, 0.1 + 0.2, 5e-324]
    values = np.array([*hard, *(rng.uniform(-1, 1) * 10 ** rng.randint(-9, 6) for _ in range(200))])
    table = RunTable(np.arange(len(values)) * 1e-3, {1: JointColumns(current_a=values)})
    write_run(tmp_path / "run.csv", table)
    found = column(read_run(tmp_path / "run.csv").table, "current_a")
    assert np.all(np.abs(found - values) <= 1e-9 + 1e-15 * np.abs(values))


def test_paths_may_be_text(tmp_path):
    (tmp_path / "a.csv").write_text("t,i\n0.000,1.5\n0.001,1.6\n0.002,1.6\n")
    (tmp_path / "columns.yaml").write_text("time_s: t\nj1.current_a: i\n")
    columns = str(tmp_path / "columns.yaml")
    for where in (str(tmp_path), [str(tmp_path)], tmp_path):
        [run] = read_runs(where, columns)
        assert (run.path, run.table.joints[1].current_a.tolist()) == (tmp_path / "a.csv", [1.5, 1.6, 1.6])
    assert ColumnMap.load(columns) == ColumnMap.load(Path(columns))


def test_a_directory_is_its_tables_and_names_are_unique(tmp_path):
    """A campaign's directory holds the log of every run beside its table: read once, not twice."""
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, seed in ((one, 1), (other, 2)):
        folder.mkdir()
        write_run(folder / "a.csv.gz", random_table(np.random.default_rng(seed), 20))
    _file(one, b"not looked at", "a.mcap")
    _file(one, GOOD, ".hidden.csv")
    read = read_runs([one, other / "a.csv.gz"])
    assert [run.name for run in read] == ["a.csv.gz", str(other / "a.csv.gz")]
    assert [(run.path, run.source) for run in read] == [(d / "a.csv.gz", "csv") for d in (one, other)]
    assert repr(read[0]) == f"RunFile(a.csv.gz, csv, {read[0].table!r})"
    for segments in (False, True):
        with pytest.raises(RunError, match=r"one/a\.csv\.gz: found it twice, expected every run once"):
            read_runs([one, one / "a.csv.gz"], segments=segments)
    shutil.copy(one / "a.csv.gz", one / "twin.csv.gz")
    with pytest.raises(RunError, match=r"same data as in a\.csv\.gz, expected every run once"):
        read_runs([one])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(RunError, match=r"no run file in it, expected any of \.csv, "):
        read_runs([empty])


def test_a_column_map_may_be_given_as_its_file(tmp_path):
    path = _file(tmp_path, GOOD.replace("j1.current_a", "I"))
    columns = _file(tmp_path, "time_s: time_s\nj1.current_a: {column: I, scale: 2.0}\n", "columns.yaml")
    [run] = read_runs([path], columns)
    assert column(run.table, "current_a").tolist() == [3.0, 5.0, 7.0]


# One run in two files -------------------------------------------------------------------------------------------

LOG = ROOT / "tests" / "golden" / "network.mcap"
COUNT_RAD, LEVEL_A = 2.0 * np.pi / 65536, 0.005


def swung(seed: int, rows: int = 20_000, moves: float = 1.0, levels: float = 3.0) -> RunTable:
    """One motion as counts, and current in steps; moves: part of the time; levels: noise in steps of current."""
    rng = np.random.default_rng(seed)
    time_s = 1e-3 * np.arange(rows)
    swing = np.sin(np.minimum(2.0 * np.pi * 0.5 * time_s, 2.0 * np.pi * 0.5 * moves * time_s[-1]))
    position = np.round(40.0 * swing / COUNT_RAD) * COUNT_RAD
    current = np.round(swing / LEVEL_A + levels * rng.normal(size=rows) / 3.0) * LEVEL_A
    return RunTable(time_s, {1: JointColumns(current_a=current, motor_position_rad=position)})


def part(table: RunTable, rows: slice, digits: int = 17) -> RunTable:
    """These rows, with so many digits."""

    def rounded(_: str, numbers: np.ndarray) -> np.ndarray:
        return np.array([float(f"{number:.{digits}g}") for number in numbers[rows]])

    time_s = table.time_s[rows] - table.time_s[rows][0]
    return RunTable(time_s, {number: each.map(rounded) for number, each in table.joints.items()})


@pytest.mark.parametrize(
    ("rows", "digits"), [(slice(None), 17), (slice(None), 7), (slice(3000, 9000), 9), (slice(5, None), 8)]
)
def test_the_same_samples_are_the_same_run(rows, digits):
    whole = swung(1)
    assert same_run(windows(whole), windows(part(whole, rows, digits)))
    assert same_run(windows(part(whole, rows, digits)), windows(whole))


@pytest.mark.parametrize("moves", [1.0, 0.1])
@pytest.mark.parametrize("levels", [3.0, 1.0, 0.0])
def test_runs_of_one_motion_are_not(moves, levels):
    """Also with little noise, and mostly at rest; without any noise they are not judged."""
    one, two = (windows(swung(seed, moves=moves, levels=levels)) for seed in (1, 2))
    if levels:
        assert not same_run(one, two)
    elif moves < 1.0:
        assert not one, "not judged"


def test_other_joints_and_missing_columns_are_not_compared():
    table = swung(1)
    other = RunTable(table.time_s, {2: table.joints[1]})
    assert not same_run(windows(table), windows(other))
    assert windows(RunTable(table.time_s, {1: JointColumns(current_a=table.joints[1].current_a)})) == {}
    assert windows(swung(1, rows=100)) == {}


def test_one_joint_that_differs_makes_another_run():
    one, two = swung(1), swung(2)
    both = [RunTable(one.time_s, {1: one.joints[1], 2: each.joints[1]}) for each in (one, two)]
    assert not same_run(*map(windows, both))


def test_a_log_and_its_table_are_refused_in_one_line(tmp_path, capsys):
    table = tmp_path / "exported.csv"
    export.main(["csv", str(LOG), "--out", str(table)])
    capsys.readouterr()
    with pytest.raises(RunError, match=r"exported\.csv: found the same run as in network\.mcap"):
        read_runs([LOG, table], segments=True)
    joint = str(ROOT / "models" / "joint1.yaml")
    assert diagnose.main([str(LOG), str(table), "--joint", joint, "--out", str(tmp_path / "d")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "expected every run once" in error


def test_a_table_of_all_cycles_is_the_same_run_without_its_blank_cells(tmp_path):
    table = tmp_path / "all.csv"
    export.main(["csv", str(LOG), "--out", str(table), "--all-cycles"])
    [found] = read_runs([table], segments=True)
    assert "193 of 1050 rows left out for a blank cell ('j1.temperature_c' in 193" in found.notes[0]
    with pytest.raises(RunError, match=r"found the same run as in network\.mcap"):
        read_runs([LOG, table], segments=True)


@pytest.mark.parametrize(
    "text",
    [
        "# recorded 2026-01-01\n\n# rig 3\n" + GOOD,
        "# rig 3\n# " + GOOD,
        "% rig 3\n% " + GOOD,
        "// rig 3\n//" + GOOD,
        GOOD.replace("\n", "\n# under way\n"),
        GOOD.replace("\n", "\n// a, remark, more, of it\n"),
        GOOD + "% end of the recording",
        *(
            GOOD + f"0.003,{word},-5\n0.004,3.5,{word}\n"
            for word in (
                "nan",
                "-nan(ind)",
                "nan(ind)",
                "-1.#IND",
                "1.#QNAN",
                "-nan(snan)",
                "N/A",
                "#N/A",
                "+NaN",
            )
        ),
        GOOD + "#N/A,1.5,-5\n",
    ],
)
def test_comments_and_words_for_a_blank_cell(tmp_path, text):
    [run] = read_runs([_file(tmp_path, text)], segments=True)
    assert run.table.time_s.tolist() == [0.0, 0.001, 0.002]
    assert column(run.table, "torque_nm").tolist() == [-2.0, -3.0, -4.0]


def test_a_row_that_begins_with_a_blank_cell_is_no_comment(tmp_path):
    [run] = read_runs([_file(tmp_path, GOOD + "#N/A,1.5,-5\n# the end\n")], segments=True)
    assert run.notes[0] == "1 of 4 rows left out for a blank cell ('time_s' in 1)"


def _interleaved(rows, values, first="t,q,i"):
    """A table of two topics; `values`: which of them each row has, in turn."""
    cells = {"q": "{0},", "i": ",{0}", "both": "{0},{0}", "": ","}
    lines = [f"{n / 1000:.3f},{cells[values[n % len(values)]].format(n % 7)}" for n in range(rows)]
    return "\n".join([first, *lines]) + "\n"


@pytest.mark.parametrize(
    ("values", "interleaved"),
    [
        (["q", "i"], True),
        (["q", "q", "i"], True),
        (["q", "i", "", "i"], True),
        ([*["q", "i"] * 10, "both"], True),
        (["both", "i"], False),  # one topic at half the rate, on the stamps of the other
        (["both", "i", "i", "i", "i", "i"], False),
        ([*["both"] * 2000, "q", "i"], False),
    ],
)
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_topics_with_stamps_of_their_own_are_told(tmp_path, values, interleaved, ending):
    path = _file(tmp_path, _interleaved(6000, values))
    if ending == "parquet":
        pytest.importorskip("pyarrow")
        from pyarrow import csv, parquet

        parquet.write_table(csv.read_csv(path), tmp_path / "a.parquet")
        path = tmp_path / "a.parquet"
    columns = _map(time_s="t", j1__current_a="i", j1__motor_position_rad="q")
    if not interleaved:
        notes = read_runs([path], columns, segments=True)[0].notes
        assert "rows left out for a blank cell" in notes[0]
        return
    words = r": found columns '[qi]' and '[qi]' filled in different rows: topics with stamps of their own"
    with pytest.raises(RunError, match=words):
        read_runs([path], columns, segments=True)


def test_lines_are_counted_with_the_comments(tmp_path):
    with pytest.raises(RunError, match=r"line 5, column 'j1.current_a': found 'x'"):
        read_run(_file(tmp_path, "# rig 3\n\n" + GOOD.replace("2.5", "x")))


@pytest.mark.parametrize("text", ["0.0,1.5\n0.1,2.5\n", "# a rig\n0.0,1.5\n0.1,2.5\n"])
def test_a_header_of_numbers_is_refused_as_such(tmp_path, text):
    with pytest.raises(RunError, match=r"line [12]: found numbers, expected a header row"):
        read_run(_file(tmp_path, text), _map(time_s="0", j1__current_a="1"))


def test_columns_that_are_counted_are_names(tmp_path):
    run = read_run(_file(tmp_path, "0,1\n0.0,1.5\n0.1,2.5\n"), _map(time_s="0", j1__current_a="1"))
    assert column(run.table, "current_a").tolist() == [1.5, 2.5]


def test_two_runs_are_read(tmp_path):
    for seed in (1, 2):
        write_run(tmp_path / f"{seed}.csv", swung(seed, rows=3000))
    assert len(read_runs([tmp_path])) == 2


def test_the_examples_in_the_docstrings_hold():
    for module in (runs, text, column_names):
        result = doctest.testmod(module)
        assert result.attempted
        assert not result.failed
