"""`jtq fit`: which part of a joint file is to be fitted; each kind has a module of its own."""

from __future__ import annotations

import difflib
import importlib
import sys
from typing import Final

KINDS: Final = {
    "efficiency": ("sysid.efficiency_fit_command", "Eq. (8) per quadrant, from plateaus: efficiency"),
    "friction": (
        "sysid.friction_fit_command",
        "Coulomb and viscous friction at no load, from plateaus: friction",
    ),
    "losses": ("sysid.loss_fit_command", "additive loss over load and velocity, from whole runs: losses"),
}
"""Kind -> (module with `main(argv) -> int`, one line of help)."""


def main(argv: list[str]) -> int:
    """Hand over to the kind's module; exit status 0 done, 1 failure, 2 usage, 3 done with findings."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_help(), end="")
        return 0 if argv else 2
    kind = KINDS.get(argv[0])
    if kind is None:
        near = difflib.get_close_matches(argv[0], KINDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        print(f"jtq fit: found {argv[0]!r}, expected one of {', '.join(KINDS)}{hint}", file=sys.stderr)
        return 2
    try:
        module = importlib.import_module(kind[0])
    except ModuleNotFoundError as error:
        if error.name != kind[0]:
            raise
        print(f"jtq fit {argv[0]}: is not part of this version", file=sys.stderr)
        return 1
    return int(module.main(argv[1:]))


def _help() -> str:
    width = max(map(len, KINDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in KINDS.items())
    return (
        "usage: jtq fit KIND RUNS... --joint JOINT.yaml --out NEW_JOINT.yaml ...\n\n"
        "Fit one section of a joint file to measured runs and write a new joint file.\n\n"
        f"kinds:\n{rows}\n\n"
        "examples:\n"
        "  jtq fit efficiency campaigns/efficiency --joint joint1.yaml --out joint1.fitted.yaml --plot fig6.png\n"
        "  jtq fit KIND --help\n"
    )
