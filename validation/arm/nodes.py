"""CANopen nodes of the foreign arm: joints of a recorded day on four buses, all at the same instant of the day.

    python -m validation.arm.nodes DAY.npz --bus vcan0 --joints 1,2 --begin-ns N

A real arm is in one place at one time, whatever bus a joint is on: the day begins at CLOCK_MONOTONIC N on every bus. Until
then the first rows, in which the arm hardly moves, are gone over to and fro.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Final

import numpy as np
import yaml

from jtqd.sim_can.bench import Bench, run
from jtqd.sim_can.source import ChannelSignal, DriveRatings, DriveSignals, Source
from jtqd.sysid.fit.joint_writer import write_joint
from validation.arm.arm import CYCLE_S, Arm, Readings
from validation.arm.joints import RealJoints

BUSES: Final = ((1, 2), (3, 4), (5, 6), (7,))
"""Joints of each bus, as its drives 1 and 2."""
WAITING: Final = 200
"""Rows that are gone over before the day begins."""
COLUMNS: Final = ("current_a", "motor_rad", "motor_rad_s", "link_rad", "temperature_c")
CONFIG: Final = {"node_id": 32, "estimator": {"method": "fused", "track_zeros": True}}


class DaySource(Source):
    """One or two joints (1..7) of a day. since(): seconds since the day began, asked once, at the first SYNC."""

    def __init__(
        self,
        columns: Sequence[np.ndarray],
        joints: Sequence[int],
        ratings: Sequence[DriveRatings],
        since: Callable[[], float],
    ) -> None:
        self.ratings = ratings
        self.drives = tuple(DriveSignals() for _ in joints)
        self.channels: tuple[ChannelSignal, ...] = ()
        self._rows = [[x[:, joint - 1].tolist() for x in columns] for joint in joints]
        self._length = len(columns[0])
        self._since: Callable[[], float] | None = since
        self._time_s = 0.0
        for drive in self.drives:
            drive.enabled = True
        self._show(0)

    def advance(self, dt_s: float) -> bool:
        """Go on by dt_s [s]; False when the day is over."""
        if self._since is not None:
            self._time_s, self._since = self._since(), None
        else:
            self._time_s += dt_s
        row = math.floor(self._time_s / CYCLE_S + 0.5)
        if row >= self._length:
            return False
        if row < 0:
            row = abs((row + WAITING) % (2 * WAITING) - WAITING)
        self._show(row)
        return True

    def _show(self, row: int) -> None:
        for drive, rows in zip(self.drives, self._rows, strict=True):
            (
                drive.current_a,
                drive.motor_position_rad,
                drive.motor_velocity_rad_s,
                drive.link_position_rad,
                drive.temperature_c,
            ) = (each[row] for each in rows)


def ratings_of(arm: Arm) -> list[DriveRatings]:
    """Return the ratings of the arm's drives."""
    drive, measured = arm.law["drive"], arm.law["measurement"]
    return [
        DriveRatings(
            gear_ratio=float(arm.ratio[j]),
            rated_current_a=float(arm.size[j] * drive["rated_current_a"][j]),
            rated_torque_nm=float(
                arm.nominal["torque_constant_nm_per_a"][j] * arm.size[j] * drive["rated_current_a"][j]
            ),
            trip_current_a=math.inf,
            motor_counts_per_rev=int(measured["motor_counts_per_rev"][j]),
            link_counts_per_rev=int(measured["link_counts_per_rev"][j]),
        )
        for j in range(len(arm.size))
    ]


def write_arm(folder: Path, arm: Arm, joints: RealJoints, readings: Readings) -> None:
    """Write a day (day.npz), joint files and a configuration per bus (bus_1.yaml, ...) into a folder. Raises OSError."""
    ratings = [astuple(each) for each in ratings_of(arm)]
    np.savez(folder / "day.npz", ratings=ratings, **{key: getattr(readings, key) for key in COLUMNS})
    for joint in joints.joints:
        write_joint(folder / f"{joint.name}.yaml", joint, "Joint of the foreign arm")
    for number, on_bus in enumerate(BUSES, start=1):
        config = CONFIG | {
            f"joint_{node}": {"node": node, "file": f"joint{joint}.yaml", "temperature": True}
            for node, joint in enumerate(on_bus, start=1)
        }
        (folder / f"bus_{number}.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")


def main(words: Sequence[str] | None = None) -> int:
    """Run the nodes of one bus until the day is over."""
    parser = argparse.ArgumentParser(prog="python -m validation.arm.nodes", description=__doc__)
    parser.add_argument("day", type=Path)
    parser.add_argument("--bus", required=True)
    parser.add_argument("--joints", required=True, help="1,2")
    parser.add_argument("--begin-ns", type=int, required=True)
    options = parser.parse_args(words)
    joints = [int(each) for each in options.joints.split(",")]
    with np.load(options.day) as day:
        columns = [day[key] for key in COLUMNS]
        kept = [day["ratings"][joint - 1].tolist() for joint in joints]
    ratings = [
        DriveRatings(ratio, amps, torque, trip, int(motor), int(link))
        for ratio, amps, torque, trip, motor, link in kept
    ]

    def since() -> float:
        return float(time.monotonic_ns() - options.begin_ns) * 1e-9

    source = DaySource(columns, joints, ratings, since)
    return run(options.bus, Bench(source, "rest", with_sensor=False))


if __name__ == "__main__":
    raise SystemExit(main())
