"""A joint with section `fused` and a small random network for it, for tests that need the method and not a good fit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from estimator.fused_network import FUSED_FEATURES
from estimator.fused_parameters import AdditiveLoss, Fused, FusedSigma, LossSide, Torsion
from estimator.fused_trust import Envelope
from estimator.parameters import Joint
from models.files import load_joint, shipped
from sysid.onnx_export import export_network

HIDDEN = (16, 16)
"""As `jtq train` makes them."""
_LOW = (-3.0, -60.0, -20.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0)


def fused_section() -> Fused:
    """Losses near those of joint 1, stiffness as in its file, kinematic error of the campaign's plant."""
    nodes = (-40.0, -24.0, -12.0, -4.0, 4.0, 12.0, 24.0, 40.0)
    side = LossSide(
        constant_nm=(7.0, 5.0, 3.6, 3.1, 3.1, 4.0, 6.0, 9.0),
        viscous_nms_per_rad=(2.0,) * 8,
        quadratic_nms2_per_rad2=(-0.1,) * 8,
        stribeck_nm=0.8,
    )
    loss = AdditiveLoss(
        load_nodes_nm=nodes,
        positive=side,
        negative=replace(side, stribeck_nm=0.7),
        stribeck_velocity_rad_s=0.05,
        velocity_max_rad_s=3.3,
        temperature_c=25.0,
        thermal_viscous_nms_per_rad=2.0,
        viscous_per_k=0.025,
    )
    torsion = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (3e-5, 1e-6), (2e-5, -1e-6))
    sigma = FusedSigma(0.4, 0.2, 0.03, 0.5, 0.01, 0.3)
    return Fused(loss, torsion, sigma)


def fused_joint(number: int = 1) -> Joint:
    """Joint 1 or 2 of the bench with that section."""
    return replace(load_joint(shipped(f"joint{number}.yaml")), fused=fused_section())


def fused_network(
    joint: str = "joint1", *, temperature_c: tuple[float, float] | None = (15.0, 45.0), seed: int = 1
) -> bytes:
    """An ONNX file: random weights, a correction of some tenths of Nm, known to 3.3 rad/s and 60 Nm."""
    rng = np.random.default_rng(seed)
    sizes = (len(FUSED_FEATURES), *HIDDEN, 1)
    layers = [(rng.normal(0.0, m**-0.5, (m, n)), rng.normal(0.0, 0.1, n)) for m, n in pairwise(sizes)]
    envelope = Envelope(0.25, 3.0, ((1,) * 41,) * 29, 20.0, temperature_c)
    metadata: dict[str, Any] = {
        "features": list(FUSED_FEATURES),
        "envelope": envelope.to_mapping(),
        "sigma_scale": [0.6, 0.6, 0.8, 0.8],
        "input_low": list(_LOW),
        "input_high": [-low for low in _LOW],
        "joint": joint,
        "data_sha256": "cd" * 32,
    }
    return export_network(layers, np.zeros(len(_LOW)), -np.array(_LOW), 0.0, 0.5, metadata)
