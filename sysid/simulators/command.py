"""`jtq export-model`: a joint file, its effects included, as MJCF or URDF."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Final

from jtqd.estimator.checked import ConfigError, check_output
from jtqd.models.files import load_joint
from jtqd.sysid.simulators.model import mjcf, model_of, urdf

BY: Final = "jtq export-model"


def main(argv: list[str]) -> int:
    """Write the model; exit status 0 done, 1 failure, 2 usage, 3 done, but the format cannot say all of the joint file."""
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
        model = model_of(load_joint(options.joint))
        text = mjcf(model, flexible=options.flexible) if options.format == "mjcf" else urdf(model)
        if options.out is None:
            print(text, end="")
        else:
            _write(options.out, text)
    except (ConfigError, OSError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    for line in model.left_out:
        print(f"{BY}: {options.joint}: not in the model: {line}", file=sys.stderr)
    return 3 if model.left_out else 0


def _write(path: Path, text: str) -> None:
    """Whole or not at all."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq export-model`."""
    parser = argparse.ArgumentParser(
        prog=BY,
        description="Write a joint file with its effects for another simulator: rotor inertia, friction, gear, spring.\n"
        "What the format has no words for is listed on stderr and in the file.",
        epilog=(
            "examples:\n"
            "  jtq export-model diagnosis/extended.joint.yaml --out joint.xml\n"
            "  jtq export-model diagnosis/extended.joint.yaml --flexible --out joint.xml\n"
            "  jtq export-model diagnosis/extended.joint.yaml --format urdf\n\n"
            "Exit status: 0 done; 1 failure; 2 usage; 3 done, but something of the joint file is not in the model."
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
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
