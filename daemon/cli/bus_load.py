"""`jtq bus-load`: the worst-case load of the bus by a configuration, before it is run."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.config import load_config
from jtqd.drivers.bus_load import LIMIT
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.errors import ConfigError

_EXAMPLES = """examples:
  jtq bus-load                                  of the shipped bench
  jtq bus-load --config /etc/jtqd/can0.yaml     before use: jtqd refuses a load above 95 %
  jtq bus-load --json | jq '.rows[] | [.cob_id, .share]'

`jtq check` measures the real load of a bus.

exit status: 0 it fits, 1 it does not or cannot be read, 2 usage"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq bus-load`."""
    result = command_parser(
        "jtq bus-load",
        "Compute the worst-case bus load of a configuration: all PDOs, with the maximum number of stuff bits.",
        _EXAMPLES,
    )
    shipped = "configuration (default: the shipped bench)"
    result.add_argument("--config", type=Path, metavar="FILE", help=shipped)
    result.add_argument("--json", action="store_true", help="print as JSON")
    return result


def main(argv: list[str]) -> int:
    """Print the table; returns the exit status."""
    arguments = parser().parse_args(argv)
    try:
        config = load_config(arguments.config)
    except ConfigError as error:
        print(f"jtq bus-load: {error}", file=sys.stderr)
        return 1
    load = bus_load_of(config)
    rows, fits = load.table(), load.worst <= LIMIT
    if arguments.json:
        print(
            json.dumps(
                {"worst": load.worst, "unstuffed": load.unstuffed, "limit": LIMIT, "fits": fits, "rows": rows}
            )
        )
        return 0 if fits else 1
    print(f"{'COB-ID':<7} {'bytes':>5} {'per cycle':>9} {'worst bits':>10} {'share':>7}  who")
    for row in rows:
        print(
            f"{row['cob_id']:<7} {row['bytes']:>5} {row['per_cycle']:>9.3g} {row['worst_bits']:>10.1f} "
            f"{row['share']:>7.2%}  {row['who']}"
        )
    bounds = f"worst case {load.worst:.1%}, without stuff bits {load.unstuffed:.1%}, limit {LIMIT:.0%}"
    print(bounds if fits else f"{bounds}: does not fit")
    return 0 if fits else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
