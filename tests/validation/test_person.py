"""The study `person`: its judge, its oracle and its counting, each on a case whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.run import JointColumns, RunTable
from validation.diagnosis import balance, person, person_sets
from validation.diagnosis.entries import SENSOR

TRUE = Joint(
    name="j",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.1,
    rotor_inertia_kgm2=6e-5,
    stiffness_nm_per_rad=16000.0,
    damping_nms_per_rad=8.0,
    link_inertia_kgm2=0.1,
    rated_torque_nm=40.0,
    friction=Friction(coulomb_nm=4.0, viscous_nms_per_rad=3.0),
)
"""The plant of `run`, with a load friction of LOAD besides."""
LOAD = 0.1
LOADED = (EFFECTS["load_dependent_friction"], {"load_coefficient": LOAD})


def run(seed: int, seconds: float = 8.0, step_s: float = 2e-3) -> RunTable:
    """Return a run of TRUE without noise, from its equations: sums of sines for the link's angle and the torque."""
    rng = np.random.default_rng(seed)
    t = step_s * np.arange(round(seconds / step_s))

    def sines(size: float, order: int = 0) -> np.ndarray:
        f = 2 * np.pi * np.array([0.31, 0.73, 1.37])
        phase, own = phases.pop(0), size / f**0.5
        return np.asarray(
            sum(
                a * w**order * np.sin(w * t + p + order * np.pi / 2)
                for a, w, p in zip(own, f, phase, strict=True)
            )
        )

    start = rng.uniform(0.0, 6.0, (2, 3))
    phases = [start[0]] * 3 + [start[1]] * 3
    q, v, a = (sines(1.2, k) for k in range(3))
    torque, rate, bend = (sines(12.0, k) for k in range(3))
    gear = torque + TRUE.link_inertia_kgm2 * a
    # twist x: K x + D dx/dt = gear torque, to first order in D/K
    twist = gear / TRUE.stiffness_nm_per_rad - TRUE.damping_nms_per_rad / TRUE.stiffness_nm_per_rad**2 * rate
    speed, bent = v + rate / TRUE.stiffness_nm_per_rad, a + bend / TRUE.stiffness_nm_per_rad
    loss = (
        np.sign(speed) * (TRUE.friction.coulomb_nm + LOAD * np.abs(gear))
        + TRUE.friction.viscous_nms_per_rad * speed
    )
    needed = gear + loss + TRUE.gear_ratio**2 * TRUE.rotor_inertia_kgm2 * bent
    current = needed / (TRUE.gear_ratio * TRUE.torque_constant_nm_per_a)
    columns = JointColumns(
        current_a=current,
        motor_position_rad=TRUE.gear_ratio * (q + twist + 1e-4),
        link_position_rad=q,
        torque_nm=torque,
    )
    return RunTable(t, {1: columns})


@pytest.fixture(scope="module")
def views() -> list[balance.View]:
    return [balance.view(run(k), k, 1, TRUE, True) for k in range(3)]


def test_a_derivative_is_that_of_the_function() -> None:
    t = 2e-3 * np.arange(4000)
    for order, expected in enumerate((3.0 * t + np.sin(5 * t), 3.0 + 5 * np.cos(5 * t), -25 * np.sin(5 * t))):
        found = balance.spectral(3.0 * t + np.sin(5 * t), 2e-3, 80.0, order)
        assert np.abs(found - expected)[200:-200].max() < 2e-3 * np.abs(expected).max()


def test_the_true_file_misses_nothing_and_a_wrong_one_what_it_is_wrong_by(views: list[balance.View]) -> None:
    nothing, _ = balance.combined_nm(views, {1: balance.File(TRUE, [LOADED])}, {1: TRUE})
    assert nothing < 0.02
    wrong = replace(TRUE, friction=Friction(coulomb_nm=5.0, viscous_nms_per_rad=3.0))
    e = [balance.errors(v, balance.File(wrong, [LOADED]), TRUE) for v in views]
    motor = np.concatenate([x[balance.MOTOR] for x in e])
    assert abs(np.sqrt(np.mean(motor**2)) - 1.0) < 0.02, (
        "a newton metre of friction, in the current's own torque"
    )
    softer = replace(TRUE, stiffness_nm_per_rad=0.5 * TRUE.stiffness_nm_per_rad)
    torsion = balance.errors(views[0], balance.File(softer, [LOADED]), TRUE)[balance.TORSION]
    s = views[0].state
    gear = views[0].low(s.torque_nm + TRUE.link_inertia_kgm2 * s.link_acceleration_rad_s2)[
        views[0].keep_torsion
    ]
    assert abs(torsion.std() / gear.std() - 1.0) < 0.05, "twice the twist is once more the torque"


@pytest.mark.parametrize("factor", [0.5, 0.1])
def test_scaling_a_whole_balance_gains_nothing(views: list[balance.View], factor: float) -> None:
    """Torque constant, inertias, friction, stiffness smaller, a sensor that reads too much: `factor` times the balance."""
    wrong = replace(TRUE, friction=Friction(coulomb_nm=5.0, viscous_nms_per_rad=3.0))
    small = replace(
        wrong,
        torque_constant_nm_per_a=factor * wrong.torque_constant_nm_per_a,
        rotor_inertia_kgm2=factor * wrong.rotor_inertia_kgm2,
        link_inertia_kgm2=factor * wrong.link_inertia_kgm2,
        stiffness_nm_per_rad=factor * wrong.stiffness_nm_per_rad,
        damping_nms_per_rad=factor * wrong.damping_nms_per_rad,
        friction=Friction(coulomb_nm=factor * 5.0, viscous_nms_per_rad=factor * 3.0),
    )
    gain = (EFFECTS["sensor_gain"], {"gain": 1.0 / factor})
    one, _ = balance.combined_nm(views, {1: balance.File(wrong, [LOADED])}, {1: TRUE})
    two, _ = balance.combined_nm(views, {1: balance.File(small, [LOADED, gain])}, {1: TRUE})
    assert one > 0.5
    assert abs(two / one - 1.0) < 1e-6


def test_the_oracle_recovers_the_truth_from_afar(views: list[balance.View]) -> None:
    start = replace(
        TRUE, torque_constant_nm_per_a=0.11, friction=Friction(coulomb_nm=5.5, viscous_nms_per_rad=3.0)
    )
    free = [
        balance.Parameter(0, 1, "torque_constant_nm_per_a", 0.11, 0.11, 0.01),
        balance.Parameter(1, 1, "friction.coulomb_nm", 5.5, 5.5, 3.0),
        balance.Parameter(2, 1, "load_coefficient", 0.02, 0.0, 0.05, "load_dependent_friction"),
    ]
    truth = balance.Truth({1: start}, {1: [(LOADED[0], {"load_coefficient": 0.02})]}, free)
    found = balance.fit(views, truth, {1: start})
    assert found.values == pytest.approx([0.1, 4.0, LOAD], rel=0.01)
    assert (found.sigma > 0.0).all()
    moved = [(v - q.file) / q.scale for v, q in zip(found.values, free, strict=True)]
    assert balance.settled(views, found, truth, {1: start}, moved, ()) == [True, True, True]
    error, _ = balance.combined_nm(views, found.files, {1: start})
    assert error < 0.02
    assert balance.ladder(views, views, {1: start}) < 0.03


def test_an_offset_of_a_current_and_an_asymmetry_are_not_settled_where_the_joint_turns_one_way() -> None:
    """Samples of one direction: the offset of the current has rivals."""
    views = [balance.view(run(k), k, 1, TRUE, True) for k in range(3)]
    for v in views:
        v.__dict__["keep"] = v.keep[v.state.velocity_rad_s[v.keep] > 0.0]
    off = {"offset_a": 0.1}
    free = [balance.Parameter(0, 1, "offset_a", 0.1, 0.0, 0.05, "current_offset")]
    truth = balance.Truth({1: TRUE}, {1: [LOADED, (EFFECTS["current_offset"], off)]}, free)
    found = balance.fit(views, truth, {1: TRUE})
    assert balance.settled(views, found, truth, {1: TRUE}, [-2.0], ()) == [False]


# What is drawn.


@pytest.mark.parametrize("bench", ["ours", "mujoco", "belt", "practice"])
def test_a_plan_is_that_of_its_seed_and_within_what_the_generator_can(bench: str) -> None:
    can = person_sets.BENCHES[bench].can
    plans = [person_sets.plan(can, bench, 1, k) for k in range(200)]
    assert plans[7] == person_sets.plan(can, bench, 1, 7)
    assert plans[7] != person_sets.plan(can, bench, 2, 7)
    hidden = [p for p in plans if not p.nothing]
    assert 0.1 < 1.0 - len(hidden) / len(plans) < 0.3
    for p in hidden:
        assert 3 <= len(p.values) <= 6
        assert not any(
            p.encoders == 1 and name in person_sets.TORSION_ONLY for name, *_ in (*p.values, *p.effects)
        )
        assert not any(p.known_load and name.startswith("sensor_") for name, *_ in (*p.values, *p.effects))
    work = np.mean([p.runs * p.seconds for p in plans])
    assert 60.0 < work < 140.0, "about 5 runs of 20 s"


def test_the_file_is_wrong_where_the_plan_has_it_and_the_truth_is_the_plant() -> None:
    true = {1: TRUE.to_mapping()}
    values = (("coulomb_friction", 1, 0.01), ("torque_constant", 1, 1.0), ("sensor_gain", SENSOR, 2.0))
    p = replace(
        person_sets.plan(person_sets.BENCHES["ours"].can, "ours", 1, 0), values=values, effects=(), joints=1
    )
    hidden = person_sets.hidden_values(p, true)
    assert hidden == {("sensor_gain", SENSOR): {"gain": 1.02}}
    entries = person_sets.entries_of(p, true, hidden)
    assert [(e.name, e.parameters, e.base) for e in entries] == [
        ("coulomb_friction", {"coulomb_nm": 4.0}, {"coulomb_nm": 5.0}),  # at least 25 % off
        ("torque_constant", {"torque_constant_nm_per_a": 0.1}, {"torque_constant_nm_per_a": 0.11}),
        ("sensor_gain", {"gain": 1.02}, {"gain": 1.0}),
    ]
    assert all(e.wrong_value for e in entries)


# What is counted.


def cause(name: str, joint: Any, value: float, half: float, parameter: str, **more: Any) -> dict[str, Any]:
    ci95 = [value - half, value + half]
    return {
        "name": name,
        "joint": joint,
        "class": [name],
        "parameters": {parameter: {"value": value, "ci95": ci95, "unit": ""}},
        **more,
    }


def line(verdict: str, causes: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """Return the line of a set: Coulomb friction and torque constant of joint 1 are wrong, and a cogging is there."""
    entries = [
        {"name": "coulomb_friction", "joint": 1, "parameters": {"coulomb_nm": 4.0}, "wrong_value": True},
        {
            "name": "torque_constant",
            "joint": 1,
            "parameters": {"torque_constant_nm_per_a": 0.1},
            "wrong_value": True,
        },
        {
            "name": "cogging",
            "joint": 1,
            "parameters": {"amplitude_nm": 1.0, "order_per_motor_rev": 12.0},
            "wrong_value": False,
        },
    ]
    oracle = [
        {
            "name": n,
            "joint": 1,
            "parameter": p,
            "true": t,
            "file": f,
            "value": t,
            "sigma": s,
            "beyond": True,
            "alone": a,
            "wrong_value": True,
        }
        for n, p, t, f, s, a in (
            ("coulomb_friction", "coulomb_nm", 4.0, 5.0, 0.1, True),
            ("torque_constant", "torque_constant_nm_per_a", 0.1, 0.11, 0.001, False),
        )
    ]
    found = {"verdict": verdict, "causes": causes}
    return {
        "key": "ours.0",
        "bench": "ours",
        "nothing": False,
        "plan": {"rest": None},
        "entries": entries,
        "status": "3",
        "verdict": verdict,
        "reported": person.reported(found),
        "placed": False,
        "oracle": oracle,
        "error_nm": {"file": 2.0, "true": 1.0, "oracle": 1.0, "tool": 1.5, "ladder": 1.2},
        "relevance": 0.0,
        "cpu_s": 10.0,
        "memory_mb": 200.0,
        **more,
    }


RIGHT = cause("coulomb_friction", 1, 4.05, 0.3, "coulomb_nm")
WRONG = cause("hysteresis", 1, 1.0, 0.1, "torque_nm")


def test_a_wrong_certain_name_counts_and_a_missing_and_a_right_one_count_as_they_are() -> None:
    rows = {row.what: row for row in person.shares([line("cause", [RIGHT, WRONG])]) if row is not None}
    found = {what: (row.value, row.trials) for what, row in rows.items()}
    assert found["1 wrong certain: sets with something hidden"] == (1.0, 1)
    assert found["2 wrong values beyond 3 oracle sigma: reported at any grade"] == (0.5, 2), "one is missing"
    assert found["2 of those with an interval: it holds the truth"] == (1.0, 1)
    assert found["3 settled by the oracle alone: graded certain"] == (1.0, 1)
    assert found["4 something hidden: held-out error at most the ladder's"] == (0.0, 1)
    assert found["4 something hidden: at most the ladder's, or as the oracle's"] == (0.0, 1)
    error = {"oracle": 1.3, "tool": 1.31, "ladder": 1.2}
    (as_good,) = (
        r.value for r in person.shares([line("cause", [], error_nm=error)]) if r and "as the oracle" in r.what
    )
    assert as_good == 1.0
    figures = {row.what: row.value for row in person.figures([line("cause", [RIGHT, WRONG])])}
    assert figures["3 settled: width of the interval over the oracle's, median"] == pytest.approx(0.3 / 0.196)
    assert figures["4 held-out error over the oracle's, median"] == 1.5
    notes = person.tables([line("cause", [RIGHT, WRONG])])[1]
    assert any("hysteresis of 1" in note and "wrong certain" in note for note in notes)


def test_a_name_of_another_joint_is_wrong_and_an_alias_of_the_same_order_is_there() -> None:
    other = cause("coulomb_friction", 2, 4.0, 0.3, "coulomb_nm")
    ripple = cause("torque_ripple", 1, 1.0, 0.1, "amplitude_nm")
    wave = {
        **ripple,
        "parameters": {
            **ripple["parameters"],
            "order_per_motor_rev": {"value": 12.0, "ci95": None, "unit": ""},
        },
    }
    first = "1 wrong certain: sets with something hidden"
    for causes, wrong in (([other], 1.0), ([wave], 0.0), ([ripple], 1.0)):
        rows = {row.what: row for row in person.shares([line("cause", causes)]) if row is not None}
        assert rows[first].value == wrong


def test_both_forms_of_findings_are_read() -> None:
    """Today: class and verdict; coming: grade and rivals."""
    today = {
        "verdict": "ambiguous",
        "causes": [{**RIGHT, "class": ["coulomb_friction", "stribeck_friction"]}, WRONG],
    }
    first, second = person.reported(today)
    assert (first["grade"], first["rivals"], second["grade"]) == (
        "one_of",
        [["stribeck_friction", 1]],
        "certain",
    )
    assert first["parameters"]["coulomb_nm"] == pytest.approx([4.05, 3.75, 4.35])
    coming = {
        "verdict": "cause",
        "causes": [{**WRONG, "grade": "effective", "rivals": ["coulomb_friction"], "share": 0.4}],
    }
    (only,) = person.reported(coming)
    assert (only["grade"], only["rivals"], only["share"]) == ("effective", [["coulomb_friction", 1]], 0.4)
    counted = line("cause", coming["causes"])
    rows = {row.what: row for row in person.shares([counted]) if row is not None}
    assert rows["1 wrong certain: sets with something hidden"].value == 0.0, "effective is not certain"
    assert rows["2 wrong values beyond 3 oracle sigma: reported at any grade"].value == 0.5, (
        "a rival is reported"
    )


def test_a_rival_of_another_joint_is_not_the_value_that_is_wrong() -> None:
    what = "2 wrong values beyond 3 oracle sigma: reported at any grade"
    for rival, found in (
        ("torque_constant of joint 2", 0.5),
        ("torque_constant of joint 1", 1.0),
        ("torque_constant", 1.0),
    ):
        causes = [RIGHT, {**WRONG, "class": ["hysteresis", rival, "sensor_gain of the sensor"]}]
        counted = line("ambiguous", causes)
        assert ["sensor_gain", SENSOR] in counted["reported"][1]["rivals"]
        rows = {row.what: row for row in person.shares([counted]) if row is not None}
        assert rows[what].value == found


def test_nothing_hidden_and_foreign_kinds_have_rows_of_their_own() -> None:
    nothing = line("no_gap", [], nothing=True, entries=[], oracle=[])
    foreign = line("unexplained", [], relevance=0.01, plan={"rest": ["slipping_hub", 1]})
    slight = line("no_gap", [], relevance=0.001, plan={"rest": ["slipping_hub", 1]})
    smooth = line("no_gap", [], relevance=0.01, plan={"rest": ["smooth", 1]})
    rows = {row.what: row for row in person.shares([nothing, foreign, slight, smooth]) if row is not None}
    assert (rows["5 nothing hidden: no_gap"].value, rows["5 nothing hidden: no_gap"].trials) == (1.0, 1)
    refused = rows["5 foreign above relevance: refused or placed"]
    assert (refused.value, refused.trials) == (1.0, 1), "only foreign kinds worth more than the relevance"


def test_an_error_is_raised_only_beyond_its_scatter_over_runs() -> None:
    assert person.raised([1.0, 1.1, 0.9, 1.0], [1.2, 1.3, 1.1, 1.25])
    assert not person.raised([1.0, 1.1, 0.9, 1.0], [1.2, 0.9, 0.8, 1.1])
    assert not person.raised([1.0, 1.1], [1.0, 1.1])


FAKE = """
import json, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir()
(out / "findings.json").write_text(json.dumps({"verdict": "cause", "causes": []}))
Path(sys.argv[1]).write_text("[3, 1.5, 80.0]")
"""


@pytest.mark.parametrize("usable", [True, False])
def test_the_answer_is_what_the_tool_wrote_and_an_unusable_file_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, usable: bool
) -> None:
    mapping = TRUE.to_mapping() if usable else {"name": "half a file"}
    extended = f"(out / 'extended.joint.yaml').write_text({yaml.safe_dump(mapping)!r})"
    monkeypatch.setattr(person, "_CALL", f"{FAKE}{extended}")
    given = tmp_path / "joint1.yaml"
    wrong = replace(TRUE, torque_constant_nm_per_a=0.11)
    given.write_text(yaml.safe_dump(wrong.to_mapping()), encoding="utf-8")
    answer = person.ask(tmp_path, [], {1: given}, None)
    assert answer.findings.get("verdict") == ("cause" if usable else None)
    assert answer.files[1] == (TRUE if usable else wrong)
    assert (answer.status == "3") is usable


def test_a_generator_that_is_not_there_is_left_out_loudly(capsys: pytest.CaptureFixture[str]) -> None:
    import argparse

    parser = argparse.ArgumentParser()
    person.options(parser)
    names, notes = person._benches(parser.parse_args(["--bench", "ours,practice"]))
    assert names == ["ours"]
    assert notes == ["LEFT OUT: bench practice: --practice DIR is not given"]
    assert "LEFT OUT" in capsys.readouterr().err


def test_a_campaign_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        person, "run_task", lambda task: {"key": f"{task.bench}.{task.index}", "bench": task.bench}
    )
    header = {"schema": person.SCHEMA, "seed": 1}
    tasks = [person.Task("ours", 1, k, 0.2) for k in range(3)]
    path = tmp_path / "r.jsonl"
    assert len(person.campaign(path, header, tasks[:2], 1)) == 2
    path.write_text(path.read_text() + '{"key": "ours.2", "be', encoding="utf-8")  # stopped while it wrote
    assert [each["key"] for each in person.campaign(path, header, tasks, 1)] == ["ours.0", "ours.1", "ours.2"]
    assert len(person.read(path)[1]) == 3
    with pytest.raises(ValueError, match="seed"):
        person.campaign(path, {**header, "seed": 2}, tasks, 1)
