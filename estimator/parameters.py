"""Parameters of one joint as frozen values: what `joint.yaml` holds, checked on every way in.

Stiffness, damping, link inertia, friction: joint side. Torque constant, rotor inertia: motor side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, Final

from estimator.checked import ConfigError, Section
from estimator.effects.library import EFFECTS, checked_parameters, read_parameters
from estimator.fused_parameters import Fused

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
