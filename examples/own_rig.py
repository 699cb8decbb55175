"""Somebody's test rig: a servo swings a known weight. Recorded in a layout of its own, with a joint file that is wrong.

    python -m examples.own_rig --out rig
    python -m examples.own_rig --out flat --upright       the axis upright: the weight swings level and pulls at nothing

writes rig/runs (six recordings) and rig/new (two more) as CSV, rig/columns.yaml, which maps their columns, and
rig/servo.yaml, the data sheet's joint file. The servo gives its duty and no current, there is no torque sensor, it has one
encoder, on the motor, and the recorder lost 0.4 s of one run. What the data sheet does not say is in `TRUE`,
and in rig/truth.txt; `Servo` is integrated here, with no law of this project.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import make_directory
from jtqd.estimator.errors import ConfigError

MASS_KG: Final = 1.2
LEVER_M: Final = 0.15
INERTIA_KGM2: Final = MASS_KG * LEVER_M**2 + 0.002
SUPPLY_V: Final = 12.0
STEP_S: Final = 2e-4
RATE_HZ: Final = 500.0
RUN_S: Final = 16.0
COUNTS: Final = 2**12
"""Per turn of the motor."""


@dataclass(frozen=True)
class Servo:
    """A geared DC motor, SI units; friction on the joint side."""

    gear_ratio: float = 150.0
    torque_constant: float = 0.0105
    resistance: float = 2.2
    rotor_inertia: float = 4e-7
    coulomb: float = 0.10
    viscous: float = 0.06


DATA_SHEET: Final = Servo()
TRUE: Final = replace(DATA_SHEET, coulomb=0.22, viscous=0.11)


def recorded(servo: Servo, seed: int, *, upright: bool = False) -> FloatArray:
    """Return one run as recorded [n, 4]: time [ms], angle [counts], duty [-1000..1000], temperature of the board [degC]."""
    weight = 0.0 if upright else MASS_KG * 9.80665 * LEVER_M
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.2, 0.55, 3)
    rates = np.array([0.5, 1.1, 1.9]) * rng.uniform(0.8, 1.25, 3)
    phases = rng.uniform(0.0, 2.0 * math.pi, 3)
    g, kt = servo.gear_ratio, servo.torque_constant
    inertia = INERTIA_KGM2 + g * g * servo.rotor_inertia
    waves = [(float(a), float(w), float(p)) for a, w, p in zip(sizes, rates, phases, strict=True)]
    q = v = 0.0
    rows: list[tuple[float, float, float, float]] = []
    every = round(1.0 / RATE_HZ / STEP_S)
    for k in range(round(RUN_S / STEP_S)):
        t = k * STEP_S
        start = min(t / 2.0, 1.0)
        wanted = start * sum(a * math.sin(w * t + p) for a, w, p in waves)
        duty = max(-1.0, min(1.0, 3.0 * (wanted - q) - 0.05 * v))
        duty = round(1000.0 * duty) / 1000.0
        current = (duty * SUPPLY_V - kt * g * v) / servo.resistance
        if k % every == 0:
            rows.append((1e3 * t, q, duty, 31.0 + 0.02 * t))
        push = g * kt * current - weight * math.sin(q) - servo.viscous * v
        free = v + STEP_S * push / inertia
        stop = STEP_S * servo.coulomb / inertia  # Coulomb friction stops and never turns round
        v = math.copysign(max(abs(free) - stop, 0.0), free)
        q += STEP_S * v
    table = np.array(rows)
    table[:, 1] = np.floor(table[:, 1] * servo.gear_ratio / (2.0 * math.pi) * COUNTS)
    table[:, 2] *= 1000.0
    return table


COLUMNS: Final = f"""\
# Column map of this rig: what the run table of jtqd wants, from what the recorder has (docs/your_data.md).
time_s: "0.001 * `t [ms]`"
j1.motor_position_rad: "rev2rad(counts / {COUNTS})"
j1.link_position_rad: "rev2rad(counts / {COUNTS}) / {DATA_SHEET.gear_ratio:g}"   # one encoder
j1.drive: {{voltage_v: "{SUPPLY_V:g} * duty / 1000", resistance_ohm: {DATA_SHEET.resistance:g}, \
back_emf_vs_per_rad: {DATA_SHEET.torque_constant:g}}}
"""
LOAD: Final = f"j1.load: {{mass_kg: {MASS_KG:g}, lever_m: {LEVER_M:g}, inertia_kgm2: {INERTIA_KGM2:.4g}}}\n"
LEVEL: Final = f"j1.load: {{inertia_kgm2: {INERTIA_KGM2:.4g}}}   # no torque acts but the joint's own\n"

JOINT: Final = f"""\
# From the data sheet of the servo.
name: servo
gear_ratio: {DATA_SHEET.gear_ratio:g}
torque_constant_nm_per_a: {DATA_SHEET.torque_constant:g}
rotor_inertia_kgm2: {DATA_SHEET.rotor_inertia:.1e}
stiffness_nm_per_rad: 2000.0   # not used: one encoder
damping_nms_per_rad: 0.5
link_inertia_kgm2: 0.0         # the load has all of it
rated_torque_nm: 4.0
friction: {{coulomb_nm: {DATA_SHEET.coulomb:g}, viscous_nms_per_rad: {DATA_SHEET.viscous:g}}}
motion_limits: {{travel_rad: [-1.2, 1.2], velocity_rad_s: 2.0, torque_nm: 3.0}}
"""


def main(argv: list[str] | None = None) -> int:
    """Write recordings, column map and joint file."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.own_rig", description="Record a made-up test rig in a layout of its own."
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of the recordings")
    parser.add_argument("--upright", action="store_true", help="axis upright: no torque of the weight")
    options = parser.parse_args(argv)
    out: Path = options.out
    try:
        make_directory(out)
    except ConfigError as error:
        print(f"own_rig: {error}", file=sys.stderr)
        return 1
    for folder, seeds in (("runs", range(1, 7)), ("new", range(7, 9))):
        (out / folder).mkdir(exist_ok=True)
        for seed in seeds:
            table = recorded(TRUE, seed, upright=options.upright)
            if seed == 3:
                table = table[(table[:, 0] < 9000.0) | (table[:, 0] > 9400.0)]
            lines = ["t [ms],counts,duty,board [C]"]
            lines += [f"{t:.1f},{q:.0f},{duty:.0f},{board:.1f}" for t, q, duty, board in table]
            (out / folder / f"swing_{seed}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "columns.yaml").write_text(COLUMNS + (LEVEL if options.upright else LOAD), encoding="utf-8")
    (out / "servo.yaml").write_text(JOINT, encoding="utf-8")
    (out / "truth.txt").write_text(f"{TRUE}\ndata sheet: {DATA_SHEET}\n", encoding="utf-8")
    print(f"wrote {out}: 6 runs, 2 new ones, columns.yaml, servo.yaml")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
