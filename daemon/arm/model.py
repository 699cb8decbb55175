"""The rigid bodies of an arm: pinocchio's model of a URDF, a payload at the tool, the surfaces that can be pushed.

Torques are on the link side of the joints, positive along the joint's angle; angles, speeds and accelerations are arrays [n]
of the n joints in the order of the URDF's tree. Vectors are in base axes unless stated otherwise.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin

from jtqd.estimator.decoder import numbers_text
from jtqd.estimator.errors import ConfigError, shown

Array = np.ndarray
G: Final = 9.81
INERTIAL: Final = 10
"""Parameters of a rigid body: m, m c (3), inertia about its frame's origin (xx, xy, yy, xz, yz, zz)."""
POINT_M: Final = 0.045
"""Distance of the points that stand for a surface."""
_NUMBERS: Final = (
    (".", "axis", "xyz", 3, -1e3, 1e3),
    (".", "origin", "xyz rpy", 3, -10.0, 10.0),
    ("inertial", "origin", "xyz rpy", 3, -10.0, 10.0),
    ("inertial", "mass", "value", 1, 0.0, 1e4),
    ("inertial", "inertia", "ixx iyy izz", 1, 0.0, 1e4),
    ("inertial", "inertia", "ixy ixz iyz", 1, -1e4, 1e4),
    ("collision", "origin", "xyz rpy", 3, -10.0, 10.0),
    ("collision/geometry", "cylinder", "radius length", 1, 0.0, 3.0),
    ("collision/geometry", "sphere", "radius", 1, 0.0, 3.0),
    ("collision/geometry", "box", "size", 3, 0.0, 3.0),
)
"""Of joints and links: element, attributes, how many numbers, from, to (kg, m, rad); a size in mm is beyond."""


class Payload(NamedTuple):
    """What hangs at the tool: a point mass; centre in the tool's frame."""

    mass_kg: float = 0.0
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Surface(NamedTuple):
    """Points of the links' shapes: link 1..n (behind the joint of that number), position, normal [p, 3] in its frame."""

    link: Array
    point_m: Array
    normal: Array


class ArmModel:
    """Raises ConfigError, which names the URDF and what does not fit.

    urdf: the file's text. joints: names of the joints that move; all others stand at zero. tool: a link of the URDF.
    up: the direction that is up, in base axes.
    """

    def __init__(
        self,
        urdf: str,
        joints: Sequence[str],
        tool: str,
        *,
        up: Sequence[float] = (0.0, 0.0, 1.0),
        name: str = "URDF",
    ) -> None:
        self.root = _parsed(urdf, name)
        try:
            every = pin.buildModelFromXML(ET.tostring(self.root, encoding="unicode"))
        except (ValueError, RecursionError) as error:  # of pinocchio; why, its parser has printed
            raise ConfigError(f"{name}: {error}") from None
        known = list(every.names)[1:]
        for joint in joints:
            if joint not in known:
                raise ConfigError(
                    f"{name}: found no moving joint {joint}, expected one of {', '.join(known)}"
                )
        for each in self.root.findall("joint"):
            leader = "" if (mimic := each.find("mimic")) is None else mimic.get("joint", "")
            if leader in joints and each.get("name") not in joints:
                found = f"joint {each.get('name')} follows {leader} (mimic)"
                raise ConfigError(f"{name}: found {found}, expected it in joints, with an encoder of its own")
        locked = [every.getJointId(joint) for joint in known if joint not in joints]
        model = pin.buildReducedModel(every, locked, pin.neutral(every))
        for joint in list(model.names)[1:]:
            kind = model.joints[model.getJointId(joint)].shortname()
            if not kind.startswith("JointModelR"):
                raise ConfigError(f"{name}: joint {joint}: found {kind[10:]}, expected a revolute joint")
        model.gravity.linear = -G * np.asarray(up, float) / np.linalg.norm(up)
        self.name = name
        self.pin = model
        self.joints = tuple(list(model.names)[1:])
        self.n = model.nv
        for k, joint in enumerate(self.joints, start=1):
            if sum(each.mass for each in list(model.inertias)[k:]) <= 0.0:
                raise ConfigError(f"{name}: what moves with joint {joint} has no mass")
        if not self.moves(tool):
            raise ConfigError(f"{name}: found no link {tool} that moves with a joint, expected it for tool")
        self._tool = model.getFrameId(tool, pin.FrameType.BODY)
        frame = model.frames[self._tool]
        self.tool_joint, self.tool_place = frame.parentJoint, frame.placement
        self._bare = [pin.Inertia(each) for each in model.inertias]
        self.data = model.createData()
        self.payload_columns = self._payload_columns()
        self.surface = self._surface()

    def moves(self, link: str) -> bool:
        """Return whether a link of the URDF moves with a joint."""
        body = link, pin.FrameType.BODY
        there = self.pin.existFrame(*body)
        return bool(there and self.pin.frames[self.pin.getFrameId(*body)].parentJoint > 0)

    # ---- what hangs on it ----

    def set_inertial(self, parameters: Array) -> None:
        """Take inertial parameters [n, 10] of the links, without payload."""
        for k, each in enumerate(parameters, start=1):
            self._bare[k] = pin.Inertia.FromDynamicParameters(np.ascontiguousarray(each))
        self.set_payload(Payload())

    def inertial(self) -> Array:
        """Return the inertial parameters [n, 10] of the links, without payload."""
        return np.stack([self._bare[k].toDynamicParameters() for k in range(1, self.n + 1)])

    def set_payload(self, payload: Payload) -> None:
        """Hang a payload at the tool in place of the one before."""
        for k in range(1, self.n + 1):
            self.pin.inertias[k] = self._bare[k]
        if payload.mass_kg > 0.0:
            point = pin.Inertia(payload.mass_kg, np.array(payload.centre_m), np.zeros((3, 3)))
            self.pin.inertias[self.tool_joint] = self._bare[self.tool_joint] + self.tool_place.act(point)

    def payload_parameters(self, payload: Payload) -> Array:
        """Return what a payload adds to the parameters [10] of the tool's link."""
        point = pin.Inertia(payload.mass_kg, np.array(payload.centre_m), np.zeros((3, 3)))
        return np.asarray(self.tool_place.act(point).toDynamicParameters())

    def _payload_columns(self) -> Array:
        """Return the parameters [10, 4] of the tool's link per kg at the tool, and per kg m of m c along its axes."""

        def of(mass: float, centre: Array) -> Array:
            point = self.tool_place.act(pin.Inertia(mass, centre, np.zeros((3, 3))))
            return np.asarray(point.toDynamicParameters())

        centred = of(1.0, np.zeros(3))
        small = 1e-4
        return np.stack([centred, *((of(1.0, small * e) - centred) / small for e in np.eye(3))], axis=1)

    # ---- mechanics ----

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return what a motion needs on the joints [n], weight and payload included (recursive Newton-Euler)."""
        return np.asarray(pin.rnea(self.pin, self.data, q, v, a))

    def inertia(self, q: Array) -> Array:
        """Return the inertia matrix [n, n] of a pose."""
        upper = np.triu(pin.crba(self.pin, self.data, q))
        return np.asarray(upper + np.triu(upper, 1).T)

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torque's derivatives [n, 10 n] by the links' inertial parameters (Atkeson, An, Hollerbach 1986)."""
        return np.reshape(pin.computeJointTorqueRegressor(self.pin, self.data, q, v, a), (self.n, -1))

    def of_payload(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torque's derivatives [n, 4] by mass and m c of the payload."""
        first = INERTIAL * (self.tool_joint - 1)
        return np.asarray(self.regressor(q, v, a)[:, first : first + INERTIAL] @ self.payload_columns)

    def place(self, q: Array) -> None:
        """Compute places and Jacobians of all joints in a pose, for the methods below."""
        pin.computeJointJacobians(self.pin, self.data, q)

    def tool_jacobian(self) -> Array:
        """Return the tool's Jacobian [6, n]: torques = J' (force, torque about the tool's origin)."""
        pin.updateFramePlacement(self.pin, self.data, self._tool)
        return np.asarray(
            pin.getFrameJacobian(self.pin, self.data, self._tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        )

    def surface_jacobians(self) -> tuple[Array, Array]:
        """Return per point of `surface` what a force does to the joints [p, n, 3], and the normals [p, 3]."""
        links = self.surface.link
        places = [self.data.oMi[k] for k in range(self.n + 1)]
        turn = np.stack([each.rotation for each in places])
        at = np.stack([each.translation for each in places])
        points = at[links] + np.einsum("pij,pj->pi", turn[links], self.surface.point_m)
        normals = np.einsum("pij,pj->pi", turn[links], self.surface.normal)
        spatial = np.asarray(self.data.J)  # [6, n], about the base's origin
        linear, angular = spatial[:3].T, spatial[3:].T
        moved = linear[None] + np.cross(angular[None], points[:, None, :])
        moved *= (np.arange(1, self.n + 1)[None] <= links[:, None])[:, :, None]
        return moved, normals

    # ---- shapes ----

    def _surface(self) -> Surface:
        """Return points of the cylinders, spheres and boxes of the URDF's `collision` elements of links that move."""
        found: list[tuple[int, Array, Array]] = []
        solids: list[tuple[int, _Solid]] = []
        for link in self.root.iter("link"):
            name = link.get("name", "")
            if not self.moves(name):
                continue
            frame = self.pin.frames[self.pin.getFrameId(name, pin.FrameType.BODY)]
            found_here = (_solid(shape, frame.placement) for shape in link.iter("collision"))
            solids += [(frame.parentJoint, solid) for solid in found_here if solid is not None]
        for joint, solid in solids:
            points, normals = solid.points()
            free = np.ones(len(points), bool)
            for other_joint, other in solids:
                if other_joint == joint and other is not solid:
                    free &= ~other.inside(points)
            found.append((joint, points[free], normals[free]))
        if not found:
            return Surface(np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3)))
        return Surface(
            np.concatenate([np.full(len(points), joint) for joint, points, _ in found]),
            np.concatenate([points for _, points, _ in found]),
            np.concatenate([normals for _, _, normals in found]),
        )


class _Solid(NamedTuple):
    """A cylinder, sphere (half 0) or box at a place in its joint's frame."""

    kind: str
    place: Any
    size: tuple[float, ...]

    def points(self) -> tuple[Array, Array]:
        """Return points and outward normals [p, 3]."""
        at, normal = {"cylinder": self._of_cylinder, "sphere": self._of_sphere, "box": self._of_box}[
            self.kind
        ]()
        turn = self.place.rotation
        return at @ turn.T + self.place.translation, normal @ turn.T

    def _of_cylinder(self) -> tuple[Array, Array]:
        radius, half = self.size
        around = max(6, round(2.0 * math.pi * radius / POINT_M))
        along = max(2, round(2.0 * half / POINT_M))
        angles, heights = 2.0 * np.pi * np.arange(around) / around, _spread(half, along)
        phi, z = (each.ravel() for each in np.meshgrid(angles, heights))
        normal = np.stack((np.cos(phi), np.sin(phi), np.zeros_like(phi)), axis=-1)
        return radius * normal + z[:, None] * np.array([0.0, 0.0, 1.0]), normal

    def _of_sphere(self) -> tuple[Array, Array]:
        count = max(12, round(4.0 * math.pi * (self.size[0] / POINT_M) ** 2))
        k = np.arange(count) + 0.5  # Fibonacci's spiral
        z, phi = 1.0 - 2.0 * k / count, np.pi * (1.0 + math.sqrt(5.0)) * k
        ring = np.sqrt(1.0 - z * z)
        normal = np.stack((ring * np.cos(phi), ring * np.sin(phi), z), axis=-1)
        return self.size[0] * normal, normal

    def _of_box(self) -> tuple[Array, Array]:
        points, normals = [], []
        for axis in range(3):
            first, second = (axis + 1) % 3, (axis + 2) % 3
            sides = (
                _spread(h, max(1, round(2.0 * h / POINT_M))) for h in (self.size[first], self.size[second])
            )
            u, w = (each.ravel() for each in np.meshgrid(*sides))
            for sign in (-1.0, 1.0):
                at, out = np.zeros((len(u), 3)), np.zeros((len(u), 3))
                at[:, first], at[:, second], at[:, axis], out[:, axis] = u, w, sign * self.size[axis], sign
                points.append(at)
                normals.append(out)
        return np.concatenate(points), np.concatenate(normals)

    def inside(self, points: Array) -> Array:
        """Return which points [p, 3] are inside."""
        local = (points - self.place.translation) @ self.place.rotation
        if self.kind == "cylinder":
            radius, half = self.size
            return np.asarray(
                (np.hypot(local[:, 0], local[:, 1]) < radius - 1e-9) & (np.abs(local[:, 2]) < half - 1e-9)
            )
        if self.kind == "sphere":
            return np.asarray(np.linalg.norm(local, axis=1) < self.size[0] - 1e-9)
        return np.asarray((np.abs(local) < np.array(self.size) - 1e-9).all(axis=1))


def _spread(half: float, count: int) -> Array:
    """Return the centres of `count` equal parts of -half..half."""
    return half * ((np.arange(count) + 0.5) / count * 2.0 - 1.0)


def _solid(shape: ET.Element, frame: Any) -> _Solid | None:
    """Return the solid of a `collision` element in its joint's frame; None for a mesh."""
    origin, geometry = shape.find("origin"), shape.find("geometry")
    xyz = _numbers(origin, "xyz")
    place = frame * pin.SE3(pin.rpy.rpyToMatrix(*_numbers(origin, "rpy")), xyz)
    if geometry is None:
        return None
    if (each := geometry.find("cylinder")) is not None:
        return _Solid("cylinder", place, (float(each.attrib["radius"]), 0.5 * float(each.attrib["length"])))
    if (each := geometry.find("sphere")) is not None:
        return _Solid("sphere", place, (float(each.attrib["radius"]),))
    if (each := geometry.find("box")) is not None:
        return _Solid("box", place, tuple(0.5 * x for x in _numbers(each, "size")))
    return None


def _numbers(element: ET.Element | None, key: str) -> Array:
    text = "0 0 0" if element is None else element.get(key, "0 0 0")
    return np.array([float(word) for word in text.split()])


def _check(owner: ET.Element, where: str) -> None:  # of a link with such numbers pinocchio takes one half
    for path, child, keys, count, least, most in _NUMBERS:
        for parent in owner.findall(path):
            each = parent.find(child)
            for key in keys.split() if each is not None or child in ("mass", "inertia") else ():
                text = "" if each is None else each.get(key, "0 0 0" if child == "origin" else "")
                try:
                    good = [least <= float(word) <= most for word in text.split()] == [True] * count
                except ValueError:
                    good = False
                if not good:
                    expected = f"{numbers_text(count)} from {least:g} to {most:g}"
                    raise ConfigError(f"{where}: {child} {key}: found {shown(text)}, expected {expected}")


def _parsed(urdf: str, name: str) -> ET.Element:
    """Return the URDF; joints without limits of angle become revolute ones. Raises ConfigError."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ConfigError(f"{name}: found no XML: {error}") from None
    if root.tag != "robot":
        raise ConfigError(f"{name}: found <{root.tag}>, expected <robot>")
    joints, links = ({each.get("name") for each in root.findall(kind)} for kind in ("joint", "link"))
    if joints & links:
        raise ConfigError(f"{name}: found joint and link {(joints & links).pop()}, expected different names")
    for owner in (*root.findall("joint"), *root.findall("link")):
        _check(owner, f"{name}: {owner.tag} {owner.get('name')}")
    for joint in root.findall("joint"):
        turns = joint.get("type") in ("revolute", "continuous")
        if turns and (axis := joint.find("axis")) is not None and not _numbers(axis, "xyz").any():
            raise ConfigError(f"{name}: joint {joint.get('name')}: found axis 0 0 0, expected a direction")
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            limit = joint.find("limit")
            if limit is None:
                limit = ET.SubElement(joint, "limit", effort="0", velocity="0")
            limit.set("lower", "-1e9")
            limit.set("upper", "1e9")
    return root
