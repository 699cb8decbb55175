"""Parameters of the fused estimator: section `fused` of a joint file, fitted by `jtq fit losses`.

All torques are joint side. `load` is the motor's torque seen from the joint and along the motion,
x = sign(v) G Kt i_eff: positive when driving, negative when back-driven.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Final

from estimator.checked import ConfigError, Section

MAX_NODES: Final = 64


def _numbers(section: Section, key: str, unit: str, least: int, most: int) -> tuple[float, ...]:
    """Return a list of `least` to `most` finite numbers."""
    count = str(least) if least == most else f"{least} to {most}"
    expected = f"a list of {count} finite numbers in {unit}"
    values = section.raw(key)
    if not isinstance(values, list) or not all(_finite(value) for value in values):
        raise section.error(key, values, expected)
    if not least <= len(values) <= most:
        raise section.error(key, f"{len(values)} numbers", expected)
    return tuple(float(value) for value in values)


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _rising(values: tuple[float, ...]) -> bool:
    return all(a < b for a, b in pairwise(values))


@dataclass(frozen=True, slots=True)
class LossSide:
    """Loss while turning one way, per load node: constant + viscous |v| + quadratic v^2 [Nm], and a Stribeck peak."""

    constant_nm: tuple[float, ...]
    viscous_nms_per_rad: tuple[float, ...]
    quadratic_nms2_per_rad2: tuple[float, ...]
    stribeck_nm: float

    @classmethod
    def from_section(cls, section: Section, nodes: int) -> LossSide:
        """Read the mapping `positive` or `negative` of `fused.loss`; `nodes`: length of its lists."""
        side = cls(
            constant_nm=_numbers(section, "constant_nm", "Nm", nodes, nodes),
            viscous_nms_per_rad=_numbers(section, "viscous_nms_per_rad", "Nms/rad", nodes, nodes),
            quadratic_nms2_per_rad2=_numbers(section, "quadratic_nms2_per_rad2", "Nms2/rad2", nodes, nodes),
            stribeck_nm=section.number("stribeck_nm", "Nm"),
        )
        section.finish()
        return side


@dataclass(frozen=True, slots=True)
class AdditiveLoss:
    """Loss as a function of load, speed, direction and temperature; piecewise linear in load, quadratic in speed.

    load_nodes_nm: increasing, the lists of both sides as long as it (else ConfigError); velocity_max_rad_s:
    fastest measured, faster counts as this; temperature_c: of the fit; thermal_viscous_nms_per_rad: friction
    that falls as exp(-viscous_per_k (T - temperature_c)).
    """

    load_nodes_nm: tuple[float, ...]
    positive: LossSide
    negative: LossSide
    stribeck_velocity_rad_s: float
    velocity_max_rad_s: float
    temperature_c: float
    thermal_viscous_nms_per_rad: float
    viscous_per_k: float

    def __post_init__(self) -> None:
        nodes = self.load_nodes_nm
        if len(nodes) < 2 or not _rising(nodes):
            raise ConfigError(f"fused.loss.load_nodes_nm: found {nodes}, expected at least 2 rising numbers")
        for side in (self.positive, self.negative):
            lists = (side.constant_nm, side.viscous_nms_per_rad, side.quadratic_nms2_per_rad2)
            if any(len(values) != len(nodes) for values in lists):
                found = ", ".join(str(len(values)) for values in lists)
                raise ConfigError(
                    f"fused.loss: found lists of {found} numbers, expected {len(nodes)} as nodes"
                )

    @classmethod
    def from_section(cls, section: Section) -> AdditiveLoss:
        """Read the mapping `fused.loss`."""
        nodes = _numbers(section, "load_nodes_nm", "Nm", 2, MAX_NODES)
        if not _rising(nodes):
            raise section.error("load_nodes_nm", list(nodes), "rising numbers")
        loss = cls(
            load_nodes_nm=nodes,
            positive=LossSide.from_section(section.required("positive"), len(nodes)),
            negative=LossSide.from_section(section.required("negative"), len(nodes)),
            stribeck_velocity_rad_s=section.number("stribeck_velocity_rad_s", "rad/s", above=0.0),
            velocity_max_rad_s=section.number("velocity_max_rad_s", "rad/s", above=0.0),
            temperature_c=section.number("temperature_c", "degC", low=-60.0, high=200.0),
            thermal_viscous_nms_per_rad=section.number("thermal_viscous_nms_per_rad", "Nms/rad", low=0.0),
            viscous_per_k=section.number("viscous_per_k", "1/K", low=-0.1, high=0.1),
        )
        section.finish()
        return loss


@dataclass(frozen=True, slots=True)
class Torsion:
    """Torque from both encoders: tau = K d + K3 d^3 + D d' + H z, d = theta_m/G - theta_l - zero - kinematic error [rad].

    z follows d through a Maxwell-slip element, dz = dd/travel held in [-1, 1]: elastic hysteresis of half width H.
    Kinematic error: sum over orders n per motor revolution of c cos(n theta_m) + s sin(n theta_m).
    """

    stiffness_nm_per_rad: float
    cubic_nm_per_rad3: float
    zero_rad: float
    orders_per_motor_rev: tuple[float, ...]
    cos_rad: tuple[float, ...]
    sin_rad: tuple[float, ...]
    hysteresis_nm: float = 0.0
    hysteresis_travel_rad: float = 1e-4
    damping_nms_per_rad: float = 0.0

    @classmethod
    def from_section(cls, section: Section) -> Torsion:
        """Read the mapping `fused.torsion`."""
        orders = _numbers(section, "orders_per_motor_rev", "1/rev", 1, MAX_NODES)
        torsion = cls(
            stiffness_nm_per_rad=section.number("stiffness_nm_per_rad", "Nm/rad", above=0.0),
            cubic_nm_per_rad3=section.number("cubic_nm_per_rad3", "Nm/rad3"),
            zero_rad=section.number("zero_rad", "rad"),
            orders_per_motor_rev=orders,
            cos_rad=_numbers(section, "cos_rad", "rad", len(orders), len(orders)),
            sin_rad=_numbers(section, "sin_rad", "rad", len(orders), len(orders)),
            hysteresis_nm=section.number("hysteresis_nm", "Nm", low=0.0, default=0.0),
            hysteresis_travel_rad=section.number("hysteresis_travel_rad", "rad", above=0.0, default=1e-4),
            damping_nms_per_rad=section.number("damping_nms_per_rad", "Nms/rad", low=0.0, default=0.0),
        )
        section.finish()
        return torsion


_SIGMA_UNITS: Final = {
    "current_nm": "Nm",
    "viscous_nms_per_rad": "Nms/rad",
    "load": "1",
    "torsion_nm": "Nm",
    "torsion_load": "1",
    "reference_nm": "Nm",
}
_FLOORS: Final = ("current_nm", "torsion_nm")
"""Must be > 0: two paths that are both exact have no weights (0/0)."""


@dataclass(frozen=True, slots=True)
class FusedSigma:
    """Standard deviations of the two paths, found on runs that the fit had not seen.

    current path: current_nm, viscous_nms_per_rad |v|, load |tau_raw|, added as squares; torsion path:
    torsion_nm, torsion_load |tau|; reference_nm: of the torque sensor's zero from run to run, which every
    comparison contains. scale: factor per quadrant (QUADRANTS' order) so that the 90 % interval covers 90 %.
    current_nm, torsion_nm and scale must be > 0 (else ConfigError).
    """

    current_nm: float
    viscous_nms_per_rad: float
    load: float
    torsion_nm: float
    torsion_load: float
    reference_nm: float
    scale: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        for key in _FLOORS:
            if not getattr(self, key) > 0.0:
                raise ConfigError(f"fused.sigma.{key}: found {getattr(self, key)!r}, expected a number > 0")
        if not min(self.scale) > 0.0:
            raise ConfigError(f"fused.sigma.scale: found {self.scale}, expected numbers > 0")

    @classmethod
    def from_section(cls, section: Section) -> FusedSigma:
        """Read the mapping `fused.sigma`."""
        values = {
            key: section.number(key, unit, **({"above": 0.0} if key in _FLOORS else {"low": 0.0}))
            for key, unit in _SIGMA_UNITS.items()
        }
        a, b, c, d = _numbers(section, "scale", "1", 4, 4)
        if min(a, b, c, d) <= 0.0:
            raise section.error("scale", [a, b, c, d], "4 numbers > 0")
        section.finish()
        return cls(**values, scale=(a, b, c, d))


@dataclass(frozen=True, slots=True)
class Fused:
    """Section `fused` of a joint file; torsion None: a joint whose link encoder says nothing about torque."""

    loss: AdditiveLoss
    torsion: Torsion | None
    sigma: FusedSigma

    @classmethod
    def from_section(cls, section: Section) -> Fused:
        """Read the mapping `fused` of a joint file. Raises ConfigError."""
        torsion = section.section("torsion", optional=True)
        fused = cls(
            loss=AdditiveLoss.from_section(section.required("loss")),
            torsion=None if torsion is None else Torsion.from_section(torsion),
            sigma=FusedSigma.from_section(section.required("sigma")),
        )
        section.finish()
        return fused

    def to_mapping(self) -> dict[str, Any]:
        """Return plain dicts and lists; `from_section` of it gives an equal value."""
        return {
            f.name: _plain(getattr(self, f.name)) for f in fields(self) if getattr(self, f.name) is not None
        }


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    if hasattr(value, "__dataclass_fields__"):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    return value
