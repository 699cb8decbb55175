"""What is drawn around the hidden effect: two nominal joints, and what changes from run to run on any bench."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

VISCOUS_DRIFT: Final = 0.15  # half width, share of the viscous friction, each joint and run
SENSOR_ZERO_NM: Final = 0.3  # half width, each run
LINK_ZERO_RAD: Final = 10e-6  # half width, each joint and run


def draw_joint(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Return a joint file as a mapping: friction only, ranges of integrated harmonic-drive joints."""
    ratio = float(rng.integers(80, 161))
    reflected = rng.uniform(0.35, 1.1)  # rotor on the joint side, kg m2
    return {
        "name": f"drawn{number}",
        "gear_ratio": ratio,
        "torque_constant_nm_per_a": _rounded(rng.uniform(0.04, 0.12)),
        "rotor_inertia_kgm2": _rounded(reflected / ratio**2),
        "stiffness_nm_per_rad": _rounded(float(np.exp(rng.uniform(np.log(8e3), np.log(3e4))))),
        "damping_nms_per_rad": _rounded(rng.uniform(6.0, 14.0)),
        "link_inertia_kgm2": _rounded(rng.uniform(0.012, 0.04)),
        "rated_torque_nm": _rounded(rng.uniform(30.0, 90.0)),
        "friction": {
            "coulomb_nm": _rounded(rng.uniform(3.0, 6.0)),
            "viscous_nms_per_rad": _rounded(rng.uniform(2.0, 8.0)),
        },
    }


@dataclass(frozen=True)
class Drift:
    """Of one run: factor on viscous friction [2], zero of the sensor [Nm], zeros of the link encoders [2] [rad]."""

    viscous: np.ndarray
    sensor_nm: float
    link_rad: np.ndarray


def draw_drift(rng: np.random.Generator) -> Drift:
    """Return what one run has of its own."""
    return Drift(
        viscous=1.0 + VISCOUS_DRIFT * rng.uniform(-1.0, 1.0, 2),
        sensor_nm=SENSOR_ZERO_NM * float(rng.uniform(-1.0, 1.0)),
        link_rad=LINK_ZERO_RAD * rng.uniform(-1.0, 1.0, 2),
    )


def _rounded(x: float) -> float:
    return float(f"{x:.4g}")
