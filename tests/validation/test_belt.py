"""The belt's and gear's world: balances of its noise-free signals, closed forms, and what each effect leaves in them."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS as LIBRARY
from jtqd.estimator.effects import checked_parameters
from jtqd.estimator.joint import Joint
from jtqd.sysid.runs.column_map import ColumnMap
from tests.validation.balances import binned, expected, rms, signals, slope, slow_enough
from validation.generator import belt
from validation.generator.belt import (
    EFFECTS,
    FOREIGN,
    LOADS,
    TRANSMISSIONS,
    Plant,
    Recording,
    columns_file,
    draw_plant,
    joint_file,
    record,
    relevance,
    showable,
    simulate,
    with_effect,
    without,
)

FINE, SHORT = (
    tuple(Recording(motion, 3, seconds, 1000.0, 12) for motion in ("multisine", "ladder", "creep"))
    for seconds in (3.5, 2.0)
)
VARIED = ("nonlinear_stiffness", "sensor_drift", "sensor_crosstalk", "encoder_eccentricity", "channel_delay")


@pytest.fixture(scope="module")
def once() -> Iterator[None]:
    """What was simulated last is not simulated again: the plant without an effect, and the same one to be measured."""
    kept: list[tuple[tuple[object, ...], belt.Truth]] = []

    def simulated(
        plant: Plant, recordings: Sequence[Recording], seed: int, *, quiet: bool = False
    ) -> belt.Truth:
        asked = (plant, tuple(recordings), seed, quiet)
        place = next((k for k, (known, _) in enumerate(kept) if known == asked), None)
        found = (
            kept.pop(place) if place is not None else (asked, simulate(plant, recordings, seed, quiet=quiet))
        )
        kept.append(found)
        del kept[:-4]
        return found[1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(belt, "simulate", simulated)
        yield


def plain_plant(load: str = "sensor", transmission: str = "gear", encoders: int = 2, seed: int = 5) -> Plant:
    """Return a plant without Stribeck friction and with an exact model of the arm."""
    plant = draw_plant(np.random.default_rng(seed), load=load, encoders=encoders, transmission=transmission)
    values = dict(plant.values) | {"friction.stribeck_nm": 0.0}
    return replace(plant, values=values, nominal=values, body={**plant.body, "gravity_error": 0.0})


def test_it_shares_no_code() -> None:
    tree = ast.parse(Path(belt.__file__).read_text(encoding="utf-8"))
    names = [a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names]
    names += [str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert {name.split(".")[0] for name in names} <= {
        *("__future__", "math", "collections", "dataclasses", "types", "typing", "numpy", "scipy")
    }


@pytest.mark.parametrize("transmission", TRANSMISSIONS)
@pytest.mark.parametrize("load", LOADS)
def test_balances_close_with_the_true_file(load: str, transmission: str) -> None:
    """In percent of the rated torque, reference torque by the user's own formula."""
    plant = plain_plant(load, transmission)
    rated = plant.values["rated_torque_nm"]
    for run in record(plant, FINE, 1, quiet=True):
        columns = dict(run)
        if load == "arm":
            columns["j1.torque_nm"] = columns["model_torque_nm"]
        elif load == "pendulum":
            load_of = ColumnMap.from_mapping(columns_file(plant) or {}, "map", Path()).loads
            assert load_of is not None
            known, q, t = load_of[1], run["j1.link_position_rad"], run["time_s"]
            weight = known.mass_kg * known.gravity_m_s2 * known.lever_m * np.sin(q)
            columns["j1.torque_nm"] = weight + known.inertia_kgm2 * slope(slope(q, t), t)
        s = signals(columns, 1, joint_file(plant))
        assert s.moving.mean() > 0.3
        assert rms(s.tau) > 0.01 * rated
        inside = s.moving & (s.time_s > 0.1) & (s.time_s < s.time_s[-1] - 0.1)
        assert rms(binned(s.motor_nm, inside)) < 4e-4 * rated
        assert rms(binned(s.torsion_nm, inside)) < 2e-4 * rated


def test_free_pendulum_has_the_frequency_of_its_inertias() -> None:
    """Small swing without friction and current: w^2 = m g l / (J + Jl + G^2 Jm), the spring almost rigid."""
    plant = plain_plant("pendulum", "gear")
    free = {"friction.coulomb_nm": 0.0, "friction.viscous_nms_per_rad": 0.0}
    plant = replace(
        plant, values={**plant.values, **free}, drive={**plant.drive, "bandwidth_rad_s": 0.0, "duty": 0.0}
    )
    n = 60 * belt.BLOCK
    zero = np.zeros((n, 1))
    push = zero.copy()
    push[:400] = 0.2 * plant.values["rated_torque_nm"]
    x = belt.SimpleNamespace(**{name: np.zeros(1) for name in belt._KEPT})
    x.day_c = x.day_v = np.ones(1)
    x.temperature = np.full(1, 25.0)
    steady = np.ones(1), np.zeros(1), np.ones(1)
    out = belt._integrated(
        plant, x, belt._References(zero, zero, push, zero, np.zeros(1, bool)), x.temperature, steady
    )
    q = out.q[400:, 0]
    up = np.flatnonzero((q[:-1] < 0.0) & (q[1:] >= 0.0)) + 0.0
    up += [-q[int(k)] / (q[int(k) + 1] - q[int(k)]) for k in up]
    period = float(np.mean(np.diff(up))) * belt.STEP_S
    v, b = plant.values, plant.body
    inertia = b["inertia_kgm2"] + v["link_inertia_kgm2"] + v["gear_ratio"] ** 2 * v["rotor_inertia_kgm2"]
    omega = np.sqrt(b["mass_kg"] * belt.GRAVITY_M_S2 * b["lever_m"] / inertia)
    size = float(np.max(np.abs(q)))
    assert len(up) >= 3
    assert size < 0.3
    assert period == pytest.approx(2 * np.pi / omega * (1 + size**2 / 16), rel=3e-3)
    assert float(np.max(np.abs(q[-4000:]))) == pytest.approx(size, rel=0.02), "nothing takes its energy"


def test_current_at_constant_speed_is_friction_and_load() -> None:
    plant = draw_plant(np.random.default_rng(8), load="sensor", encoders=1, transmission="gear")
    n, speed, load = 30 * belt.BLOCK, 0.4, 0.2 * plant.values["rated_torque_nm"]
    q = (speed * belt.STEP_S * np.arange(n))[:, None]
    x = belt.SimpleNamespace(**{name: np.zeros(1) for name in belt._KEPT})
    x.day_c = x.day_v = np.ones(1)
    x.temperature = np.full(1, 25.0)
    steady = np.ones(1), np.zeros(1), np.ones(1)
    refs = belt._References(q, np.full((n, 1), speed), np.full((n, 1), load), 0.0 * q, np.zeros(1, bool))
    out = belt._integrated(plant, x, refs, x.temperature, steady)
    v = plant.values
    loss = v["friction.coulomb_nm"] + v["friction.viscous_nms_per_rad"] * speed
    loss += v["friction.stribeck_nm"] * np.exp(-((speed / v["friction.stribeck_velocity_rad_s"]) ** 2))
    wanted = (load + loss) / (v["gear_ratio"] * v["torque_constant_nm_per_a"])
    assert float(np.mean(out.i[-4000:])) == pytest.approx(wanted, rel=2e-3)
    assert float(np.mean(out.v[-4000:])) == pytest.approx(speed, rel=1e-3)


def test_a_joint_sticks() -> None:
    """Below breakaway the rotor bends the bristle and does not creep."""
    plant = plain_plant("sensor", "gear")
    x = simulate(plant, [Recording("trapezoid", 2, 4.0)], 1, quiet=True).signals
    still = np.abs(x.v[:, 0]) < 1e-4
    assert still.mean() > 0.1
    assert float(np.ptp(x.s[still, 0])) > 0.2
    assert np.max(np.abs(x.s)) <= 1.0


def test_energy_goes_into_losses() -> None:
    """Work of motor less load = change of kinetic and elastic energy + losses, all of them, on a towed belt."""
    plant = plain_plant("sensor", "belt")
    x = simulate(plant, SHORT, 1, quiet=True).signals
    v, h = plant.values, belt.STEP_S
    full = v["gear_ratio"] * v["torque_constant_nm_per_a"]
    drive = np.sum(full * x.i * x.v, 0) * h
    out = np.sum(x.torque * x.u, 0) * h
    lost = np.sum((v["friction.coulomb_nm"] * x.s + v["friction.viscous_nms_per_rad"] * x.v) * x.v, 0) * h
    damped = np.sum(v["damping_nms_per_rad"] * (x.v - x.u) ** 2, 0) * h
    kinetic = 0.5 * v["gear_ratio"] ** 2 * v["rotor_inertia_kgm2"] * (x.v[-1] ** 2 - x.v[0] ** 2)
    spring = 0.5 * v["stiffness_nm_per_rad"] * ((x.p - x.q)[-1] ** 2 - (x.p - x.q)[0] ** 2)
    assert drive - out == pytest.approx(lost + damped + kinetic + spring, rel=0.01)


def test_same_seed_same_runs() -> None:
    plant = draw_plant(np.random.default_rng(1), load="pendulum", encoders=1, transmission="belt")
    assert plant == draw_plant(np.random.default_rng(1), load="pendulum", encoders=1, transmission="belt")
    short = [Recording("sines", 1, 2.0, 250.0, 6), Recording("chirp", 2, 3.0, 300.0, 5, "absent")]
    first, second, third = record(plant, short, 1), record(plant, short, 1), record(plant, short, 2)
    assert [len(run["time_s"]) for run in first] == [500, 900]
    assert "j1.temperature_c" not in first[1]
    for a, b, c in zip(first, second, third, strict=True):
        assert all(np.array_equal(a[key], b[key]) for key in a)
        assert not np.array_equal(a["j1.current_a"], c["j1.current_a"])
    for run, digits in zip(first, (6, 5), strict=True):
        assert all(float(f"{x:.{digits}g}") == x for key in run for x in run[key])


@pytest.mark.parametrize("name", EFFECTS)
def test_effect_leaves_what_its_law_gives(name: str) -> None:
    """With the file of the healthy plant, by the laws of tests/estimator/effects/laws.py."""
    assert name in LIBRARY
    plant = plain_plant()
    for seed in (
        (0, 1, 2) if name in VARIED else (0,)
    ):  # cubic or slope, with time or temperature, channel, side
        hidden = with_effect(plant, name, rng=np.random.default_rng(seed))
        assert hidden.hidden == (name,)
        assert without(hidden, name) == plant
        Joint.from_mapping(joint_file(hidden), "joint")
        keys = {key.split(".")[-1] for key in belt._KEYS.get(name, ())}
        new = {k.split(".")[-1]: x for k, x in hidden.values.items() if k.split(".")[-1] in keys}
        parameters = checked_parameters(name, {**new, **hidden.effects.get(name, {})})
        file, worst = joint_file(plant), 0.0
        rated = file["rated_torque_nm"]
        for run in record(hidden, FINE if name == "sensor_drift" else SHORT, 1, quiet=True):
            s = signals(run, 1, file)
            clear = s.moving & slow_enough(name, parameters, s) & (s.time_s > 0.1)
            if clear.sum() < 100:
                continue
            laws = expected(name, parameters, s, file, run["j1.temperature_c"])
            for found, law in zip((s.motor_nm, s.torsion_nm), laws, strict=True):
                want = binned(law, clear)
                left = binned(found, clear) - want
                assert np.quantile(np.abs(left), 0.75) < 0.06 * rms(want) + 6e-4 * rated
                worst = max(worst, rms(want))
        assert worst > 1e-3 * rated, "the typical size cannot be seen"


@pytest.mark.usefixtures("once")
@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_effect_is_seen_and_is_in_no_library(name: str) -> None:
    assert name not in LIBRARY
    load = "pendulum" if name == "cable_chain" else "sensor"
    plant = draw_plant(np.random.default_rng(5), load=load, encoders=2, transmission="belt")
    hidden = with_effect(plant, name, rng=np.random.default_rng(1))
    assert hidden.hidden == (name,)
    assert without(hidden, name) == plant
    runs = SHORT
    small, large = (
        relevance(with_effect(plant, name, size, rng=np.random.default_rng(1)), name, runs, 1)
        for size in (0.5, 1.0)
    )
    assert 0.05 < small < large < 20.0
    change = [
        max(float(np.max(np.abs(a[key] - b[key]))) for key in a)
        for a, b in zip(record(plant, runs, 1, quiet=True), record(hidden, runs, 1, quiet=True), strict=True)
    ]
    assert max(change) > 1e-3


def test_relevance_of_an_offset_is_the_offset() -> None:
    plant = plain_plant()
    hidden = with_effect(plant, "sensor_offset", rng=np.random.default_rng(1))
    offset = abs(hidden.effects["sensor_offset"]["offset_nm"])
    assert relevance(hidden, "sensor_offset", SHORT, 1) == pytest.approx(
        100.0 * offset / plant.values["rated_torque_nm"], rel=1e-6
    )


def test_only_what_a_plant_can_show_is_hidden() -> None:
    plant = draw_plant(np.random.default_rng(1), load="pendulum", encoders=1, transmission="gear")
    rng = np.random.default_rng(1)
    for name in ("sensor_gain", "hysteresis", "pulley_slip", "current_into_sensor"):
        assert name not in showable(plant)
        with pytest.raises(ValueError, match="expected one of"):
            with_effect(plant, name, rng=rng)
    hidden = [with_effect(plant, "channel_delay", rng=rng).effects["channel_delay"] for _ in range(6)]
    assert {p["channel"] for p in hidden} == {1.0}
