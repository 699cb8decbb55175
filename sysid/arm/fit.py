"""Links and noise of an arm from logs of `jtqd-arm`: runs without gaps, held-out errors, URDF and ARM.yaml."""

from __future__ import annotations

import datetime as dt
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd import __version__
from jtqd.daemon.arm.arm_file import ArmConfig, load_arm
from jtqd.daemon.arm.estimator import FASTEST_RAD_S, ArmNoise
from jtqd.daemon.arm.model import INERTIAL, ArmModel, Array, Payload
from jtqd.daemon.logs.read import read_topic
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import read_file, write_whole
from jtqd.estimator.text import counted, number, percent, sha256_hex, table_lines
from jtqd.models.files import parse_yaml
from jtqd.sysid.arm.identification import (
    DETERMINED,
    FreeMotion,
    Normal,
    identify,
    noise_of,
    normal_of,
)

_TOPIC: Final = "/arm/external"
_SHORTEST_S: Final = 5.0
"""Of a run without a gap: in a shorter one an offset and a slow error look like anything."""
_LEAST_RAD: Final = 0.1
"""Travel of the joint that moves most: noise at standstill is not that of motion."""
_PARTS: Final = ("mass", *["centre"] * 3, *["inertia"] * 6)


class ArmFit(NamedTuple):
    """What logs tell. held_out: by joint, rms in Nm of the file's values and of the fitted ones, each log by the others;
    None of one log. from_cad: by joint what of its link stays near the file's value. better: held out, or not known.
    """

    inertial: Array
    noise: ArmNoise
    held_out: dict[str, tuple[float, float]] | None
    better: bool
    from_cad: dict[str, list[str]]
    logs: dict[str, dict[str, Any]]

    def content(self) -> dict[str, Any]:
        """Return it as plain data for JSON."""
        return {key: getattr(self, key) for key in ("held_out", "better", "from_cad", "logs")}


def fit_arm(
    path: Path, payloads: Mapping[Path, tuple[float, float, float, float] | None]
) -> tuple[ArmConfig, ArmModel, ArmFit]:
    """Fit the arm of an ARM.yaml to logs. payloads: log -> mass [kg] and centre [m], None: the file's.

    Raises OneLineError, OSError.
    """
    config = load_arm(path)
    file, urdf = config.file, str(config.urdf_path)
    model = ArmModel(config.urdf, [*file.joints], file.tool, up=file.up, name=urdf)
    groups, logs = [], dict[str, dict[str, Any]]()
    fixed = (0.0, 0.0, 0.0, 0.0) if file.payload is None else (file.payload.mass_kg, *file.payload.centre_m)
    for log, hung in payloads.items():
        mass, x, y, z = hung or fixed
        groups.append(_runs(log, model, Payload(mass, (x, y, z))))
        sha256 = sha256_hex(read_file(log))
        twin = next((name for name, each in logs.items() if each["sha256"] == sha256), None)
        if twin is not None:
            raise ConfigError(f"{log}: found the same log as {twin}, expected one that holds it out")
        logs[str(log)] = {"sha256": sha256, "payload": [mass, x, y, z]}
    normals = [[normal_of(model, run) for run in runs] for runs in groups]
    found = identify(model, [each for some in normals for each in some])
    held_out, better = None, True
    if len(groups) > 1:
        before, after = _held_out(model, normals)
        pairs = zip(before.tolist(), after.tolist(), strict=True)
        held_out = dict(zip(model.joints, pairs, strict=True))
        sigma = np.mean([each.sigma_nm for some in normals for each in some], axis=0)
        better = bool(np.sum((after / sigma) ** 2) <= np.sum((before / sigma) ** 2))
    model.set_inertial(found.inertial)
    noise = noise_of(model, [run for runs in groups for run in runs])
    from_cad = {
        joint: list(
            dict.fromkeys(name for name, share in zip(_PARTS, row, strict=True) if share > DETERMINED)
        )
        for joint, row in zip(model.joints, found.relative, strict=True)
    }
    return config, model, ArmFit(found.inertial, noise, held_out, better, from_cad, logs)


def _runs(path: Path, model: ArmModel, payload: Payload) -> list[FreeMotion]:
    """Return the parts of a log without gaps. Raises OneLineError."""
    table = read_topic(path, _TOPIC)
    names = bytes(table["joints"][0]).decode("utf-8", "replace").rstrip("\0")
    expected = " ".join(model.joints)
    if names != expected:
        raise ConfigError(f"{path}: found joints {names}, expected {expected}")
    time_ns = np.asarray(table["monotonic_ns"], np.int64)
    position = np.asarray(table["position_rad"], float)
    torque, sigma = np.asarray(table["torque_nm"], float), np.asarray(table["torque_sigma_nm"], float)
    torque = np.where((sigma > 0.0) & (sigma < np.inf), torque, np.nan)
    steps = np.diff(time_ns)
    period_ns = float(np.median(steps)) if len(steps) else 0.0
    there = np.isfinite(position).all(axis=1)
    jumps = (np.abs(np.diff(position, axis=0)) > 1e-9 * FASTEST_RAD_S * period_ns).any(axis=1)
    gaps = (np.abs(steps - period_ns) > 0.5 * period_ns) | (there[1:] != there[:-1])
    breaks = np.flatnonzero(gaps | jumps) + 1
    least = _SHORTEST_S * 1e9 / max(period_ns, 1.0)
    parts = [
        part
        for part in np.split(np.arange(len(time_ns)), breaks)
        if len(part) >= least
        and there[part[0]]
        and np.isfinite(torque[part]).any(axis=0).all()
        and np.ptp(position[part], axis=0).max() > _LEAST_RAD
    ]
    if not parts:
        found = f"no {_SHORTEST_S:g} s of motion with all positions and with torques of each joint"
        raise ConfigError(f"{path}: found {found}, expected longer free motion")
    return [FreeMotion(1e-9 * period_ns, position[p], torque[p], sigma[p], payload) for p in parts]


def _held_out(model: ArmModel, normals: Sequence[Sequence[Normal]]) -> tuple[Array, Array]:
    """Return the rms [n] in Nm before and after, each log judged by a fit to the others."""
    before, after = [], []
    for k, own in enumerate(normals):
        rest = identify(model, [each for j, some in enumerate(normals) if j != k for each in some])
        for each in own:
            before.append(each.left_nm(model.inertial()))
            after.append(each.left_nm(rest.inertial))
    return np.sqrt(np.mean(np.square(before), axis=0)), np.sqrt(np.mean(np.square(after), axis=0))


def lines(result: ArmFit) -> list[str]:
    """Return the report."""
    found = []
    if result.held_out is not None:
        rows = [
            (joint, number(before, 3), number(after, 3), percent(after / before - 1.0))
            for joint, (before, after) in result.held_out.items()
        ]
        head = ("joint", "file [Nm]", "fitted [Nm]", "change")
        found += [
            "Torque on held-out logs, rms beside the offsets of a run:",
            *table_lines([head, *rows], (0,)),
        ]
    else:
        found.append("One log: nothing is held out. Record a second one to see what the fit gains.")
    kept = [f"{joint} ({', '.join(names)})" for joint, names in result.from_cad.items() if names]
    if kept:
        found.append(f"Near the values of the URDF, because the motion does not tell: {'; '.join(kept)}.")
    return found


def write(folder: Path, config: ArmConfig, model: ArmModel, result: ArmFit, command: str) -> None:
    """Write arm.urdf and arm.yaml. Raises OSError."""
    date = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    origin = [f"command: {command}", f"jtqd {__version__}, {date}"]
    origin += [
        f"{Path(path).name}: SHA-256 {each['sha256']}, payload {each['payload']}"
        for path, each in result.logs.items()
    ]
    text = [f"URDF {config.urdf_path.name}: SHA-256 {sha256_hex(config.urdf.encode())}", *origin]
    note = "Inertial parameters by jtq fit arm; what is fixed to a link is in that link."
    comment = "\n".join((note, *(re.sub("-(?=-)", "- ", each) for each in text)))
    write_whole(folder / "arm.urdf", _urdf(model, result.inertial, comment).encode())
    content: dict[str, Any] = dict(parse_yaml(config.text.encode(), str(config.path)))
    content["urdf"], content["noise"] = "arm.urdf", _noise(model, result.noise)
    head = "".join(
        f"# {line}\n" for line in (f"Written by jtq fit arm from {counted(len(result.logs), 'log')}.", *text)
    )
    write_whole(folder / "arm.yaml", (head + yaml.safe_dump(content, sort_keys=False)).encode())


def _noise(model: ArmModel, noise: ArmNoise) -> dict[str, Any]:
    def named(values: Array) -> dict[str, Any]:
        return dict(zip(model.joints, np.round(values, 9).tolist(), strict=True))

    return {
        "total": named(noise.total),
        "offset": noise.offset,
        "tests": named(noise.tests.T),
        "position_rad": named(noise.position_rad),
    }


def _urdf(model: ArmModel, inertial: Array, comment: str) -> str:
    """Return the URDF with these parameters of the links that move; links fixed to them have no inertia of their own."""
    root = model.root
    child = {each.get("name"): str(each.find("child").get("link")) for each in root.findall("joint")}  # type: ignore[union-attr]
    links = {child[joint]: theta for joint, theta in zip(model.joints, inertial, strict=True)}
    for link in root.iter("link"):
        name = link.get("name", "")
        if not model.moves(name):
            continue
        for each in link.findall("inertial"):
            link.remove(each)
        if name in links:
            link.append(_inertial(links[name]))
    root.insert(0, ET.Comment(comment))
    ET.indent(root, " ")
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _inertial(theta: Array) -> ET.Element:
    mass = float(theta[0])
    x, y, z = theta[1:4] / mass
    cross = mass * np.array([y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y])
    own = dict(zip(("ixx", "ixy", "iyy", "ixz", "iyz", "izz"), theta[4:INERTIAL] - cross, strict=True))
    element = ET.Element("inertial")
    ET.SubElement(element, "origin", xyz=f"{x:.9g} {y:.9g} {z:.9g}", rpy="0 0 0")
    ET.SubElement(element, "mass", value=f"{mass:.9g}")
    ET.SubElement(element, "inertia", {key: f"{value:.9g}" for key, value in own.items()})
    return element
