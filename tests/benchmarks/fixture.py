"""What all contenders are given: configuration, networks, and the scaling that a boot would have read from the devices.

The networks have the paper's size (6-20-40-10-1) and follow the efficiency torque: random hidden layers with a fixed
seed, the last layer fitted. What a cycle costs depends on the size and not on the weights, and these do not change when
the shipped ones do.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.network import FEATURES
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.train.network import Layer, Trained, export_network
from tests.benchmarks.traffic import SCALING, SENSOR_NM_PER_UNIT

_HIDDEN = (20, 40, 10)
ENVELOPE_LOW = np.array([-6.0, -250.0, -130.0, -2.5, -2.0, -40.0])
ENVELOPE_HIGH = np.array([6.0, 250.0, 130.0, 2.5, 2.0, 40.0])
SIGMA_NM = 0.6
_SEED = 20

Report = dict[str, Any]


@dataclass(frozen=True)
class Fixture:
    """Files of one benchmark run in `directory`."""

    directory: Path

    @property
    def config(self) -> Path:
        return self.directory / "bench.yaml"

    @property
    def report(self) -> Report:
        """Boot report: scaling of both drives and the sensor."""
        drive = {"scaling": SCALING}
        sensor = {"scaling": {"nm_per_unit": {"1": SENSOR_NM_PER_UNIT}}}
        return {"ok": True, "nodes": {"1": drive, "2": drive, "3": sensor}}


@dataclass(frozen=True)
class SmallNetwork:
    """Weights (W [inputs, outputs], b [outputs]) per layer; input and output are normalised as in sysid.train.network."""

    layers: tuple[Layer, ...]
    input_mean: FloatArray
    input_std: FloatArray
    output_mean: float
    output_std: float

    def onnx(self, joint: str) -> bytes:
        metadata = {
            "features": list(FEATURES),
            "envelope_low": list(ENVELOPE_LOW),
            "envelope_high": list(ENVELOPE_HIGH),
            "sigma_nm": SIGMA_NM,
            "joint": joint,
            "data_sha256": "0" * 64,
        }
        network = Trained(self.layers, self.input_mean, self.input_std, self.output_mean, self.output_std)
        return export_network(network, metadata)


def small_network(number: int) -> SmallNetwork:
    """The network of joint 1 or 2, always the same."""
    rng = np.random.default_rng(_SEED + number)
    sizes = (len(FEATURES), *_HIDDEN)
    layers: list[Layer] = []
    features = rng.uniform(-1.0, 1.0, (4000, len(FEATURES)))
    h = features
    for inputs, outputs in pairwise(sizes):
        w = rng.normal(0.0, 1.0 / np.sqrt(inputs), (inputs, outputs))
        b = rng.normal(0.0, 0.1, outputs)
        layers.append((np.asarray(w, np.float64), np.asarray(b, np.float64)))
        h = np.tanh(0.5 * (h @ w + b))
    target = features[:, -1] + 0.02 * np.sin(3.0 * features[:, 1])
    solution = np.linalg.lstsq(np.column_stack([h, np.ones(len(h))]), target, rcond=None)[0]
    layers.append((np.asarray(solution[:-1, None], np.float64), np.asarray(solution[-1:], np.float64)))
    return SmallNetwork(
        tuple(layers), (ENVELOPE_LOW + ENVELOPE_HIGH) / 2.0, (ENVELOPE_HIGH - ENVELOPE_LOW) / 2.0, 0.0, 40.0
    )


def make_fixture(directory: Path) -> Fixture:
    """Write configuration, networks and boot report into `directory`."""
    mapping = yaml.safe_load(shipped("bench.yaml").read_text(encoding="utf-8"))
    mapping["estimator"] |= {"method": "network", "shadow": []}
    for number in (1, 2):
        joint = mapping[f"joint_{number}"]
        joint["file"] = str(shipped(f"joint{number}.yaml"))  # the same whatever ships as trained
        file = directory / f"joint{number}.onnx"
        data = small_network(number).onnx(load_joint(joint["file"]).name)
        file.write_bytes(data)
        joint["network"] = {"file": str(file), "sha256": hashlib.sha256(data).hexdigest()}
    fixture = Fixture(directory)
    fixture.config.write_text(yaml.safe_dump(mapping), encoding="utf-8")
    return fixture
