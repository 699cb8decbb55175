"""One joint as MJCF and as URDF: rotor, friction, gear, spring; and what neither format has words for.

    armature       G^2 Jm                      rotor inertia seen from the joint
    frictionloss   Fc        damping  Fv       Coulomb and viscous friction, joint side
    gear           G Kt                        torque per ampere: ctrl is the motor's current [A]
    stiffness      K         damping  D        of the gear, in a joint of its own (flexible)

The effects of the file that stand for one of these values are in it. Losses that depend on the load (an efficiency) become
the straight line through them at no load, and Stribeck friction is left out: both are told. Attributes as in MuJoCo's XML
reference; URDF's <dynamics> has damping and friction only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.base_loss import BaseLoss
from jtqd.sysid.diagnosis.diagnose import with_effects_applied

_SPEEDS_RAD_S: Final = np.linspace(0.05, 2.0, 200)
"""Over which losses of an efficiency are made a straight line."""
_LEAST_INERTIA_KGM2: Final = 1e-6
_LEAST_MASS_KG: Final = 1e-3
"""MuJoCo has no body without mass; what really turns is the user's own body."""
_DIGITS: Final = 7
_STEP_S: Final = 1e-3
_STEP_SHARE: Final = 0.3
"""Of the spring's swing per radian; from 2 on a semi-implicit step grows."""


@dataclass(frozen=True)
class JointModel:
    """What other simulators can say of a joint, SI units, joint side; torque_per_ampere_nm: G Kt.

    left_out: what of the joint file they cannot, one line each.
    """

    name: str
    gear_ratio: float
    armature_kgm2: float
    frictionloss_nm: float
    damping_nms_per_rad: float
    torque_per_ampere_nm: float
    stiffness_nm_per_rad: float
    spring_damping_nms_per_rad: float
    link_inertia_kgm2: float
    rated_torque_nm: float
    travel_rad: tuple[float, float] | None
    velocity_rad_s: float | None
    left_out: tuple[str, ...]


def model_of(joint: Joint) -> JointModel:
    """Return the joint with its effects as far as other simulators go."""
    plain = with_effects_applied(joint)
    coulomb, viscous, left_out = _friction(plain)
    for effect in plain.effects:
        kind = EFFECTS[effect.name]
        whose = "of the measuring" if kind.group == "measurement" else f"of the {kind.group}"
        values = ", ".join(f"{name} {value:g}" for name, value in effect.parameters.items())
        left_out.append(f"{effect.name} ({whose}): {values}")
    limits = plain.motion_limits
    bounded = limits is not None and max(map(abs, limits.travel_rad)) < 1e6
    return JointModel(
        name=plain.name,
        gear_ratio=plain.gear_ratio,
        armature_kgm2=plain.gear_ratio**2 * plain.rotor_inertia_kgm2,
        frictionloss_nm=coulomb,
        damping_nms_per_rad=viscous,
        torque_per_ampere_nm=plain.gear_ratio * plain.torque_constant_nm_per_a,
        stiffness_nm_per_rad=plain.stiffness_nm_per_rad,
        spring_damping_nms_per_rad=plain.damping_nms_per_rad,
        link_inertia_kgm2=plain.link_inertia_kgm2,
        rated_torque_nm=plain.rated_torque_nm,
        travel_rad=limits.travel_rad if limits is not None and bounded else None,
        velocity_rad_s=limits.velocity_rad_s if limits is not None and limits.velocity_rad_s < 1e6 else None,
        left_out=tuple(left_out),
    )


def _friction(joint: Joint) -> tuple[float, float, list[str]]:
    """Return Coulomb and viscous friction at no load, and what they leave out."""
    friction = joint.friction
    if joint.efficiency is None:
        if friction.stribeck_nm == 0.0:
            return friction.coulomb_nm, friction.viscous_nms_per_rad, []
        peak = (
            f"friction.stribeck_nm {friction.stribeck_nm:g} below {friction.stribeck_velocity_rad_s:g} rad/s"
        )
        return friction.coulomb_nm, friction.viscous_nms_per_rad, [peak]
    v = _SPEEDS_RAD_S
    loss = BaseLoss(joint).loss(np.zeros_like(v), v)
    slope, level = np.polyfit(v, loss, 1)
    if slope < 0.0 or level < 0.0:  # a friction that pushes is none
        slope, level = (0.0, float(np.mean(loss))) if slope < 0.0 else (float(loss @ v / (v @ v)), 0.0)
    apart = float(np.sqrt(np.mean((loss - level - slope * v) ** 2)))
    told = (
        f"efficiency: losses that depend on the load; at no load the straight line leaves {apart:.2g} Nm rms"
    )
    return float(level), float(slope), [told]


def mjcf(model: JointModel, *, flexible: bool = False) -> str:
    """Return a MuJoCo model of the joint alone about a vertical axis; flexible: with a joint for the spring of the gear.

    Joint NAME carries rotor and friction; flexible, NAME_spring follows it, and the link's angle is the sum of both.
    Actuator NAME_current takes the motor's current [A].
    """
    root = ET.Element("mujoco", model=model.name)
    _comments(root, model)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=_number(_step_s(model, flexible)), integrator="implicitfast")
    world = ET.SubElement(root, "worldbody")
    rotor = {
        "name": model.name,
        "type": "hinge",
        "axis": "0 0 1",
        "armature": _number(model.armature_kgm2),
        "damping": _number(model.damping_nms_per_rad),
        "frictionloss": _number(model.frictionloss_nm),
    }
    if model.travel_rad is not None:
        rotor["range"] = " ".join(map(_number, model.travel_rad))
    if flexible:
        outer = _body(world, f"{model.name}_rotor", 0.0)
        ET.SubElement(outer, "joint", rotor)
        link = _body(outer, f"{model.name}_link", model.link_inertia_kgm2)
        spring = {
            "name": f"{model.name}_spring",
            "type": "hinge",
            "axis": "0 0 1",
            "stiffness": _number(model.stiffness_nm_per_rad),
            "damping": _number(model.spring_damping_nms_per_rad),
        }
        ET.SubElement(link, "joint", spring)
    else:
        link = _body(world, f"{model.name}_link", model.link_inertia_kgm2)
        ET.SubElement(link, "joint", rotor)
    actuator = ET.SubElement(root, "actuator")
    ET.SubElement(
        actuator,
        "motor",
        name=f"{model.name}_current",
        joint=model.name,
        gear=_number(model.torque_per_ampere_nm),
    )
    return _text(root)


def urdf(model: JointModel) -> str:
    """Return a URDF of the joint between two links, with <dynamics>, and a transmission with the gear ratio.

    URDF has no rotor inertia: it stands in a comment, and most importers take it as their own key.
    """
    root = ET.Element("robot", name=model.name)
    _comments(root, model)
    root.append(
        ET.Comment(
            f" rotor inertia seen from the joint: {_number(model.armature_kgm2)} kg m2; torque per ampere: "
            f"{_number(model.torque_per_ampere_nm)} Nm/A "
        )
    )
    ET.SubElement(root, "link", name="base")
    link = ET.SubElement(root, "link", name=f"{model.name}_link")
    inertial = ET.SubElement(link, "inertial")
    inertia = _number(max(model.link_inertia_kgm2, _LEAST_INERTIA_KGM2))
    ET.SubElement(inertial, "mass", value=_number(_LEAST_MASS_KG))
    ET.SubElement(inertial, "inertia", ixx=inertia, iyy=inertia, izz=inertia, ixy="0", ixz="0", iyz="0")
    joint = ET.SubElement(
        root, "joint", name=model.name, type="continuous" if model.travel_rad is None else "revolute"
    )
    ET.SubElement(joint, "parent", link="base")
    ET.SubElement(joint, "child", link=f"{model.name}_link")
    ET.SubElement(joint, "axis", xyz="0 0 1")
    limit = {"effort": _number(model.rated_torque_nm), "velocity": _number(model.velocity_rad_s or 100.0)}
    if model.travel_rad is not None:
        limit |= {"lower": _number(model.travel_rad[0]), "upper": _number(model.travel_rad[1])}
    ET.SubElement(joint, "limit", limit)
    ET.SubElement(
        joint,
        "dynamics",
        damping=_number(model.damping_nms_per_rad),
        friction=_number(model.frictionloss_nm),
    )
    transmission = ET.SubElement(root, "transmission", name=f"{model.name}_transmission")
    ET.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    ET.SubElement(transmission, "joint", name=model.name)
    motor = ET.SubElement(transmission, "actuator", name=f"{model.name}_motor")
    ET.SubElement(motor, "mechanicalReduction").text = _number(model.gear_ratio)
    return _text(root)


def _step_s(model: JointModel, flexible: bool) -> float:
    """Return a step in which the integration is stable: the spring swings with the link that the file has."""
    if not flexible:
        return _STEP_S
    rate = math.sqrt(model.stiffness_nm_per_rad / max(model.link_inertia_kgm2, _LEAST_INERTIA_KGM2))
    return min(_STEP_S, _STEP_SHARE / rate)


def _comments(root: ET.Element, model: JointModel) -> None:
    root.append(ET.Comment(" made by jtq export-model; SI units, joint side "))
    for line in model.left_out:
        root.append(ET.Comment(f" not in this model: {line.replace('--', '- -')} "))


def _body(parent: ET.Element, name: str, inertia_kgm2: float) -> ET.Element:
    body = ET.SubElement(parent, "body", name=name)
    inertia = _number(max(inertia_kgm2, _LEAST_INERTIA_KGM2))
    ET.SubElement(
        body, "inertial", pos="0 0 0", mass=_number(_LEAST_MASS_KG), diaginertia=" ".join([inertia] * 3)
    )
    return body


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _number(value: float) -> str:
    if not math.isfinite(value):
        raise ValueError(f"found {value}, expected a finite number")
    return f"{value:.{_DIGITS}g}"
