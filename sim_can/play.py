"""Playback of a measured run: a `Source` whose rows the bench's nodes send as PDO values, faithfully in time.

Run time advances by the measured step from SYNC to SYNC. The value of a SYNC is the row nearest to its
time, never an interpolation, so that what is on the bus is what was measured. Nearest, not previous: rows
are 1 ms apart like SYNCs, and with "previous" a SYNC that comes a microsecond early would repeat a row and
the next one skip one; with "nearest" row and SYNC stay half a row apart from that. A SYNC that was missed
skips its row, as it would with the live joint.

When the run is over `advance` returns False for good. The nodes then stop answering: a frozen value is
never sent as a measured one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTableError
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.source import ChannelSignal, DriveRatings, DriveSignals, Source
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.run_file import RunError, RunFile

COLUMN_MAP_NAME = "columns.yaml"


class PlaySource(Source):
    """`Source` of two recorded joints, each with a torque sensor channel of its own.

    Attributes:
        notes: remarks of the run's reader on the joints that are played.
        row: of the run that the signals show, from 0.
    """

    def __init__(
        self, run: RunFile, joints: tuple[int, int], ratings: tuple[DriveRatings, DriveRatings]
    ) -> None:
        time_s = run.table.time_s
        unplayed = tuple(f"j{number}." for number in run.table.joints if number not in joints)
        self.notes = tuple(note for note in run.notes if not note.startswith(unplayed))
        self.ratings = ratings
        self._rows = _rows(run, joints, ratings)
        # Row k is the nearest one from _change[k-1] on; the last entry is the end of the run.
        middles = 0.5 * (time_s[1:] + time_s[:-1]) - time_s[0]
        half_last_step = 0.5 * float(time_s[-1] - time_s[-2])
        self._change = [*middles.tolist(), float(time_s[-1] - time_s[0]) + half_last_step]
        self._time_s = 0.0
        self.drives = (DriveSignals(), DriveSignals())
        self.channels = (ChannelSignal(), ChannelSignal())
        for drive, channel, joint in zip(self.drives, self.channels, joints, strict=True):
            drive.enabled = True
            channel.valid = run.table.joints[joint].torque_nm is not None
        self._show(0)

    def advance(self, dt_s: float) -> bool:
        """Go on by dt_s >= 0 [s]; False when the run is over (signals then stay). Raises ValueError."""
        if not 0.0 <= dt_s < math.inf:
            raise ValueError(f"play: found a time step of {dt_s} s, expected a finite one >= 0")
        self._time_s += dt_s
        time_s, row, change = self._time_s, self.row, self._change
        while time_s >= change[row]:
            if row + 1 == len(change):
                return False
            row += 1
        if row != self.row:
            self._show(row)
        return True

    def _show(self, row: int) -> None:
        """Set the signals to a row of the run."""
        self.row = row
        first, second = self.drives
        (
            first.current_a,
            first.motor_position_rad,
            first.motor_velocity_rad_s,
            first.link_position_rad,
            self.channels[0].torque_nm,
            second.current_a,
            second.motor_position_rad,
            second.motor_velocity_rad_s,
            second.link_position_rad,
            self.channels[1].torque_nm,
        ) = self._rows[row]


def columns_beside(run_path: Path | str) -> Path | None:
    """Return the run's own column map, columns.yaml in its folder; None where there is none."""
    path = Path(run_path).parent / COLUMN_MAP_NAME
    return path if path.is_file() else None


def open_play(
    run_path: Path | str,
    columns_path: Path | str | None = None,
    joints: tuple[int, int] | None = None,
) -> PlaySource:
    """Play two joints of a run as drives 0 and 1 of the bench.

    Without `joints`: the two for which the column map names a joint file, else 1 and 2. The drives' ratings
    come from the column map's `jN.joint_file`, else from the bench's nominal joints.
    Raises ConfigError: run file, column map or joint file cannot be used.
    """
    columns = ColumnMap.load(Path(columns_path)) if columns_path is not None else None
    named = columns.joint_files if columns is not None else {}
    joints = joints or ((min(named), max(named)) if len(named) == 2 else (1, 2))
    if len(joints) != 2 or joints[0] == joints[1]:
        raise ConfigError(f"{run_path}: found joints {joints}, expected two different joints of the run")
    try:
        run = read_run(run_path, columns)
        for joint in joints:
            if joint not in run.table.joints:
                present = ", ".join(str(number) for number in sorted(run.table.joints))
                raise ConfigError(f"{run_path}: found no joint {joint}, expected one of {present}")
        shipped_files = shipped("joint1.yaml"), shipped("joint2.yaml")
        files = [named.get(k, file) for k, file in zip(joints, shipped_files, strict=True)]
        first, second = (_ratings(load_joint(path)) for path in files)
        return PlaySource(run, joints, (first, second))
    except RunError as error:
        raise ConfigError(str(error)) from None


def _ratings(joint: Joint) -> DriveRatings:
    """Return ratings whose rated current gives the joint's rated torque: i_rated = tau_rated/(G Kt). Never trips."""
    rated_current_a = joint.rated_torque_nm / (joint.gear_ratio * joint.torque_constant_nm_per_a)
    return DriveRatings(
        gear_ratio=joint.gear_ratio,
        rated_current_a=rated_current_a,
        rated_torque_nm=joint.torque_constant_nm_per_a * rated_current_a,
        trip_current_a=math.inf,
    )


def _rows(run: RunFile, joints: Sequence[int], ratings: Sequence[DriveRatings]) -> list[tuple[float, ...]]:
    """Return one tuple of floats per row, ready to be assigned: four quantities and the torque of each joint."""
    columns: list[FloatArray] = []
    for joint, rating in zip(joints, ratings, strict=True):
        try:
            _, *inputs = run.table.estimator_inputs(joint, rating.gear_ratio)
        except RunTableError as error:
            raise RunError(f"run to play: {error}") from None
        torque = run.table.joints[joint].torque_nm
        columns += [*inputs, torque if torque is not None else np.zeros(len(run.table.time_s))]
    return list(zip(*(column.tolist() for column in columns), strict=True))
