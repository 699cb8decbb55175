"""One drive in front of the cycle of its joint: frames of its TPDOs in, records out."""

from __future__ import annotations

import struct
from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core.input_pdos import JointInputs, drive_places, input_pdos
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import SCALE

MS = 1_000_000
NUMBER_OF = {
    "motor_position": lambda k: 400 * k - 2**31 + 5000,
    "link_position": lambda k: 40 * k,
    "motor_velocity": lambda k: -4000 - 7 * (k % 300),
    "current": lambda k: 100 - k % 97,
    "statusword": lambda k: 0x27,
}


def config_with(directory: Path, tpdos: Any, **more: Any) -> Config:
    content = yaml.safe_load(shipped("bench.yaml").read_text())
    content["estimator"] = {"method": "efficiency"}
    for number in (1, 2):
        content[f"joint_{number}"]["file"] = str(shipped(f"joint{number}.yaml"))
        content[f"joint_{number}"]["temperature"] = False
    content["joint_1"] |= {"tpdos": tpdos, **more}
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return load_config(path)


class OneDrive:
    """Drive 1 of a configuration in front of a joint's cycle."""

    def __init__(self, config: Config, number_of: Any = None) -> None:
        self.config, joint = config, config.joints[0]
        self.number_of = number_of or NUMBER_OF
        self.intake = Intake(input_pdos(config))
        self.intake.leave_out(2)
        self.intake.leave_out(3)
        inputs = JointInputs(drive_places(0, joint.tpdos, joint.objects), None, **SCALE)
        estimator = JointEstimator(load_joint(shipped("joint1.yaml")), EstimatorSettings(method="efficiency"))
        counts = SimpleNamespace(
            counters=array("Q", [0] * len(COUNTERS)), errors=array("d", [0.0] * 3 * cr.MOST_JOINTS)
        )
        self.cycle = JointCycle(0, inputs, estimator, intake=self.intake, snapshot=counts, period_ns=MS)

    def frames(self, k: int) -> list[bytes]:
        made = []
        for pdo in self.config.joints[0].tpdos:
            values = [self.number_of[name](k) if name else 0x55 for name in pdo.names]
            data = pdo.layout.pack(*values)
            made.append(struct.pack("<IB3x8s", pdo.cob_id, len(data), data))
        return made

    def step(self, k: int, missing: int | None = None) -> cr.JointRecord:
        """One cycle; `missing`: TPDO that does not come."""
        at = (k + 1) * MS
        self.intake.begin(k % 240 + 1)
        frames = [struct.pack("<IB3x8s", 0x80, 0, bytes([k % 240 + 1]))]
        frames += [frame for n, frame in enumerate(self.frames(k)) if n != missing]
        own = [True] + [False] * (len(frames) - 1)
        self.intake.take(b"".join(frames), [at + n for n in range(len(frames))], own, len(frames))
        self.intake.close()
        self.cycle.observe(at, False, True)
        return cr.JointRecord._make(self.cycle.sample)
