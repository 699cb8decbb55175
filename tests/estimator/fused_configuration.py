"""Configurations of the daemon with method `fused`: joint files with that section, and random networks."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, shipped
from tests.estimator.fused_helpers import fused, fused_network


def joint_of(number: int) -> Joint:
    """Joint 1 or 2 of the bench with section `fused`."""
    return replace(load_joint(shipped(f"joint{number}.yaml")), fused=fused())


def network_of(number: int) -> bytes:
    """ONNX file of a random network of joint 1 or 2."""
    return fused_network(joint=f"joint{number}").data


def networks() -> dict[int, bytes]:
    """Of both joints."""
    return {number: network_of(number) for number in (1, 2)}


def configured(
    directory: Path, method: str, onnx: dict[int, bytes], *, without_fused: tuple[int, ...] = (), **joint: Any
) -> Path:
    """bench.yaml with this method, joint files with section `fused` and these networks; `joint` adds keys to both."""
    content = {
        **yaml.safe_load(shipped("bench.yaml").read_text()),
        "estimator": {"method": method, **({"track_torsion": True} if onnx and method == "fused" else {})},
    }
    for number in (1, 2):
        file = yaml.safe_load(shipped(f"joint{number}.yaml").read_text())
        file.pop("fused", None)
        if number not in without_fused:
            file["fused"] = fused().to_mapping()
        (directory / f"j{number}.yaml").write_text(yaml.safe_dump(file))
        section: dict[str, Any] = {"node": number, "file": f"j{number}.yaml", "sensor_channel": 1, **joint}
        if number in onnx:
            (directory / f"n{number}.onnx").write_bytes(onnx[number])
            sha256 = hashlib.sha256(onnx[number]).hexdigest()
            section["network"] = {"file": f"n{number}.onnx", "sha256": sha256}
        content[f"joint_{number}"] = section
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
