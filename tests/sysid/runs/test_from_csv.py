"""`jtq init --from-csv`: files, report and errors; and the way from a table to the first answer of `jtq diagnose`."""

import json
import re
import shlex

import numpy as np
import pytest
import yaml

from jtqd.daemon import jtq
from jtqd.estimator.joint import ELASTIC
from jtqd.models.files import load_joint
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run

RATIO, KT, ROTOR = 101.0, 0.07, 6e-5
COULOMB, VISCOUS = 4.0, 2.0
"""Truth [Nm, Nms/rad]; the joint file of the test has 2.5 Nm."""


def recording(seed, *, link=False):
    """Return columns of a joint that swings a pendulum of 5 kg at 0.3 m, as a drive and a torque sensor record them."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 12.0, 0.004)
    q = sum(a * np.sin(w * t + p) for a, w, p in random.uniform((0.1, 0.5, 0.0), (0.25, 2.5, 6.28), (4, 3)))
    v = np.gradient(q, t)
    acceleration = np.gradient(v, t)
    torque = 0.5 * acceleration + 5.0 * 9.81 * 0.3 * np.sin(q)
    loss = COULOMB * np.tanh(v / 0.005) + VISCOUS * v
    current = (torque + loss + RATIO**2 * ROTOR * acceleration) / (RATIO * KT)
    columns = {
        "timestamp [ms]": 1000.0 * t + 5e5,
        "Motor Angle [deg]": np.round(np.degrees(RATIO * q) * 65536 / 360) * 360 / 65536,
        "Iq [mA]": 1000.0 * (current + random.normal(0.0, 0.02, len(t))),
        "Torque Sensor [Nm]": torque + random.normal(0.0, 0.05, len(t)),
        "Temp [C]": np.full(len(t), 31.0),
    }
    return columns | ({"Output Angle [deg]": np.degrees(q + torque / 1e4)} if link else {})


def written(path, columns):
    rows = "\n".join(";".join(f"{x:.5f}" for x in row) for row in zip(*columns.values(), strict=True))
    path.write_text(";".join(columns) + "\n" + rows + "\n")
    return path


def init(*arguments):
    return jtq.main(["init", "--from-csv", *map(str, arguments)])


def filled(path, **values):
    """Put values in place of ??? and take the # away, as a user does."""
    lines = path.read_text().splitlines()
    for key, value in values.items():
        [at] = [k for k, line in enumerate(lines) if line.startswith(f"# {key}: ")]
        lines[at] = f"{key}: {value}"
    path.write_text("\n".join(lines) + "\n")


SHEET = {
    "gear_ratio": 101,
    "torque_constant_nm_per_a": 0.07,
    "rotor_inertia_kgm2": "6.0e-5",
    "rated_torque_nm": 40,
    "friction": "{coulomb_nm: 2.5, viscous_nms_per_rad: 2.0}",
}


def test_from_a_table_to_the_first_answer_in_two_commands(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in range(3):
        written(tmp_path / f"swing_{seed}.csv", recording(seed))
    assert init(*(f"swing_{seed}.csv" for seed in range(3))) == 0
    out = capsys.readouterr().out
    assert re.search(r"Temp \[C\] +- .*shows nothing", out)
    command = out.splitlines()[-1].split()
    assert command[:2] == ["jtq", "diagnose"]
    arguments = shlex.split(out.splitlines()[-1])[1:]

    assert jtq.main(arguments) == 1
    [error] = capsys.readouterr().err.splitlines()
    assert re.findall(r"key '(\w+)': missing", error) == list(SHEET)
    assert not any(key in error for key in ELASTIC)

    filled(tmp_path / "joint.yaml", **SHEET)
    assert jtq.main([*arguments, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    causes = {cause["name"]: cause["parameters"] for cause in found["causes"]}
    assert list(causes) == ["coulomb_friction"]
    assert causes["coulomb_friction"]["coulomb_nm"]["value"] == pytest.approx(COULOMB, rel=0.03)
    extended = load_joint(tmp_path / "diagnosis" / "extended.joint.yaml", elastic=False)
    assert np.isnan(extended.stiffness_nm_per_rad)


def test_two_encoders_give_the_gear_ratio_and_need_a_stiffness(tmp_path, capsys):
    table = written(tmp_path / "a.csv", recording(1, link=True))
    assert init(table, "--out", tmp_path / "rig") == 0
    text = (tmp_path / "rig" / "joint.yaml").read_text()
    assert yaml.safe_load(text) == {"name": "joint1", "gear_ratio": 101}
    assert all(f"# {key}: ???" in text for key in ELASTIC)
    filled(tmp_path / "rig" / "joint.yaml", **{key: SHEET[key] for key in list(SHEET)[1:]})
    capsys.readouterr()
    files = ("--columns", tmp_path / "rig" / "columns.yaml", "--joint", tmp_path / "rig" / "joint.yaml")
    assert jtq.main(["diagnose", *map(str, (table, *files, "--out", tmp_path / "d"))]) == 1
    assert re.findall(r"key '(\w+)': missing", capsys.readouterr().err) == list(ELASTIC)


def test_the_proposed_map_reads_the_table_in_si_units(tmp_path):
    columns = recording(2)
    table = written(tmp_path / "a.csv", columns)
    assert init(table, "--out", tmp_path) == 0
    run = read_run(table, ColumnMap.load(tmp_path / "columns.yaml")).table
    assert run.time_s == pytest.approx(columns["timestamp [ms]"] / 1000.0)
    assert run.joints[1].motor_position_rad == pytest.approx(
        np.radians(columns["Motor Angle [deg]"]), abs=1e-5
    )
    assert run.joints[1].current_a == pytest.approx(columns["Iq [mA]"] / 1000.0, abs=1e-5)
    assert run.joints[1].temperature_c is None


def test_what_has_no_sensor_asks_for_load_and_drive(tmp_path):
    columns = recording(3)
    table = {
        "t": columns["timestamp [ms]"] / 1000.0,
        "counts": np.round(columns["Motor Angle [deg]"] / 360 * 4096),
        "duty": columns["Iq [mA]"] / 10.0,
    }
    assert init(written(tmp_path / "a.csv", table), "--out", tmp_path) == 0
    text = (tmp_path / "columns.yaml").read_text()
    assert yaml.safe_load(text) == {"time_s": "t"}
    filled(
        tmp_path / "columns.yaml",
        **{
            "j1.motor_position_rad": '"rev2rad(counts / 4096)"',
            "j1.link_position_rad": '"rev2rad(counts / 4096) / 101"',
            "j1.drive": '{voltage_v: "0.024 * duty", resistance_ohm: 1.0, back_emf_vs_per_rad: 0.07}',
            "j1.load": "{mass_kg: 5.0, lever_m: 0.3}",
        },
    )
    run = read_run(tmp_path / "a.csv", ColumnMap.load(tmp_path / "columns.yaml")).table
    assert run.joints[1].current_a is not None
    assert run.joints[1].torque_nm is not None


def test_parquet_and_several_joints(tmp_path, capsys):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    t = np.arange(0.0, 5.0, 0.005)
    table = {"t": t, "note": ["x"] * len(t)}
    for n in (1, 2):
        table |= {f"pos{n}": np.sin(n * t), f"cur{n}": np.cos(n * t), f"torque{n}": np.cos(n * t + 0.5)}
    parquet.write_table(pa.table(table), tmp_path / "a.parquet")
    assert init(tmp_path / "a.parquet", "--out", tmp_path) == 0
    out = capsys.readouterr().out
    assert "text: 'x'" in out
    assert f"--joint 1={tmp_path}/joint_1.yaml --joint 2={tmp_path}/joint_2.yaml" in out
    assert set(yaml.safe_load((tmp_path / "columns.yaml").read_text())) == {
        "time_s",
        *(f"j{n}.{key}" for n in (1, 2) for key in ("link_position_rad", "current_a", "torque_nm")),
    }


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", "", "found an empty file"),
        ("a.csv", "t,pos\n", "fewer than 2 rows"),
        ("a.csv", "t,pos\na,b\nc,d\n", "no column of numbers"),
        ("a.csv", "t,pos\ns,deg\n0,1\n1,2\n", "no column of numbers (column 't' has 's')"),
        (
            "a.csv",
            "t|pos\n0|1\n1|2\n",
            "(column 't|pos' has '0|1'), expected numbers from the row below the header on",
        ),
        ("a.csv", "time,pos\n2024-11-27,1\n2024-11-28,2\n", "not numbers: 'time' ('2024-11-27')"),
        ("a.csv", "0.0,1,2\n0.1,1,2\n", "line 1: found numbers, expected a header row"),
        ("a.csv", "t,t\n0,1\n1,2\n", "column 't' twice"),
        ("a.csv", "t,pos\n0,1\n1\n", "line 3: found 1 cell, expected 2"),
        ("a.csv", "a,b\n0,1\n0,1\n", "no column that rises"),
        ("a.csv", "t,b\n0,1\n0.01,1\n", "no column that its name makes one of a joint"),
        ("a.csv", b"\xff\xfe\x00", "not UTF-8"),
        ("a.parquet", b"PAR1", "not a readable Parquet file"),
        ("a.mcap", b"x", "found a file ending in '.mcap'"),
        ("none.csv", None, "no such file"),
    ],
)
def test_what_is_no_recording_is_one_line(tmp_path, capsys, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    assert init(tmp_path / name, "--out", tmp_path / "o") == 1
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1
    assert words in captured.err
    assert not captured.out
    assert not (tmp_path / "o").exists()


def test_names_of_columns_do_not_control_the_terminal(tmp_path, capsys):
    columns = recording(5)
    names = {"Iq [mA]": "Iq\x1b[31m [mA]", "Temp [C]": "x" * 300}
    table = written(tmp_path / "a.csv", {names.get(name, name): x for name, x in columns.items()})
    assert init(table, "--out", tmp_path / "o") == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert r"Iq\x1b[31m [mA]" in out
    assert max(map(len, out.split("\n\n")[0].splitlines())) < 160
    columns_map = ColumnMap.load(tmp_path / "o" / "columns.yaml")
    assert read_run(table, columns_map).table.joints[1].current_a is not None


def test_every_column_that_is_not_used_has_a_reason(tmp_path, capsys):
    columns = recording(6)
    spare = {"U [V]": columns["Iq [mA]"] * 1e-3, "Duty": columns["Iq [mA]"] * 1e-4}
    assert init(written(tmp_path / "a.csv", columns | spare), "--out", tmp_path / "o") == 0
    rows = capsys.readouterr().out.split("\n\n")[0].splitlines()
    spared = [row for row in rows if "not needed besides 'Iq [mA]'" in row]
    assert [row.split()[0] for row in spared] == ["U", "Duty"]


def test_help_needs_no_file(capsys):
    with pytest.raises(SystemExit) as ended:
        init("--help")
    assert ended.value.code == 0
    assert "--out DIR" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        init("--out", "x")
    assert ended.value.code == 2
    assert "expected one or more" in capsys.readouterr().err


def test_files_that_are_there_stay_without_force(tmp_path, capsys):
    table = written(tmp_path / "a.csv", recording(4))
    (tmp_path / "joint.yaml").write_text("mine")
    assert init(table, "--out", tmp_path) == 2
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "joint.yaml").read_text() == "mine"
    assert not (tmp_path / "columns.yaml").exists()
    assert init(table, "--out", tmp_path, "--force") == 0
    assert "???" in (tmp_path / "joint.yaml").read_text()
