"""`jtq fit losses` without a torque sensor: a joint that carries two known payloads on an arm that nobody has weighed.

The joint moves alone on a horizontal axis. It is fitted from the same runs twice: with the torque sensor between joint and
arm, and with a column map that has the masses and nothing else of the load. Both files are judged on other days, motions and
with a third payload, against the true torque of the instant. Beside them: a fit on a towing bench from as many runs, and
fits without the link encoder.

    weight = m g l sin(q - h) + unknown arm          load = weight + inertia d2q/dt2

What a person knows is a little wrong: mass, lever and angle by MASS_KG, LEVER_M, ANGLE_RAD (uniform, one draw per joint),
and the payload is no point. Plants: `typical`, `bad day`, `coarse`; joint 2 of a file is put in the place of joint 1.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint
from jtqd.sim_can.emulated_run import SENSOR_NM_PER_UNIT, TEMPERATURE_C_PER_UNIT
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import VELOCITY
from jtqd.sim_can.towing.bench_file import TowingBench
from jtqd.sysid.fit.command import main as fit
from jtqd.sysid.planner.campaigns import make_plan
from jtqd.sysid.runs.tables import write_run
from validation.generator import coarse
from validation.goals.goals import ZEROS, Figure, ratio, root, settings_of, share
from validation.goals.identify import (
    QUICK,
    SIDES,
    Mapped,
    PlantFile,
    drive,
    nominal_joints,
    one_encoder,
    scale_of,
    the_four,
)
from validation.study import Report, Table

FIT_SEED: Final = 4100
JUDGE_SEED: Final = 7351
"""Days, motions and what is wrong with the known load; nothing was chosen on them."""
RATIO: Final = 1.3
LOW, HIGH = 85.0, 95.0
GRAVITY_M_S2: Final = 9.80665
LEVER_M: Final = 0.3
PAYLOADS_KG: Final = {"light": 2.0, "heavy": 8.0}
JUDGED_KG: Final = 5.0
ARM: Final = coarse.Load(0.09, 2.6, 1.1)
"""About 1 kg at 0.3 m, its centre off the axis of the payload."""
WRONG_KG, WRONG_M, WRONG_RAD = 0.01, 0.001, 0.0035
GYRATION_M: Final = 0.055
"""Of the payload about its own centre: a disc of 8 cm."""
_FASTEST_RAD_S: Final = (0.25, 2.5)
_QUICKEST_RAD_S2: Final = 4.0
_FURTHEST_RAD: Final = 2.2
_REST_S: Final = 0.8
_SETTLE_S: Final = 0.5
_MOVING_RAD_S: Final = 0.02


class Sizes(NamedTuple):
    """Runs to fit to and to judge on, their lengths [s], joints."""

    fit_runs: int
    fit_s: float
    judge_runs: int
    judge_s: float
    joints: tuple[int, ...]


FULL: Final = Sizes(24, 12.0, 24, 8.0, (1, 2))
FEW: Final = Sizes(12, 10.0, 8, 8.0, (1,))


def velocity_of(rng: np.random.Generator, seconds: float) -> FloatArray:
    """Return set-points [n, rad/s] at 1 kHz: a sum of sines between two rests, within speed, acceleration and travel."""
    t = np.arange(0.0, seconds - 2.0 * _REST_S, 1e-3)
    waves = [
        a * np.sin(2.0 * math.pi * f * t + p)
        for a, f, p in zip(
            rng.normal(size=5), rng.uniform(0.08, 0.6, 5), rng.uniform(0.0, 6.3, 5), strict=True
        )
    ]
    v = np.sum(waves, axis=0) * np.clip(np.minimum(t, t[-1] - t) / 0.8, 0.0, 1.0)
    fastest = float(rng.uniform(*_FASTEST_RAD_S))
    limits = (
        fastest / np.abs(v).max(),
        _QUICKEST_RAD_S2 / np.abs(np.gradient(v, 1e-3)).max(),
        _FURTHEST_RAD / np.abs(np.cumsum(v) * 1e-3).max(),
    )
    rest = np.zeros(round(1e3 * _REST_S))
    return np.concatenate((rest, v * min(limits), rest))


class Known(NamedTuple):
    """How wrong a person's mass [kg], lever [m] and angle [rad] are."""

    mass_kg: float
    lever_m: float
    angle_rad: float

    @classmethod
    def drawn(cls, seed: int, number: int) -> Known:
        widths = np.array((WRONG_KG, WRONG_M, WRONG_RAD))
        return cls(*(widths * np.random.default_rng([seed, 9, number]).uniform(-1.0, 1.0, 3)).tolist())

    def load(self, mass_kg: float) -> coarse.Load:
        """Return arm and payload as they are."""
        mass, lever = mass_kg + self.mass_kg, LEVER_M + self.lever_m
        weight = mass * GRAVITY_M_S2 * lever
        return coarse.Load(
            ARM.inertia_kgm2 + mass * (lever**2 + GYRATION_M**2),
            ARM.sine_nm + weight * math.cos(self.angle_rad),
            ARM.cosine_nm - weight * math.sin(self.angle_rad),
        )


class Driven(NamedTuple):
    """A run of joint 1 as measured, sensor included, and its true torque [n]."""

    name: str
    table: RunTable
    true_nm: FloatArray


def alone(plant: PlantFile, number: int) -> PlantFile:
    """Return the plant with joint `number` in the place of joint 1."""

    def swap(mapping: Mapped) -> None:
        if number == 2:
            mapping[SIDES[0]], mapping[SIDES[1]] = mapping[SIDES[1]], mapping[SIDES[0]]

    return plant.changed(swap)


def carried(
    plant: PlantFile, velocities: Sequence[FloatArray], loads: Sequence[coarse.Load], seed: int
) -> list[Driven]:
    """Return runs of joint 1 of a plant with these loads, each on a day of its own of this seed."""
    if coarse.KEY in plant.mapping:
        bench = plant.bench()
        assert isinstance(bench, coarse.Bench)
        commands = [coarse.Command(0, v, np.zeros_like(v)) for v in velocities]
        read = bench.record(commands, seed, loads=loads)
        return [_of_coarse(each, f"run_{k:02d}") for k, each in enumerate(read)]
    return [
        _towed(plant, v, load, seed, day) for day, (v, load) in enumerate(zip(velocities, loads, strict=True))
    ]


def _of_coarse(read: coarse.Recorded, name: str) -> Driven:
    columns = JointColumns(
        current_a=np.ascontiguousarray(read.current_a[:, 0]),
        motor_position_rad=np.ascontiguousarray(read.motor_rad[:, 0]),
        motor_velocity_rad_s=np.ascontiguousarray(read.motor_rad_s[:, 0]),
        link_position_rad=np.ascontiguousarray(read.link_rad[:, 0]),
        torque_nm=read.sensor_nm,
        temperature_c=np.ascontiguousarray(read.temperature_c[:, 0]),
    )
    return _driven(name, columns, read.true_nm[:, 0])


def _driven(name: str, columns: JointColumns, true_nm: FloatArray) -> Driven:
    time_s: FloatArray = 1e-3 * np.arange(len(true_nm), dtype=np.float64)
    return Driven(name, RunTable(time_s, {1: columns}), np.ascontiguousarray(true_nm))


def _towed(plant: PlantFile, velocity: FloatArray, load: coarse.Load, seed: int, day: int) -> Driven:
    """Return a run of a towing bench whose second gear transmits nothing: its link is the load, its weight a push."""

    def change(mapping: Mapped) -> None:
        none = {"stiffness_nm_per_rad": [1e-6] * 3, "damping_nms_per_rad": 0.0, "errors": [], "slips": []}
        mapping[SIDES[1]]["gear"] = mapping[SIDES[1]]["gear"] | none
        mapping[SIDES[1]]["link_inertia_kgm2"] = load.inertia_kgm2

    bench = plant.changed(change).bench()
    assert isinstance(bench, TowingBench)
    source = PlantSource(bench, seed, noise_seed=f"{seed} day {day}")
    source.begin_day(bench.run_to_run.day(seed, day))
    one, channel, gear_ratio = source.drives[0], source.channels[0], bench.joints[0].joint.gear_ratio
    rows, true = np.empty((len(velocity), 6)), np.empty(len(velocity))
    source.advance(0.0)
    for k, target in enumerate(velocity.tolist()):
        rows[k] = (
            one.current_a,
            one.motor_position_rad,
            one.motor_velocity_rad_s,
            one.link_position_rad,
            one.temperature_c,
            channel.torque_nm,
        )
        true[k] = source.plant.joint_torques()[0]
        source.command(0, VELOCITY, gear_ratio * target)
        q = source.plant.link_position
        source.plant.push(-load.sine_nm * math.sin(q) - load.cosine_nm * math.cos(q))
        source.advance(1e-3)
    rating = source.ratings[0]
    motor, link = (2.0 * math.pi / n for n in (rating.motor_counts_per_rev, rating.link_counts_per_rev))
    units = (
        rating.rated_current_a / 1000.0,
        motor,
        motor,
        link,
        TEMPERATURE_C_PER_UNIT,
        SENSOR_NM_PER_UNIT,
    )
    i, motor_rad, motor_rad_s, link_rad, celsius, sensor = (np.round(rows / units) * units).T.copy()
    columns = JointColumns(
        current_a=i,
        motor_position_rad=motor_rad,
        motor_velocity_rad_s=motor_rad_s,
        link_position_rad=link_rad,
        torque_nm=sensor,
        temperature_c=celsius,
    )
    return _driven(f"run_{day:02d}", columns, true)


# Fits --------------------------------------------------------------------------------------------------

_SENSOR: Final = "j1.torque_nm: j1.torque_nm"
_MASSES: Final = (
    "j1.load:\n"
    + "\n".join(
        f"  {name}: {{mass_kg: {mass}, lever_m: {LEVER_M}, arm: unknown}}" for name, mass in PAYLOADS_KG.items()
    )
)  # fmt: skip
_COLUMNS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "temperature_c")


def column_map(reference: str, joint: Joint, *, two_encoders: bool) -> str:
    """Return a column map of the runs with this reference."""
    link = (
        "j1.link_position_rad"
        if two_encoders
        else f"{{column: j1.motor_position_rad, scale: {1.0 / joint.gear_ratio!r}}}"
    )
    lines = ["time_s: time_s", *(f"j1.{name}: j1.{name}" for name in _COLUMNS)]
    return "\n".join([*lines, f"j1.link_position_rad: {link}", reference, ""])


@contextlib.contextmanager
def _written(runs: Sequence[tuple[str, RunTable]]) -> Iterator[Path]:
    """Yield a directory of run files, one directory per payload."""
    with tempfile.TemporaryDirectory() as name:
        for k, (payload, table) in enumerate(runs):
            (Path(name) / payload).mkdir(exist_ok=True)
            write_run(Path(name) / payload / f"{k:02d}.csv", table)
        yield Path(name)


def fitted(folder: Path, file: Path, columns: str) -> Joint:
    """Return the joint that `jtq fit losses` writes; the runs lie in directories named by payload. Raises RuntimeError."""
    payloads = [str(each) for each in sorted(folder.iterdir()) if each.is_dir()]
    out, said = folder / "fitted.yaml", io.StringIO()
    (folder / "columns.yaml").write_text(columns)
    options = ["--joint", str(file), "--number", "1", "--columns", str(folder / "columns.yaml")]
    out.unlink(missing_ok=True)
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = fit(["losses", *payloads, *options, "--out", str(out)])
    if status:
        raise RuntimeError(f"jtq fit losses: exit status {status}: {said.getvalue().strip()}")
    return load_joint(out)


KINDS: Final = {
    "two payloads": (_MASSES, True),
    "sensor": (_SENSOR, True),
    "two payloads, one encoder": (_MASSES, False),
    "sensor, one encoder": (_SENSOR, False),
}
BENCH: Final = "towing bench"


def joints_of(plant: PlantFile, number: int, sizes: Sizes, seed: int) -> dict[str, Joint | str]:
    """Return the joint by kind of fit, or why there is none."""
    single = alone(plant, number)
    rng = np.random.default_rng([seed, number])
    velocities = [velocity_of(rng, sizes.fit_s) for _ in range(sizes.fit_runs)]
    payloads = [list(PAYLOADS_KG)[k % 2] for k in range(sizes.fit_runs)]
    known = Known.drawn(seed, number)
    runs = carried(single, velocities, [known.load(PAYLOADS_KG[name]) for name in payloads], seed)
    file = plant.directory / single.mapping[SIDES[0]]["joint"]
    found: dict[str, Joint | str] = {}
    with _written([(name, run.table) for name, run in zip(payloads, runs, strict=True)]) as folder:
        for kind, (reference, two) in KINDS.items():
            found[kind] = _or_why(folder, file, column_map(reference, load_joint(file), two_encoders=two))
    joints = nominal_joints(single)
    of_bench = QUICK._replace(fit_runs=sizes.fit_runs, fit_s=sizes.fit_s, evaluations=40)
    plan = make_plan("excitation", scale_of(of_bench, joints, seed, "excitation"))
    towed = [("towed", run.table) for run in drive(single.bench(), plan.runs, seed)]
    with _written(towed) as folder:
        found[BENCH] = _or_why(folder, file, column_map(_SENSOR, joints[0], two_encoders=True))
    return found


def _or_why(folder: Path, file: Path, columns: str) -> Joint | str:
    try:
        return fitted(folder, file, columns)
    except RuntimeError as error:
        return str(error)


# Judge -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A kind of fit on a plant: RMSE in motion [Nm], share [%] inside the 90 % interval; refused: why there is no fit."""

    plant: str
    kind: str
    rmse_nm: Figure
    inside: Figure
    refused: tuple[str, ...] = ()


def rows_of(plant: PlantFile, sizes: Sizes, fit_seed: int, judge_seed: int) -> list[Row]:
    """Return the rows of a plant: its joints are fitted and judged one after the other."""
    squares: dict[str, list[tuple[str, float, float]]] = {}
    inside: dict[str, list[tuple[str, BoolArray, BoolArray]]] = {}
    refused: dict[str, list[str]] = {}
    for number in sizes.joints:
        joints = joints_of(plant, number, sizes, fit_seed)
        rng = np.random.default_rng([judge_seed, number])
        velocities = [velocity_of(rng, sizes.judge_s) for _ in range(sizes.judge_runs)]
        load = Known.drawn(judge_seed, number).load(JUDGED_KG)
        days = carried(alone(plant, number), velocities, [load] * len(velocities), judge_seed)
        for kind, joint in joints.items():
            if isinstance(joint, str):
                refused.setdefault(kind, []).append(joint)
                continue
            for day in days:
                error, half, moving = judged(joint, day, two_encoders="one encoder" not in kind)
                name = f"{number} {day.name}"
                squares.setdefault(kind, []).append(
                    (name, float(error[moving] @ error[moving]), float(np.count_nonzero(moving)))
                )
                inside.setdefault(kind, []).append((name, np.abs(error) <= half, moving))
    return [
        Row(
            plant.name,
            kind,
            root(ratio(squares.get(kind, []))),
            share(inside.get(kind, [])),
            tuple(refused.get(kind, ())),
        )
        for kind in (*KINDS, BENCH)
    ]


def judged(joint: Joint, day: Driven, *, two_encoders: bool) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return error, half width of the interval [n, Nm], and which samples count."""
    columns = day.table.joint(1, joint.gear_ratio)
    if not two_encoders:
        columns = one_encoder(columns, joint)
    found = estimate_columns(joint, settings_of(ZEROS), None, day.table.time_s, columns)
    speed = np.abs(columns.motor_velocity_rad_s) / joint.gear_ratio  # type: ignore[arg-type]
    moving = (speed > _MOVING_RAD_S) & (day.table.time_s > _SETTLE_S) & np.isfinite(found.torque_nm)
    error = np.where(np.isfinite(found.torque_nm), found.torque_nm - day.true_nm, 0.0)
    return error, GAUSS * np.nan_to_num(found.sigma_nm), moving


def table_of(rows: Sequence[Row]) -> tuple[Table, bool]:
    """Return the table, and whether all targets are reached."""
    reached, cells = True, []
    for row in rows:
        sensor = next(
            each
            for each in rows
            if (each.plant == row.plant and each.kind == row.kind.replace("two payloads", "sensor"))
            or (each.plant == row.plant and row.kind == BENCH and each.kind == "sensor")
        )
        times = row.rmse_nm.value / sensor.rmse_nm.value
        if row.kind == "two payloads":
            reached &= times <= RATIO and LOW <= row.inside.value <= HIGH and not row.refused
        cells.append(
            (
                row.plant,
                row.kind,
                f"{row.rmse_nm.value:.3f} ± {row.rmse_nm.se:.3f}",
                f"{times:.2f}",
                f"{row.inside.value:.1f} ± {row.inside.se:.1f}",
                "; ".join(row.refused),
            )
        )
    head = (
        "plant",
        "fitted with",
        "RMSE now, Nm",
        f"to that with a sensor (two payloads: {RATIO})",
        f"inside 90 % (two payloads: {LOW:g} to {HIGH:g})",
        "refused",
    )
    return Table(head, cells), reached


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="12 runs, joint 1 alone")
    parser.add_argument("--fit-seed", type=int, default=FIT_SEED, metavar="SEED")
    parser.add_argument("--judge-seed", type=int, default=JUDGE_SEED, metavar="SEED")
    parser.add_argument("--plant", action="append", metavar="NAME", help="only this plant")


def run(options: argparse.Namespace) -> Report:
    sizes = FEW if options.quick else FULL
    plants = [plant for plant in the_four()[1:] if not options.plant or plant.name in options.plant]
    rows = [row for plant in plants for row in rows_of(plant, sizes, options.fit_seed, options.judge_seed)]
    table, reached = table_of(rows)
    seeds = {"fit": options.fit_seed, "judged": options.judge_seed}
    return Report([table], seeds, values=rows, reached=reached)
