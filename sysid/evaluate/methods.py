"""The methods that are compared, and the directory of models they come from.

DIR holds jointN.yaml (joint file), jointN.onnx (the paper's network) and jointN.fused.onnx (ours). What is missing
leaves its methods out, by name.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from estimator.checked import ConfigError
from estimator.friction import FloatArray
from estimator.fused_run import ObservedRun, estimate_observed, observe_run
from estimator.methods import AnyNetwork, estimate_columns, load_network
from estimator.parameters import Joint
from estimator.run import JointColumns
from estimator.settings import EstimatorSettings
from estimator.whole_run import EstimateRun
from models.files import load_joint
from sysid.evaluate.provenance import TrainingRuns, joint_training_runs, network_training_runs

TITLES: Final = MappingProxyType(
    {
        "tob": "classical TOB",
        "efficiency": "TOB with efficiency",
        "network": "the paper's chain",
        "physics": "our physics",
        "fused": "ours",
    }
)
"""Methods in the order of every table. `physics` is `fused` without its network; the others are jtqd's own names."""

OURS: Final = "fused"
PAPERS: Final = "network"


@dataclass(frozen=True)
class JointModels:
    """Everything that estimates one joint.

    number: of the joint in the runs; networks: by method; methods: those that can be run, in TITLES' order; missing:
    the others, with the reason; training: runs that anything here was fitted to; files: name to SHA-256.
    """

    number: int
    joint: Joint
    networks: Mapping[str, AnyNetwork]
    methods: tuple[str, ...]
    missing: Mapping[str, str]
    training: TrainingRuns
    files: Mapping[str, str]

    def estimate(
        self, time_s: FloatArray, columns: JointColumns
    ) -> tuple[Mapping[str, EstimateRun], ObservedRun]:
        """Return every method's estimates of a run and what the observer saw; ConfigError, ValueError as the estimators."""
        runs = {}
        for method in self.methods:
            if method not in ("physics", OURS):
                settings = EstimatorSettings(method=method)
                runs[method] = estimate_columns(
                    self.joint, settings, self.networks.get(method), time_s, columns
                )
        settings = EstimatorSettings(method=OURS)
        torsion = None if self.joint.fused is None else self.joint.fused.torsion
        dt = np.diff(time_s, prepend=time_s[0])
        current, motor, velocity, link = (getattr(columns, name) for name in _INPUTS)
        seen = observe_run(
            self.joint, settings, torsion, dt, current, motor, velocity, link, columns.temperature_c
        )
        for method in ("physics", OURS):  # one observer serves both
            if method in self.methods:
                network = self.networks.get(method)
                runs[method] = estimate_observed(self.joint, settings, network, seen)  # type: ignore[arg-type]
        return runs, seen


_INPUTS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")


def load_models(directory: Path, numbers: Sequence[int] = ()) -> tuple[JointModels, ...]:
    """Return the models of the joints `numbers`, or of every jointN.yaml there is.

    Raises:
        ConfigError: the directory or a joint file is missing or wrong, or a network is of another joint.
        NetworkError: a network file cannot be used.
    """
    if not directory.is_dir():
        raise ConfigError(
            f"--models {directory}: found no directory, expected one with joint1.yaml, joint1.onnx, ..."
        )
    there = sorted(
        int(match.group(1))
        for path in directory.iterdir()
        if (match := re.fullmatch(r"joint(\d)\.yaml", path.name))
    )
    absent = [number for number in numbers if number not in there]
    if absent or not there:
        wanted = " and ".join(f"joint{number}.yaml" for number in absent) or "joint1.yaml"
        have = ", ".join(f"joint{number}.yaml" for number in there) or "no joint file"
        raise ConfigError(f"--models {directory}: found {have}, expected {wanted}")
    return tuple(_joint_models(directory, number) for number in (sorted(set(numbers)) or there))


def _joint_models(directory: Path, number: int) -> JointModels:
    path = directory / f"joint{number}.yaml"
    joint = load_joint(path)
    files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}
    training = joint_training_runs(path.name, joint)
    networks: dict[str, AnyNetwork] = {}
    missing: dict[str, str] = {}
    for method, name in ((PAPERS, f"joint{number}.onnx"), (OURS, f"joint{number}.fused.onnx")):
        source = directory / name
        if not source.exists():
            missing[method] = f"no {name} in {directory}"
            continue
        network = load_network(method, str(source))
        if network.joint != joint.name:
            raise ConfigError(
                f"{source}: found a network of joint '{network.joint}', expected one of '{joint.name}'"
            )
        networks[method] = network
        files[name] = network.sha256
        training = training.and_those_of(network_training_runs(source))
    if joint.efficiency is None:
        reason = f"{path.name} has no efficiency"
        missing |= {"efficiency": reason, PAPERS: reason}
    if joint.fused is None:
        reason = f"{path.name} has no section fused (jtq fit losses)"
        missing |= {"physics": reason, OURS: reason}
    methods = tuple(method for method in TITLES if method not in missing)
    ordered = {method: missing[method] for method in TITLES if method in missing}
    return JointModels(number, joint, networks, methods, ordered, training, files)
