"""findings.json and the extended joint files from made-up findings: the contract's keys, no NaN, nothing added twice."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Effect
from jtqd.models.files import load_joint
from jtqd.sysid.diagnosis.command import extended, extended_title, write_extended
from jtqd.sysid.diagnosis.findings import (
    INSUFFICIENT,
    NO_GAP,
    CandidateEvidence,
    Present,
    Untold,
    Value,
    plain,
    to_mapping,
)
from jtqd.sysid.diagnosis.limits import PRIORS
from tests.sysid.diagnosis.diagnose_helpers import COULOMB, JOINT, OFFSET, RIPPLE, cause, findings, value

ORIGIN = {"sha256": {"a.csv": "aa", "b.csv.gz": "bb", "other": "cc"}, "date": "2026-11-21"}


def as_json(mapping: object) -> str:
    return json.dumps(mapping, allow_nan=False)


def test_the_contract_s_keys_are_there_in_every_verdict() -> None:
    for made in (
        findings(causes=(RIPPLE, COULOMB, OFFSET)),
        findings(INSUFFICIENT, gaps=(), gain=None),
        findings(NO_GAP),
    ):
        mapping = json.loads(as_json(to_mapping(made)))
        assert mapping["schema"] == "jtq.findings/1"
        assert mapping["verdict"] == made.verdict
        assert {"joint", "rmse_nm", "noise_floor_nm", "localisation"} <= set(mapping["gap"])
        assert {"rmse_before_nm", "rmse_after_nm", "split", "ci95"} <= set(mapping["gain"])
        assert {"too_small", "cannot_be_told", "priors", "relevance", "provenance"} <= set(mapping)
        assert "next_experiment" in mapping
        assert len(mapping["causes"]) == len(made.causes)
        for each in mapping["causes"]:
            assert {"name", "joint", "class", "parameters", "evidence", "grade", "rivals", "given"} <= set(
                each
            )
            assert set(each["evidence"]) == {"delta_bic", "held_out_gain"}
            assert all(set(p) == {"value", "ci95", "unit"} for p in each["parameters"].values())


def test_values_are_those_of_the_findings_and_what_is_not_finite_is_null() -> None:
    made = findings(
        causes=(replace(RIPPLE, rivals=("cogging",)), OFFSET),
        candidates=(
            CandidateEvidence("hysteresis", 1, -3.0, {"torque_nm": Value(math.inf, (0, 0), "Nm")}, "x"),
        ),
        next_experiment={"why": "because", "plan": {"schema": "jtq.plan/1"}},
        too_small=(COULOMB,),
        cannot_be_told=(Untold("lost_motion", 1, "no channel", "load_ramp"),),
    )
    mapping = to_mapping(made, sha256={"a.csv": "aa"}, files=["report.html"])
    text = as_json(mapping)
    assert mapping["gap"]["joint"] == 2
    assert mapping["gap"]["localisation"][0]["axis"] == "velocity"
    assert mapping["gap"]["localisation"][0]["bin"] == "0.1 to 0.2 rad/s"
    assert mapping["gap"]["localisation"][0]["share"] == 0.4
    first, second = mapping["causes"]
    assert first["class"] == ["torque_ripple", "cogging"]
    assert first["parameters"]["amplitude_nm"] == {"value": 0.5, "ci95": [0.48, 0.52], "unit": "Nm"}
    assert first["parameters"]["phase_rad"]["ci95"] == [None, None]
    assert second["joint"] == "sensor"
    assert [each["name"] for each in mapping["too_small"]] == ["coulomb_friction"]
    assert mapping["cannot_be_told"] == [
        {"name": "lost_motion", "joint": 1, "why": "no channel", "experiment": "load_ramp"}
    ]
    assert {each["name"] for each in mapping["priors"]} == set(PRIORS)
    assert not {"left_over", "odd_runs", "steadiness"} & set(mapping)
    assert mapping["candidates"][0]["minimum"]["torque_nm"]["value"] is None
    assert mapping["candidates"][0]["delta_bic"] == -3.0
    assert mapping["next_experiment"] == {"why": "because", "plan": {"schema": "jtq.plan/1"}}
    assert mapping["runs"] == [
        {"name": "a.csv", "sha256": "aa", "used": True},
        {"name": "b.csv.gz", "sha256": None, "used": True},
    ]
    assert "NaN" not in text
    assert "Infinity" not in text


def test_numpy_becomes_plain() -> None:
    given = {
        1: np.float64(2.5),
        "a": np.array([1, 2]),
        "b": np.array([np.nan]),
        "c": np.bool_(True),
        "d": (np.int64(3),),
    }
    assert plain(given) == {"1": 2.5, "a": [1, 2], "b": [None], "c": True, "d": [3]}
    assert isinstance(plain(np.float64(1.0)), float)
    assert plain(float("-inf")) is None
    with pytest.raises(TypeError):
        plain(object())


def names_of(joint: object) -> list[str]:
    return [effect.name for effect in joint.effects]  # type: ignore[attr-defined]


def test_each_joint_gets_its_own_causes_and_the_sensor_s() -> None:
    made = findings(causes=(RIPPLE, OFFSET, COULOMB))
    one = extended(JOINT, 1, made, **ORIGIN)
    two = extended(JOINT, 2, made, **ORIGIN)
    assert names_of(one) == ["torque_ripple", "sensor_offset"]
    assert names_of(two) == ["sensor_offset", "coulomb_friction"]
    assert dict(one.effects[0].parameters) == {
        "amplitude_nm": 0.5,
        "order_per_motor_rev": 2.0,
        "phase_rad": 0.3,
    }
    assert dict(two.effects[1].parameters) == {"coulomb_nm": 4.4}
    assert two.friction == JOINT.friction  # the effect states the right value, the file's own stays
    record = one.provenance["diagnosis"]
    assert record["verdict"] == "cause"
    assert record["sha256"] == {"a.csv": "aa", "b.csv.gz": "bb"}
    assert record["effects"][0]["ci95"] == {
        "amplitude_nm": [0.48, 0.52],
        "order_per_motor_rev": [None, None],
        "phase_rad": [None, None],
    }


def test_an_effect_is_replaced_and_the_same_twice_is_the_same_once() -> None:
    has = replace(
        JOINT,
        effects=(
            Effect("sensor_offset", {"offset_nm": 2.0}),
            Effect("unbalance", {"moment_nm": 0.5, "phase_rad": 0.1}),
        ),
        provenance={"friction": {"by": "hand"}},
    )
    made = findings(causes=(OFFSET,))
    once = extended(has, 1, made, **ORIGIN)
    assert names_of(once) == ["unbalance", "sensor_offset"]
    assert once.effects[1].parameters["offset_nm"] == 0.31
    assert once.provenance["friction"] == {"by": "hand"}
    assert extended(once, 1, made, **ORIGIN) == once


def test_a_class_is_written_with_what_it_cannot_be_told_from() -> None:
    unclear = cause("current_offset", 1, {"offset_a": value(0.02, 0.001, "A")}, "friction_asymmetry")
    joint = extended(JOINT, 1, findings("ambiguous", causes=(unclear,)), **ORIGIN)
    assert joint.provenance["diagnosis"]["effects"][0]["cannot_be_told_from"] == ["friction_asymmetry"]
    assert joint.provenance["diagnosis"]["verdict"] == "ambiguous"


def test_files_read_back_as_the_joints_meant(tmp_path: Path) -> None:
    made = findings(causes=(COULOMB, RIPPLE, OFFSET))
    joints = {1: JOINT, 2: replace(JOINT, name="other")}
    names = write_extended(tmp_path, joints, made, **ORIGIN)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)
    assert load_joint(tmp_path / "extended.joint2.yaml") == extended(joints[2], 2, made, **ORIGIN)
    assert load_joint(tmp_path / "extended.joint.yaml") == load_joint(tmp_path / "extended.joint2.yaml")
    assert load_joint(tmp_path / "extended.joint1.yaml") == extended(joints[1], 1, made, **ORIGIN)
    text = (tmp_path / "extended.joint1.yaml").read_text()
    assert text.startswith(f"# {extended_title(1, made)}")
    assert "torque_ripple, sensor_offset" in text.splitlines()[0]


def test_what_predicts_is_in_the_file_and_what_was_found_in_its_provenance() -> None:
    made = findings(
        causes=(COULOMB,),
        too_small=(OFFSET,),
        predicts=(
            Present("coulomb_friction", 2, {"coulomb_nm": 4.5}),
            Present("sensor_offset", "sensor", {"offset_nm": 0.3}),
            Present("viscous_friction", 2, {"viscous_nms_per_rad": 2.1}),
            Present("viscous_friction", 1, {"viscous_nms_per_rad": 1.9}),
        ),
    )
    two = extended(JOINT, 2, made, **ORIGIN)
    assert [(e.name, *e.parameters.values()) for e in two.effects] == [
        ("coulomb_friction", 4.5),
        ("sensor_offset", 0.3),
        ("viscous_friction", 2.1),
    ]
    record = two.provenance["diagnosis"]
    assert [(each["name"], each["grade"]) for each in record["effects"]] == [
        ("coulomb_friction", "certain"),
        ("sensor_offset", "certain"),
    ]
    assert record["better_prediction_only"] == ["viscous_friction"]
    alone = extended(JOINT, 2, findings(causes=(COULOMB,)), **ORIGIN)
    assert "better_prediction_only" not in alone.provenance["diagnosis"]


def test_a_file_says_how_many_runs_were_used() -> None:
    made = replace(findings(causes=(COULOMB,)), runs=("a", "b", "c"), used=("a", "c"))
    assert extended_title(2, made).startswith(
        "Written by jtq diagnose from 2 of 3 runs: found coulomb_friction"
    )
    origin = ORIGIN | {"sha256": {"a": "0", "b": "1", "c": "2"}}
    assert extended(JOINT, 2, made, **origin).provenance["diagnosis"]["sha256"] == {"a": "0", "c": "2"}
    assert [run["used"] for run in to_mapping(made)["runs"]] == [True, False, True]
    assert extended_title(2, replace(made, used=())).startswith("Written by jtq diagnose from 3 runs: ")


def test_without_a_cause_the_joint_stays_as_it_is(tmp_path: Path) -> None:
    write_extended(tmp_path, {1: JOINT}, findings(NO_GAP), **ORIGIN)
    joint = load_joint(tmp_path / "extended.joint.yaml")
    assert replace(joint, provenance=JOINT.provenance) == JOINT
    assert "effects" not in joint.provenance["diagnosis"]
    assert "gain" not in joint.provenance["diagnosis"]


def test_what_no_joint_file_allows_is_refused_in_one_line(tmp_path: Path) -> None:
    bad = cause("warp_core", 1, {"amplitude_nm": value(1.0)})
    with pytest.raises(ConfigError) as caught:
        write_extended(tmp_path, {1: JOINT}, findings(causes=(bad,)), **ORIGIN)
    assert "warp_core" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
