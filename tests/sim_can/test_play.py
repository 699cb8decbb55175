"""Play-back: each SYNC gets the measured row of its time, also with jitter, and nothing after the end."""

import random
from pathlib import Path

import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.models.files import shipped
from jtqd.sim_can.play import PlaySource, columns_beside, open_play

KINOVA = shipped("kinova_gen3/columns.yaml").parent
COLUMNS = KINOVA / "columns.yaml"


def _ramp(folder: Path, rows: int = 20) -> PlaySource:
    """Two joints whose every value names its row: value = row + offset of the column."""
    names = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "torque_nm")
    header = ["time_s"] + [f"j{j}.{n}" for j in (1, 2) for n in names]
    lines = [",".join(header)]
    for row in range(rows):
        values = [row + 1000 * j + 100 * k for j in (1, 2) for k in range(len(names))]
        lines.append(",".join([f"{7 + row * 0.001:.3f}", *map(str, values)]))
    path = folder / "ramp.csv"
    path.write_text("\n".join(lines))
    return open_play(path, None, (1, 2))


def _shown(source: PlaySource) -> tuple[float, ...]:
    values = []
    for drive, channel in zip(source.drives, source.channels, strict=True):
        values += [
            drive.current_a,
            drive.motor_position_rad,
            drive.motor_velocity_rad_s,
            drive.link_position_rad,
        ]
        values.append(channel.torque_nm)
    return tuple(values)


def _expected(row: int) -> tuple[float, ...]:
    return tuple(float(row + 1000 * j + 100 * k) for j in (1, 2) for k in range(5))


def test_first_sync_is_row_zero_and_every_sync_is_one_row(tmp_path: Path) -> None:
    source = _ramp(tmp_path)
    assert source.advance(0.0)
    assert _shown(source) == _expected(0)
    for row in range(1, 20):
        assert source.advance(0.001)
        assert _shown(source) == _expected(row)


def test_jitter_neither_repeats_nor_skips_a_row(tmp_path: Path) -> None:
    seed = 3
    print("seed", seed)
    random_ = random.Random(seed)
    source = _ramp(tmp_path)
    source.advance(0.0)
    before = 0.0
    for row in range(1, 20):
        now = row * 0.001 + random_.uniform(-0.0003, 0.0003)
        assert source.advance(now - before)
        before = now
        assert source.row == row


def test_a_missed_sync_skips_its_row_and_a_double_one_repeats_it(tmp_path: Path) -> None:
    source = _ramp(tmp_path)
    source.advance(0.0)
    source.advance(0.003)
    assert _shown(source) == _expected(3)
    source.advance(0.0)
    assert _shown(source) == _expected(3)
    source.advance(0.0004)
    assert source.row == 3
    source.advance(0.0002)
    assert source.row == 4


def test_the_end_is_the_end(tmp_path: Path) -> None:
    source = _ramp(tmp_path, rows=5)
    answers = [source.advance(0.001 if k else 0.0) for k in range(8)]
    assert answers == [True] * 5 + [False] * 3
    assert source.row == 4
    jump = _ramp(tmp_path, rows=5)
    assert not jump.advance(10.0)
    assert not jump.advance(0.0)


@pytest.mark.parametrize("dt_s", [-0.001, float("nan"), float("inf")])
def test_impossible_steps_are_refused(tmp_path: Path, dt_s: float) -> None:
    with pytest.raises(ValueError, match="time step"):
        _ramp(tmp_path).advance(dt_s)


def test_what_is_missing_is_derived_through_the_gear(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    rows = "".join(f"{k / 1000},1,{0.002 * k},1,{0.004 * k}\n" for k in range(5))
    path.write_text("time_s,j1.current_a,j1.link_position_rad,j2.current_a,j2.motor_position_rad\n" + rows)
    source = open_play(path, None, (1, 2))
    source.advance(0.003)
    first, second = source.drives
    gear = [rating.gear_ratio for rating in source.ratings]
    assert first.motor_position_rad == pytest.approx(0.006 * gear[0])
    assert first.motor_velocity_rad_s == pytest.approx(2.0 * gear[0])
    assert second.link_position_rad == pytest.approx(0.012 / gear[1])
    assert second.motor_velocity_rad_s == pytest.approx(4.0)
    assert [channel.valid for channel in source.channels] == [False, False]


def test_commands_change_nothing_and_drives_are_enabled(tmp_path: Path) -> None:
    source = _ramp(tmp_path)
    source.advance(0.0)
    source.command(0, 10, 5.0)
    source.advance(0.001)
    assert _shown(source) == _expected(1)
    assert [drive.enabled for drive in source.drives] == [True, True]


def test_kinova_joints_2_and_4_with_their_ratings() -> None:
    source = open_play(KINOVA / "opti_traj_testing1.csv.gz", COLUMNS)
    assert source.advance(0.0)
    # First row of the file, columns Cur, Position, Velocity, Position, TorqueSm of joints 2 and 4.
    assert _shown(source) == pytest.approx(
        (-2.85206, 119.094, 0.0, 1.19094, -25.8335, 0.186002, -45.1905, 0.0, -0.451905, 4.64851), rel=1e-14
    )
    rating = source.ratings[0]
    assert rating.gear_ratio == 100.0
    # Rated torque over torque per ampere: 32 Nm / 9.13 Nm/A.
    assert rating.rated_current_a == pytest.approx(32.0 / 9.13)
    assert rating.rated_torque_nm == pytest.approx(0.32)
    steps = 0
    while source.advance(0.001):
        steps += 1
    assert steps == 4740


def test_a_dead_channel_is_invalid_and_the_other_is_not() -> None:
    source = open_play(KINOVA / "RunTrajectory1.csv.gz", COLUMNS, (1, 2))
    assert [channel.valid for channel in source.channels] == [False, True]
    assert len(source.notes) == 1
    source.advance(0.5)
    assert [channel.valid for channel in source.channels] == [False, True]


@pytest.mark.parametrize(
    ("joints", "said"), [((2, 9), "no joint 9"), ((2, 2), "two different"), ((2,), "two different")]
)
def test_wrong_joints_are_named(joints: tuple[int, int], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        open_play(KINOVA / "RunTrajectory1.csv.gz", COLUMNS, joints)


def test_missing_columns_and_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("time_s,j1.current_a,j2.current_a\n0,1,1\n1,1,1\n")
    with pytest.raises(ConfigError, match=r"j1\.motor_position_rad: missing"):
        open_play(path, None, (1, 2))
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        open_play(path, tmp_path / "none.yaml", (1, 2))


def test_defaults_come_from_the_column_map_beside_the_run(tmp_path: Path) -> None:
    run = KINOVA / "RunTrajectory1.csv.gz"
    assert columns_beside(run) == COLUMNS
    assert columns_beside(tmp_path / "r.csv") is None
    default, given = open_play(run, COLUMNS), open_play(run, COLUMNS, (2, 4))
    for source in (default, given):
        source.advance(0.0)
        source.advance(0.4)
    assert _shown(default) == _shown(given)
    assert default.notes == ()  # the dead channel is joint 1's, which is not played
    assert len(open_play(run, COLUMNS, (1, 2)).notes) == 1
