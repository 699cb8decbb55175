"""What all kinds of `jtq fit` ask for on the command line."""

from __future__ import annotations

import argparse
import datetime as dt
from pathlib import Path

from sysid.plateaus import PlateauRules


def fit_parser(kind: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Parser with RUNS, --joint, --number, --out, --columns and --json; the kind adds its own."""
    parser = argparse.ArgumentParser(
        prog=f"jtq fit {kind}",
        description=description,
        epilog=f"examples:\n{examples}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUNS", help="run files (.csv, .csv.gz) or directories of them"
    )
    parser.add_argument("--joint", type=Path, required=True, metavar="FILE", help="joint file to start from")
    parser.add_argument(
        "--number",
        type=int,
        choices=range(1, 8),
        metavar="N",
        help="which joint of the runs it is (default: the number its name ends in)",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="joint file to write; none: only the report")
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def add_plateau_options(parser: argparse.ArgumentParser) -> None:
    """--min-hold and --min-current of the fits that rest on plateaus."""
    parser.add_argument(
        "--min-hold",
        type=positive,
        default=PlateauRules().shortest_s,
        metavar="S",
        help="shortest plateau in seconds (default %(default)s)",
    )
    parser.add_argument(
        "--min-current",
        type=positive,
        metavar="A",
        help="current below which eta is not formed (default: what overcomes the joint's own static friction)",
    )


def parse_fit(parser: argparse.ArgumentParser, argv: list[str]) -> argparse.Namespace:
    """Parse; the joint file that is read is never the one that is written."""
    options = parser.parse_args(argv)
    if options.out is not None and options.out.resolve() == options.joint.resolve():
        parser.error(f"--out: found {options.out}, the joint file itself, expected a new file")
    return options


def positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number > 0")
    return value


def today() -> str:
    """The date of a fit, ISO 8601, local time."""
    return dt.datetime.now().astimezone().date().isoformat()
