"""Every plant there is: by plant file or joint file (the simulation), or by bench file (laws of its own)."""

from __future__ import annotations

from pathlib import Path

from jtqd.models.files import load_joint, load_yaml
from jtqd.sim_can import plant_file
from jtqd.sim_can.towing import bench_file

AnyPlant = plant_file.PlantParameters | bench_file.TowingBench
AnyDay = plant_file.Day | bench_file.Day


def load_any_plant(path: Path) -> AnyPlant:
    """Read a bench file, known by its key `towing`, or what `plant_file.load_plant` reads.

    Joint files named in it are looked up beside it.

    Raises:
        ConfigError: unreadable file, unknown or missing key, value out of range; the message names file and key.
    """
    mapping = load_yaml(path)
    if bench_file.KEY not in mapping:
        return plant_file.load_plant(path)
    return bench_file.bench_from_mapping(mapping, str(path), lambda name: load_joint(path.parent / name))
