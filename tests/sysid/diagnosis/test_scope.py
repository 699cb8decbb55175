"""Options --without, --given and --trust, known references, and the file's values beside those found."""

import math
from argparse import ArgumentTypeError
from dataclasses import replace

import pytest

from jtqd.estimator.joint import Effect
from jtqd.sysid.diagnosis.command import effect_at, scope_of, trusted
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import EVERYTHING, NO_GAP, UNEXPLAINED, Scope, file_values, priors
from jtqd.sysid.diagnosis.limits import PRIORS
from jtqd.sysid.runs.options import UsageError
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run
from tests.sysid.diagnosis.diagnose_helpers import JOINT, bench_run

RIPPLE = Effect("torque_ripple", {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 0.1})
JOINTS = {1: JOINT, 2: replace(JOINT, effects=(RIPPLE,))}


def names(scope: Scope, numbers: tuple[int, ...] = (1, 2)) -> set[tuple[str, int | str]]:
    runs = [(f"r{k}", bench_run(phase=0.7 * k, numbers=numbers)) for k in range(3)]
    joints = dict.fromkeys(numbers, JOINT)
    usable, reasons = usable_signals(runs, joints, numbers)
    assert usable, reasons
    dataset = build_dataset(usable, joints, scope)
    found = {(c.effect.name, c.joint) for c in dataset.candidates}
    return found | {("nuisance " + f.name, f.joint) for f in dataset.families}


def test_what_is_left_out_is_no_candidate() -> None:
    everything = names(EVERYTHING)
    assert {("coulomb_friction", 1), ("coulomb_friction", 2), ("sensor_gain", "sensor")} <= everything
    absent = [*map(effect_at, ("coulomb_friction", "2=viscous_friction", "sensor=sensor_drift"))]
    scope = scope_of(absent, [], JOINTS)
    gone = everything - names(scope)
    assert gone == {
        ("coulomb_friction", 1),
        ("coulomb_friction", 2),
        ("viscous_friction", 2),
        ("sensor_drift", "sensor"),
    }


def test_no_sensor_effect_touches_a_known_load() -> None:
    everything, known = names(EVERYTHING, (1,)), names(Scope(known_references=frozenset({1})), (1,))
    gone = everything - known
    assert ("sensor_gain", "sensor") in gone
    assert ("nuisance zero", 0) in gone
    assert not [where for _, where in known if where == "sensor"]
    assert ("channel_delay", 1) in known  # of current and link, not of the load


@pytest.mark.parametrize(
    ("without", "given", "said"),
    [
        (["gravity"], [], "gravity: found no effect of that name, expected NAME"),
        (["3=coulomb_friction"], [], "found no joint 3 in runs and joint files: 1, 2"),
        ([], ["1=torque_ripple"], "--given torque_ripple: found it neither among"),
        ([], ["nothing="], "nothing=: found no effect"),
    ],
)
def test_wrong_names_are_told(without: list[str], given: list[str], said: str) -> None:
    with pytest.raises((UsageError, ArgumentTypeError)) as caught:
        scope_of([*map(effect_at, without)], [*map(effect_at, given)], JOINTS)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("without", "given"),
    [("coulomb_friction", ""), pytest.param("", "coulomb_friction", marks=pytest.mark.campaign)],
)
def test_what_all_runs_lack_is_no_noise_where_its_name_may_not_be_said(without: str, given: str) -> None:
    """The runs' own changes took it: `no_gap`, with a noise floor as high as the gap."""
    friction = JOINT.friction
    plain = replace(JOINT, efficiency=None, friction=replace(friction, stribeck_nm=0.0))
    more = replace(
        plain, friction=replace(plain.friction, coulomb_nm=friction.coulomb_nm + 0.04 * plain.rated_torque_nm)
    )
    runs = [(f"run{k}", rich_run(more, 40 + k, noise=2e-3)) for k in range(4)]
    scope = scope_of(*([effect_at(name)] if name else [] for name in (without, given)), {1: plain})
    found = diagnose(runs, {1: plain}, scope)
    assert found.verdict == UNEXPLAINED
    assert (
        found.reasons[-1]
        == "not looked for, as asked: coulomb_friction; the unexplained residual may be theirs"
    )
    gap = next(g for g in found.gaps if g.balance == "motor")
    assert gap.rmse_nm == pytest.approx(0.04 * plain.rated_torque_nm, rel=0.1)
    assert gap.noise_floor_nm < 0.3 * gap.rmse_nm
    plain_too = diagnose(runs, {1: more}, scope)
    assert plain_too.verdict == NO_GAP
    assert not any("not looked for" in reason for reason in plain_too.reasons)


def test_given_is_what_the_file_has() -> None:
    scope = scope_of([], [*map(effect_at, ("2=torque_ripple", "coulomb_friction"))], JOINTS)
    assert not scope.looks_for("torque_ripple", 2, 2)
    assert scope.looks_for("torque_ripple", 1, 1)
    assert not scope.looks_for("coulomb_friction", 1, 1)


def test_the_files_value_stands_beside_the_found_one() -> None:
    found = file_values("coulomb_friction", 1, JOINTS)["coulomb_nm"]
    assert found == (JOINT.friction.coulomb_nm, "friction.coulomb_nm")
    assert found.change(1.5 * JOINT.friction.coulomb_nm) == pytest.approx(0.5)
    gain = file_values("sensor_gain", "sensor", JOINTS)["gain"]
    assert (gain.value, gain.change(1.03)) == (1.0, pytest.approx(0.03))
    ripple = file_values("torque_ripple", 2, JOINTS)
    assert ripple["amplitude_nm"].value == 0.4
    fresh = file_values("torque_ripple", 1, JOINTS)
    assert (fresh["amplitude_nm"].value, fresh["amplitude_nm"].change(0.2)) == (0.0, None)
    assert fresh["phase_rad"].value is None
    assert file_values("unheard_of", 1, JOINTS) == {}
    assert gain.change(math.nan) is None


@pytest.mark.parametrize(
    ("item", "factor"),
    [
        ("sensor_gain=5%", 5.0),
        ("sensor_gain=0.5 %", 0.5),
        ("coulomb_friction=50%", 0.5),
        ("stribeck_friction=25%", 0.5),
        ("channel_delay=6ms", 2.0),
        ("encoder_eccentricity.motor=10 mrad", 2.0),
        ("lost_motion=.03mrad", 0.1),
    ],
)
def test_how_far_a_value_may_be_off_is_a_factor_on_its_prior(item: str, factor: float) -> None:
    assert trusted(item) == (item.partition("=")[0], pytest.approx(factor))


@pytest.mark.parametrize(
    ("item", "wanted"),
    [
        ("gravity=5%", "found 'gravity', expected NAME=SIZE with one of channel_delay, "),
        ("sensor_gain", "found '', expected a number above 0 with the unit % (default 1 %)"),
        ("sensor_gain=wide%", "found 'wide%', expected a number above 0"),
        ("sensor_gain=0%", "found '0%', expected a number above 0"),
        ("sensor_gain=1.2.3%", "found '1.2.3%', expected a number above 0"),
        ("sensor_gain=0.05", "found '0.05', expected a number above 0 with the unit %"),
        ("coulomb_friction=5Nm", "found '5Nm', expected a number above 0 with the unit % (default 100 %)"),
        ("channel_delay=5%", "found '5%', expected a number above 0 with the unit ms (default 3 ms)"),
    ],
)
def test_a_wrong_trust_is_one_line(item: str, wanted: str) -> None:
    with pytest.raises(ArgumentTypeError) as caught:
        trusted(item)
    assert wanted in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", PRIORS)
def test_every_prior_has_a_size_in_a_unit(name: str) -> None:
    size, unit, *_ = PRIORS[name].text.split()
    assert trusted(f"{name}={2.0 * float(size)} {unit}") == (name, pytest.approx(2.0))
    [row] = [row for row in priors({name: 3.0}) if row.set_by_user]
    assert row.size == PRIORS[name].text.replace(size, f"{3.0 * float(size):.3g}")
