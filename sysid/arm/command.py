"""`jtq fit arm`: inertial parameters of the links and what the estimate leaves, from logs of `jtqd-arm`."""

from __future__ import annotations

import argparse
import datetime as dt
import json
import shlex
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from jtqd import __version__
from jtqd.daemon.arm.arm_file import ArmConfig, load_arm
from jtqd.daemon.arm.estimator import ArmNoise
from jtqd.daemon.arm.model import INERTIAL, ArmModel, Array, Payload
from jtqd.daemon.logs.log_file import LogError
from jtqd.daemon.logs.read import read_topic
from jtqd.estimator.command_line import check_installed, command_parser, make_directory
from jtqd.estimator.errors import ConfigError, OneLineError
from jtqd.estimator.files import write_whole
from jtqd.estimator.text import counted, number, percent, sha256_hex, table_lines
from jtqd.models.files import parse_yaml
from jtqd.sysid.arm.identification import (
    TOLD,
    FreeMotion,
    Identified,
    Normal,
    identify,
    noise_of,
    normal_of,
)

_TOPIC: Final = "/arm/external"
_SHORTEST_S: Final = 5.0
"""Of a run without a gap; offsets and slow errors of a shorter one are not told from anything."""
_LARGEST_LOG: Final = 4_000_000_000
_PARTS: Final = ("mass", *["centre"] * 3, *["inertia"] * 6)

_EXAMPLES: Final = """examples:
  jtqd-arm arm.yaml --record logs                         free motion: nothing pushes, all joints move, poses of all kinds
  jtq fit arm arm.yaml logs/*.mcap --out fitted
  jtq fit arm arm.yaml empty.mcap heavy.mcap --payload heavy.mcap=2.0,0.01,-0.02,0.06 --out fitted

exit status: 0 done, 1 failure, 2 usage, 3 written, but on held-out logs the file's values are better"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq fit arm`."""
    result = command_parser(
        "jtq fit arm",
        "Identify the links of an arm from free motion that jtqd-arm has recorded.",
        _EXAMPLES,
    )
    add = result.add_argument
    add("arm", type=Path, metavar="ARM.yaml", help="with the URDF that CAD gave")
    add("logs", type=Path, nargs="+", metavar="LOG.mcap", help="of jtqd-arm, without contact")
    add(
        "--payload",
        action="append",
        default=[],
        metavar="LOG=KG,X,Y,Z",
        help="what hung at the tool in a log: mass, centre in the tool's frame [m] (default: nothing)",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="for arm.urdf and arm.yaml")
    add("--json", action="store_true", help="print the result as JSON")
    return result


def main(argv: list[str]) -> int:
    """Fit and write; argv begins with `arm`. Returns the exit status."""
    options = parser().parse_args(argv[1:])
    try:
        check_installed("arm", "pinocchio")
        payloads = _payloads(options.payload, options.logs)
    except ConfigError as error:
        print(f"jtq fit arm: {error}", file=sys.stderr)
        return 2
    try:
        make_directory(options.out)
        config = load_arm(options.arm)
        model = ArmModel(
            config.urdf,
            [*config.file.joints],
            config.file.tool,
            up=config.file.up,
            name=str(config.urdf_path),
        )
        groups = [(path, _runs(path, model, payload)) for path, payload in payloads.items()]
        result = _fit(model, groups)
        result |= {"command": shlex.join(["jtq", "fit", *argv]), "version": __version__}
        result["date"] = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
        _write(options.out, config, model, result)
    except (OneLineError, LogError, OSError) as error:
        print(f"jtq fit arm: {error}", file=sys.stderr)
        return 1
    found = {key: value for key, value in result.items() if key not in ("inertial", "noise")}
    print(json.dumps(found, indent=1) if options.json else "\n".join(_lines(model, result)))
    print(f"jtq fit arm: wrote {options.out / 'arm.urdf'}, {options.out / 'arm.yaml'}", file=sys.stderr)
    return 0 if result["held_out"] is None or result["better"] else 3


def _payloads(words: Sequence[str], logs: Sequence[Path]) -> dict[Path, Payload]:
    """Return the payload of each log. Raises ConfigError."""
    found = {path: Payload() for path in logs}
    for word in words:
        name, _, text = word.rpartition("=")
        try:
            mass, x, y, z = (float(each) for each in text.split(","))
        except ValueError:
            raise ConfigError(f"--payload: found {word!r}, expected LOG=KG,X,Y,Z") from None
        if not (0.0 <= mass < np.inf and max(map(abs, (x, y, z))) <= 2.0):
            raise ConfigError(f"--payload: found {word!r}, expected kg >= 0 and a centre within 2 m")
        matching = [path for path in logs if name in (str(path), path.name)]
        if len(matching) != 1:
            raise ConfigError(f"--payload: found {name!r}, expected one of {', '.join(map(str, logs))}")
        found[matching[0]] = Payload(mass, (x, y, z))
    return found


def _runs(path: Path, model: ArmModel, payload: Payload) -> list[FreeMotion]:
    """Return the parts of a log without gaps. Raises OneLineError."""
    table = read_topic(path, _TOPIC)
    names = tuple(bytes(table["joints"][0]).decode("utf-8", "replace").split())
    if names != model.joints:
        raise ConfigError(f"{path}: found joints {', '.join(names)}, expected {', '.join(model.joints)}")
    time_ns = np.asarray(table["monotonic_ns"], np.int64)
    position = np.asarray(table["position_rad"], float)
    torque, sigma = np.asarray(table["torque_nm"], float), np.asarray(table["torque_sigma_nm"], float)
    steps = np.diff(time_ns)
    period_ns = float(np.median(steps)) if len(steps) else 0.0
    there = np.isfinite(position).all(axis=1)
    breaks = np.flatnonzero((np.abs(steps - period_ns) > 0.5 * period_ns) | (there[1:] != there[:-1])) + 1
    least = _SHORTEST_S * 1e9 / max(period_ns, 1.0)
    parts = [
        part for part in np.split(np.arange(len(time_ns)), breaks) if len(part) >= least and there[part[0]]
    ]
    if not parts:
        raise ConfigError(
            f"{path}: found no {_SHORTEST_S:g} s with all positions, expected longer free motion"
        )
    return [FreeMotion(1e-9 * period_ns, position[p], torque[p], sigma[p], payload) for p in parts]


def _fit(model: ArmModel, groups: Sequence[tuple[Path, list[FreeMotion]]]) -> dict[str, Any]:
    """Return what logs tell: parameters, held-out errors by joint, what stayed at CAD's value, noise."""
    normals = [[normal_of(model, run) for run in runs] for _, runs in groups]
    found = identify(model, [each for some in normals for each in some])
    held_out, better = None, True
    if len(groups) > 1:
        before, after = _held_out(model, normals)
        held_out = dict(zip(model.joints, zip(before.tolist(), after.tolist(), strict=True), strict=True))
        sigma = np.mean([each.sigma_nm for some in normals for each in some], axis=0)
        better = bool(((after / sigma) ** 2).sum() <= ((before / sigma) ** 2).sum())
    model.set_inertial(found.inertial)
    noise = noise_of(model, [run for _, runs in groups for run in runs])
    return {
        "inertial": found.inertial,
        "noise": noise,
        "held_out": held_out,
        "better": better,
        "from_cad": _from_cad(model, found),
        "logs": {
            str(path): {
                "sha256": sha256_hex(path.read_bytes()),
                "payload": [runs[0].payload.mass_kg, *runs[0].payload.centre_m],
            }
            for path, runs in groups
        },
    }


def _held_out(model: ArmModel, normals: Sequence[Sequence[Normal]]) -> tuple[Array, Array]:
    """Return the rms [n] in Nm before and after, each log judged by what the others told."""
    before, after = [], []
    for k, own in enumerate(normals):
        rest = identify(model, [each for j, some in enumerate(normals) if j != k for each in some])
        for each in own:
            before.append(each.left_nm(model.inertial()))
            after.append(each.left_nm(rest.inertial))
    return np.sqrt(np.mean(np.square(before), axis=0)), np.sqrt(np.mean(np.square(after), axis=0))


def _from_cad(model: ArmModel, found: Identified) -> dict[str, list[str]]:
    """Return by joint what of its link stayed near CAD's value: the motion cannot tell it."""
    return {
        joint: list(dict.fromkeys(name for name, share in zip(_PARTS, row, strict=True) if share > TOLD))
        for joint, row in zip(model.joints, found.untold, strict=True)
    }


def _lines(model: ArmModel, result: dict[str, Any]) -> list[str]:
    lines = []
    if result["held_out"] is not None:
        rows = [
            (joint, number(before, 3), number(after, 3), percent(after / before - 1.0))
            for joint, (before, after) in result["held_out"].items()
        ]
        head = ("joint", "file [Nm]", "fitted [Nm]", "change")
        lines += [
            "Torque on held-out logs, rms beside the offsets of a run:",
            *table_lines([head, *rows], (0,)),
        ]
    else:
        lines.append("One log: nothing is held out. Record a second one to see what the fit gains.")
    kept = [f"{joint} ({', '.join(names)})" for joint, names in result["from_cad"].items() if names]
    if kept:
        lines.append(f"Near the values of the URDF, because the motion does not tell: {'; '.join(kept)}.")
    return lines


def _write(folder: Path, config: ArmConfig, model: ArmModel, result: dict[str, Any]) -> None:
    """Write arm.urdf and arm.yaml. Raises OSError."""
    origin = [f"{key}: {result[key]}" for key in ("command", "version", "date")]
    origin += [
        f"{Path(path).name}: SHA-256 {each['sha256']}, payload {each['payload']}"
        for path, each in result["logs"].items()
    ]
    text = [f"URDF {config.urdf_path.name}: SHA-256 {sha256_hex(config.urdf.encode())}", *origin]
    note = "Inertial parameters by jtq fit arm; what is fixed to a link is in that link."
    comment = "\n".join((note, *(each.replace("--", "- -") for each in text)))
    write_whole(folder / "arm.urdf", _urdf(model, result["inertial"], comment).encode())
    content: dict[str, Any] = dict(parse_yaml(config.text.encode(), str(config.path)))
    content["urdf"], content["noise"] = "arm.urdf", _noise(model, result["noise"])
    head = "".join(
        f"# {line}\n"
        for line in (f"Written by jtq fit arm from {counted(len(result['logs']), 'log')}.", *text)
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
    child = {each.get("name"): str(each.find("child").get("link")) for each in root.iter("joint")}  # type: ignore[union-attr]
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


if __name__ == "__main__":
    raise SystemExit(main(["arm", *sys.argv[1:]]))
