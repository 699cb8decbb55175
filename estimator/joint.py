"""Parameters of the fused estimator: section `fused` of a joint file, fitted by `jtq fit losses`.

All torques are joint side. `load` is the motor's torque seen from the joint and along the motion,
x = sign(v) G Kt i_eff: positive when driving, negative when back-driven.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Final

from jtqd.estimator.checked import ConfigError, Section
from jtqd.estimator.effects.library import EFFECTS, checked_parameters, read_parameters

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


# Parameters of one joint as frozen values: what `joint.yaml` holds, checked on every way in.
#
# Stiffness, damping, link inertia, friction: joint side. Torque constant, rotor inertia: motor side.


CONVENTIONS: Final = ("joint_over_motor", "motor_over_joint")
"""eta = tau_j/(G Kt i), as in the paper's Table I; or eta = G Kt i/tau_j, its Eq. (6)."""

QUADRANTS: Final = ("i_pos_w_pos", "i_neg_w_neg", "i_neg_w_pos", "i_pos_w_neg")
"""Order of Table I: two driving quadrants, then two back-driving quadrants."""

EFFECT_NAMES: Final = frozenset(EFFECTS)


def _require(name: str, value: object, low: float, exclusive: bool) -> None:
    sign = ">" if exclusive else ">="
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not good or not (value > low if exclusive else value >= low):  # type: ignore[operator]
        raise ConfigError(f"{name}: found {value!r}, expected a finite number {sign} {low:g}")


@dataclass(frozen=True, slots=True)
class Friction:
    """Additive joint-side friction: Coulomb + viscous + Stribeck; negative values raise ConfigError."""

    coulomb_nm: float
    viscous_nms_per_rad: float
    stribeck_nm: float = 0.0
    stribeck_velocity_rad_s: float = 0.05

    def __post_init__(self) -> None:
        _require("friction.coulomb_nm", self.coulomb_nm, 0.0, False)
        _require("friction.viscous_nms_per_rad", self.viscous_nms_per_rad, 0.0, False)
        _require("friction.stribeck_nm", self.stribeck_nm, 0.0, False)
        _require("friction.stribeck_velocity_rad_s", self.stribeck_velocity_rad_s, 0.0, True)

    @classmethod
    def from_section(cls, section: Section) -> Friction:
        """Read the mapping `friction` of a joint file."""
        friction = cls(
            coulomb_nm=section.number("coulomb_nm", "Nm", low=0.0),
            viscous_nms_per_rad=section.number("viscous_nms_per_rad", "Nms/rad", low=0.0),
            stribeck_nm=section.number("stribeck_nm", "Nm", low=0.0, default=0.0),
            stribeck_velocity_rad_s=section.number(
                "stribeck_velocity_rad_s", "rad/s", above=0.0, default=0.05
            ),
        )
        section.finish()
        return friction


@dataclass(frozen=True, slots=True)
class QuadrantPolynomial:
    """Eq. (8): eta = p00 + p10 i + p01 v + p20 i^2 + p11 i v + p02 v^2; signed i [A], v = omega_m/G."""

    p00: float
    p10: float
    p01: float
    p20: float
    p11: float
    p02: float
    rmse: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            _require(item.name, getattr(self, item.name), -math.inf, True)
        _require("rmse", self.rmse, 0.0, False)

    def value(self, current_a: float, velocity_rad_s: float) -> float:
        """Return the polynomial itself, unbounded."""
        i, v = current_a, velocity_rad_s
        return self.p00 + self.p10 * i + self.p01 * v + self.p20 * i * i + self.p11 * i * v + self.p02 * v * v

    @classmethod
    def from_section(cls, section: Section) -> QuadrantPolynomial:
        """Read one quadrant of the mapping `efficiency`."""
        values = {key: section.number(key) for key in ("p00", "p10", "p01", "p20", "p11", "p02")}
        polynomial = cls(**values, rmse=section.number("rmse", low=0.0, default=0.0))
        section.finish()
        return polynomial


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Four quadrants of Eq. (8) in a named convention (see CONVENTIONS)."""

    convention: str
    i_pos_w_pos: QuadrantPolynomial
    i_neg_w_neg: QuadrantPolynomial
    i_neg_w_pos: QuadrantPolynomial
    i_pos_w_neg: QuadrantPolynomial

    def __post_init__(self) -> None:
        if self.convention not in CONVENTIONS:
            raise ConfigError(
                f"efficiency.convention: found {self.convention!r}, expected one of {_CONVENTION_TEXT}"
            )

    @classmethod
    def from_section(cls, section: Section) -> Efficiency:
        """Read the mapping `efficiency`; without a convention its numbers mean nothing: an error."""
        if not section.has("convention"):
            key = f"{section.path}.convention"
            raise ConfigError(f"{section.where}: key '{key}': missing, expected one of {_CONVENTION_TEXT}")
        convention = section.raw("convention")
        if convention not in CONVENTIONS:
            raise section.error("convention", convention, f"one of {_CONVENTION_TEXT}")
        quadrants = {name: QuadrantPolynomial.from_section(section.required(name)) for name in QUADRANTS}
        section.finish()
        return cls(convention=convention, **quadrants)


_CONVENTION_TEXT: Final = (
    "'joint_over_motor' (eta = tau_j/(G Kt i), below 1 when driving: Table I) or "
    "'motor_over_joint' (eta = G Kt i/tau_j, above 1 when driving: Eq. 6)"
)


@dataclass(frozen=True, slots=True)
class Effect:
    """One term of the extended model: a name of the effect library and its parameters in SI units.

    Defaults are filled in. Raises ConfigError for an unknown name, an unknown, missing or implausible parameter.
    """

    name: str
    parameters: Mapping[str, float]

    def __post_init__(self) -> None:
        parameters = checked_parameters(self.name, self.parameters)
        object.__setattr__(self, "parameters", MappingProxyType(parameters))

    def __reduce__(self) -> tuple[type[Effect], tuple[str, dict[str, float]]]:
        """Copy and pickle through plain dicts: a mapping proxy can do neither."""
        return Effect, (self.name, dict(self.parameters))

    @classmethod
    def from_section(cls, section: Section) -> Effect:
        """Read one entry of the list `effects`."""
        name = section.text("name", choices=sorted(EFFECT_NAMES))
        inner = section.section("parameters", optional=True)
        if inner is None:
            inner = Section({}, section.where, f"{section.path}.parameters")
        section.finish()
        return cls(name, read_parameters(name, inner))


# key -> unit, lower limit, whether the limit itself is excluded
_JOINT_NUMBERS: Final = {
    "gear_ratio": ("", 0.0, True),
    "torque_constant_nm_per_a": ("Nm/A", 0.0, True),
    "rotor_inertia_kgm2": ("kg m2", 0.0, True),
    "stiffness_nm_per_rad": ("Nm/rad", 0.0, True),
    "damping_nms_per_rad": ("Nms/rad", 0.0, False),
    "link_inertia_kgm2": ("kg m2", 0.0, False),
    "rated_torque_nm": ("Nm", 0.0, True),
}


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint: `joint.yaml` as values. Numbers out of range raise ConfigError (replace() too).

    `effects` add to what the other sections say; an effect that replaces one of their values may be there once.
    """

    name: str
    gear_ratio: float
    torque_constant_nm_per_a: float
    rotor_inertia_kgm2: float
    stiffness_nm_per_rad: float
    damping_nms_per_rad: float
    link_inertia_kgm2: float
    rated_torque_nm: float
    friction: Friction
    efficiency: Efficiency | None = None
    fused: Fused | None = None
    effects: tuple[Effect, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, (_, low, exclusive) in _JOINT_NUMBERS.items():
            _require(f"joint {self.name}: {key}", getattr(self, key), low, exclusive)
        object.__setattr__(self, "effects", tuple(self.effects))
        self._check_effects()
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))

    def __reduce__(self) -> tuple[type[Joint], tuple[Any, ...]]:
        """Copy and pickle through plain dicts: a mapping proxy can do neither."""
        return Joint, tuple(
            dict(self.provenance) if item.name == "provenance" else getattr(self, item.name)
            for item in fields(self)
        )

    def _check_effects(self) -> None:
        """Refuse two right values for one key."""
        seen: set[str] = set()
        for effect in self.effects:
            if any(p.key for p in EFFECTS[effect.name].parameters):
                if effect.name in seen:
                    raise ConfigError(
                        f"joint {self.name}: effects: found {effect.name!r} twice, expected once"
                    )
                seen.add(effect.name)

    @classmethod
    def from_mapping(cls, mapping: object, where: str) -> Joint:
        """Build from what a YAML parser gave; `where` names the file in messages. Raises ConfigError."""
        section = Section(mapping, where)
        name = section.text("name")
        numbers = {
            key: section.number(key, unit, **({"above": low} if exclusive else {"low": low}))
            for key, (unit, low, exclusive) in _JOINT_NUMBERS.items()
        }
        friction = Friction.from_section(section.required("friction"))
        inner = section.section("efficiency", optional=True)
        efficiency = None if inner is None else Efficiency.from_section(inner)
        inner = section.section("fused", optional=True)
        fused = None if inner is None else Fused.from_section(inner)
        effects = tuple(Effect.from_section(item) for item in section.sections("effects"))
        provenance = section.raw("provenance", None)
        if provenance is not None and not isinstance(provenance, Mapping):
            raise section.error("provenance", provenance, "a mapping of keys to values")
        section.finish()
        return cls(
            name=name,
            friction=friction,
            efficiency=efficiency,
            fused=fused,
            effects=effects,
            provenance=provenance or {},
            **numbers,
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return plain dicts and lists in file order; `from_mapping` of it gives an equal joint."""
        out: dict[str, Any] = {"name": self.name} | {key: getattr(self, key) for key in _JOINT_NUMBERS}
        out["friction"] = {f.name: getattr(self.friction, f.name) for f in fields(self.friction)}
        if self.efficiency is not None:
            out["efficiency"] = {"convention": self.efficiency.convention} | {
                name: {
                    f.name: getattr(getattr(self.efficiency, name), f.name)
                    for f in fields(QuadrantPolynomial)
                }
                for name in QUADRANTS
            }
        if self.fused is not None:
            out["fused"] = self.fused.to_mapping()
        out["effects"] = [{"name": e.name, "parameters": dict(e.parameters)} for e in self.effects]
        out["provenance"] = dict(self.provenance)
        return out
