"""What columns of foreign tables are taken for: names and units, numbers where the names state nothing, signs, joints."""

import math

import numpy as np
import pytest

from jtqd.sysid.runs.column_names import read_name
from jtqd.sysid.runs.propose import ProposalError, propose

RATE_HZ = 200.0
RATIO = 50.0
T = np.arange(0.0, 12.0, 1.0 / RATE_HZ)
Q = 0.6 * np.sin(1.3 * T) + 0.3 * np.sin(2.9 * T + 1.0)
V = np.gradient(Q, T)
TORQUE = 20.0 * np.sin(Q) + 2.0 * np.gradient(V, T)
NOISE = np.random.default_rng(5).normal(0.0, 0.05, (3, len(T)))
CURRENT = (TORQUE + 3.0 * np.sign(V) + 2.0 * V) / (RATIO * 0.07) + NOISE[0]
SENSOR = TORQUE + NOISE[1]
DEG = 180.0 / math.pi


def proposed(**columns):
    """Return the targets of joint 1 as (source, sign of the source included)."""
    table = {"t": T, **{name.replace("__", " "): value for name, value in columns.items()}}
    [joint] = propose([table]).joints
    return {target: each.text for target, each in joint.targets.items()}, joint


@pytest.mark.parametrize(
    ("name", "kind", "unit", "number"),
    [
        ("timestamp [ms]", "time", "ms", None),
        ("header.stamp.nanosec", "time", "ns", None),
        ("time_us", "time", "us", None),
        ("Motor Angle [deg]", "position", "deg", None),
        ("motorPositionRad", "position", "rad", None),
        ("/rig/enc/counts", "position", "counts", None),
        ("enc_ticks", "position", "counts", None),
        ("joint_3_pos_deg", "position", "deg", 3),
        ("speed (rpm)", "velocity", "rpm", None),
        ("j2.vel_rad_s", "velocity", "rad/s", 2),
        ("gyro_dps", "velocity", "deg/s", None),
        ("qd", "velocity", "", None),
        ("Iq [mA]", "current", "mA", None),
        ("i_q3_a", "current", "A", 3),
        ("torque current", "current", "", None),
        ("current position", "position", "", None),
        ("Torque Sensor [Nm]", "torque", "Nm", None),
        ("torque_mnm", "torque", "mNm", None),
        ("effort[0]", "torque", "", 0),
        ("duty", "duty", "", None),
        ("u_v", "voltage", "V", None),
        ("board [C]", "temperature", "degC", None),
        ("position_s", "position", "", None),
        ("acceleration", "", "", None),
        ("status", "", "", None),
        *(
            (name, "current", "mA", None)
            for name in ("i_mA", "I_mA", "iq_mA", "current_mA", "IqMA", "effort [mA]")
        ),
        ("iq_mA_2", "current", "mA", 2),
        ("i_m_A", "current", "A", None),
        ("torque_mNm", "torque", "mNm", None),
        ("torque_m_Nm", "torque", "Nm", None),
        ("Ts_Nm", "torque", "Nm", None),
        ("T_Nm", "torque", "Nm", None),
        ("M [N·m] out", "torque", "Nm", None),
        ("T_C", "temperature", "degC", None),
        ("T_ms", "time", "ms", None),
        ("degC", "temperature", "degC", None),
        ("Temp [deg]", "temperature", "degC", None),
        ("pos1_deg", "position", "deg", 1),
        ("motor_rad_s", "velocity", "rad/s", None),
        ("velRadPerSec", "velocity", "rad/s", None),
        ("enc [rad/s]", "velocity", "rad/s", None),
        ("rpm_motor", "velocity", "rpm", None),
        ("dtheta_m", "velocity", "", None),
        ("thetadot", "velocity", "", None),
        ("phi_ddot", "", "", None),
        ("acc_rad_s2", "", "rad/s2", None),
        ("Torque [counts]", "", "counts", None),
        ("loadcell_mV", "", "mV", None),
    ],
)
def test_a_name_states_quantity_unit_and_joint(name, kind, unit, number):
    found = read_name(name)
    assert (found.kind, found.unit, found.number) == (kind, unit, number)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"stamp_us": 1e6 * T + 5e9}, "1e-06 * stamp_us"),
        ({"time": 1000.0 * T}, "0.001 * time"),
        ({"time": 1e9 * T + 1.7e18}, "1e-09 * time"),
        ({"time": T}, "time"),
        ({"time [s]": 1000.0 * T}, "0.001 * `time [s]`"),
        ({"row": np.arange(len(T)), "elapsed": T}, "elapsed"),
        (
            {"stamp.sec": np.floor(T) + 1.7e9, "stamp.nanosec": 1e9 * (T % 1.0)},
            "stamp.sec + 1e-9 * stamp.nanosec",
        ),
    ],
)
def test_the_time_and_its_unit(columns, expected):
    found = propose([{**columns, "pos": Q, "cur": CURRENT}])
    assert found.time == expected
    assert found.rate_hz == pytest.approx(RATE_HZ, rel=1e-3)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"pos": Q}, {"link_position_rad": "pos"}),
        ({"motor_pos": RATIO * Q}, {"motor_position_rad": "motor_pos"}),
        ({"pos": Q * DEG}, {"link_position_rad": "deg2rad(pos)"}),
        ({"pos_rad": RATIO * Q}, {"motor_position_rad": "pos_rad"}),
        ({"pos_deg": Q * DEG}, {"link_position_rad": "deg2rad(pos_deg)"}),
        (
            {"pos": Q * DEG, "vel_rad_s": V},
            {"link_position_rad": "deg2rad(pos)", "link_velocity_rad_s": "vel_rad_s"},
        ),
        (
            {"pos_rad": Q, "speed": V * DEG},
            {"link_position_rad": "pos_rad", "link_velocity_rad_s": "deg2rad(speed)"},
        ),
        (
            {"motor_pos_rad": RATIO * Q, "speed": RATIO * V * 30.0 / math.pi},
            {"motor_position_rad": "motor_pos_rad", "motor_velocity_rad_s": "rpm2rad_s(speed)"},
        ),
        ({"enc": np.round(RATIO * Q * 4096 / (2 * math.pi))}, {"motor_position_rad": "rev2rad(enc / ???)"}),
        (
            {"counts": np.round(RATIO * Q * 4096 / (2 * math.pi)) % 4096},
            {"motor_position_rad": "rev2rad(unwrap(counts, 4096) / 4096)"},
        ),
        ({"angle_deg": (20.0 * Q * DEG) % 360.0}, {"motor_position_rad": "deg2rad(unwrap(angle_deg, 360))"}),
    ],
)
def test_units_and_sides_of_the_motion(columns, expected):
    found, _ = proposed(**columns, cur=CURRENT, sensor_torque=SENSOR)
    assert found == {**expected, "current_a": "cur", "torque_nm": "sensor_torque"}


@pytest.mark.parametrize(
    ("name", "values", "target", "source"),
    [
        ("Ts_Nm", SENSOR, "torque_nm", "Ts_Nm"),
        ("T_mNm", 1000.0 * SENSOR, "torque_nm", "0.001 * T_mNm"),
        ("Ts", SENSOR, "torque_nm", "Ts"),
        ("T", SENSOR, "torque_nm", "T"),
        ("T_C", 31.0 + T / 60.0, "temperature_c", "T_C"),
        ("T_motor", 31.0 + T / 60.0, "temperature_c", "T_motor"),
        ("T_motor", np.round(31.0 + T / 60.0, 1), "temperature_c", "T_motor"),
        ("ts", 1000.0 * T, "torque_nm", None),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_t_is_of_a_time_a_torque_or_a_temperature(name, values, target, source, first):
    columns = {"t": T, "pos": Q, "i_mA": 1000.0 * CURRENT}
    found = propose([{name: values, **columns} if first else {**columns, name: values}])
    targets = {key: each.text for key, each in found.joints[0].targets.items()}
    assert found.time in ("t", f"0.001 * {name}")
    assert targets["current_a"] == "0.001 * i_mA"
    assert targets.get(target) == source


@pytest.mark.parametrize("unit", [1.0, DEG, 30.0 / math.pi])
@pytest.mark.parametrize("turn", [4096, 10000])
def test_a_velocity_is_compared_with_counts_and_not_with_another_position(unit, turn):
    """By a roll-over the counts per turn are known; else only one unit of the velocity gives those of an encoder."""
    counts = np.round(RATIO * Q * turn / (2.0 * math.pi))
    for enc in (counts, counts % turn):
        found, joint = proposed(enc_counts=enc, joint_deg=DEG * Q, vel=RATIO * unit * V)
        assert joint.targets["motor_velocity_rad_s"].factor == pytest.approx(1.0 / unit)
        assert 2.0 * math.pi / joint.targets["motor_position_rad"].factor == pytest.approx(turn, rel=0.003)
        assert joint.gear_ratio == pytest.approx(RATIO, rel=0.003)
        assert found["link_position_rad"] == "deg2rad(joint_deg)"


def test_a_unit_that_contradicts_the_name_is_a_reason():
    found = {each.column: each for each in propose([{"t": T, "pos": Q, "Tq [V]": SENSOR}]).columns}
    assert (found["Tq [V]"].target, found["Tq [V]"].why) == (
        "",
        ["no quantity of a joint by its name and unit V"],
    )


def test_counts_per_turn_by_a_velocity():
    counts = RATIO * Q * 8192 / (2 * math.pi)
    found, joint = proposed(motor_counts=np.round(counts), motor_rpm=RATIO * V * 30.0 / math.pi)
    per_turn = 2.0 * math.pi / joint.targets["motor_position_rad"].factor
    assert per_turn == pytest.approx(8192, rel=0.01)
    assert found["motor_velocity_rad_s"] == "rpm2rad_s(motor_rpm)"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_positions_show_the_gear_ratio_and_their_sign(sign):
    found, joint = proposed(angle_1=RATIO * Q, angle_2=sign * Q, cur=CURRENT)
    assert joint.gear_ratio == RATIO
    assert found["motor_position_rad"] == "angle_1"
    assert found["link_position_rad"] == ("angle_2" if sign > 0.0 else "-angle_2")


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("torque", [True, False])
def test_motion_against_the_current_is_turned(sign, torque):
    columns = {"pos": sign * Q, "vel": sign * V, "cur": CURRENT} | ({"sensor_nm": SENSOR} if torque else {})
    found, _ = proposed(**columns)
    mark = "" if sign > 0.0 else "-"
    assert found["link_position_rad"] == f"{mark}pos"
    assert found["link_velocity_rad_s"] == f"{mark}vel"


@pytest.mark.parametrize(
    ("columns", "target", "source"),
    [
        ({"Iq": 1000.0 * CURRENT}, "current_a", "0.001 * Iq"),
        ({"Iq_ma": 1000.0 * CURRENT}, "current_a", "0.001 * Iq_ma"),
        ({"cur": CURRENT, "current_cmd": CURRENT}, "current_a", "cur"),
        ({"id_current": 0.1 * CURRENT, "iq": CURRENT}, "current_a", "iq"),
        ({"bus_current": np.abs(CURRENT), "cur": CURRENT}, "current_a", "cur"),
        ({"cur": CURRENT, "torque": SENSOR}, "torque_nm", "torque"),
        ({"cur": CURRENT, "torque": -SENSOR}, "torque_nm", "-torque"),
        ({"cur": CURRENT, "torque": 3.5 * CURRENT}, "torque_nm", None),
        ({"cur": CURRENT, "torque_mnm": 1000.0 * SENSOR}, "torque_nm", "0.001 * torque_mnm"),
        ({"torque": SENSOR}, "torque_nm", None),
        ({"torque": SENSOR}, "drive", "torque"),
        ({"torque_sensor": SENSOR}, "torque_nm", "torque_sensor"),
        ({"duty": 10.0 * CURRENT}, "drive", "duty"),
        ({"cur": CURRENT, "bus_voltage": 24.0 + NOISE[2]}, "drive", None),
        ({"cur": CURRENT, "temp": np.full(len(T), 31.0)}, "temperature_c", None),
        ({"cur": CURRENT, "motor_temp": 31.0 + T / 60.0, "temp": 25.0 + T}, "temperature_c", "motor_temp"),
    ],
)
def test_current_torque_and_temperature(columns, target, source):
    found, _ = proposed(**columns, motor_pos_rad=RATIO * Q)
    assert found.get(target) == source


def test_every_column_has_a_reason():
    table = {"t": T, "pos": Q, "cur": CURRENT, "cur_ref": CURRENT, "x": NOISE[0], "temp": np.zeros(len(T))}
    found = {each.column: each for each in propose([table]).columns}
    assert set(found) == set(table)
    assert all(each.why for each in found.values())
    assert [name for name, each in found.items() if not each.target] == ["cur_ref", "x", "temp"]


@pytest.mark.parametrize(("names", "numbers"), [("pos{} cur{}", (0, 1)), ("j{}.pos j{}.cur", (3, 5))])
def test_joints_by_the_numbers_of_the_names(names, numbers):
    table = {"t": T}
    for n in numbers:
        table |= {name.format(n): value for name, value in zip(names.split(), (Q, CURRENT), strict=True)}
    found = propose([table]).joints
    first = 1 if 0 in numbers else 0
    assert [each.number for each in found] == [n + first for n in numbers]
    assert all(set(each.targets) == {"link_position_rad", "current_a"} for each in found)


def test_one_number_makes_no_joint():
    [joint] = propose([{"t": T, "enc1": Q, "enc2": RATIO * Q, "cur": CURRENT}]).joints
    assert (joint.number, joint.gear_ratio) == (1, RATIO)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"pos": Q, "cur": CURRENT}, "no column that rises"),
        ({"t": T, "x": Q, "y": CURRENT}, "no column that its name makes one of a joint"),
        ({"time": 1e30 * T, "pos": Q}, "expected a time in s, ms, us or ns"),
        (
            {
                "t": T,
                "pos": np.where(np.arange(len(T)) % 2, Q, math.nan),
                "cur": np.where(np.arange(len(T)) % 2, math.nan, CURRENT),
            },
            "'pos' and 'cur' filled in different rows",
        ),
    ],
)
def test_what_nothing_can_be_proposed_for(table, words):
    with pytest.raises(ProposalError, match=words):
        propose([table])


def test_several_files_are_looked_at_together():
    """Their times start again; a column that one of them lacks is not used."""
    half = len(T) // 2
    one = {"t": T[:half], "pos": Q[:half], "cur": CURRENT[:half], "temp": 30.0 + T[:half]}
    two = {"t": T[:half], "pos": Q[half:], "cur": CURRENT[half:]}
    found = propose([one, two])
    assert set(found.joints[0].targets) == {"link_position_rad", "current_a"}
    assert found.rate_hz == pytest.approx(RATE_HZ)
