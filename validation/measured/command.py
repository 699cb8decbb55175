"""`python -m validation measured`: score the torque observer on the shipped runs of a real arm, offline or over a CAN bus.

python -m validation measured --out DIR [--json] [--joint-files DIR]
python -m validation measured --bus unix:PATH --out DIR [--json]
python -m jtqd.sim_can.bench_kernel run --time-travel --out DIR -- python -m validation measured --bus vcan0 --out DIR
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jtqd.daemon.logs import LogError
from jtqd.estimator.checked import ConfigError, make_directory
from jtqd.estimator.run import RunTableError
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.runs.run_file import RunError
from validation.measured import bus, offline


def main(arguments: list[str] | None = None) -> int:
    """Command line; results on stdout, log on stderr. Exit status 0 done, 1 failure, 2 usage."""
    options = parser().parse_args(arguments)
    if options.bus is not None and options.joint_files is not None:
        parser().error("--joint-files: not possible with --bus, which does not fit")
    try:
        make_directory(options.out)
        if options.bus is None:
            _offline(options.out, options.joint_files or options.out, options.json)
        else:
            _on_bus(options.bus, options.out, options.json)
    except OSError as error:
        print(f"measured: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
        return 1
    except (RunError, RunTableError, ConfigError, LossFitError, LogError, bus.PlayError) as error:
        print(f"measured: {error}", file=sys.stderr)
        return 1
    return 0


def parser() -> argparse.ArgumentParser:
    """Arguments of `python -m validation measured`."""
    result = argparse.ArgumentParser(
        prog="python -m validation measured",
        description="Score the torque observer on the Kinova Gen3 runs, before and after fitting the losses.",
        epilog="example: python -m validation measured --bus unix:/tmp/bus --out measured",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument(
        "--bus", help="play the runs on this bus (vcan0, unix:PATH) and score the published estimates of jtqd"
    )
    result.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="directory of the figures and jtqd's logs"
    )
    result.add_argument("--json", action="store_true", help="print the results as JSON")
    result.add_argument(
        "--joint-files",
        type=Path,
        metavar="DIR",
        help="directory of the fitted joint files (default: the --out directory)",
    )
    return result


def _offline(out: Path, joint_files: Path, as_json: bool) -> None:
    cases, fits = offline.evaluate(joint_files, dt.date.today().isoformat())
    _draw(cases, out / "measured_joint{}.png", "draw_joint")
    if as_json:
        print(json.dumps(offline.as_mapping(cases, fits), indent=1))
        return
    print("RMSE of the estimate against the arm's torque sensor, Nm (percent of rated torque)")
    print("\n".join(offline.table_lines(cases)))
    for (joint, run), fit in fits.items():
        print(f"\njoint {joint}, losses fitted on {run}:", *fit.lines(), sep="\n  ")


def _on_bus(address: str, out: Path, as_json: bool) -> None:
    results = bus.evaluate(address, out)
    _draw(results, out / "measured_bus_joint{}.png", "draw_bus_joint")
    if as_json:
        runs = [bus.as_mapping(each) for each in results]
        print(json.dumps({"schema": "jtq.measured_bus/1", "runs": runs}, indent=1))
        return
    print("RMSE of the published estimate against the arm's torque sensor; differences in Nm")
    print("\n".join(bus.table_lines(results)))


def _draw(results: Sequence[Any], pattern: Path, function: str) -> None:
    """Draw one figure per joint by a function of `figures`; without matplotlib write that to the log instead.

    Args:
        results: each with the attribute `joint`.
        pattern: path of the figures, "{}" in place of the joint's number.
        function: name of (results of one joint, path) -> None.
    """
    try:
        from validation.measured import figures
    except ImportError:
        print("measured: no figures: matplotlib is not installed (extra: train)", file=sys.stderr)
        return
    draw: Callable[[Sequence[Any], Path], None] = getattr(figures, function)
    for number in offline.JOINTS:
        path = pattern.with_name(pattern.name.format(number))
        draw([result for result in results if result.joint == number], path)
        print(f"measured: wrote {path}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
