"""What to expect of a joint, from its data sheet: error and interval on an emulated bench that has these values.

The bench is `typical` (or --plant) with the values of the data sheet in the place of its own; torques and inertias at the
joint stay. Both joints are identified from a campaign on it and judged on other days, against the true torque now.
Scales of encoders have noise of half a step beside their resolution; accuracy is the amplitude of an error once a turn.

python -m validation expect --link-bits 17 --stiffness 20000
python -m validation expect --link-bits 14 17 19 21          one row each
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import BoolArray
from jtqd.estimator.command_line import natural
from jtqd.estimator.fusion import GAUSS
from jtqd.models.files import load_joint
from jtqd.sysid.fit.joint_writer import write_joint
from validation.goals.goals import ONE, ZEROS, Figure, Judged, judge, ratio, root, share
from validation.goals.identify import (
    QUICK,
    SIDES,
    TINY,
    Mapped,
    PlantFile,
    Sizes,
    drive,
    fit_one_encoder,
    identify_physics,
    judging_runs,
    nominal_joints,
    of_sides,
    the_four,
)
from validation.study import Report, Table

FIT_SEED: Final = 4200
JUDGE_SEED: Final = 7361
SIZES: Final = {"usual": QUICK._replace(fit_runs=24, evaluations=60, judge_runs=16), "tiny": TINY}
TITLES: Final = {ZEROS: "both encoders", ONE: "one encoder"}


@dataclass(frozen=True)
class Sheet:
    """Values of a data sheet, None: those of the bench. Accuracies are of the angle of their own shaft."""

    link_bits: int | None = None
    motor_bits: int | None = None
    link_accuracy_rad: float | None = None
    motor_accuracy_rad: float | None = None
    current_noise_a: float | None = None
    stiffness_nm_per_rad: float | None = None
    ratio: float | None = None
    friction_nm: float | None = None

    def bench(self, plant: PlantFile, folder: Path) -> PlantFile:
        """Return the plant with these values; its joint files are written to a folder."""
        for side in SIDES:
            name = plant.mapping[side]["joint"]
            joint = load_joint(plant.directory / name)
            geared = 1.0 if self.ratio is None else self.ratio / joint.gear_ratio
            joint = replace(
                joint,
                gear_ratio=joint.gear_ratio * geared,
                torque_constant_nm_per_a=joint.torque_constant_nm_per_a / geared,
                rotor_inertia_kgm2=joint.rotor_inertia_kgm2 / geared**2,
                stiffness_nm_per_rad=self.stiffness_nm_per_rad or joint.stiffness_nm_per_rad,
            )
            write_joint(folder / Path(name).name, joint, "Joint of a data sheet")

        @of_sides
        def change(side: Mapped) -> None:
            old = load_joint(plant.directory / side["joint"]).gear_ratio
            side["joint"] = Path(side["joint"]).name
            self._change(side, 1.0 if self.ratio is None else self.ratio / old)

        return plant.changed(change)._replace(directory=folder)

    def _change(self, side: Mapped, geared: float) -> None:
        """Change a side of a bench file; geared: ratio in parts of the bench's."""
        measurement, gear, friction, motor = (
            side[key] for key in ("measurement", "gear", "friction", "motor")
        )
        for bits, shaft in ((self.link_bits, "link"), (self.motor_bits, "motor")):
            if bits is not None:
                measurement[f"{shaft}_counts_per_rev"] = 1 << bits
        if self.link_bits is not None:
            measurement["link_noise_rad"] = math.pi / (1 << self.link_bits)
        for accuracy, shaft in ((self.link_accuracy_rad, "link"), (self.motor_accuracy_rad, "motor")):
            if accuracy is not None:
                _scale(measurement[f"{shaft}_errors"], accuracy)
        if self.current_noise_a is not None:
            measurement["current_noise_a"] = self.current_noise_a
        if self.stiffness_nm_per_rad is not None:
            first, *_ = values = gear["stiffness_nm_per_rad"]
            gear["stiffness_nm_per_rad"] = [self.stiffness_nm_per_rad * each / first for each in values]
        if self.friction_nm is not None:
            more = self.friction_nm / friction["coulomb_nm"]
            for key in ("coulomb_nm", "viscous_nm", "load_nm"):
                friction[key] *= more
        motor["torque_constant_nm_per_a"] /= geared
        motor["rotor_inertia_kgm2"] /= geared**2
        for wave in motor["cogging"]:
            wave["amplitude_nm"] /= geared


def _scale(waves: Sequence[dict[str, float]], largest: float) -> None:
    """Scale errors of a turn so that their first one, of order 1, has this amplitude."""
    factor = largest / waves[0]["amplitude_rad"]
    for wave in waves:
        wave["amplitude_rad"] *= factor


@dataclass(frozen=True)
class Expected:
    """By method: RMSE in motion [Nm], half width of the 90 % interval [Nm], share inside [%]; rated torque [Nm]."""

    sheet: Sheet
    rmse_nm: Mapping[str, Figure]
    half_nm: Mapping[str, float]
    inside: Mapping[str, Figure]
    rated_nm: float


def expected(plant: PlantFile, sheet: Sheet, sizes: Sizes, fit_seed: int, seed: int) -> Expected:
    """Identify and judge a bench with the values of a data sheet. Raises as `identify_physics`."""
    with tempfile.TemporaryDirectory() as folder:
        bench = sheet.bench(plant, Path(folder))
        joints = nominal_joints(bench)
        models, runs = identify_physics(bench, sizes, fit_seed)
        models = tuple(
            replace(one, one_encoder=fit_one_encoder(one.joint, one.number, runs)) for one in models
        )
        days = drive(bench.bench(), judging_runs(sizes, joints, seed), seed)
    judged = [judge(day, one, None, (ZEROS, ONE)) for day in days for one in models]

    def square(one: Judged, name: str) -> tuple[str, float, float]:
        error = (one.results[name].torque_nm - one.true_nm)[one.moving]
        return one.run, float(error @ error), float(len(error))

    def half(name: str) -> float:
        widths = [_sigma(one, name)[one.moving] for one in judged]
        return GAUSS * float(np.mean(np.concatenate(widths)))

    def inside(one: Judged, name: str) -> tuple[str, BoolArray, BoolArray]:
        return one.run, one.results[name].inside(GAUSS), one.moving

    return Expected(
        sheet,
        {name: root(ratio(square(one, name) for one in judged)) for name in TITLES},
        {name: half(name) for name in TITLES},
        {name: share(inside(one, name) for one in judged) for name in TITLES},
        joints[0].rated_torque_nm,
    )


def _sigma(one: Judged, name: str) -> Any:
    sigma = one.results[name].sigma_nm
    assert sigma is not None
    return sigma


def table_of(rows: Sequence[Expected]) -> Table:
    """Return a row for each data sheet."""
    what = [f"{title}: RMSE, Nm (% of rated); 90 % interval +- Nm, holds %" for title in TITLES.values()]

    def cell(row: Expected, name: str) -> str:
        rmse = row.rmse_nm[name].value
        part = 100.0 * rmse / row.rated_nm
        return f"{rmse:.2f} ({part:.1f}); {row.half_nm[name]:.2f}, {row.inside[name].value:.0f}"

    def title(sheet: Sheet) -> str:
        given = {key: value for key, value in vars(sheet).items() if value is not None}
        return ", ".join(f"{key} {value:g}" for key, value in given.items()) or "the bench as it is"

    return Table(
        ("data sheet", *what), [(title(row.sheet), *(cell(row, name) for name in TITLES)) for row in rows]
    )


def options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--plant", default="typical", choices=["typical", "bad day"], help="bench (default %(default)s)")
    add(
        "--link-bits",
        type=natural,
        nargs="+",
        default=[None],
        metavar="N",
        help="of the link encoder; one row each",
    )
    add("--motor-bits", type=natural, metavar="N", help="of the motor encoder")
    add("--link-accuracy", type=float, metavar="ARCSEC", help="of the link encoder, amplitude once a turn")
    add("--motor-accuracy", type=float, metavar="ARCSEC", help="of the motor encoder, the same")
    add("--current-noise", type=float, metavar="A", help="standard deviation of a sample")
    add("--stiffness", type=float, metavar="NM_PER_RAD", help="at small torques (K1)")
    add("--ratio", type=float, metavar="G", help="gear ratio")
    add(
        "--friction",
        type=float,
        metavar="NM",
        help="Coulomb friction at the joint; all friction is scaled with it",
    )
    add("--sizes", choices=SIZES, default="usual", help=argparse.SUPPRESS)


def run(options: argparse.Namespace) -> Report:
    arcsec = math.pi / 180.0 / 3600.0
    accuracies = (options.link_accuracy, options.motor_accuracy)
    link, motor = (None if each is None else arcsec * each for each in accuracies)
    rest = (options.current_noise, options.stiffness, options.ratio, options.friction)
    sheets = [Sheet(bits, options.motor_bits, link, motor, *rest) for bits in options.link_bits]
    plant = next(each for each in the_four() if each.name == options.plant)
    rows = [expected(plant, sheet, SIZES[options.sizes], FIT_SEED, JUDGE_SEED) for sheet in sheets]
    return Report([table_of(rows)], {"campaign": FIT_SEED, "days": JUDGE_SEED}, values=rows)
