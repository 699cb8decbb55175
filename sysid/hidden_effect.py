"""Files of the hidden-effect run: the secret bench, jtqd's configurations, the plans. docs/diagnosis.md says what it is for.

The secret bench differs from the nominal joint files by one effect of joint 1 alone; noise, drives and the days
(`run_to_run`) are those of the campaign's bench. Its joints are otherwise what `jtq sim --plant` makes of their files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import yaml

from estimator.parameters import Effect, Joint
from models.files import load_joint, load_yaml, shipped
from sim_can.plant_parameters import plant_of_joint
from sysid.campaign.fourier_runs import variable_runs
from sysid.campaign.plan import DEFAULT_LIMITS, Plan
from sysid.joint_writer import write_joint

NUMBERS: Final = (1, 2)
SECRET_JOINT: Final = 1
_PLANT: Final = "campaign_plant.yaml"
_KT_LOW: Final = 0.94
_FRESH_SEED: Final = 1000
"""Added to the seed: no motion of the fresh runs is one of the diagnosed runs."""


def nominal_file(number: int) -> Path:
    """Joint file that campaign, diagnosis and jtqd begin with."""
    return shipped(f"joint{number}.yaml")


def secrets(joint: Joint) -> Mapping[str, Effect]:
    """Effects that can be hidden in `joint`, by name."""
    made = (
        Effect(
            "torque_constant", {"torque_constant_nm_per_a": _KT_LOW * joint.torque_constant_nm_per_a}
        ),  # 6 % low
        Effect("torque_ripple", {"amplitude_nm": 0.8, "order_per_motor_rev": 2.0, "phase_rad": 0.7}),
        Effect("kinematic_error", {"amplitude_rad": 1.0e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.9}),
    )
    return {effect.name: effect for effect in made}


NAMES: Final = ("torque_constant", "torque_ripple", "kinematic_error")


def write_secret(directory: Path, name: str) -> Path:
    """Write the plant file of the secret bench and its joint files; returns its path. Raises ConfigError, OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    mapping: dict[str, Any] = load_yaml(shipped(_PLANT))[0]
    for number in NUMBERS:
        joint = load_joint(nominal_file(number))
        effects = (secrets(joint)[name],) if number == SECRET_JOINT else ()
        file = f"joint{number}.yaml"
        write_joint(directory / file, replace(joint, effects=effects), "Joint of the secret bench.")
        own = plant_of_joint(joint).joints[0].deviations
        peak = {"torque_nm": own.stribeck_nm, "velocity_rad_s": own.stribeck_velocity_rad_s}
        part: dict[str, Any] = mapping[f"joint_{number}"]
        mapping[f"joint_{number}"] = {
            "joint": file,
            "deviations": {"stribeck": peak},
            **{key: part[key] for key in ("drive", "measurement")},
        }
    path = directory / "plant.yaml"
    path.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    return path


def write_config(path: Path, joint_files: Mapping[int, Path], method: str) -> Path:
    """Write a configuration of jtqd for the bench: these joint files, this method, no network. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mapping: dict[str, Any] = load_yaml(shipped("bench.yaml"))[0]
    mapping["estimator"] = {**mapping["estimator"], "method": method}
    for number, file in joint_files.items():
        joint = mapping[f"joint_{number}"]
        joint["file"] = str(file.resolve())
        joint.pop("network", None)
    path.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
    return path


def plans(runs: int, fresh: int, seconds: float, seed: int) -> tuple[Plan, Plan]:
    """Plans of the runs to diagnose and of the fresh ones: drawn Fourier motions, none in both. Raises ConfigError."""
    joints = (load_joint(nominal_file(1)), load_joint(nominal_file(2)))
    limits = DEFAULT_LIMITS
    return (
        Plan("hidden effect", limits, variable_runs(limits, runs, seconds, seed=seed, joints=joints)),
        Plan(
            "hidden effect fresh",
            limits,
            variable_runs(limits, fresh, seconds, seed=seed + _FRESH_SEED, joints=joints),
        ),
    )
