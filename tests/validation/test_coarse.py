"""The plant `coarse`: it shares nothing with what is judged on it; its laws against closed forms."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from jtqd.models.files import load_yaml
from jtqd.sysid.planner.plan import Plateau, Rest, Run
from validation.generator import coarse
from validation.goals.identify import Driven, drive, nominal_joints, plant_file, the_four

PLANT = the_four()[-1]


def bench(**changes: Any) -> coarse.Bench:
    """The plant with numbers of both joints' sections replaced, `gear__slips=[]`, and without differences of days."""

    def change(mapping: dict[str, Any]) -> None:
        mapping["run_to_run"] = dict.fromkeys(mapping["run_to_run"], 0.0)
        for side in ("joint_1", "joint_2"):
            for key, value in changes.items():
                section, _, name = key.partition("__")
                assert name in mapping[side][section], key
                mapping[side][section][name] = value

    made = PLANT.changed(change).bench()
    assert isinstance(made, coarse.Bench)
    return made


QUIET = {
    "motor__cogging": [{"order": 12.0, "amplitude_nm": 0.0, "phase_rad": 0.0}],
    "friction__motor_angle": [{"order": 2.0, "share": 0.0, "phase_rad": 0.0}],
    "friction__link_angle": [{"order": 1.0, "share": 0.0, "phase_rad": 0.0}],
    "gear__errors": [{"order": 2.0, "amplitude_rad": 0.0, "phase_rad": 0.0}],
    "gear__link_errors": [{"order": 1.0, "amplitude_rad": 0.0, "phase_rad": 0.0}],
}


def command(velocity: float, current: float, seconds: float = 1.5, leader: int = 0) -> coarse.Command:
    n = round(1000 * seconds)
    rise = np.minimum(np.arange(n) / 300.0, 1.0)
    return coarse.Command(leader, velocity * rise, current * rise)


def test_imports_nothing_of_the_project() -> None:
    text = coarse.FILE.with_suffix(".py").read_text(encoding="utf-8")
    found = set(re.findall(r"^\s*(?:from|import)\s+([\w.]+)", text, re.M))
    assert found == {"__future__", "collections.abc", "dataclasses", "math", "pathlib", "typing", "numpy"}


def test_every_number_of_the_file_has_a_source() -> None:
    lines = coarse.FILE.read_text(encoding="utf-8").splitlines()
    first = lines[: _at(lines, "joint_2:")]
    for line in first:
        if re.match(r"    \w+: (?!\*)[-\d\[]", line):
            assert re.search(r"#.*\[([A-Z]\d\d|est|cal|file)\]", line), line


def _at(lines: list[str], start: str) -> int:
    return next(k for k, line in enumerate(lines) if line.startswith(start))


def test_a_run_is_the_same_alone_and_beside_others() -> None:
    made = PLANT.bench()
    assert isinstance(made, coarse.Bench)
    both = made.record([command(0.5, 1.0, 0.6), command(-0.8, 2.0, 0.5, leader=1)], seed=3)
    alone = made.record([command(-0.8, 2.0, 0.5, leader=1)], seed=3, first_day=1)[0]
    assert len(both[0].sensor_nm) == 600
    for one, other in zip(both[1], alone, strict=True):
        assert one == pytest.approx(other, abs=1e-9)
    assert not np.allclose(
        both[1].sensor_nm, made.record([command(-0.8, 2.0, 0.5, leader=1)], 4)[0].sensor_nm
    )


@pytest.mark.parametrize(("velocity", "current"), [(0.9, 5.0), (-0.4, 3.0), (0.9, -2.0)])
def test_friction_of_steady_motion_is_that_of_the_docstring(velocity: float, current: float) -> None:
    """G Kt i_r tanh(i/i_r) - tau of the last half second, against g and the viscous part at the mean torque."""
    made = bench(**QUIET)
    run = made.record([command(velocity, current)], 1)[0]
    last = slice(-500, None)
    p, motor = made.sections["friction"], made.sections["motor"]
    for k, v in enumerate((velocity, -velocity)):
        tau = run.true_nm[last, k].mean()
        knee, constant = motor["saturation_a"][k, 0], motor["torque_constant_nm_per_a"][k, 0]
        driving = (100.0 * constant * knee * np.tanh(run.current_a[last, k] / knee)).mean()
        law = {name: float(value[k, 0]) for name, value in p.items() if isinstance(value, np.ndarray)}
        share = law["direction_share_back"] if tau * v < 0.0 else law["direction_share"]
        level = law["coulomb_nm"] * (
            1.0 + (law["static_ratio"] - 1.0) * np.exp(-abs(v) / law["stribeck_velocity_rad_s"])
        )
        level += law["load_nm"] * (abs(tau) / 40.0) ** 1.12
        expected = np.sign(v) * level * (1.0 + share * np.sign(v))
        expected += law["viscous_nm"] * np.arcsinh(v / law["eyring_rad_s"])
        assert driving - tau == pytest.approx(expected, abs=0.15)
        assert abs(expected) > 3.0


def test_spring_and_stop_operators_at_rest() -> None:
    """Current against a held joint: tau = K a tan(x/a) + sum H sat(x/travel) at first loading, x of the true angles."""
    made = bench(**QUIET)
    held = coarse.Command(0, np.zeros(1500), 6.0 * np.minimum(np.arange(1500) / 1000.0, 1.0))
    day = {name: np.zeros((2, 1)) for name in made.days.drawn(0, 0)}
    true = coarse._integrated(made, [held], day)
    gear = made.sections["gear"]
    for k in range(2):
        x = (true["motor"][:, k, 0] / 100.0 - true["link"][:, k, 0])[100:900]
        harden = gear["hardening_rad"][k, 0]
        expected = gear["stiffness_nm_per_rad"][k, 0] * harden * np.tan(x / harden)
        torque, travel = gear["slips"]
        expected = expected + (torque[:, k] * np.clip(x / travel[:, k], -1.0, 1.0)).sum(axis=0)
        assert true["tau"][100:900, k, 0] == pytest.approx(expected, abs=0.2)
        assert x[-1] * 12000.0 > 15.0


def test_bristles_bend_before_they_slide() -> None:
    """With the drives off a torque below friction is held, and a slow push bends a spring of C/bristle_rad."""
    made = bench(**QUIET)
    day = {name: np.zeros((2, 1)) for name in made.days.drawn(0, 0)}
    friction = coarse._Friction(made, day)
    one = np.ones((2, 1))
    speed = 1e-3
    torques = [friction.step(1e-3, speed * one, 0.0 * one, one) for _ in range(100)]
    viscous = made.sections["friction"]["viscous_nm"] * np.arcsinh(
        speed / made.sections["friction"]["eyring_rad_s"]
    )
    bent = np.array(torques)[:, 0, 0] - viscous[0, 0] - friction.damping[0, 0] * speed
    stiffness = made.sections["friction"]["coulomb_nm"][0, 0] / made.sections["friction"]["bristle_rad"][0, 0]
    assert bent[-1] == pytest.approx(stiffness * speed * 0.0995, rel=0.05)


def test_the_sensor_is_the_torque_less_the_link_s_share() -> None:
    made = bench(**QUIET)
    day = {name: np.zeros((2, 1)) for name in made.days.drawn(0, 0)}
    true = coarse._integrated(
        made, [coarse.Command(0, 1.5 * np.sin(0.02 * np.arange(1500)), np.full(1500, 2.0))], day
    )
    acceleration = np.gradient(np.gradient(true["link"][:, 0, 0], 1e-3), 1e-3)[20:-20]
    error = true["sensor"][20:-20, 0] - true["tau"][20:-20, 0, 0] + made.link_inertia[0] * acceleration
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.abs(made.link_inertia[0] * acceleration).max() > 0.1


def test_unknown_keys_are_refused() -> None:
    mapping = load_yaml(coarse.FILE)
    mapping["joint_1"]["gearbox"] = {}
    with pytest.raises(ValueError, match="gearbox"):
        coarse.Bench(mapping, [dict.fromkeys(coarse.NOMINAL, 1.0)] * 2)


def test_driven_runs_have_the_truth_of_both_joints() -> None:
    run = Run("short", 2, (Rest(0.2, 0.0), Plateau(0.6, 2.0, 0.4, 0.2), Rest(0.2, 0.2)))
    made: Driven = drive(PLANT.bench(), [run], 5)[0]
    assert made.true_nm.shape == (len(made.table.time_s), 2)
    columns = made.columns(2, nominal_joints(PLANT)[1])
    assert columns.motor_velocity_rad_s is not None
    assert columns.motor_velocity_rad_s[700] == pytest.approx(60.0, abs=3.0)
    assert plant_file("coarse", coarse.FILE).mapping == PLANT.mapping
