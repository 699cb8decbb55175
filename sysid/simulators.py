"""`jtq export-model`: one joint with its effects as MJCF (MuJoCo) or URDF: rotor, friction, gear, spring.

    armature       G^2 Jm                      rotor inertia seen from the joint
    frictionloss   Fc        damping  Fv       Coulomb and viscous friction, joint side
    gear           G Kt                        torque per ampere: ctrl is the motor's current [A]
    stiffness      K         damping  D        of the gear, in a joint of its own (flexible)

Effects that stand for one of these values are included. Losses that depend on the load (an efficiency) become the straight
line through them at no load, and Stribeck friction is left out; what the format cannot express is listed on stderr and in
the file. Attributes as in MuJoCo's XML reference; URDF's <dynamics> has damping and friction only.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from jtqd.estimator.command_line import check_output, command_parser
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint

BY: Final = "jtq export-model"
_SPEEDS_RAD_S: Final = np.linspace(0.05, 2.0, 200)
"""For the straight line through the losses of an efficiency."""
_UNLIMITED: Final = 1e6
_LEAST_INERTIA_KGM2: Final = 1e-6
_LEAST_MASS_KG: Final = 1e-3
"""MuJoCo has no body without mass; the load is the user's own body."""
_DIGITS: Final = 7
_STEP_S: Final = 1e-3
_STEP_SHARE: Final = 0.3
"""Of the spring's period per radian; from 2 on a semi-implicit step is unstable."""


@dataclass(frozen=True)
class JointModel:
    """A joint as other simulators can express it, joint side.

    joint: with the effects applied that stand for a value of the file; frictionloss_nm, damping_nms_per_rad: friction at no
    load. left_out: what of the joint file they cannot express, one line each.
    """

    joint: Joint
    frictionloss_nm: float
    damping_nms_per_rad: float
    left_out: tuple[str, ...]

    @property
    def armature_kgm2(self) -> float:
        """Rotor inertia seen from the joint."""
        return self.joint.gear_ratio**2 * self.joint.rotor_inertia_kgm2

    @property
    def torque_per_ampere_nm(self) -> float:
        """G Kt."""
        return self.joint.gear_ratio * self.joint.torque_constant_nm_per_a

    @property
    def travel_rad(self) -> tuple[float, float] | None:
        """Lowest and highest position; None: not limited."""
        limits = self.joint.motion_limits
        bounded = limits is not None and max(map(abs, limits.travel_rad)) < _UNLIMITED
        return limits.travel_rad if limits is not None and bounded else None


def model_of(joint: Joint) -> JointModel:
    """Return the joint with its effects as far as other simulators can express it."""
    plain = with_effects_applied(joint)
    coulomb, viscous, left_out = _friction(plain)
    for effect in plain.effects:
        kind = EFFECTS[effect.name]
        whose = "of the measuring" if kind.group == "measurement" else f"of the {kind.group}"
        values = ", ".join(f"{name} {value:g}" for name, value in effect.parameters.items())
        left_out.append(f"{effect.name} ({whose}): {values}")
    return JointModel(plain, coulomb, viscous, tuple(left_out))


def _friction(joint: Joint) -> tuple[float, float, list[str]]:
    """Return Coulomb and viscous friction at no load, and what they leave out."""
    friction = joint.friction
    if joint.efficiency is None:
        peak = (
            f"friction.stribeck_nm {friction.stribeck_nm:g} below {friction.stribeck_velocity_rad_s:g} rad/s"
        )
        left_out = [peak] if friction.stribeck_nm else []
        return friction.coulomb_nm, friction.viscous_nms_per_rad, left_out
    from jtqd.sysid.diagnosis.signals import BaseLoss

    v = _SPEEDS_RAD_S
    loss = BaseLoss(joint).loss(np.zeros_like(v), v)
    slope, level = np.polyfit(v, loss, 1)
    if slope < 0.0 or level < 0.0:  # friction does not push
        slope, level = (0.0, float(np.mean(loss))) if slope < 0.0 else (float(loss @ v / (v @ v)), 0.0)
    rms = float(np.sqrt(np.mean((loss - level - slope * v) ** 2)))
    text = f"efficiency: losses that depend on the load; at no load the straight line leaves {rms:.2g} Nm rms"
    return float(level), float(slope), [text]


def mjcf(model: JointModel, *, flexible: bool = False) -> str:
    """Return a MuJoCo model of the joint alone about a vertical axis; flexible: with a joint for the spring of the gear.

    Joint NAME carries rotor and friction; flexible, NAME_spring follows it, and the link's angle is the sum of both.
    Actuator NAME_current takes the motor's current [A].
    """
    joint, name = model.joint, model.joint.name
    root = ET.Element("mujoco", model=name)
    _comments(root, model)
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=_number(_step_s(joint, flexible)), integrator="implicitfast")
    world = ET.SubElement(root, "worldbody")
    rotor = {
        "name": name,
        "type": "hinge",
        "axis": "0 0 1",
        "armature": _number(model.armature_kgm2),
        "damping": _number(model.damping_nms_per_rad),
        "frictionloss": _number(model.frictionloss_nm),
    }
    if model.travel_rad is not None:
        rotor["range"] = " ".join(map(_number, model.travel_rad))
    body = _body(world, f"{name}_rotor", 0.0) if flexible else world
    if flexible:
        ET.SubElement(body, "joint", rotor)
    link = _body(body, f"{name}_link", joint.link_inertia_kgm2)
    if flexible:
        elastic = {"stiffness": joint.stiffness_nm_per_rad, "damping": joint.damping_nms_per_rad}
        rotor = {"name": f"{name}_spring", "type": "hinge", "axis": "0 0 1"}  # in its place the spring
        rotor |= {key: _number(value) for key, value in elastic.items()}
    ET.SubElement(link, "joint", rotor)
    gear = _number(model.torque_per_ampere_nm)
    ET.SubElement(ET.SubElement(root, "actuator"), "motor", name=f"{name}_current", joint=name, gear=gear)
    return _text(root)


def urdf(model: JointModel) -> str:
    """Return a URDF of the joint between two links, with <dynamics>, and a transmission with the gear ratio.

    URDF has no rotor inertia: it stands in a comment, and most importers take it as their own key.
    """
    joint, name = model.joint, model.joint.name
    root = ET.Element("robot", name=name)
    _comments(root, model)
    root.append(
        ET.Comment(
            f" rotor inertia seen from the joint: {_number(model.armature_kgm2)} kg m2; torque per ampere: "
            f"{_number(model.torque_per_ampere_nm)} Nm/A "
        )
    )
    ET.SubElement(root, "link", name="base")
    inertial = ET.SubElement(ET.SubElement(root, "link", name=f"{name}_link"), "inertial")
    inertia = _number(max(_LEAST_INERTIA_KGM2, joint.link_inertia_kgm2))
    ET.SubElement(inertial, "mass", value=_number(_LEAST_MASS_KG))
    ET.SubElement(inertial, "inertia", ixx=inertia, iyy=inertia, izz=inertia, ixy="0", ixz="0", iyz="0")
    kind = "continuous" if model.travel_rad is None else "revolute"
    hinge = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(hinge, "parent", link="base")
    ET.SubElement(hinge, "child", link=f"{name}_link")
    ET.SubElement(hinge, "axis", xyz="0 0 1")
    limits = joint.motion_limits
    bounded = limits is not None and limits.velocity_rad_s < _UNLIMITED
    velocity = limits.velocity_rad_s if limits is not None and bounded else 100.0
    limit = {"effort": _number(joint.rated_torque_nm), "velocity": _number(velocity)}
    if model.travel_rad is not None:
        limit |= {"lower": _number(model.travel_rad[0]), "upper": _number(model.travel_rad[1])}
    ET.SubElement(hinge, "limit", limit)
    dynamics = {
        "damping": _number(model.damping_nms_per_rad),
        "friction": _number(model.frictionloss_nm),
    }
    ET.SubElement(hinge, "dynamics", dynamics)
    transmission = ET.SubElement(root, "transmission", name=f"{name}_transmission")
    ET.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    ET.SubElement(transmission, "joint", name=name)
    motor = ET.SubElement(transmission, "actuator", name=f"{name}_motor")
    ET.SubElement(motor, "mechanicalReduction").text = _number(joint.gear_ratio)
    return _text(root)


def _step_s(joint: Joint, flexible: bool) -> float:
    """Return a step at which the integration is stable: the spring swings with the link inertia of the file."""
    if not flexible:
        return _STEP_S
    rate = math.sqrt(joint.stiffness_nm_per_rad / max(_LEAST_INERTIA_KGM2, joint.link_inertia_kgm2))
    return min(_STEP_S, _STEP_SHARE / rate)


def _comments(root: ET.Element, model: JointModel) -> None:
    root.append(ET.Comment(" made by jtq export-model; SI units, joint side "))
    for line in model.left_out:
        root.append(ET.Comment(f" not in this model: {line.replace('--', '- -')} "))


def _body(parent: ET.Element, name: str, inertia_kgm2: float) -> ET.Element:
    body = ET.SubElement(parent, "body", name=name)
    inertia = _number(max(_LEAST_INERTIA_KGM2, inertia_kgm2))  # NaN: a joint with one encoder has none
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


def main(argv: list[str]) -> int:
    """Write the model; exit status 0 done, 1 failure, 2 usage, 3 done without what the format cannot express."""
    options = parser().parse_args(argv)
    if options.flexible and options.format != "mjcf":
        print(
            f"{BY}: --flexible: found format {options.format}, expected mjcf: URDF has no springs",
            file=sys.stderr,
        )
        return 2
    try:
        if options.out is not None:
            check_output(options.out)
        model = model_of(load_joint(options.joint, elastic=options.flexible))
        text = mjcf(model, flexible=options.flexible) if options.format == "mjcf" else urdf(model)
        if options.out is None:
            print(text, end="")
        else:
            write_whole(options.out, text.encode())
    except (ConfigError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    for line in model.left_out:
        print(f"{BY}: {options.joint}: not in the model: {line}", file=sys.stderr)
    return 3 if model.left_out else 0


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq export-model`."""
    parser = command_parser(
        BY,
        "Write a joint file with its effects for another simulator: rotor inertia, friction, gear, spring.\n"
        "What the format has no words for is listed on stderr and in the file.",
        "examples:\n"
        "  jtq export-model diagnosis/extended.joint.yaml --out joint.xml\n"
        "  jtq export-model diagnosis/extended.joint.yaml --flexible --out joint.xml\n"
        "  jtq export-model diagnosis/extended.joint.yaml --format urdf\n\n"
        "Exit status: 0 done; 1 failure; 2 usage; 3 done, but something of the joint file is not in the model.",
    )
    parser.add_argument("joint", type=Path, metavar="JOINT.yaml", help="joint file")
    parser.add_argument(
        "--format", choices=("mjcf", "urdf"), default="mjcf", help="mjcf (MuJoCo, the default) or urdf"
    )
    parser.add_argument(
        "--flexible", action="store_true", help="mjcf: the gear's spring as a joint of its own"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="file to write (default: standard output)")
    return parser


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
