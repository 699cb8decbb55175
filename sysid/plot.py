"""`jtq plot`: draw estimate and standard deviation, torque sensor, shadow methods, differences and contacts of a log."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.daemon.logs import LogError, Records, read_topic, rmse, shadow_errors, topics_of
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import check_installed, command_parser
from jtqd.estimator.files import whole_file
from jtqd.estimator.observer import reference_of
from jtqd.estimator.settings import METHODS, EstimatorSettings
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

_SHADES: Final[dict[int, str]] = {
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
_SHADOW_COLOURS = ("#c9930e", "#3b8f5a", "#8a4fb0", "#7a7a7a")
CONTACT_KNOWN, CONTACT = 64, 128
"""Bits of `input_flags` in a log (schema jtqd_msgs/msg/JointEstimate)."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq plot`."""
    parser = command_parser(
        "jtq plot",
        "Draw the estimate of one joint and the torque sensor, as old as it, from a log of jtqd.",
        "example: jtq plot logs/jtqd-sim-20261121T080000Z.mcap --joint 1 --out joint1.png",
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
        log, shadow = read_topic(arguments.log, f"/joint/{joint}/state"), None
        if (topic := f"/joint/{joint}/shadow") in topics_of(arguments.log):
            shadow = read_topic(arguments.log, topic)
            log, shadow = (a[np.isin(a["cycle"], b["cycle"])] for a, b in ((log, shadow), (shadow, log)))
        error_nm = draw(log, joint, arguments.out, shadow)
    except (LogError, OSError, ValueError) as error:
        text = (
            f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
        )
        print(f"jtq plot: {text}", file=sys.stderr)
        return 1
    if arguments.json:
        errors = {} if shadow is None else shadow_errors(log, shadow)
        shadows = {"shadow_rmse_nm": {name: finite(rmse(error)) for name, error in errors.items()}}
        rmses = {"rmse_nm": {f"joint_{joint}": finite(error_nm)}, **(shadows if errors else {})}
        print(json.dumps({"paths": [str(arguments.out)], **rmses}))
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


def _draw_shadows(above: Any, below: Any, time_s: FloatArray, log: Records, shadow: Records) -> None:
    """Draw each shadow method into the two panels; its RMSE and age are in the legend."""
    for (name, error), colour in zip(shadow_errors(log, shadow).items(), _SHADOW_COLOURS, strict=False):
        title, age = METHODS[name].title if name in METHODS else name, float(shadow[f"{name}_age_ms"].max())
        if np.isfinite(error).any():
            title += f"\nRMSE {rmse(error):.2f} Nm, " + (f"{age:.3g} ms old" if age > 0.0 else "now")
        above.plot(time_s, shadow[f"{name}_torque_nm"], color=colour, linewidth=0.6, label=title)
        below.plot(time_s, error, color=colour, linewidth=0.4)


def draw(log: Records, joint: int, path: Path, shadow: Records | None = None) -> float:
    """Draw panels over time: torque and sensor, then their difference; shaded where the status is not valid.

    shadow: shadow methods of the same cycles; each of them is drawn in both panels. Where contacts were watched, two more
    panels: the external torque with its contacts shaded, and the torque rate.

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
        len(ratios), 1, figsize=(11.5, 1.2 + sum(ratios)), sharex=True, height_ratios=ratios
    )
    above, below = axes[:2]
    above.fill_between(
        time_s, torque - sigma, torque + sigma, color="#9ec5e8", linewidth=0, label="estimate ± sigma"
    )
    if shadow is not None:
        _draw_shadows(above, below, time_s, log, shadow)
    with_sensor = bool(np.isfinite(sensor).any())
    if with_sensor:
        above.plot(time_s, sensor, color="#222222", linewidth=1.0, label="torque sensor")
    above.plot(time_s, torque, color="#1f6fb4", linewidth=0.8, label="estimate")
    moving = np.isin(status, (VALID, DEGRADED))
    error = np.where(moving, torque - sensor, np.nan)
    below.plot(time_s, error, color="#b4431f", linewidth=0.6)
    below.axhline(0.0, color="#222222", linewidth=0.6)
    error_nm = rmse(error)
    when = f"both {age:.3g} ms old" if age > 0.0 else "now"
    title = (
        f"estimate and sensor, {when}, RMSE {error_nm:.2f} Nm in motion"
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
    figure.tight_layout(rect=(0.0, 0.0, 0.83, 1.0))
    above.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, fontsize=8)
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), dpi=110)
    plt.close(figure)
    return error_nm


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
