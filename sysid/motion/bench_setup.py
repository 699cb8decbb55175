"""All devices of the bench made ready for the motion, and put back after it, over a frame socket of its own."""

from __future__ import annotations

import logging
import math
import time

from drivers.boot_error import BootError
from drivers.devices import COMMANDER_NODE, SYNC_COB_ID, DriveProfile, SensorProfile
from drivers.errors import BusError
from drivers.frame import FRAME, FRAME_SIZE, pack
from drivers.frame_sdo import FrameSdo
from drivers.frame_socket import exact, open_frame_socket
from sysid.motion.cia402_client import CST, CSV
from sysid.motion.drive_setup import (
    DriveUnits,
    SensorUnits,
    quick_stop,
    release,
    reset_fault,
    sensor_units,
    set_up,
    switch_off,
)
from sysid.motion.limits import Limits
from sysid.motion.result import MotionError, Timing
from sysid.motion.setpoints import Setpoints

_HEARTBEAT = pack(0x700 + COMMANDER_NODE, b"\x05")


class BenchSetup:
    """SDO to both drives and the sensor. Raises BusError when the bus cannot be opened."""

    def __init__(
        self,
        bus: str,
        drives: tuple[DriveProfile, DriveProfile],
        sensor: SensorProfile | None,
        timing: Timing,
    ) -> None:
        nodes = [profile.node_id for profile in (*drives, sensor) if profile is not None]
        self._socket = open_frame_socket(bus, [exact(SYNC_COB_ID), exact(0x700 + COMMANDER_NODE)])
        self._drives, self._sensor, self._timing = drives, sensor, timing
        self._beating = False
        self._access = {node: FrameSdo(self._socket, node) for node in nodes}

    def prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, DriveUnits], SensorUnits | None]:
        """Both drives off and free of faults, modes set, targets zero, watching our heartbeat; their units and the sensor's.

        Raises MotionError; what was set is put back then. A second commander is noticed before anything is touched.
        """
        try:
            self._require_company()
        except BusError as error:
            raise MotionError(str(error)) from None
        try:
            return self._prepare(setpoints, limits)
        except (BootError, BusError) as error:
            self.release(beating=False)
            raise MotionError(str(error)) from None

    def _require_company(self) -> None:
        """jtqd's SYNC is there, and no other commander: for two periods of our own heartbeat nobody else sends it."""
        socket, frames = self._socket, self._socket.frames
        heard = set()
        end_s = time.monotonic() + 2.0 * self._timing.own_heartbeat_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(left_s)
            while count := socket.receive():
                heard |= {FRAME.unpack_from(frames, FRAME_SIZE * position)[0] for position in range(count)}
        if 0x700 + COMMANDER_NODE in heard:
            raise MotionError(f"another commander is on the bus (node {COMMANDER_NODE:02X}h): end it first")
        if SYNC_COB_ID not in heard:
            raise MotionError(f"no SYNC on {socket.bus}: jtqd must run on this bus")
        socket.set_filters([exact(0x580 + node) for node in self._access])

    def _prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, DriveUnits], SensorUnits | None]:
        access = self._access
        for profile in self._drives:
            quick_stop(access[profile.node_id], profile.node_id)
        for profile in self._drives:
            switch_off(access[profile.node_id], profile.node_id, time.sleep)
            fault = reset_fault(access[profile.node_id], profile.node_id, time.sleep)
            if fault is not None:
                logging.getLogger(__name__).warning("node %d: %s was reset", profile.node_id, fault)
        units = [
            set_up(
                access[profile.node_id],
                profile,
                CSV if joint == setpoints.velocity_joint else CST,
                round(self._timing.drive_timeout_s * 1e3),
                time.sleep,
                temperature=math.isfinite(limits.temperature_c),
            )
            for joint, profile in enumerate(self._drives, 1)
        ]
        sensor = self._sensor
        found = None if sensor is None else sensor_units(access[sensor.node_id], sensor)
        return (units[0], units[1]), found

    def release(self, *, beating: bool) -> str:
        """Both drives off for certain, targets zero, no longer watching us; "" or what could not be done, in one line.

        `beating`: our heartbeat has been heard, so it goes on until nobody watches it any more.
        """
        self._beating = beating
        problems = []
        for step in (self._quick_stop, self._release):
            for profile in self._drives:
                try:
                    self._beat()
                    step(profile.node_id)
                except (BootError, BusError) as error:
                    problems.append(str(error))
        return "; ".join(dict.fromkeys(problems))

    def _quick_stop(self, node: int) -> None:
        quick_stop(self._access[node], node)

    def _release(self, node: int) -> None:
        release(self._access[node], node, self._sleep)

    def _sleep(self, duration_s: float) -> None:
        self._beat()
        time.sleep(duration_s)

    def _beat(self) -> None:
        if self._beating:
            self._socket.send(_HEARTBEAT)

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()
