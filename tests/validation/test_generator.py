"""The generator of trials: with nothing hidden both balances close, and each effect leaves in them what its formula gives,
in the right joint, and nothing in the other.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS, checked_parameters
from tests.paths import ROOT
from tests.validation.balances import Signals, binned, expected, rms, signals, slow_enough
from validation.diagnosis.entries import ENTRIES, SENSOR, Hidden, at_sensor, base_value, scaled
from validation.generator import plant as plant_module
from validation.generator.draw import (
    LINK_COUNTS,
    MOTOR_COUNTS,
    UNKNOWN,
    Case,
    Order,
    _late,
    _slow,
    draw,
    draw_many,
    follow_up,
)
from validation.generator.plant import Reference

SEED = 1127
EXTRA = (  # second parameters that carry an effect, and variants
    Hidden("sensor_drift", SENSOR, {"per_k_nm": 0.08}),
    Hidden("sensor_crosstalk", SENSOR, {"share": 0.04}),
    Hidden("nonlinear_stiffness", 2, fixed={"stiffness_nm_per_rad": 9000.0}, size=0.0),
    Hidden("temperature_dependent_friction", 1, {"coulomb_per_k": 0.02}),
    Hidden("encoder_eccentricity", 2, {"amplitude_rad": 8e-3, "motor_side": 1.0}),
    *(Hidden("channel_delay", 1 + k % 2, 0.003, fixed={"channel": float(k)}) for k in range(3)),
)


def quiet_set(hidden: list[Hidden], seed: int) -> list[Case]:
    """Return cases without noise or drift, two runs each: a ladder and Fourier motions."""
    return draw_many(
        [Order(seed + k, (h,), runs=2, duration_s=8.0, quiet=True) for k, h in enumerate(hidden)]
    )


@pytest.fixture(scope="module")
def library_cases() -> list[Case]:
    print(f"seed {SEED}")
    hidden = [Hidden(name, SENSOR if at_sensor(name) else 1 + k % 2) for k, name in enumerate(ENTRIES)]
    return quiet_set([*hidden, *EXTRA], SEED)


UNLIKE = [name for name, entry in UNKNOWN.items() if not entry.resembling]


@pytest.fixture(scope="module")
def long_cases() -> list[Case]:
    """Runs of 12 s, integrated side by side: nothing hidden, quiet; with noise; each unknown thing."""
    print(f"seed {SEED}")
    unknown = [
        Order(SEED + k, ((n, 1, UNKNOWN[n].high),), runs=4, duration_s=12.0, quiet=True)
        for k, n in enumerate(UNLIKE)
    ]
    return draw_many(
        [
            Order(SEED, duration_s=12.0, quiet=True),
            Order(SEED, profile="slow", runs=2, duration_s=12.0),
            *unknown,
        ]
    )


@pytest.fixture(scope="module")
def plain(long_cases: list[Case]) -> Case:
    return long_cases[0]


def test_both_balances_close_when_nothing_is_hidden(plain: Case) -> None:
    for columns in plain.runs[:3]:
        for number, joint in plain.joints.items():
            s = signals(columns, number, joint)
            assert s.moving.mean() > 0.3
            assert rms(binned(s.motor_nm, s.moving)) < 0.02
            assert np.median(np.abs(binned(s.motor_nm, s.moving))) < 1e-4
            assert rms(binned(s.torsion_nm, s.moving)) < 1e-3


def test_noise_is_what_is_left_with_noise(long_cases: list[Case]) -> None:
    case = long_cases[1]
    for columns in case.runs:
        for number, joint in case.joints.items():
            s = signals(columns, number, joint)
            rest = binned(s.torsion_nm, s.moving)
            assert abs(np.mean(rest)) < 0.3 + 2e-5 * joint["stiffness_nm_per_rad"] + 0.1
            assert 0.02 < np.std(rest) < 0.15


@pytest.mark.parametrize("index", range(len(ENTRIES) + len(EXTRA)))
def test_effect_leaves_what_its_formula_says(library_cases: list[Case], index: int) -> None:
    case = library_cases[index]
    (item,) = case.truth
    print(case.seed, item)
    worst = 0.0
    for number, joint in case.joints.items():
        owner = item["joint"] in (number, SENSOR)
        for columns in case.runs:
            s = signals(columns, number, joint)
            formula = expected(item["name"], item["parameters"], s, joint, columns["j1.temperature_c"])
            clear = s.moving & slow_enough(item["name"], item["parameters"], s)
            assert clear.sum() > 100
            for found, wanted in zip((s.motor_nm, s.torsion_nm), formula, strict=True):
                want = binned(wanted, clear) if owner else np.zeros(1)
                left = binned(found, clear) - want
                # a quarter of the samples may lie in fast transients, where derivatives of samples are not exact
                assert np.quantile(np.abs(left), 0.75) < 0.05 * rms(want) + 0.03, (
                    number,
                    rms(want),
                    rms(left),
                )
                assert rms(left) < 0.15 * rms(want) + 0.1
                worst = max(worst, rms(want))
    assert worst > 0.005, "the typical size cannot be seen at all"


def test_menu_is_the_library(library_cases: list[Case]) -> None:
    assert set(ENTRIES) == set(EFFECTS)
    for case in library_cases:
        (item,) = case.truth
        assert set(item["parameters"]) <= {p.name for p in EFFECTS[item["name"]].parameters}
        checked_parameters(item["name"], item["parameters"])


def test_size_is_the_deviation_of_the_leading_parameter() -> None:
    for name, size in (("coulomb_friction", 0.7), ("sensor_gain", 0.05), ("torque_constant", 0.004)):
        orders = [Order(s, ((name, 2, size),), runs=1, duration_s=1.0) for s in range(12)]
        found = [case.truth[0]["size"] for case in draw_many(orders)]
        assert np.allclose(np.abs(found), size)
        assert min(found) < 0.0 < max(found), "both signs occur"


def test_hidden_thing_changes_nothing_else_of_its_seed() -> None:
    plain, hidden = draw_many(
        [
            Order(SEED, runs=2, duration_s=2.0),
            Order(SEED, (("sensor_offset", SENSOR, 0.8),), runs=2, duration_s=2.0),
        ]
    )
    assert plain.joints == hidden.joints
    offset = hidden.truth[0]["parameters"]["offset_nm"]
    for a, b in zip(plain.runs, hidden.runs, strict=True):
        assert np.allclose(b["j1.torque_nm"] - a["j1.torque_nm"], offset)
        assert np.array_equal(a["j2.motor_position_rad"], b["j2.motor_position_rad"])
    again = draw(SEED, runs=2, duration_s=2.0).runs[0]
    assert all(np.array_equal(again[k], x) for k, x in plain.runs[0].items())


def test_case_does_not_depend_on_its_neighbours_in_the_batch() -> None:
    odd = Order(SEED + 1, (("coupling_slip", 1, None),), runs=2, duration_s=3.0)
    rich = Order(SEED + 2, (("hysteresis", 1, None), ("kinematic_error", 2, None)), runs=2, duration_s=3.0)
    alone = draw_many([odd])[0]
    beside = draw_many([rich, odd])[1]
    assert alone.truth == beside.truth
    for a, b in zip(alone.runs, beside.runs, strict=True):
        for key, x in a.items():
            assert np.allclose(x, b[key], atol=2e-3, rtol=0.0), key


def test_energy_goes_into_friction_and_nowhere_else() -> None:
    """Work of both motors = change of kinetic and elastic energy + Coulomb and viscous losses (+ dampers, < 3 %)."""
    hidden = (
        Hidden("kinematic_error", 1, {"amplitude_rad": 2e-4}),
        Hidden("nonlinear_stiffness", 2, None),
        Hidden("torque_ripple", 1, {"amplitude_nm": 1.0}),
    )
    case = draw(SEED, hidden, runs=2, duration_s=5.0, quiet=True)
    for columns in case.runs:
        t = columns["time_s"]
        work = lost = 0.0
        for number, joint in case.joints.items():
            s = signals(columns, number, joint)
            drive = joint["gear_ratio"] * joint["torque_constant_nm_per_a"] * s.current_a
            work += np.trapezoid(drive * s.v, t)
            f = joint["friction"]
            lost += np.trapezoid((f["coulomb_nm"] + f["viscous_nms_per_rad"] * np.abs(s.v)) * np.abs(s.v), t)
        # it begins and ends at standstill; what the springs hold then is below F^2/K = 0.01 J
        assert work == pytest.approx(lost, rel=0.03, abs=0.2)


def test_rests_are_standstill_with_zero_current(plain: Case) -> None:
    for columns, motion in zip(plain.runs, plain.motions, strict=True):
        off = ~motion.on
        settled = np.convolve(off, np.ones(300), "full")[: len(off)] > 299.5
        assert settled.sum() > 500
        for j in "12":
            assert np.max(np.abs(columns[f"j{j}.current_a"][settled])) < 1e-6
            assert np.max(np.abs(columns[f"j{j}.link_velocity_rad_s"][settled])) < 2e-4


def test_finer_steps_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    order = Order(SEED, (("hysteresis", 1, None),), profile="fourier", runs=2, duration_s=1.0, quiet=True)
    coarse = draw_many([order])[0]
    monkeypatch.setattr(plant_module, "SUBSTEPS", 16)
    fine = draw_many([order])[0]
    for a, b in zip(coarse.runs, fine.runs, strict=True):
        assert rms(a["j1.torque_nm"] - b["j1.torque_nm"]) < 0.05
        assert rms(a["j1.motor_position_rad"] - b["j1.motor_position_rad"]) < 0.02


def test_profiles_cover_what_a_diagnosis_needs(plain: Case) -> None:
    case = plain
    travel = [np.ptp(c["j1.link_position_rad"]) for c in case.runs]
    assert sum(x > 2 * np.pi for x in travel) >= 1
    both = {(bool(a), bool(b)) for c in case.runs for a, b in _quadrants(signals(c, 1, case.joints[1]))}
    assert len(both) == 4
    temperature = np.concatenate([c["j1.temperature_c"] for c in case.runs])
    assert temperature.min() < 28.0
    assert temperature.max() > 40.0
    for c in case.runs:
        for number, joint in case.joints.items():
            assert np.max(np.abs(c["j1.torque_nm"])) < 1.5 * joint["rated_torque_nm"]
            assert np.array_equal(c["j1.torque_nm"], c[f"j{number}.torque_nm"])


def _quadrants(s: Signals) -> set[tuple[bool, bool]]:
    busy = s.moving & (np.abs(s.sensor_nm) > 1.0)
    return set(zip((s.v[busy] > 0).tolist(), (s.sensor_nm[busy] > 0).tolist(), strict=True))


def test_encoders_are_quantised_and_noise_has_its_size() -> None:
    case = draw(SEED, runs=1, duration_s=4.0)
    for key, counts in (("motor_position_rad", MOTOR_COUNTS), ("link_position_rad", LINK_COUNTS)):
        x = case.runs[0][f"j2.{key}"] * counts / (2 * np.pi)
        assert np.allclose(x, np.round(x), atol=1e-4)
    rng = np.random.default_rng(SEED)
    sizes = [np.std(_slow(rng, 20000, 1.5, 0.05)) for _ in range(40)]
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(0.05, rel=0.05)


def test_late_channel_is_the_channel_of_before() -> None:
    t = 1e-3 * np.arange(2000)
    for delay in (0.0, 0.4e-3, 1e-3, 3.7e-3):
        late = _late(np.sin(2 * np.pi * 5.0 * t), delay)
        assert np.max(np.abs(late[20:-2] - np.sin(2 * np.pi * 5.0 * (t - delay))[20:-2])) < 1e-6


@pytest.mark.parametrize("index", range(len(UNLIKE)))
def test_unknown_thing_shows_at_its_place_and_little_elsewhere(long_cases: list[Case], index: int) -> None:
    case = long_cases[2 + index]
    (item,) = case.truth
    print(case.seed, item)
    assert item["name"] not in ENTRIES
    inside, outside = [], []
    for k, columns in enumerate(case.runs, 1):
        s = signals(columns, 1, case.joints[1])
        energy = s.motor_nm**2 + (s.torsion_nm - s.torsion_nm.mean()) ** 2
        here = np.zeros(len(s.v), bool)
        for place in item["places"]:
            if place["axis"] == "frequency":
                here[:] = True
            elif place["axis"] != "channel" and place.get("run", f"run{k}") == f"run{k}":
                x = {"time": s.time_s, "current": s.current_a, "velocity": s.v, "link_angle": s.link_rad}[
                    place["axis"]
                ]
                low, high = place["low"], place["high"]
                if place["axis"] == "link_angle":
                    here |= np.mod(x - low, 2 * np.pi) < high - low
                elif place["axis"] == "time":
                    here |= (x > low - 0.05) & (x < high + 0.05)
                else:
                    here |= (x > low) & (x < high)
        inside.append(energy[here & s.moving])
        outside.append(energy[~here & s.moving])
    strong, weak = np.concatenate(inside), np.concatenate(outside)
    assert np.mean(strong) > 0.03
    if len(weak) > 100:
        # a slip is there to stay, so it is a matter of more and less
        assert np.mean(weak) < (0.6 if item["name"] == "coupling_slip" else 0.25) * np.mean(strong)


def test_generator_is_independent_of_the_project() -> None:
    code = (
        "import sys, validation.generator.draw, validation.diagnosis.mujoco_bench, validation.diagnosis.measured_bench; "
        "bad = [m for m in sys.modules if m.split('.')[0] in ('jtqd', 'scipy')]; "
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ValueError, match="'gremlin', expected one of"):
        draw(1, (("gremlin", 1, None),))
    with pytest.raises(ValueError, match="profile: found 'waltz'"):
        draw(1, profile="waltz")


def test_scaled_size_is_a_multiple_of_the_deviation() -> None:
    case = draw(3, runs=1, duration_s=1.0)
    rng = np.random.default_rng(3)
    for name, entry in ENTRIES.items():
        nominal = case.joints[1]
        for parameter in filter(None, (entry.parameter, entry.second)):
            base = base_value(name, nominal, parameter)
            step = 0.02 * (abs(base) or 1.0)
            values = scaled(name, nominal, {parameter: base + step}, 3.0, rng)
            assert abs(values[parameter] - base) == pytest.approx(3.0 * step)


def test_further_runs_come_from_the_same_bench() -> None:
    """A bench with a large sensor offset shows it again in runs that somebody else designs."""
    order = Order(8, (("sensor_offset", "sensor", {"offset_nm": 5.0}),), runs=1, duration_s=2.0)
    t = np.arange(3000) * 1e-3
    ramp = np.minimum(t, 0.5)
    asked = [Reference(0, ramp, 0.0 * t), Reference(1, ramp[:2000], 0.5 * ramp[:2000])]
    first, second = follow_up(order, asked)
    assert len(first["time_s"]) == 3000
    assert len(second["time_s"]) == 2000
    ratio = draw(8, runs=1, duration_s=1.0).joints[1]["gear_ratio"]
    assert np.mean(first["j1.motor_velocity_rad_s"][2000:]) / ratio == pytest.approx(0.5, abs=0.02)
    assert np.mean(first["j1.torque_nm"][:20]) == pytest.approx(5.0, abs=0.6)
    assert np.mean(second["j2.torque_nm"][:20]) == pytest.approx(5.0, abs=0.6)


def test_drives_that_somebody_wants_off_carry_no_current_and_the_table_says_so() -> None:
    """Only what is asked for is marked; what is read then is the offset."""
    order = Order(8, (("current_offset", 1, {"offset_a": 0.2}),), runs=1, duration_s=2.0)
    t = np.arange(2500) * 1e-3
    velocity = 0.3 * np.sin(2.0 * np.pi * np.clip(t, 0.0, 1.0))
    one, other = follow_up(
        order, [Reference(0, velocity, 0.0 * t, ((1000, 2000),)), Reference(0, velocity, 0.0 * t)]
    )
    off = one["j1.enabled"] == 0.0
    assert np.flatnonzero(off).tolist() == list(range(1000, 2000))
    assert np.array_equal(one["j1.enabled"], one["j2.enabled"])
    assert "j1.enabled" not in other
    late = np.arange(1100, 2000)
    assert np.mean(one["j1.current_a"][late]) == pytest.approx(0.2, abs=0.003)
    assert np.mean(one["j2.current_a"][late]) == pytest.approx(0.0, abs=0.003)
    assert np.ptp(one["j1.motor_position_rad"][late]) < 0.01
