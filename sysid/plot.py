"""`jtq plot`: draw estimate and standard deviation, torque sensor, their difference and contacts of a log."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np

from jtqd.daemon.logs import LogError, Records, read_topic
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import check_installed
from jtqd.estimator.files import whole_file
from jtqd.estimator.observer import reference_of
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import (
    DEGRADED,
    DRIVE_FAULT,
    INVALID,
    NAMES,
    OFF,
    STALE,
    STANDSTILL,
    STARTING,
    VALID,
)
from jtqd.estimator.text import counted, finite
from jtqd.sysid.report.page import check_picture, shade

_SHADES = {
    STANDSTILL: "#dcecf2",
    DEGRADED: "#fbe8c8",
    STARTING: "#e3f0d8",
    OFF: "#e4e4e4",
    STALE: "#f5c9c9",
    DRIVE_FAULT: "#c9b3dd",
    INVALID: "#e08f8f",
}
"""By status; a torque was published with the first two only."""
_OTHER = "#c0c0c0"
_CONTACT = "#e58fb1"
CONTACT_KNOWN, CONTACT = 64, 128
"""Bits of `input_flags` in a log (schema jtqd_msgs/msg/JointEstimate)."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq plot`."""
    parser = argparse.ArgumentParser(
        prog="jtq plot",
        description="Draw the estimate of one joint and the torque sensor, as old as it, from a log of jtqd.",
        epilog="example: jtq plot logs/jtqd-sim-20261121T080000Z.mcap --joint 1 --out joint1.png",
    )
    parser.add_argument("log", type=Path, help="MCAP file of jtqd")
    parser.add_argument(
        "--joint", type=int, choices=range(1, 5), default=1, metavar="N", help="1 to 4 (default 1)"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="figure to write (png, svg, pdf)"
    )
    parser.add_argument("--json", action="store_true", help="print the path and the RMSE as JSON")
    return parser


def main(argv: list[str]) -> int:
    """Draw one joint of a log; exit status 0 done, 1 failure, 2 usage."""
    arguments = parser().parse_args(argv)
    joint = arguments.joint
    try:
        check_installed("analysis", "matplotlib")
        check_picture(arguments.out)
        rmse = draw(read_topic(arguments.log, f"/joint/{joint}/state"), joint, arguments.out)
    except (LogError, OSError, ValueError) as error:
        text = (
            f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
        )
        print(f"jtq plot: {text}", file=sys.stderr)
        return 1
    if arguments.json:
        print(json.dumps({"paths": [str(arguments.out)], "rmse_nm": {f"joint_{joint}": finite(rmse)}}))
    else:
        print(arguments.out)
    return 0


def reference(log: Records) -> tuple[FloatArray, float]:
    """Return the sensor, as old as the estimate [n], and that age [ms].

    A log without the field `reference_nm` has no age; it was recorded with the default bandwidth.
    """
    if "reference_nm" in (log.dtype.names or ()):
        known = log["age_ms"][np.isfinite(log["age_ms"])]
        return log["reference_nm"], float(known[-1]) if len(known) else math.nan
    rate = EstimatorSettings().bandwidth_rad_s
    return reference_of(log["sensor_torque_nm"], log["dt_s"], rate), 1e3 / rate


def contacts(log: Records) -> BoolArray | None:
    """Return where a contact was reported [n]; None where contacts were not watched, or the log has no such field."""
    if "contact_nm" not in (log.dtype.names or ()) or not (log["input_flags"] & CONTACT_KNOWN).any():
        return None
    there: BoolArray = (log["input_flags"] & CONTACT) != 0
    return there


def draw(log: Records, joint: int, path: Path) -> float:
    """Draw panels over time: torque and sensor, then their difference; shaded where the status is not valid.

    Where contacts were watched, two more: the external torque with its contacts shaded, and the torque rate.

    Returns the RMSE in the title [Nm], over the samples in motion with a valid sensor, both of one age; NaN without any.
    """
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
    from matplotlib import pyplot as plt

    time_s = (log["sync_monotonic_ns"] - log["sync_monotonic_ns"][0]) * 1e-9
    status = log["status"]
    published = np.isin(status, (VALID, DEGRADED, STANDSTILL))
    torque = np.where(published, log["torque_nm"], np.nan)
    sigma, sensor, age = log["sigma_nm"], *reference(log)
    contact = contacts(log)
    ratios = (3, 1.3) if contact is None else (3, 1.3, 1.3, 1.3)
    figure, axes = plt.subplots(
        len(ratios), 1, figsize=(11, 1.2 + sum(ratios)), sharex=True, height_ratios=ratios
    )
    above, below = axes[:2]
    above.fill_between(
        time_s, torque - sigma, torque + sigma, color="#9ec5e8", linewidth=0, label="estimate ± sigma"
    )
    with_sensor = bool(np.isfinite(sensor).any())
    if with_sensor:
        above.plot(time_s, sensor, color="#222222", linewidth=1.0, label="torque sensor")
    above.plot(time_s, torque, color="#1f6fb4", linewidth=0.8, label="estimate")
    moving = np.isin(status, (VALID, DEGRADED))
    error = np.where(moving, torque - sensor, np.nan)
    below.plot(time_s, error, color="#b4431f", linewidth=0.6)
    below.axhline(0.0, color="#222222", linewidth=0.6)
    rmse = float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else float("nan")
    when = f"both {age:.3g} ms old" if age > 0.0 else "now"
    title = (
        f"estimate and sensor, {when}, RMSE {rmse:.2f} Nm in motion"
        if with_sensor
        else "estimate; the log has no reference"
    )
    above.set_title(f"joint {joint}: {title}", fontsize=10)
    above.set_ylabel("joint torque [Nm]")
    below.set_ylabel("difference [Nm]")
    if contact is not None:
        for axis, values, what in zip(
            axes[2:],
            (log["contact_nm"], log["torque_rate_nm_s"]),
            ("from outside\n[Nm]", "torque rate\n[Nm/s]"),
            strict=True,
        ):
            axis.plot(time_s, values, color="#444444", linewidth=0.6)
            axis.set_ylabel(what)
            axis.margins(x=0)
        begun = int(contact[0]) + int((np.diff(contact.astype(np.int8)) > 0).sum())
        shade(axes[2], time_s, contact, _CONTACT, None)
        axes[2].set_title(counted(begun, "contact"), fontsize=9, color=_CONTACT)
    axes[-1].set_xlabel("time [s]")
    for axis in (above, below):
        axis.margins(x=0)
        for code in np.unique(status[status != VALID]):
            label = NAMES.get(int(code), str(code)) if axis is above else None
            shade(axis, time_s, status == code, _SHADES.get(int(code), _OTHER), label)
    figure.tight_layout(rect=(0.0, 0.0, 0.84, 1.0))
    above.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, fontsize=8)
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), dpi=110)
    plt.close(figure)
    return rmse
