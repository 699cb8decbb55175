"""`jtq fit arm`: inertial parameters of the links and what the estimate leaves, from logs of `jtqd-arm`; command line."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from jtqd.estimator.command_line import check_installed, command_parser, make_directory
from jtqd.estimator.errors import ConfigError, OneLineError

Hung = tuple[float, float, float, float]
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
        help="what hung at the tool in a log: mass, centre in its frame [m] (default: that of ARM.yaml, else nothing)",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="for arm.urdf and arm.yaml")
    add("--json", action="store_true", help="print the result as JSON")
    return result


def main(argv: list[str]) -> int:
    """Fit and write; argv may begin with `arm`. Returns the exit status."""
    options = parser().parse_args(argv[1:] if argv[:1] == ["arm"] else argv)
    try:
        check_installed("arm", "pinocchio")
        payloads = _payloads(options.payload, options.logs)
    except ConfigError as error:
        print(f"jtq fit arm: {error}", file=sys.stderr)
        return 2
    from jtqd.daemon.arm.arm_file import load_arm
    from jtqd.sysid.arm.fit import fit_arm, lines, write

    try:
        for path in (options.arm, load_arm(options.arm).urdf_path):
            if path.resolve() in ((options.out / name).resolve() for name in ("arm.urdf", "arm.yaml")):
                raise ConfigError(f"--out {options.out}: found {path} there, expected another directory")
        make_directory(options.out)
        config, model, result = fit_arm(options.arm, payloads)
        write(options.out, config, model, result, shlex.join(["jtq", "fit", *argv]))
    except (OneLineError, OSError) as error:
        print(f"jtq fit arm: {error}", file=sys.stderr)
        return 1
    print(json.dumps(result.content(), indent=1) if options.json else "\n".join(lines(result)))
    print(f"jtq fit arm: wrote {options.out / 'arm.urdf'}, {options.out / 'arm.yaml'}", file=sys.stderr)
    return 0 if result.better else 3


def _payloads(words: Sequence[str], logs: Sequence[Path]) -> dict[Path, Hung | None]:
    """Return mass [kg] and centre [m] of what hung in each log, None where none is given. Raises ConfigError."""
    found: dict[Path, Hung | None] = dict.fromkeys(logs)
    for word in words:
        name, _, text = word.rpartition("=")
        try:
            mass, x, y, z = (float(each) for each in text.split(","))
        except ValueError:
            raise ConfigError(f"--payload: found {word!r}, expected LOG=KG,X,Y,Z") from None
        if not (0.0 <= mass <= 1000.0 and max(map(abs, (x, y, z))) <= 2.0):
            raise ConfigError(f"--payload: found {word!r}, expected 0 to 1000 kg and a centre within 2 m")
        matching = [path for path in logs if name in (str(path), path.name)]
        if len(matching) != 1:
            raise ConfigError(f"--payload: found {name!r}, expected one of {', '.join(map(str, logs))}")
        found[matching[0]] = (mass, x, y, z)
    return found


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
