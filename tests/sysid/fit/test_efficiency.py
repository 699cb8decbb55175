"""Efficiency map: Table I comes back, conventions, refusals, contradicting plateaus, and the picture."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import CONVENTIONS, QUADRANTS, Joint
from jtqd.estimator.losses import LossModel
from jtqd.models.files import shipped
from jtqd.sim_can.plant_file import PlantParameters, load_plant, plant_of_joint
from jtqd.sysid.fit.efficiency import (
    COEFFICIENTS,
    TABLE_I,
    EfficiencyFit,
    EtaPoint,
    default_current_min,
    efficiency_findings,
    eta_points,
    fit_efficiency,
    fit_figure,
    quadrant_of,
    written_findings,
)
from jtqd.sysid.fit.plateaus import Mean, Plateau, find_plateaus
from tests.estimator.estimator_helpers import joint1, reciprocal_efficiency
from tests.sysid.campaign_helpers import VELOCITIES_RAD_S, section_two_currents, section_two_runs

JOINT = joint1()
NM_PER_A = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
PAPER_RMSE = {name: getattr(TABLE_I, name).rmse for name in QUADRANTS}


def plateau(i: float, v: float, tau: float, *, se_i: float = 1e-4, se_tau: float = 1e-3) -> Plateau:
    return Plateau("run", 0.0, 2.0, Mean(v, 1e-4), Mean(i, se_i), Mean(tau, se_tau), 20, 25.0)


def grid(joint: Joint = JOINT) -> list[Plateau]:
    """Plateaus that lie on the joint's own polynomials exactly, at section II's velocities and 1 to 5 A."""
    assert joint.efficiency is not None
    found = []
    for name in QUADRANTS:
        sign_i, sign_v = (1.0 if "i_pos" in name else -1.0), (1.0 if "w_pos" in name else -1.0)
        for speed, size in itertools.product(VELOCITIES_RAD_S, (1.0, 2.0, 3.0, 4.0, 5.0)):
            i, v = sign_i * size, sign_v * speed
            eta = getattr(joint.efficiency, name).value(i, v)
            ratio = eta if joint.efficiency.convention == "joint_over_motor" else 1.0 / eta
            found.append(plateau(i, v, ratio * NM_PER_A * i))
    return found


def points_of(plateaus: Sequence[Plateau], joint: Joint = JOINT) -> list[EtaPoint]:
    return eta_points(plateaus, joint, default_current_min(joint))[0]


def emulated_points(plant: PlantParameters, joint: Joint, **runs: float) -> list[EtaPoint]:
    plateaus: list[Plateau] = []
    for k, table in enumerate(section_two_runs(plant, **runs)):  # type: ignore[arg-type]
        plateaus += find_plateaus(table.time_s, table.joint(1, joint.gear_ratio), joint, f"run{k}")
    count = 4 * sum(len(section_two_currents(v)) for v in VELOCITIES_RAD_S)
    assert len(plateaus) == count
    return points_of(plateaus, joint)


def table_rms(fit: EfficiencyFit, points: Sequence[EtaPoint]) -> dict[str, float]:
    """RMS difference of the fitted surface from Table I at the measured points."""
    out = {}
    for name, quadrant in fit.quadrants.items():
        table = getattr(TABLE_I, name)
        own = [(p.plateau.current.value, p.plateau.velocity.value) for p in points if p.quadrant == name]
        off = [quadrant.polynomial.value(i, v) - table.value(i, v) for i, v in own]
        out[name] = math.sqrt(float(np.mean(np.square(off))))
    return out


def check_table_is_given_back(points: Sequence[EtaPoint]) -> None:
    fit = fit_efficiency(points, "joint_over_motor", JOINT)
    assert not fit.refused
    from_table = table_rms(fit, points)
    for name in QUADRANTS:
        assert fit.quadrants[name].rmse <= PAPER_RMSE[name]
        assert from_table[name] <= PAPER_RMSE[name]
    assert efficiency_findings(points, JOINT) == []
    written = replace(JOINT, efficiency=fit.efficiency())
    assert written_findings(written, points, fit) == []


def test_the_emulated_joint_of_table_i_gives_table_i_back() -> None:
    """Issue: RMSE of each quadrant at most the paper's; here of the fit and of its distance from the truth."""
    assert JOINT.efficiency == TABLE_I
    points = emulated_points(plant_of_joint(JOINT), JOINT)
    check_table_is_given_back(points)
    fit = fit_efficiency(points, "joint_over_motor", JOINT)
    for name in ("i_neg_w_pos", "i_pos_w_neg"):  # inside the table's range: the coefficients themselves
        for key in COEFFICIENTS:
            truth = getattr(getattr(TABLE_I, name), key)
            assert getattr(fit.quadrants[name].polynomial, key) == pytest.approx(truth, abs=2e-3)


@pytest.mark.campaign
def test_the_full_campaign_gives_table_i_back() -> None:
    """Holds as long as the campaign's, of the ideal bench and of the shipped one with all its deviations."""
    check_table_is_given_back(emulated_points(plant_of_joint(JOINT), JOINT, hold_s=2.1, ramp_s=0.4))
    points = emulated_points(load_plant(shipped("plant.yaml")), JOINT, hold_s=2.1, ramp_s=0.4)
    fit = fit_efficiency(points, "joint_over_motor", JOINT)
    assert all(fit.quadrants[name].rmse <= PAPER_RMSE[name] for name in QUADRANTS)
    assert efficiency_findings(points, JOINT) == []


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_exact_points_give_the_coefficients_exactly_in_the_convention_of_the_joint(convention: str) -> None:
    joint = JOINT
    if convention == "motor_over_joint":
        joint = replace(JOINT, efficiency=reciprocal_efficiency(JOINT))
    points = points_of(grid(joint))
    fit = fit_efficiency(points, convention, joint)
    for name in QUADRANTS:
        truth = getattr(joint.efficiency, name)
        for key in COEFFICIENTS:
            assert getattr(fit.quadrants[name].polynomial, key) == pytest.approx(
                getattr(truth, key), abs=2e-6
            )
        assert fit.quadrants[name].rmse < 1e-6
        assert fit.quadrants[name].rmse_nm < 1e-5
        assert fit.quadrants[name].distinct == fit.quadrants[name].plateaus == 40
    assert written_findings(replace(joint, efficiency=fit.efficiency()), points, fit) == []


@pytest.mark.parametrize("fitted", CONVENTIONS)
def test_a_fit_written_under_the_other_convention_is_caught(fitted: str) -> None:
    points = points_of(grid())
    fit = fit_efficiency(points, fitted, JOINT)
    right = fit.efficiency()
    assert right.convention == fitted
    assert written_findings(replace(JOINT, efficiency=right), points, fit) == []
    other = next(name for name in CONVENTIONS if name != fitted)
    wrong = replace(right, convention=other)
    found = written_findings(replace(JOINT, efficiency=wrong), points, fit)
    assert [item.kind for item in found] == ["convention"]
    assert f"'{other}'" in found[0].text
    # and it would have mattered: the estimator's law then turns losses round or doubles them
    law = LossModel(replace(JOINT, efficiency=wrong))
    good = LossModel(JOINT)
    assert abs(law.loss(5.0, 1.0) - good.loss(5.0, 1.0)) > 2.0


def test_both_conventions_describe_the_same_measurement() -> None:
    point = points_of([plateau(4.0, 1.0, 15.0, se_i=0.01, se_tau=0.1)])[0]
    ratio = 15.0 / (4.0 * NM_PER_A)
    assert point.eta("joint_over_motor") == pytest.approx(ratio)
    assert point.eta("motor_over_joint") == pytest.approx(1.0 / ratio)
    # standard errors by a seeded draw of torque and current
    rng = np.random.default_rng(8)
    draws = (15.0 + 0.1 * rng.normal(size=20000)) / (NM_PER_A * (4.0 + 0.01 * rng.normal(size=20000)))
    assert point.eta_se("joint_over_motor") == pytest.approx(float(np.std(draws)), rel=0.05)
    assert point.eta_se("motor_over_joint") == pytest.approx(float(np.std(1.0 / draws)), rel=0.05)
    assert point.loss_nm == pytest.approx(4.0 * NM_PER_A - 15.0)
    assert point.driving


def test_standard_errors_of_the_coefficients_are_their_scatter() -> None:
    rng = np.random.default_rng(21)
    exact = grid()
    estimates, claimed = [], []
    for _ in range(150):
        noisy = [
            replace(p, torque=Mean(p.torque.value * (1.0 + 0.02 * rng.normal()), p.torque.se)) for p in exact
        ]
        fit = fit_efficiency(points_of(noisy), "joint_over_motor", JOINT).quadrants["i_pos_w_pos"]
        estimates.append([getattr(fit.polynomial, key) for key in COEFFICIENTS])
        claimed.append([fit.errors[key] for key in COEFFICIENTS])
    assert np.mean(claimed, axis=0) == pytest.approx(np.std(estimates, axis=0), rel=0.25)


def test_weights_follow_the_sensors_offset() -> None:
    """An offset of 0.3 Nm spoils eta at small currents; weighted, the fit stays nearer the torque where it is large."""
    shifted = [replace(p, torque=Mean(p.torque.value + 0.3, p.torque.se)) for p in grid()]
    points = points_of(shifted)
    assert efficiency_findings(points, JOINT) == []  # an offset within the allowance is no finding
    plain = fit_efficiency(points, "joint_over_motor", JOINT)
    weighted = fit_efficiency(points, "joint_over_motor", JOINT, weighted=True)
    assert weighted.weighted
    for name in QUADRANTS:
        assert weighted.quadrants[name].rmse_nm < plain.quadrants[name].rmse_nm
        assert weighted.quadrants[name].rmse >= plain.quadrants[name].rmse


def test_exact_points_need_no_standard_error() -> None:
    exact = [replace(p, torque=Mean(p.torque.value, 0.0), current=Mean(p.current.value, 0.0)) for p in grid()]
    assert not fit_efficiency(points_of(exact), "motor_over_joint", JOINT, weighted=True).refused


# Left out, refused, found ---------------------------------------------------------------------------------


def test_plateaus_without_an_eta_are_left_out_and_returned() -> None:
    assert default_current_min(JOINT) == pytest.approx(3.8 / 6.2)
    idle = [plateau(0.0, -1.0, 4.0), plateau(0.5, -1.0, 6.0), plateau(-0.6, 1.0, -5.0)]
    used, left_out = eta_points([*grid(), *idle], JOINT, default_current_min(JOINT))
    assert left_out == idle
    assert len(used) == len(grid())
    assert eta_points(idle, JOINT, 0.55)[1] == idle[:2]


def test_quadrants_by_sign() -> None:
    assert [quadrant_of(i, v) for i, v in ((1, 1), (-1, -1), (-1, 1), (1, -1))] == list(QUADRANTS)


POINTS = points_of(grid())


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([p for p in POINTS if p.driving], "i_neg_w_pos: found 0 distinct operating points"),
        # a plateau measured again does not make a quadrant
        (
            [p for p in POINTS if p.quadrant == "i_neg_w_pos"][:6] * 5,
            "found 6 distinct operating points (30 plateaus), expected at least 7",
        ),
        # two velocities do not span the surface
        ([p for p in POINTS if abs(p.plateau.velocity.value) in (0.2, 3.0)], "found a condition number of"),
    ],
)
def test_a_quadrant_that_cannot_be_fitted_is_refused_by_name(points: list[EtaPoint], words: str) -> None:
    assert words in fit_efficiency(points, "joint_over_motor", JOINT).refused["i_neg_w_pos"]


def test_refused_quadrants_are_those_of_a_joint_file_of_the_same_convention() -> None:
    fit = fit_efficiency([p for p in POINTS if p.driving], "joint_over_motor", JOINT)
    assert list(fit.quadrants) == ["i_pos_w_pos", "i_neg_w_neg"]
    assert list(fit.refused) == ["i_neg_w_pos", "i_pos_w_neg"]
    for kept, words in (
        (None, "found no fit of i_neg_w_pos, i_pos_w_neg, and the joint file has no eff"),
        (replace(TABLE_I, convention="motor_over_joint"), "one in the convention motor_over_joint"),
    ):
        with pytest.raises(ValueError, match=words):
            fit.efficiency(kept)
    kept_table = fit.efficiency(TABLE_I)
    assert kept_table.i_neg_w_pos == TABLE_I.i_neg_w_pos
    assert kept_table.i_pos_w_pos == fit.quadrants["i_pos_w_pos"].polynomial
    with pytest.raises(ValueError, match="found 'eta', expected one of joint_over_motor, motor_over_joint"):
        fit_efficiency(POINTS, "eta", JOINT)


BOTH = ["eta_above_1_driving", "eta_below_1_back_driven"]


def flipped(*names: str) -> Callable[[Plateau], Plateau]:
    def flip(p: Plateau) -> Plateau:
        return replace(p, **{name: Mean(-getattr(p, name).value, getattr(p, name).se) for name in names})

    return flip


def exchanged(p: Plateau) -> Plateau:
    """Torque and motor torque exchanged."""
    torque, current = Mean(NM_PER_A * p.current.value, 0.01), Mean(p.torque.value / NM_PER_A, 0.001)
    return replace(p, torque=torque, current=current)


@pytest.mark.parametrize(
    ("change", "kinds", "cause"),
    [
        (flipped("torque"), ["torque_against_current"], "swapped sign of the torque"),
        (flipped("current"), ["torque_against_current"], "swapped sign of the current"),
        (flipped("velocity"), BOTH, "swapped sign of the velocity"),
        (flipped("current", "torque"), BOTH, "current and torque together"),
        (exchanged, BOTH, "wrong convention"),
    ],
)
def test_wrong_channels_are_found_by_physics(
    change: Callable[[Plateau], Plateau], kinds: list[str], cause: str
) -> None:
    found = efficiency_findings(points_of([change(p) for p in grid()]), JOINT)
    assert [item.kind for item in found] == kinds
    assert all(cause in item.text and "\n" not in item.text for item in found)


@pytest.mark.parametrize(
    ("scale", "kind", "word"),
    [
        (0.5, "eta_above_1_driving", "too small"),
        (0.66, "eta_above_1_driving", "too small"),
        (1.08, "eta_below_1_back_driven", "too large"),
        (1.6, "eta_below_1_back_driven", "too large"),
    ],
)
@pytest.mark.parametrize("parameter", ["gear_ratio", "torque_constant_nm_per_a"])
def test_a_wrong_scale_of_the_joint_file_is_found_by_physics(
    scale: float, kind: str, word: str, parameter: str
) -> None:
    """Driving gives at most 0.72 here, back-driven at least 1.0: G Kt may be wrong by -28 % or by +2 % without a finding."""
    joint = replace(JOINT, **{parameter: getattr(JOINT, parameter) * scale})
    found = efficiency_findings(points_of(grid(), joint), joint)
    assert [item.kind for item in found] == [kind]
    assert f"G Kt of the joint file is {word}" in found[0].text


@pytest.mark.parametrize(
    ("torque_nm", "se_nm", "kinds"),
    [(-0.3, 1e-3, []), (-0.5, 1e-3, ["eta_below_1_back_driven"]), (-0.5, 0.05, [])],
)
def test_eta_at_its_border_within_its_errors_is_no_finding(
    torque_nm: float, se_nm: float, kinds: list[str]
) -> None:
    """Table I itself is 0.998 when back-driven at 3.8 A and -0.2 rad/s; noise and offset may take it a little further."""
    assert efficiency_findings(points_of(grid()), JOINT) == []
    edge = plateau(4.0, -1.0, 4.0 * NM_PER_A + torque_nm, se_tau=se_nm)
    assert [found.kind for found in efficiency_findings(points_of([edge]), JOINT)] == kinds


@pytest.mark.parametrize(
    ("ratio", "kind"), [(50.0, "eta_above_1_driving"), (160.0, "eta_below_1_back_driven")]
)
def test_findings_of_emulated_runs_with_a_wrong_joint_file(ratio: float, kind: str) -> None:
    """One run is forward drive of one joint and back drive of the other."""
    table = section_two_runs(load_plant(shipped("plant.yaml")), velocities=(1.0,))[0]
    joint = replace(JOINT, gear_ratio=ratio)
    plateaus: list[Plateau] = []
    for number in (1, 2):
        plateaus += find_plateaus(table.time_s, table.joint(number, joint.gear_ratio), joint, "run")
    assert [found.kind for found in efficiency_findings(points_of(plateaus, joint), joint)] == [kind]


@pytest.mark.parametrize("close", [False, True])
def test_texts_of_the_picture_do_not_overlap(close: bool) -> None:
    """close: velocities so near each other that their numbers would not fit beside the bar."""
    mpl = pytest.importorskip("matplotlib")
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    points = grid(JOINT)
    if close:
        points += [replace(each, velocity=Mean(1.04 * each.velocity.value, 1e-4)) for each in points]
    points = [each for each in points if abs(each.current.value) > 1.5] + [plateau(5.05, 3.0, 30.0)]
    found = points_of(points)
    fit = fit_efficiency(found, "joint_over_motor", JOINT)
    figure = fit_figure(found, fit, "joint1: measured efficiency and Eq. (8), convention joint_over_motor")
    figure.draw_without_rendering()
    beyond = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in axis.get_major_ticks()
        for label in (tick.label1, tick.label2)
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    }
    every = set(figure.findobj(mpl.text.Text)) - beyond
    texts = [text for text in every if text.get_visible() and text.get_text().strip()]
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts]
    panels = [axes for axes in figure.axes if "plateaus" in axes.get_title(loc="left")]
    edges = {axes.get_title(loc="left"): axes.get_window_extent().x1 for axes in panels}
    plt.close(figure)
    assert len(edges) == 4
    assert all(box.x1 <= edges.get(text, box.x1) for text, box in boxes), "a title beyond its panel"
    width, height = figure.get_size_inches() * figure.dpi
    for text, box in boxes:
        assert -1 <= box.x0 <= box.x1 <= width + 1, text
        assert -1 <= box.y0 <= box.y1 <= height + 1, text
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        assert not a.shrunk(0.9, 0.9).overlaps(b.shrunk(0.9, 0.9)), (one, other)
