"""Column maps: expressions of columns; known loads and voltage drives, on a pendulum whose torque and current are known."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jtqd.estimator.errors import ConfigError
from jtqd.sysid.runs.column_map import ColumnMap, ExpressionError, KnownLoad, motion_of, parse
from jtqd.sysid.runs.files import read_run, read_runs
from jtqd.sysid.runs.run_file import RunError
from tests.sysid.runs.spoiled_runs import column

T = np.arange(0.0, 6.0, 0.004)
Q = 0.8 * np.sin(2.0 * T) + 0.2 * np.sin(5.0 * T)
V = 1.6 * np.cos(2.0 * T) + np.cos(5.0 * T)
A = -3.2 * np.sin(2.0 * T) - 5.0 * np.sin(5.0 * T)
MASS, LEVER, INERTIA, HANGS, RATIO = 1.3, 0.21, 0.075, 0.1, 50.0
TORQUE = INERTIA * A + MASS * 9.80665 * LEVER * np.sin(Q - HANGS)
OHM, EMF = 2.1, 0.02
LOAD = {"mass_kg": MASS, "lever_m": LEVER, "inertia_kgm2": INERTIA, "hangs_at_rad": HANGS}


def table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    values = np.column_stack(list(columns.values()))
    lines = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in values)]
    path.write_text("\n".join(lines) + "\n")
    return path


def mapping(**more: object) -> dict[str, object]:
    return {
        "time_s": "stamp_s + 1e-3 * stamp_ms",
        "j1.link_position_rad": "deg2rad(angle)",
        **{k.replace("__", "."): v for k, v in more.items()},
    }


def made(**more: object) -> ColumnMap:
    return ColumnMap.from_mapping(mapping(**more), "m.yaml", Path())


def rig(path: Path) -> Path:
    whole = np.floor(T)
    current = TORQUE / RATIO / 0.05
    volts = OHM * current + EMF * RATIO * V
    return table(
        path,
        {
            "stamp_s": whole,
            "stamp_ms": 1e3 * (T - whole),
            "angle": np.rad2deg(Q),
            "i": current,
            "duty": volts / 12.0,
            "gravity": TORQUE - 2.0,
            "rest": np.full(len(T), 2.0),
        },
    )


def test_a_known_load_is_the_torque_of_its_motion(tmp_path):
    run = read_run(rig(tmp_path / "a.csv"), made(j1__current_a="i", j1__load=LOAD))
    found = column(run.table, "torque_nm")
    inner = slice(10, -10)
    assert np.max(np.abs(found - TORQUE)[inner]) < 0.01 * np.max(np.abs(TORQUE))
    assert run.table.time_s == pytest.approx(T)
    assert "known load of 1.3 kg at 0.21 m" in run.notes[0]
    assert "no effect of a torque sensor is looked for" in run.notes[0]


def test_without_an_inertia_the_load_is_a_point_mass():
    load = made(j1__load={"mass_kg": 2.0, "lever_m": 0.5}).loads[1]  # type: ignore[index]
    assert load == KnownLoad(None, 2.0, 0.5, 0.5)


def test_a_models_torque_is_a_known_load(tmp_path):
    columns = made(j1__current_a="i", j1__load={"torque_nm": "gravity + rest"})
    assert columns.known_loads == (1,)
    found = read_run(rig(tmp_path / "a.csv"), columns).table.joints[1].torque_nm
    assert found == pytest.approx(TORQUE, abs=1e-6)


@pytest.mark.parametrize("with_speed", [True, False])
def test_a_drive_that_gives_duty(tmp_path, with_speed):
    path = rig(tmp_path / "a.csv")
    more: dict[str, object] = {"j1__motor_position_rad": f"{RATIO} * deg2rad(angle)"}
    if with_speed:
        text = path.read_text().splitlines()
        text = [text[0] + ",w", *(f"{line},{RATIO * v:.9g}" for line, v in zip(text[1:], V, strict=True))]
        path.write_text("\n".join(text) + "\n")
        more["j1__motor_velocity_rad_s"] = "w"
    drive = {"voltage_v": "12 * duty", "resistance_ohm": OHM, "back_emf_vs_per_rad": EMF}
    run = read_run(path, made(j1__drive=drive, **more))
    found = column(run.table, "current_a")
    true = TORQUE / RATIO / 0.05
    assert np.max(np.abs(found - true)[10:-10]) < 0.01 * np.max(np.abs(true))
    assert "a wrong resistance shows as torque_constant" in run.notes[0]


def test_the_window_follows_the_motion_and_not_the_noise():
    noisy = Q + np.random.default_rng(3).normal(0.0, 1e-4, len(T))
    velocity, acceleration = motion_of(T, noisy)
    inner = slice(10, -10)
    assert np.std((velocity - V)[inner]) < 0.02
    assert np.std((acceleration - A)[inner]) < 1.0  # second differences of this noise: 15 rad/s2
    short = motion_of(T[:3], Q[:3])
    assert short[0].shape == short[1].shape == (3,)


@pytest.mark.parametrize(("rate_hz", "noise_rad"), [(100.0, 0.0), (100.0, 1e-5), (1000.0, 1e-5)])
def test_the_acceleration_of_a_load_is_known_as_far_as_it_is_judged(rate_hz, noise_rad):
    """Of a swing at 10 Hz of 0.05 rad; a load's torque is judged below 12 Hz."""
    t = np.arange(0.0, 10.0, 1.0 / rate_hz)
    swing = 0.05 * np.sin(2.0 * np.pi * 10.0 * t)
    _, acceleration = motion_of(t, swing + noise_rad * np.random.default_rng(4).normal(size=len(t)))
    true = -((2.0 * np.pi * 10.0) ** 2) * swing
    kept = acceleration[20:-20] @ true[20:-20] / (true[20:-20] @ true[20:-20])
    assert 0.93 < kept < 1.01


DRIVE = {"voltage_v": "v", "resistance_ohm": 1.0, "back_emf_vs_per_rad": 0.1}


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"j1.load": {"mass_kg": 1.0}}, "key 'j1.load.lever_m': missing"),
        ({"j1.load": {"mass_kg": -1.0, "lever_m": 1.0}}, "found -1.0, expected a number in kg >= 0"),
        ({"j1.load": {"mass": 1.0, "lever_m": 1.0}}, "'j1.load.mass': unknown key, did you mean 'mass_kg'"),
        ({"j1.load": {"torque_nm": "x", "mass_kg": 1.0}}, "key 'j1.load.mass_kg': unknown key"),
        ({"j1.load": LOAD, "j1.torque_nm": "i"}, "found it beside 'j1.torque_nm', expected one reference"),
        ({"j2.load": LOAD}, "found no 'j2.link_position_rad'"),
        ({"j1.load": 3}, "found 3, expected a mapping"),
        ({"j1.current_a": "i", "j1.drive": DRIVE}, "found it beside 'j1.current_a', expected one of them"),
        ({"j1.drive": DRIVE}, "found neither 'j1.motor_velocity_rad_s' nor"),
        (
            {"j1.motor_position_rad": "p", "j1.drive": {"voltage_v": "v", "resistance_ohm": 0.0}},
            "key 'j1.drive.resistance_ohm': found 0.0",
        ),
    ],
)  # fmt: skip
def test_wrong_loads_and_drives_are_named(more, expected):
    with pytest.raises(ConfigError) as caught:
        ColumnMap.from_mapping(mapping() | more, "m.yaml", Path())
    assert expected in str(caught.value)
    assert "m.yaml" in str(caught.value)


def test_a_wrong_expression_names_file_key_and_map(tmp_path):
    path = rig(tmp_path / "a.csv")
    with pytest.raises(RunError) as caught:
        read_run(path, made(j1__current_a="i + bias"))
    assert str(caught.value).startswith(
        f"{path}: line 1: found no column 'bias', expected it for j1.current_a of m.yaml"
    )


def test_an_outlier_of_a_position_is_not_in_the_torque_of_the_load(tmp_path):
    outlier = np.sin(T)
    outlier[1000] = 1e6
    torques = []
    for angle in (np.sin(T), outlier):
        path = table(tmp_path / "a.csv", {"t": T, "q": angle, "i": T})
        columns = made(
            time_s="t", j1__current_a="i", j1__link_position_rad="q", j1__load={"inertia_kgm2": 2.0}
        )
        torques.append(column(read_run(path, columns).table, "torque_nm"))
    assert torques[1] == pytest.approx(torques[0], abs=0.1)


def test_turns_in_a_gap_are_not_known(tmp_path):
    keep = ~((T > 2.0) & (T < 2.5))
    path = table(tmp_path / "a.csv", {"t": T[keep], "q": np.mod(9.0 * T[keep], 2.0 * np.pi), "i": Q[keep]})
    mapping = {"time_s": "t", "j1.current_a": "i", "j1.motor_position_rad": "unwrap(q, 2 * pi)"}
    columns = ColumnMap.from_mapping(mapping, "m", Path())
    first, second = read_runs([path], columns, segments=True)
    assert any("j1.motor_position_rad is unwrapped, its turns in the gaps" in note for note in first.notes)
    for segment in (first, second):
        position = column(segment.table, "motor_position_rad")
        assert np.diff(position) == pytest.approx(9.0 * np.diff(segment.table.time_s), abs=1e-6)


# Expressions ----------------------------------------------------------------------------------------------------

CELLS = {
    "a": np.array([1.0, 2.0, 4.0]),
    "b": np.array([-1.0, 0.5, 3.0]),
    "motor angle [deg]": np.array([0.0, 90.0, 180.0]),
    "effort.j1": np.array([7.0, 8.0, 9.0]),
    "counts": np.array([4090.0, 4094.0, 2.0]),
    "a+b": np.array([100.0, 200.0, 300.0]),
    "stamp_ns": np.array([0.0, 1e6, 2e6]),
}
HEADER = tuple(CELLS)


@pytest.mark.parametrize(
    ("text", "expected", "names"),
    [
        ("a", [1.0, 2.0, 4.0], ("a",)),
        ("a + 0.87*b", [0.13, 2.435, 6.61], ("a", "b")),
        ("-(a - b) / 2", [-1.0, -0.75, -0.5], ("a", "b")),
        ("a+b", [100.0, 200.0, 300.0], ("a+b",)),  # the name of a column is that column
        ("deg2rad(`motor angle [deg]`)", [0.0, math.pi / 2, math.pi], ("motor angle [deg]",)),
        ("effort.j1 - 7", [0.0, 1.0, 2.0], ("effort.j1",)),
        ("unwrap(counts, 4096) - 4090", [0.0, 4.0, 8.0], ("counts",)),
        ("unwrap(a, 2*pi)", [1.0, 2.0, 4.0], ("a",)),
        ("rpm2rad_s(a) * 30/pi", [1.0, 2.0, 4.0], ("a",)),
        ("rev2rad(a)/2/pi", [1.0, 2.0, 4.0], ("a",)),
        ("1.5 * 9.81 * 0.2 * sin(b)", list(1.5 * 9.81 * 0.2 * np.sin(CELLS["b"])), ("b",)),
        ("sign(b) * abs(b) + cos(a) - cos(a)", [-1.0, 0.5, 3.0], ("b", "a")),
        ("12", [12.0, 12.0, 12.0], ()),
    ],
)
def test_values_of_expressions(text, expected, names):
    found = parse(text, HEADER)
    assert found.names == names
    assert found.value(CELLS).tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a + d", "no column 'd', expected it for j1.torque_nm"),
        ("motor angle [deg]x", "expected a column of the file or an expression of columns"),
        ("`no such` * 2", "no column 'no such'"),
        ("a ** 2", "found the operator **"),
        ("a if b else a", "found IfExp"),
        ("a < b", "found Compare"),
        ("a[0]", "found brackets (a name with signs stands in backquotes)"),
        ("a + 0,87 * b", "found a comma"),
        ("[a]", "found List"),
        ("'a' + b", "found 'a' in"),
        ("True * a", "found True"),
        ("1j * a", "found 1j"),
        ("exp(a)", "found the call of 'exp'"),
        ("__import__('os').system('true')", "found the call of"),
        ("sin(a).__class__", "found Attribute"),
        ("sin(a, b)", "found 2 arguments of sin"),
        ("sin(x=a)", "found the call of 'sin'"),
        ("unwrap(a, b)", "a period of unwrap that is no number"),
        ("unwrap(a, 0)", "a period of unwrap of 0"),
        ("unwrap(a, -4096)", "a period of unwrap of -4096"),
        ("unwrap(a, pi / 0)", "a period of unwrap of inf"),
        ("(lambda: a)()", "found the call of"),
        ("1" + "0" * 400 + "*a", "out of range"),
        ("+".join(["a"] * 60), "more than 40 levels"),
        ("a" * 1001, "1001 characters"),
        ("(" * 300 + "a" + ")" * 300, "expected"),
    ],
)
def test_other_expressions_are_refused_in_one_line(text, expected):
    with pytest.raises(ExpressionError) as caught:
        parse(text, HEADER, "j1.torque_nm")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.text(alphabet="ab`()+-*/. 019,sincospi_[]'\"=<>!lambdexr", max_size=60))
def test_any_text_is_an_expression_or_an_expression_error(text):
    try:
        found = parse(text, HEADER)
    except ExpressionError:
        return
    assert found.value(CELLS).shape == (3,)


def test_a_run_that_lacks_a_column_is_left_out_and_named_while_most_have_it(tmp_path):
    mapping = {"time_s": "t", "j1.current_a": "i", "j1.motor_position_rad": "q"}
    columns = ColumnMap.from_mapping(mapping, "m", Path())
    runs = [table(tmp_path / f"{k}.csv", {"t": T, "q": Q + k * V, "i": A + k}) for k in range(2)]
    runs.append(table(tmp_path / "short.csv", {"t": T, "q": Q - V}))
    first, second = read_runs(runs, columns, segments=True)
    assert (first.name, second.name) == ("0.csv", "1.csv")
    assert any(
        "left out: " in note and "short.csv" in note and "no column 'i'" in note for note in first.notes
    )
    for arguments, segments in ((runs[1:], True), (runs, False)):
        with pytest.raises(RunError, match=r"short\.csv.*no column 'i'"):
            read_runs(arguments, columns, segments=segments)
