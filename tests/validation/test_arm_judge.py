"""The judge of external torque: that it tells the truth from nothing, and each figure by hand."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from validation import __main__ as command
from validation.arm import study
from validation.arm.arm import CYCLE_S, JOINTS, Arm, Contact, Payload, Readings, Run, Silence, Truth, rigid
from validation.arm.judge import (
    BINS_N,
    RMS,
    Found,
    Published,
    Row,
    curve_rows,
    figures,
    free_cycles,
    judge,
    nothing,
    of_the_past,
    oracle,
    rows,
    tool_jacobians,
    wrench_information,
    zero,
)
from validation.arm.trial import FALL_S, LEARN_S, Trial, User, Weighed, error_process

POSE = np.array([0.3, -0.3, 0.0, -2.2, 0.0, 2.0, 0.4])
LOAD = Payload(2.0, (0.01, -0.02, 0.05))
LENGTH_S = 24.0


class Day(NamedTuple):
    arm: Arm
    run: Run
    truth: Truth
    readings: Readings


@cache
def day(number: int = 0) -> Day:
    """An arm that stands still and is pushed four times; joints as wrong as those of `typical`."""
    arm, n = Arm("typical", 5), round(LENGTH_S / CYCLE_S)
    contacts = tuple(
        Contact(kind, start, start + rise, start + rise + 0.7, link, (0.06, 0.05, 0.1), force)
        for kind, start, rise, link, force in (
            ("push", 11.0, 0.01, 7, (0.0, 20.0, 0.0)),
            ("push", 14.0, 0.01, 6, (0.0, 20.0, 0.0)),
            ("clamp", 16.0, 1.0, 7, (0.0, 20.0, 0.0)),
            ("curve", 20.0, 0.01, 5, (9.0, 0.0, 0.0)),
        )
    )
    model = rigid()
    data = mujoco.MjData(model)
    data.qpos[:] = POSE
    mujoco.mj_forward(model, data)
    external, wrench = np.zeros((n, JOINTS)), np.zeros((n, 6))
    t = CYCLE_S * np.arange(n)
    for contact in contacts:
        turn, jacobian = data.xmat[contact.link].reshape(3, 3), np.zeros((3, JOINTS))
        point = data.xpos[contact.link] + turn @ np.array(contact.point_m)
        force = turn @ np.array(contact.force_n)
        mujoco.mj_jac(model, data, jacobian, None, point, contact.link)
        share = np.array([contact.share(x) for x in t])
        external += np.outer(share, jacobian.T @ force)
        if contact.link == JOINTS:
            arm_of_force = np.cross(point - data.site("tool").xpos, force)
            wrench += np.outer(share, np.concatenate((force, arm_of_force)))
    link = np.repeat(POSE[None], n, axis=0)
    zeros = np.zeros((n, JOINTS))
    run = Run(number, link, LOAD, contacts)
    truth = Truth(link, zeros, zeros, external, wrench, arm.ratio * link + t[:, None], zeros, zeros)
    torque, sigma, status = error_process(arm, run, truth, np.random.default_rng(number), "typical")
    readings = Readings(t, zeros, truth.motor_rad, zeros, link, zeros, torque, sigma, status)
    return Day(arm, run, truth, readings)


def found(published: Published, number: int = 0) -> Found:
    return judge(*day(number), published)


@cache
def known(number: int) -> Published:
    return oracle(*day(number))


def perfect(number: int = 0) -> Published:
    return Published(*(each.copy() for each in known(number)))


def at(time_s: float) -> int:
    return round(time_s / CYCLE_S)


def by_name(made: list[Row]) -> dict[str, Row]:
    return {row.what: row for row in made}


def test_an_oracle_reaches_every_limit_and_nothing_reaches_few() -> None:
    numbers = range(24)
    best = figures([found(perfect(k), k) for k in numbers], "typical")
    none = figures([found(zero(day(k).arm, day(k).readings, "typical"), k) for k in numbers], "typical")
    dull = best._replace(rms=np.full(JOINTS, 0.06))
    assert best.detected == {"push": (48, 48), "clamp": (24, 24)}
    good = {row.what: row.reached for row in rows("typical", [best, dull], 20.0)}
    assert all(reached is not False for reached in good.values()), good
    bad = {row.what: row.reached for row in rows("typical", [none, dull], 90.0)}
    missed = [what for what, reached in bad.items() if reached is False]
    assert len(missed) >= 8, missed
    assert best.pushed.max() < 0.01
    assert none.pushed.max() > 0.05


def test_errors_are_of_rated_and_without_contact() -> None:
    one = day()
    out = nothing(len(one.truth.link_rad))._replace(
        external_nm=one.truth.external_nm + 0.03 * one.arm.rated_nm
    )
    out.sigma_nm[:] = 0.03 / 1.7 * one.arm.rated_nm
    out.external_nm[~free_cycles(one.run, len(out.contact)), 2] += 50.0
    out.sigma_nm[:, 4] *= 2.0
    made = figures([found(out)], "typical")
    assert made.rms == pytest.approx(np.full(JOINTS, 0.03))
    assert made.pushed[2] > 0.5
    assert made.inside == pytest.approx([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert made.published == 1.0
    out.external_nm[at(12.5) : at(13.5), 3] = np.nan
    free = free_cycles(one.run, len(out.contact)).sum()
    assert figures([found(out)], "typical").published == pytest.approx(1.0 - 1000 / free)
    out.external_nm[at(12.5) : at(13.5), 3] = 0.03 * one.arm.rated_nm[3]
    for quiet, claimed in ((False, 2000), (True, 0)):
        run = one.run._replace(silences=(Silence(3, 12.0, 14.0),))
        out.external_nm[at(12.0) : at(14.0), 3] = np.nan if quiet else 1e6
        made = figures([judge(one.arm, run, one.truth, one.readings, out)], "typical")
        assert made.claimed == (claimed, 2000)
        assert made.published == 1.0
        assert made.rms == pytest.approx(np.full(JOINTS, 0.03))
        row = "a joint without torque: cycles with its external torque"
        assert by_name(rows("typical", [made, made]))[row].reached is quiet
    assert figures([found(nothing(len(out.contact)))], "typical").rms.min() == np.inf


def test_free_time_begins_after_learning_and_ends_with_contacts() -> None:
    one = day()
    free = free_cycles(one.run, len(one.truth.link_rad))
    assert not free[: at(LEARN_S)].any()
    assert free[at(10.5)]
    assert not free[at(11.005)]
    assert not free[at(11.01 + 0.7 + FALL_S + 0.4)]
    assert free[at(11.01 + 0.7 + FALL_S + 0.6)]


def test_a_contact_counts_by_the_cycle_in_which_it_is_first_reported() -> None:
    one = day()
    n = len(one.truth.link_rad)
    out = nothing(n)
    full = one.run.contacts[0].full_s
    out.contact[at(full) + 15 : at(full) + 400] = 7
    late = one.run.contacts[1].full_s
    out.contact[at(late) + 25 : at(late) + 400] = 6
    held = one.run.contacts[2].full_s
    out.contact[at(held) + 290 : at(held) + 400] = 7
    events = found(out).events
    assert [e.delay_s for e in events] == pytest.approx([0.015, 0.025, 0.29, np.inf])
    made = figures([found(out)], "typical")
    assert made.detected == {"push": (1, 2), "clamp": (1, 1)}
    assert found(out).alarms == 0
    short = found(out).events[0]._replace(lever_m=0.3)
    assert figures([found(out)._replace(events=[short])], "typical").detected == {
        "push": (0, 0),
        "clamp": (0, 0),
    }
    out.contact[at(10.5) :] = 3  # reported before it is there, and for ever
    assert figures([found(out)], "typical").detected == {"push": (0, 2), "clamp": (0, 1)}
    assert found(out).alarms == 1


def test_alarms_that_flicker_are_one() -> None:
    out = perfect()
    assert found(out).alarms == 0
    for start in (10.2, 10.3, 10.5, 13.0, 22.5):
        out.contact[at(start) : at(start) + 20] = 2
    assert found(out).alarms == 3
    made = figures([found(out)], "typical")
    free = free_cycles(day().run, len(out.contact)).sum() * CYCLE_S
    assert made.hours == pytest.approx(free / 3600.0)
    assert by_name(rows("typical", [made, made]))["false alarms"].reached is False


def test_link_and_point_are_those_of_the_contact() -> None:
    made = figures([found(perfect())], "typical")
    assert made.link == (3, 3)
    assert made.point_m == 0.0
    out = perfect()
    first = day().run.contacts[0]
    out.contact[at(first.full_s) + 200] = 6
    assert figures([found(out)], "typical").link == (2, 3)
    out.point_m[:, 0] += 0.06
    out.strength_n[:] *= 1.1
    out.since_s[:] += 0.02
    made = figures([found(out)], "typical")
    assert made.point_m == pytest.approx(0.06)
    assert made.strength == pytest.approx(0.1)
    assert made.since_s == pytest.approx(0.02)


def test_a_link_that_its_joint_cannot_feel_is_not_asked() -> None:
    one = day()
    out = perfect()
    events = found(out).events
    weak = [e for e in events if e.own_share < 2.0 * RMS["typical"]]
    assert len(weak) == 1
    assert weak[0].link == JOINTS or weak[0].force_n < 10.0
    assert [e.link for e in events] == [c.link for c in one.run.contacts]


def test_payload_is_read_after_learning_and_missing_is_wrong() -> None:
    out = perfect()
    out.payload_kg[:], out.centre_m[:] = 2.1, np.add(LOAD.centre_m, (0.0, 0.03, 0.04))
    made = figures([found(out)], "typical")
    assert made.mass == pytest.approx((0.05, 0.05))
    assert made.centre_m == pytest.approx((0.05, 0.05))
    best = found(perfect())
    assert figures([found(out), best, best], "typical").mass == pytest.approx((0.0, 0.05))
    out.payload_kg[: at(LEARN_S) + 1] = np.nan
    assert figures([found(out)], "typical").mass == (np.inf, np.inf)
    one = day()
    light = judge(one.arm, one.run._replace(payload=Payload(0.3)), one.truth, one.readings, out)
    assert np.isnan(light.mass_off)


def test_a_wrench_is_judged_by_what_the_joints_allow() -> None:
    one = day()
    jacobian = tool_jacobians(POSE[None])
    information, condition = wrench_information(jacobian, one.readings.sigma_nm[:1])
    covariance = np.linalg.inv(information[0])
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(np.zeros(6), covariance, len(one.truth.link_rad))
    out = perfect()._replace(wrench=one.truth.wrench + drawn)
    made = figures([found(out)], "typical")
    assert condition[0] < 20.0
    assert made.wrench == pytest.approx(1.0, abs=0.1)
    assert figures([found(out._replace(wrench=one.truth.wrench + 2.0 * drawn))], "typical").wrench > 1.8
    none = found(out._replace(wrench=drawn))
    assert figures([none], "typical").wrench > 1.3
    longer = none._replace(wrench_square=none.wrench_square * (100, 1), wrenches=none.wrenches * (100, 1))
    assert figures([longer], "typical").wrench == figures([none], "typical").wrench, "free time hides nothing"
    assert made.wrenches == 1.0
    unsure = one.readings.sigma_nm * np.array([1.0, 40.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    spread = judge(one.arm, one.run, one.truth, one.readings._replace(sigma_nm=unsure), out)
    assert spread.poses == found(out).poses, "the pose is what it was"
    out.wrench[at(12.5) :] = np.nan
    assert figures([found(out)], "typical").wrenches < 0.6
    sigma = one.readings.sigma_nm[:1].copy()
    sigma[0, 2] = np.nan
    without, worse = wrench_information(jacobian, sigma)
    assert np.isfinite(without).all()
    assert worse[0] > condition[0]
    straight = np.array([0.0, 0.2, 0.0, -0.1, 0.0, 0.2, 0.0])
    assert wrench_information(tool_jacobians(straight[None]), one.readings.sigma_nm[:1])[1][0] > 20.0


def test_a_jacobian_of_the_tool_is_the_derivative_of_its_place() -> None:
    model = rigid()
    data = mujoco.MjData(model)
    jacobian = tool_jacobians(POSE[None])[0]
    for j in range(JOINTS):
        places = []
        for step in (-1e-6, 1e-6):
            data.qpos[:] = POSE
            data.qpos[j] += step
            mujoco.mj_kinematics(model, data)
            places.append(data.site("tool").xpos.copy())
        assert (places[1] - places[0]) / 2e-6 == pytest.approx(jacobian[:3, j], abs=1e-6)


def test_the_curve_counts_pushes_by_force() -> None:
    made = figures([found(perfect())], "typical")
    assert made.curve == [(0, 0), (1, 1), (0, 0), (2, 2), (0, 0), (0, 0)]
    assert len(curve_rows([made])) == len(BINS_N) - 1


def test_cost_and_ratio_to_the_baseline_have_limits() -> None:
    made = figures([found(perfect())], "typical")
    dull = made._replace(rms=made.rms / 0.5)
    table = by_name(rows("typical", [made, dull], 81.0))
    assert table["to the baseline's, worst joint"].reached is False
    assert table["cost of a cycle"].reached is False
    assert by_name(rows("typical", [made, dull], 79.0))["cost of a cycle"].reached is True
    assert by_name(rows("typical", [made, dull]))["cost of a cycle"].reached is None


def test_days_are_shared_out_over_arms() -> None:
    parser = argparse.ArgumentParser()
    study.options(parser)
    work = study.works(parser.parse_args(["--plant", "typical", "--quiet-hours", "3"]))
    assert sorted(day for each in work for day in each.days) == list(range(30))
    quiet = sorted(day for each in work for day in each.quiet)
    assert quiet == list(range(len(quiet)))
    assert len(quiet) * (study.QUIET_S - LEARN_S) >= 3.0 * 3600.0
    assert all(each.methods[:2] == ["oracle", "baseline"] for each in work)
    assert len(study.works(parser.parse_args(["--quick"]))) == 2


@pytest.mark.parametrize(("method", "status"), [("oracle", 0), ("zero", 3)])
def test_the_study_ends_with_three_where_a_limit_is_missed(
    method: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(work: study.Work) -> study.Done:
        dull = perfect()
        runs: dict[str, list[Found]] = {
            "oracle": [found(perfect(k), k) for k in range(24)],
            "zero": [found(zero(day(k).arm, day(k).readings, "typical"), k) for k in range(24)],
            "baseline": [found(dull._replace(external_nm=dull.external_nm + 0.1 * day().arm.rated_nm))],
        }
        return study.Done(
            work.plant,
            {name: runs[name] for name in work.methods},
            [(0.01, 0.004)],
            dict.fromkeys(work.methods, 1.0),
        )

    monkeypatch.setattr(study, "judged", judged)
    out = tmp_path / "found.json"
    words = ["external_torque", "--quick", "--plant", "typical", "--method", method, "--json", str(out)]
    assert command.main(words) == status
    assert '"pushed"' in out.read_text(encoding="utf-8")


def speechless(user: User) -> Callable[[Readings], Published]:
    """An estimator that a user of the study brings: it says nothing, and counts how often it was asked."""
    assert user.urdf.exists()
    assert len(user.identification) == 2
    return lambda readings: nothing(len(readings.time_s))


def test_what_is_published_is_of_the_past_alone() -> None:
    readings = day().readings

    def mean(x: Readings) -> Published:
        return nothing(len(x.time_s))._replace(external_nm=x.torque_nm - x.torque_nm.mean(axis=0))

    def sum_so_far(x: Readings) -> Published:
        return nothing(len(x.time_s))._replace(external_nm=np.cumsum(x.torque_nm, axis=0))

    assert of_the_past(sum_so_far, readings, sum_so_far(readings))
    assert not of_the_past(mean, readings, mean(readings))


def test_the_study_takes_an_estimator_by_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Short(Trial):
        def identification(self, runs: int = 2, seconds: float = 2.0) -> list[Weighed]:
            return super().identification(runs, seconds)

        def contact(self, day: int, seconds: float = 1.0) -> Run:
            path = np.repeat(POSE[None], round(seconds / CYCLE_S), axis=0)
            return Run(1000 + day, path, Payload())

        def quiet(self, day: int, seconds: float = 1.0) -> Run:
            return self.contact(day, seconds)._replace(silences=(Silence(4, 0.3, 0.6),))

    monkeypatch.setattr(study, "Trial", Short)
    name = "tests.validation.test_arm_judge:speechless"
    done = study.judged(study.Work("typical", 38001, 0, [0], [1], [name, "baseline", "oracle"]))
    assert done.past is True
    assert done.found[name][0].published.sum() == 0
    assert done.cost_us[name] > 0.0
    assert [(each.claimed, each.silent) for each in done.found["oracle"]] == [(0, 0), (0, 300)]
    assert done.found["baseline"][1].claimed == 300
    for wrong in ("nowhere.at:all", "tests.validation.test_arm_judge:nobody", "oracel"):
        assert command.main(["external_torque", "--method", wrong]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
