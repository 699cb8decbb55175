"""Benches for the tests: one without waves, slips and noise, and the shipped ones."""

from dataclasses import replace
from pathlib import Path

import jtqd.models
from jtqd.sim_can.plant_source import load_any_plant
from jtqd.sim_can.towing.bench_file import DayWidths, TowedJoint, TowingBench
from jtqd.sim_can.towing.plant import TowingPlant

FOLDER = Path(jtqd.models.__file__).parent / "plants"


def shipped_bench(name: str) -> TowingBench:
    bench = load_any_plant(FOLDER / f"{name}.yaml")
    assert isinstance(bench, TowingBench)
    return bench


TYPICAL, BAD_DAY = shipped_bench("typical"), shipped_bench("bad_day")


def _plain(side: TowedJoint) -> TowedJoint:
    return replace(
        side,
        motor=replace(side.motor, cogging=(), saturation_share=0.0),
        friction=replace(side.friction, angle=()),
        gear=replace(side.gear, errors=(), slips=()),
        warmth=replace(side.warmth, grease_kelvin_per_w=0.0, housing_kelvin_per_w=0.0),
        measurement=replace(
            side.measurement,
            link_noise_rad=0.0,
            current_noise_a=0.0,
            motor_errors=(),
            link_errors=(),
            current_ripple=(),
        ),
    )


PLAIN = replace(
    TYPICAL,
    joints=tuple(_plain(side) for side in TYPICAL.joints),
    sensor=replace(TYPICAL.sensor, noise_nm=0.0),
    run_to_run=DayWidths(),
)


def plant_of(bench: TowingBench) -> TowingPlant:
    return TowingPlant(bench)
