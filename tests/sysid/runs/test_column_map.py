"""Column maps: known loads, voltage drives and expressions, on a pendulum whose torque and current are known."""

from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.sysid.runs.column_map import ColumnMap, KnownLoad, motion_of
from jtqd.sysid.runs.files import read_run, read_runs
from jtqd.sysid.runs.run_file import RunError

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


def test_a_known_load_is_the_torque_of_its_motion(tmp_path: Path) -> None:
    run = read_run(rig(tmp_path / "a.csv"), made(j1__current_a="i", j1__load=LOAD))
    found = run.table.joints[1].torque_nm
    assert found is not None
    inner = slice(10, -10)
    assert np.max(np.abs(found - TORQUE)[inner]) < 0.01 * np.max(np.abs(TORQUE))
    assert run.table.time_s == pytest.approx(T)
    assert "known load of 1.3 kg at 0.21 m" in run.notes[0]
    assert "no effect of a torque sensor is looked for" in run.notes[0]


def test_without_an_inertia_the_load_is_a_point_mass() -> None:
    load = made(j1__load={"mass_kg": 2.0, "lever_m": 0.5}).loads[1]  # type: ignore[index]
    assert load == KnownLoad(None, 2.0, 0.5, 0.5)


def test_a_models_torque_is_a_known_load(tmp_path: Path) -> None:
    columns = made(j1__current_a="i", j1__load={"torque_nm": "gravity + rest"})
    assert columns.known_loads == (1,)
    found = read_run(rig(tmp_path / "a.csv"), columns).table.joints[1].torque_nm
    assert found == pytest.approx(TORQUE, abs=1e-6)


@pytest.mark.parametrize("with_speed", [True, False])
def test_a_drive_that_gives_duty(tmp_path: Path, with_speed: bool) -> None:
    path = rig(tmp_path / "a.csv")
    more: dict[str, object] = {"j1__motor_position_rad": f"{RATIO} * deg2rad(angle)"}
    if with_speed:
        text = path.read_text().splitlines()
        text = [text[0] + ",w", *(f"{line},{RATIO * v:.9g}" for line, v in zip(text[1:], V, strict=True))]
        path.write_text("\n".join(text) + "\n")
        more["j1__motor_velocity_rad_s"] = "w"
    drive = {"voltage_v": "12 * duty", "resistance_ohm": OHM, "back_emf_vs_per_rad": EMF}
    run = read_run(path, made(j1__drive=drive, **more))
    found = run.table.joints[1].current_a
    assert found is not None
    true = TORQUE / RATIO / 0.05
    assert np.max(np.abs(found - true)[10:-10]) < 0.01 * np.max(np.abs(true))
    assert "a wrong resistance shows as torque_constant" in run.notes[0]


def test_the_window_follows_the_motion_and_not_the_noise() -> None:
    noisy = Q + np.random.default_rng(3).normal(0.0, 1e-4, len(T))
    velocity, acceleration = motion_of(T, noisy)
    inner = slice(10, -10)
    assert np.std((velocity - V)[inner]) < 0.02
    assert np.std((acceleration - A)[inner]) < 1.0  # second differences of this noise: 15 rad/s2
    short = motion_of(T[:3], Q[:3])
    assert short[0].shape == short[1].shape == (3,)


DRIVE = {"voltage_v": "v", "resistance_ohm": 1.0, "back_emf_vs_per_rad": 0.1}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"j1.load": {"mass_kg": 1.0}}, "key 'j1.load.lever_m': missing"),
        ({"j1.load": {"mass_kg": -1.0, "lever_m": 1.0}}, "found -1.0, expected a number in kg >= 0"),
        ({"j1.load": {"mass": 1.0, "lever_m": 1.0}}, "'j1.load.mass': unknown key, did you mean 'mass_kg'"),
        ({"j1.load": {"torque_nm": "x", "mass_kg": 1.0}}, "key 'j1.load.mass_kg': unknown key"),
        ({"j1.load": LOAD, "j1.torque_nm": "i"}, "found it beside 'j1.torque_nm', expected one reference"),
        ({"j2.load": LOAD}, "found no 'j2.link_position_rad'"),
        ({"j1.load": 3}, "found 3, expected a mapping"),
        (
            {"j1.current_a": "i", "j1.drive": DRIVE},
            "found it beside 'j1.current_a', expected one of them",
        ),
        ({"j1.drive": DRIVE}, "found neither 'j1.motor_velocity_rad_s' nor"),
        (
            {"j1.motor_position_rad": "p", "j1.drive": {"voltage_v": "v", "resistance_ohm": 0.0}},
            "key 'j1.drive.resistance_ohm': found 0.0",
        ),
    ],
)
def test_wrong_loads_and_drives_are_named(more: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ColumnMap.from_mapping(mapping() | more, "m.yaml", Path())
    assert said in str(caught.value)
    assert "m.yaml" in str(caught.value)


def test_a_wrong_expression_names_file_key_and_map(tmp_path: Path) -> None:
    path = rig(tmp_path / "a.csv")
    with pytest.raises(RunError) as caught:
        read_run(path, made(j1__current_a="i + bias"))
    assert str(caught.value).startswith(
        f"{path}: line 1: found no column 'bias', expected it for j1.current_a of m.yaml"
    )


def test_gaps_make_segments_that_keep_their_time(tmp_path: Path) -> None:
    """Gaps of 0.5 and 0.1 s; one of three rows is bridged; a segment of half a second is left out."""
    keep = ~(
        ((T > 2.0) & (T < 2.5))
        | ((T > 4.0) & (T < 4.1))
        | ((T > 4.6) & (T < 4.7))
        | ((T > 1.0) & (T < 1.014))
    )
    path = table(tmp_path / "a.csv", {"time_s": T[keep], "j1.current_a": Q[keep], "j1.torque_nm": V[keep]})
    with pytest.raises(RunError, match="found a gap of 0"):
        read_run(path)
    segments = read_runs([path], segments=True)
    assert [run.name for run in segments] == ["a.csv (1 of 3)", "a.csv (2 of 3)", "a.csv (3 of 3)"]
    assert [float(run.table.time_s[0]) for run in segments] == pytest.approx([0.0, 2.5, 4.7])
    assert len({run.sha256 for run in segments}) == 1
    assert "3 gaps of more than 0.025 s: used as 3 segments of one recording" in " ".join(segments[0].notes)
    assert segments[1].notes == ()


def test_an_outlier_of_a_position_is_not_in_the_torque_of_the_load_beside_it(tmp_path: Path) -> None:
    outlier = np.sin(T)
    outlier[1000] = 1e6
    torques = []
    for angle in (np.sin(T), outlier):
        path = table(tmp_path / "a.csv", {"t": T, "q": angle, "i": T})
        columns = ColumnMap.from_mapping(
            {
                "time_s": "t",
                "j1.current_a": "i",
                "j1.link_position_rad": "q",
                "j1.load": {"inertia_kgm2": 2.0},
            },
            "m",
            Path(),
        )
        torque = read_run(path, columns).table.joints[1].torque_nm
        assert torque is not None
        torques.append(torque)
    assert torques[1] == pytest.approx(torques[0], abs=0.1)


def test_turns_in_a_gap_are_not_known(tmp_path: Path) -> None:
    keep = ~((T > 2.0) & (T < 2.5))
    path = table(tmp_path / "a.csv", {"t": T[keep], "q": np.mod(9.0 * T[keep], 2.0 * np.pi), "i": Q[keep]})
    columns = ColumnMap.from_mapping(
        {"time_s": "t", "j1.current_a": "i", "j1.motor_position_rad": "unwrap(q, 2 * pi)"}, "m", Path()
    )
    first, second = read_runs([path], columns, segments=True)
    assert any("j1.motor_position_rad is unwrapped, its turns in the gaps" in note for note in first.notes)
    for segment in (first, second):
        position = segment.table.joints[1].motor_position_rad
        assert position is not None
        assert np.diff(position) == pytest.approx(9.0 * np.diff(segment.table.time_s), abs=1e-6)


def test_segments_that_are_all_too_short_are_refused(tmp_path: Path) -> None:
    keep = (T % 0.5) < 0.4
    path = table(tmp_path / "a.csv", {"time_s": T[keep], "j1.current_a": Q[keep]})
    with pytest.raises(
        RunError,
        match=r"found 12 segments between gaps, the longest of 0\.\d+ s, expected one of at least 1 s",
    ):
        read_runs([path], segments=True)


def test_a_short_whole_recording_is_one_segment(tmp_path: Path) -> None:
    [run] = read_runs([table(tmp_path / "a.csv", {"time_s": T[:50], "j1.current_a": Q[:50]})], segments=True)
    assert run.name == "a.csv"
