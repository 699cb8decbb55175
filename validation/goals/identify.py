"""Plants, one thing changed in a plant, both joints of a plant identified as its user would, and the runs that judge.

All runs are emulated in memory; those that judge have days and motions of other seeds and are drawn, not designed. The true
torque goes into no fit. A change of the plant is one of its file's numbers; a change of what is measured acts on the link
encoder's position, which no drive is controlled by: the joint moves as before.

Baselines are what an engineer would try first: least squares with a handful of coefficients, on the runs that ours is fitted
to.

    torsion and current   tau = a0 + a1 d + a2 d^3 + a3 tau_raw + a4 s + a5 v + a6 s |tau_raw|
    TOB, fitted friction  tau = tau_raw - (c0 + c1 s + c2 v)
    TOB, load friction    tau = tau_raw - (c0 + c1 s + c2 v + c3 s |tau_raw| + c4 s tau_raw^2 + c5 v |tau_raw| + c6 tau_raw)

d: torsion angle of both encoders, s: direction (-1 to 1), v: velocity, tau_raw: motor torque less the rotor's share, joint
side, all of the observer (`estimator.observer`). The torsion is as young as ours; what comes of the current alone is as old
as the motor path.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import CONVENTIONS, Effect, Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns, ObservedRun, RunTable
from jtqd.estimator.settings import EstimatorSettings, recommended
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sim_can.plant_file import plant_from_mapping
from jtqd.sim_can.plant_source import AnyPlant
from jtqd.sim_can.towing import bench_file
from jtqd.sysid.campaign.emulated import emulated_with_truth
from jtqd.sysid.fit.efficiency import default_current_min, eta_points, fit_efficiency
from jtqd.sysid.fit.fused import fit_fused
from jtqd.sysid.fit.plateaus import Plateau, PlateauError, find_plateaus
from jtqd.sysid.fit.signals import UNIT_TORSION, run_signals
from jtqd.sysid.planner.campaigns import Scale, make_plan, outside_runs
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Run, expand
from jtqd.sysid.train.network import Schedule, paper_block, train_paper
from validation.generator import coarse

SIDES: Final = ("joint_1", "joint_2")
Mapped = dict[str, Any]
AnyBench = AnyPlant | coarse.Bench


class PlantFile(NamedTuple):
    """A plant of the table: its column's name and its file as a mapping; `directory` has the joint files."""

    name: str
    mapping: Mapping[str, Any]
    directory: Path

    @property
    def has_own_laws(self) -> bool:
        """Whether it is a bench of docs/testing.md, which shares no equation with the estimator."""
        return bench_file.KEY in self.mapping or coarse.KEY in self.mapping

    def bench(self, effects: tuple[Effect, ...] = ()) -> AnyBench:
        """Return the plant, its joints with these effects. Raises ConfigError."""

        def joint_of(name: str) -> Joint:
            joint = load_joint(self.directory / name)
            return replace(joint, effects=effects) if effects else joint

        if coarse.KEY in self.mapping:
            nominal = [joint_of(self.mapping[side]["joint"]) for side in SIDES]
            return coarse.Bench(
                self.mapping, [{key: getattr(joint, key) for key in coarse.NOMINAL} for joint in nominal]
            )
        if self.has_own_laws:
            return bench_file.bench_from_mapping(self.mapping, self.name, joint_of)
        return plant_from_mapping(self.mapping, self.name, joint_of)

    def changed(self, change: Callable[[Mapped], None]) -> PlantFile:
        mapping = copy.deepcopy(dict(self.mapping))  # YAML anchors: joints may share a section
        for side in SIDES:
            mapping[side] = copy.deepcopy(mapping[side])
        change(mapping)
        return self._replace(mapping=mapping)


def plant_file(name: str, path: Path) -> PlantFile:
    """Return the plant of a file. Raises ConfigError."""
    return PlantFile(name, load_yaml(path), path.parent)


def the_three() -> tuple[PlantFile, PlantFile, PlantFile]:
    """Return the columns of the table: the paper's Table I, an ordinary joint, a bad day."""
    return (
        plant_file("Table I", shipped("campaign_plant.yaml")),
        plant_file("typical", shipped("plants/typical.yaml")),
        plant_file("bad day", shipped("plants/bad_day.yaml")),
    )


def the_four() -> tuple[PlantFile, ...]:
    """Return the three, and the plant that is not kind (`validation/generator/coarse.py`)."""
    return (*the_three(), plant_file("coarse", coarse.FILE))


class Change(NamedTuple):
    """One thing changed: in the plant's file, by an effect of its joints, or in the link position (angle, motor's share
    motor/G). A kind of plant that has no such thing has None in its place.
    """

    name: str
    table_i: Callable[[Mapped], None] | Effect | None = None
    own_laws: Callable[[Mapped], None] | None = None
    link: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def possible(self, plant: PlantFile) -> bool:
        return self.link is not None or (self.own_laws if plant.has_own_laws else self.table_i) is not None

    def bench(self, plant: PlantFile) -> AnyBench:
        """Return the changed plant; the plant itself for a change of what is measured."""
        how = None if self.link is not None else self.own_laws if plant.has_own_laws else self.table_i
        if isinstance(how, Effect):
            return plant.bench((how,))
        return (plant if how is None else plant.changed(how)).bench()


def of_sides(change: Callable[[Mapped], None]) -> Callable[[Mapped], None]:
    """Return a change of both joints of a plant's file."""

    def both(mapping: Mapped) -> None:
        for side in SIDES:
            change(mapping[side])

    return both


def _scaled(part: str, keys: tuple[str, ...], factor: float) -> Callable[[Mapped], None]:
    @of_sides
    def change(side: Mapped) -> None:
        for key in keys:
            value = side[part].get(key, 1.0)
            side[part][key] = [factor * each for each in value] if isinstance(value, list) else factor * value

    return change


@of_sides
def _harder(side: Mapped) -> None:
    if "hardening_rad" in side["gear"]:
        side["gear"]["hardening_rad"] /= 1.3
        return
    k1, k2, k3 = side["gear"]["stiffness_nm_per_rad"]
    side["gear"]["stiffness_nm_per_rad"] = [k1, 1.1 * k2, 1.2 * k3]


@of_sides
def _wider(side: Mapped) -> None:
    side["gear"]["slips"].append({"torque_nm": 0.6, "travel_rad": 3.0e-4})


@of_sides
def _reclocked(side: Mapped) -> None:
    for number, error in enumerate(side["gear"]["errors"]):
        error["phase_rad"] += 2.0 + number


@of_sides
def _reclocked_table_i(side: Mapped) -> None:
    side["deviations"]["kinematic_error"]["phase_rad"] += 2.0


@of_sides
def _doubled(side: Mapped) -> None:
    for slip in side["gear"]["slips"]:
        slip["torque_nm"] *= 2.0


@of_sides
def _doubled_table_i(side: Mapped) -> None:
    side["deviations"]["hysteresis"]["torque_nm"] *= 2.0


@of_sides
def _noisy(side: Mapped) -> None:
    side["measurement"]["link_noise_rad"] *= 4.0


@of_sides
def _eccentric(side: Mapped) -> None:
    side["measurement"]["motor_errors"].append({"order": 1.0, "amplitude_rad": 2.0e-3, "phase_rad": 2.0})


@of_sides
def _coarse_scale(side: Mapped) -> None:
    side["measurement"]["link_counts_per_rev"] = 1 << 14


@of_sides
def _wider_table_i(side: Mapped) -> None:
    side["deviations"]["hysteresis"] = {"torque_nm": 1.0, "travel_rad": 2.5e-4}


@of_sides
def _wavier(side: Mapped) -> None:
    side["gear"]["errors"][0]["amplitude_rad"] += 1.1e-4


@of_sides
def _wavier_table_i(side: Mapped) -> None:
    side["deviations"]["kinematic_error"]["amplitude_rad"] += 1.1e-4


@of_sides
def _steeper_load(side: Mapped) -> None:
    side["friction"]["load_exponent"] += 0.15


CHANGES: Final = (
    Change("nothing", link=lambda link, motor: link),
    Change(
        "stiffness -5 %",
        _scaled("deviations", ("stiffness_scale",), 0.95),
        _scaled("gear", ("stiffness_nm_per_rad",), 0.95),
    ),
    Change(
        "spring hardens more",
        Effect("nonlinear_stiffness", {"cubic_nm_per_rad3": 2.5e8}),  # 1.67 times as stiff at rated torque
        _harder,
    ),
    Change("hysteresis 1.2 Nm wider", _wider_table_i, _wider),
    Change("hysteresis doubled", _doubled_table_i, _doubled),
    Change("kinematic error +110 urad", _wavier_table_i, _wavier),
    Change("kinematic error re-clocked", _reclocked_table_i, _reclocked),
    Change(
        "friction +30 %",
        _scaled("deviations", ("friction_scale",), 1.3),
        _scaled("friction", ("coulomb_nm", "viscous_nm", "load_nm"), 1.3),
    ),
    Change("friction by load, exponent +0.15", None, _steeper_load),
    Change("link eccentricity 60 urad", link=lambda link, motor: link + 60e-6 * np.sin(link + 1.0)),
    Change("link zero 100 urad", link=lambda link, motor: link + 100e-6),
    Change("gear ratio +0.02 %", link=lambda link, motor: link - 2e-4 * motor),
    Change("link noise x4", _noisy, _noisy),
    Change("motor encoder 2 mrad, once a turn", None, _eccentric),
    Change("link encoder of 14 bits", _coarse_scale, _coarse_scale),
)
"""What was measured to break the estimate: `nothing` stands beside, on the same days."""


_EVERY: Final = 5
"""Neighbours at 1 kHz are alike."""


class Baseline(NamedTuple):
    """A linear model: its regressors [n, k] of an observed run; young: whether its age is the torsion's.

    residual: it models tau_raw - tau, not tau.
    """

    title: str
    young: bool
    residual: bool
    regressors: Callable[[ObservedRun], FloatArray]

    def estimate(self, seen: ObservedRun, coefficients: FloatArray) -> FloatArray:
        """Return the torque [n]; NaN where nothing was observed."""
        modelled: FloatArray = self.regressors(seen) @ coefficients
        return seen.raw_nm - modelled if self.residual else modelled


def _torsion_and_current(seen: ObservedRun) -> FloatArray:
    d = seen.torsion_nm + seen.ahead_nm  # observed with a torsion of 1 Nm/rad: the angle itself
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(d), d, d**3, raw, s, v, s * np.abs(raw)))


def _friction(seen: ObservedRun) -> FloatArray:
    return np.column_stack((np.ones_like(seen.raw_nm), seen.direction, seen.velocity_rad_s))


def _load_friction(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(raw), s, v, s * np.abs(raw), s * raw * raw, v * np.abs(raw), raw))


BASELINES: Final = {
    "regression": Baseline(
        "least squares on torsion and current, 7 coefficients", True, False, _torsion_and_current
    ),
    "tob_load": Baseline("TOB, friction by load fitted, 7 coefficients", False, True, _load_friction),
    "tob_fitted": Baseline("TOB, friction fitted, 3 coefficients", False, True, _friction),
}


class Example(NamedTuple):
    """A run to fit to: observed with a torsion of 1 Nm/rad; sensor [n] as old as the motor path, and as the torsion;
    moving [n]: which samples count.
    """

    seen: ObservedRun
    sensor_nm: FloatArray
    young_sensor_nm: FloatArray
    moving: np.ndarray[tuple[int], np.dtype[np.bool_]]


def fit_baseline(baseline: Baseline, examples: Sequence[Example], rcond: float | None = None) -> FloatArray:
    """Return the coefficients [k] of ordinary least squares over the moving samples of all runs; ValueError without any.

    rcond: singular values below this part of the largest one count as 0, None: those of rounding size alone.
    """
    rows, targets = [], []
    for each in examples:
        keep = np.flatnonzero(each.moving)[::_EVERY]
        sensor = each.young_sensor_nm if baseline.young else each.sensor_nm
        rows.append(baseline.regressors(each.seen)[keep])
        targets.append((each.seen.raw_nm - sensor if baseline.residual else sensor)[keep])
    if not sum(map(len, rows)):
        raise ValueError("found no samples in motion, expected some to fit a baseline to")
    x, y = np.concatenate(rows), np.concatenate(targets)
    size = np.sqrt(np.mean(x * x, axis=0))
    found: FloatArray = np.linalg.lstsq(x / size, y, rcond=rcond)[0] / size
    return found


FIT_SEED: Final = 1
JUDGE_SEED: Final = 7020
"""Days and motions that nothing was chosen on (docs/results.md); a new choice takes a new seed."""
WARMER_K: Final = 30.0
FASTER_RAD_S: Final = 4.5
NUMBERS: Final = (1, 2)


class Sizes(NamedTuple):
    """How much is driven: counts of runs, lengths of one and of its holds [s], iterations of the paper's network."""

    fit_runs: int
    fit_s: float
    evaluations: int
    efficiency_hold_s: float
    iterations: int
    judge_runs: int
    judge_s: float
    judge_hold_s: float
    changed_runs: int
    outside_runs: int


FULL: Final = Sizes(96, 12.0, 400, 1.2, 1000, 192, 8.0, 1.6, 48, 24)
FEW: Final = FULL._replace(judge_runs=24, changed_runs=12, outside_runs=4)
"""Identified as in full, judged on fewer days."""
QUICK: Final = Sizes(32, 12.0, 160, 1.2, 150, 24, 8.0, 1.0, 8, 4)
TINY: Final = Sizes(8, 8.0, 2, 0.8, 2, 2, 5.0, 0.6, 1, 1)
"""For tests of the steps."""


class Driven(NamedTuple):
    """A run as measured, and what no instrument knows: the true torques [n, 2] of the gears."""

    name: str
    table: RunTable
    true_nm: FloatArray

    def columns(self, number: int, joint: Joint) -> JointColumns:
        return self.table.joint(number, joint.gear_ratio)


def drive(bench: AnyBench, runs: Sequence[Run], seed: int) -> list[Driven]:
    """Return the runs on a plant, each on a day of its own of this seed."""
    if isinstance(bench, coarse.Bench):
        return _drive_coarse(bench, runs, seed)
    made = []
    for day, run in enumerate(runs):
        emulated = emulated_with_truth(bench, seed, day, run)
        made.append(Driven(run.name, emulated.table, emulated.joint_torque_nm))
    return made


_TOGETHER: Final = 96
"""Runs of `coarse` that are integrated side by side."""


def _drive_coarse(bench: coarse.Bench, runs: Sequence[Run], seed: int) -> list[Driven]:
    made = []
    for first in range(0, len(runs), _TOGETHER):
        part = runs[first : first + _TOGETHER]
        points = [expand(run) for run in part]
        commands = [
            coarse.Command(each.joints.index(each.velocity_joint), each.velocity_rad_s, each.current_a)
            for each in points
        ]
        for run, read in zip(part, bench.record(commands, seed, first), strict=True):
            made.append(Driven(run.name, _table(read), read.true_nm))
    return made


def _table(read: coarse.Recorded) -> RunTable:
    joints = {
        number: JointColumns(
            current_a=read.current_a[:, k],
            motor_position_rad=read.motor_rad[:, k],
            motor_velocity_rad_s=read.motor_rad_s[:, k],
            link_position_rad=read.link_rad[:, k],
            torque_nm=read.sensor_nm,
            temperature_c=read.temperature_c[:, k],
        )
        for k, number in enumerate(NUMBERS)
    }
    time_s: FloatArray = coarse.CYCLE_S * np.arange(len(read.sensor_nm), dtype=np.float64)
    return RunTable(time_s, joints)


class Range(NamedTuple):
    """What the campaign that a joint was identified on has driven: largest true torque and speed, temperatures."""

    torque_nm: float
    velocity_rad_s: float
    temperature_c: tuple[float, float]

    @classmethod
    def of(cls, runs: Sequence[Driven], number: int, joint: Joint) -> Range:
        columns = [run.columns(number, joint) for run in runs]
        known = np.concatenate([_present(each.temperature_c) for each in columns])
        return cls(
            max(float(np.abs(run.true_nm[:, number - 1]).max()) for run in runs),
            max(float(np.abs(_present(each.motor_velocity_rad_s)).max()) for each in columns)
            / joint.gear_ratio,
            (float(known.min()), float(known.max())),
        )


def _present(column: FloatArray | None) -> FloatArray:
    if column is None:
        raise ValueError("found a run without a column that an emulated run has")
    return column


@dataclass(frozen=True)
class Identified:
    """One joint of a plant: its file, the paper's network (ONNX), coefficients by baseline, what was driven.

    one_encoder: the same fit without the link encoder; None where it was not asked for.
    """

    number: int
    joint: Joint
    network: bytes
    baselines: Mapping[str, FloatArray]
    driven: Range
    one_encoder: Joint | None = None


def scale_of(sizes: Sizes, joints: tuple[Joint, Joint], seed: int, part: str) -> Scale:
    """Return the scale of a campaign: `excitation`, `efficiency` or `validate`."""
    if part == "validate":
        return Scale(sizes.judge_runs, sizes.judge_s, sizes.judge_hold_s, seed, joints=joints)
    return Scale(sizes.fit_runs, sizes.fit_s, sizes.efficiency_hold_s, seed, sizes.evaluations, joints=joints)


def nominal_joints(plant: PlantFile) -> tuple[Joint, Joint]:
    """Return what a user of the plant knows before: its joint files. Raises ConfigError."""
    one, two = (load_joint(plant.directory / plant.mapping[side]["joint"]) for side in SIDES)
    return one, two


def identify(plant: PlantFile, sizes: Sizes, seed: int = FIT_SEED) -> tuple[Identified, ...]:
    """Return both joints of a plant as the toolbox identifies them from campaigns of this seed.

    Raises:
        ConfigError, LossFitError, TorsionError, ValueError: as the fits, where the runs are too few.
    """
    physics, excitation = identify_physics(plant, sizes, seed)
    plan = make_plan("efficiency", scale_of(sizes, nominal_joints(plant), seed, "efficiency"))
    efficiency = drive(plant.bench(), plan.runs, seed)
    return tuple(_with_others(one, excitation, efficiency, sizes.iterations, seed) for one in physics)


def identify_physics(
    plant: PlantFile, sizes: Sizes, seed: int = FIT_SEED
) -> tuple[tuple[Identified, ...], list[Driven]]:
    """Return both joints with section `fused` alone, and the runs that they were fitted to. Raises as `identify`."""
    joints = nominal_joints(plant)
    plan = make_plan("excitation", scale_of(sizes, joints, seed, "excitation"))
    excitation = drive(plant.bench(), plan.runs, seed)
    return fit_physics(joints, excitation), excitation


def fit_physics(joints: tuple[Joint, Joint], excitation: Sequence[Driven]) -> tuple[Identified, ...]:
    """Return both joints with section `fused` fitted to these runs. Raises as `identify`."""
    settings = EstimatorSettings(method="fused")  # as `jtq fit losses`
    found = []
    for number, joint in zip(NUMBERS, joints, strict=True):
        signals = [
            run_signals(run.name, joint, settings, run.table.time_s, run.columns(number, joint))
            for run in excitation
        ]
        fused = fit_fused(signals, joint).fused
        found.append(
            Identified(number, replace(joint, fused=fused), b"", {}, Range.of(excitation, number, joint))
        )
    return tuple(found)


def one_encoder(columns: JointColumns, joint: Joint) -> JointColumns:
    """Return the columns with the link's position that the motor's tells."""
    return replace(columns, link_position_rad=_present(columns.motor_position_rad) / joint.gear_ratio)


def fit_one_encoder(joint: Joint, number: int, runs: Sequence[Driven]) -> Joint:
    """Return the joint with section `fused` fitted to these runs without their link encoder. Raises as `identify`."""
    settings = EstimatorSettings(method="fused")  # as `jtq fit losses`
    signals = [
        run_signals(
            run.name, joint, settings, run.table.time_s, one_encoder(run.columns(number, joint), joint)
        )
        for run in runs
    ]
    return replace(joint, fused=fit_fused(signals, joint, two_encoders=False).fused)


def with_efficiency(joint: Joint, number: int, runs: Sequence[Driven]) -> Joint:
    """Return the joint with the paper's efficiency, fitted to the plateaus of runs, as `jtq fit efficiency` does it."""
    plateaus: list[Plateau] = []
    for run in runs:
        try:
            plateaus += find_plateaus(run.table.time_s, run.columns(number, joint), joint, run.name)
        except PlateauError:
            continue
    points, _ = eta_points(plateaus, joint, default_current_min(joint))
    fit = fit_efficiency(points, CONVENTIONS[0], joint)
    return replace(joint, efficiency=fit.efficiency(joint.efficiency))


def _with_others(
    one: Identified, excitation: Sequence[Driven], efficiency: Sequence[Driven], iterations: int, seed: int
) -> Identified:
    """Return the joint with the paper's chain and the baselines."""
    number, joint = one.number, with_efficiency(one.joint, one.number, efficiency)
    blocks = [
        paper_block(run.name, joint, run.table.time_s, run.columns(number, joint)) for run in excitation
    ]
    names = {run.name: hashlib.sha256(run.table.time_s.tobytes()).hexdigest() for run in excitation}
    network = train_paper(blocks, joint, names, Schedule(iterations, seed))
    examples = [example(run, number, joint) for run in excitation]
    baselines = {name: fit_baseline(baseline, examples) for name, baseline in BASELINES.items()}
    known = fit_one_encoder(one.joint, number, excitation)
    return replace(one, joint=joint, network=network.data, baselines=baselines, one_encoder=known)


OF_BASELINES: Final = replace(recommended("fused"), track_torsion=False)
"""What is least squares on torsion and current has the torsion through its low pass."""


def observed(run: Driven, columns: JointColumns, joint: Joint) -> ObservedRun:
    """Return what the observer of ours sees of a run with a torsion of 1 Nm/rad."""
    dt = np.diff(run.table.time_s, prepend=run.table.time_s[0])
    return observe_run(
        joint,
        OF_BASELINES,
        UNIT_TORSION,
        dt,
        _present(columns.current_a),
        _present(columns.motor_position_rad),
        _present(columns.motor_velocity_rad_s),
        _present(columns.link_position_rad),
        columns.temperature_c,
    )


def example(run: Driven, number: int, joint: Joint) -> Example:
    columns = run.columns(number, joint)
    settings = OF_BASELINES
    dt = np.diff(run.table.time_s, prepend=run.table.time_s[0])
    sensor = _present(columns.torque_nm)
    signals = run_signals(run.name, joint, settings, run.table.time_s, columns)
    young = low_pass(sensor, dt, settings.own_torsion_bandwidth_rad_s)
    return Example(observed(run, columns, joint), signals.sensor_nm, young, signals.moving)


def judging_runs(sizes: Sizes, joints: tuple[Joint, Joint], seed: int = JUDGE_SEED) -> tuple[Run, ...]:
    """Return the motions that judge: constant and variable velocity, as of `jtq campaign validate`."""
    return make_plan("validate", scale_of(sizes, joints, seed, "validate")).runs


@of_sides
def _stronger(side: Mapped) -> None:
    side["drive"] |= {"current_limit_a": 14.0, "trip_current_a": 16.0}


@of_sides
def _warmer(side: Mapped) -> None:
    warmth = side["warmth" if "warmth" in side else "thermal"]
    warmth["ambient_c"] = warmth.get("ambient_c", warmth["reference_c"]) + WARMER_K


def outside(
    plant: PlantFile, sizes: Sizes, joints: tuple[Joint, Joint], seed: int = JUDGE_SEED
) -> dict[str, list[Driven]]:
    """Return runs that no campaign has driven, by what is beyond it: half as much load again, speed, temperature."""
    limits = replace(DEFAULT_LIMITS, current_a=16.0, torque_nm=90.0, velocity_rad_s=6.0)
    count, seconds = sizes.outside_runs, sizes.judge_s
    load = outside_runs(limits, count, seconds, seed=seed, joints=joints)
    fast = outside_runs(
        limits, count, seconds, seed=seed, joints=joints, load=1.0, velocity_rad_s=FASTER_RAD_S
    )
    warm = outside_runs(DEFAULT_LIMITS, count, seconds, seed=seed, joints=joints, load=1.0)
    parts: dict[str, tuple[Callable[[Mapped], None], tuple[Run, ...]]] = {
        "load": (_stronger, load),
        "speed": (_stronger, fast),
        "temperature": (_warmer, warm),
    }
    return {name: drive(plant.changed(change).bench(), runs, seed) for name, (change, runs) in parts.items()}
