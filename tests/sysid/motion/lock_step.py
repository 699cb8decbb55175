"""The commander against the emulated bench in lock-step: no socket, no clock, every millisecond by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jtqd.drivers.boot_node import BusSettings, NodeBoot, Sync
from jtqd.drivers.drive import DriveProfile
from jtqd.drivers.frame import FRAME
from jtqd.drivers.sdo import SdoAccess, Transfer
from jtqd.drivers.sensor import SensorProfile
from jtqd.models.files import shipped
from jtqd.sim_can.bench import Bench
from jtqd.sim_can.eds_entries import sensor_node
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import sources_of
from jtqd.sysid.motion.commander import Commander, Phase
from jtqd.sysid.motion.drives import CST, CSV, Drive, sending_order, sensor_units
from jtqd.sysid.motion.setpoints import Limits, Setpoints, Surroundings, Timing

MS = 1_000_000
PLANT = load_plant(shipped("plant.yaml"))
WIDE = Limits(current_a=9.0, velocity_rad_s=3.3, torque_nm=100.0, travel_rad=60.0)
WARM = replace(WIDE, temperature_c=70.0)


def raised_cosine(n: int) -> np.ndarray:
    """From 0 to 1 in n steps, smooth at both ends."""
    return 0.5 - 0.5 * np.cos(math.pi * np.arange(1, n + 1) / n)


def plateau(
    velocity: float, current: float, hold_ms: int = 400, ramp_ms: int = 300, joint: int = 1
) -> Setpoints:
    """Up, hold, down."""
    ramp = raised_cosine(ramp_ms)
    shape = np.concatenate([ramp, np.ones(hold_ms), 1.0 - ramp])
    return Setpoints(joint, velocity * shape, current * shape)


Frames = list[tuple[int, bytes, int]]
"""COB-ID, data and time of each."""
Filter = Callable[[Frames], Frames]


def changed(can_id: int, change: Callable[[bytes], bytes]) -> Filter:
    """A filter that changes the data of one COB-ID."""
    return lambda frames: [(i, change(d) if i == can_id else d, t) for i, d, t in frames]


def without(*identifiers: int) -> Filter:
    """A filter that loses the frames of some COB-IDs."""
    return lambda frames: [frame for frame in frames if frame[0] not in identifiers]


def turning(node: int, velocity_rad_s: float) -> Filter:
    """A filter: the drive measures this velocity, joint side."""
    units = round(velocity_rad_s * 100 / (2 * math.pi) * 65536)
    return changed(0x280 + node, lambda data: units.to_bytes(4, "little") + data[4:])


class BenchAccess:
    """SDO to one node of a bench in memory; the bench's clock advances by what `sleep` is called with."""

    def __init__(self, lock: LockStep, node: int) -> None:
        self.lock, self.node = lock, node

    def read(self, index: int, subindex: int) -> bytes:
        return self._run(Transfer(index, subindex))

    def write(self, index: int, subindex: int, data: bytes) -> None:
        self._run(Transfer(index, subindex, data))

    def _run(self, transfer: Transfer) -> bytes:
        while not transfer.done:
            frames = self.lock.to_bench(0x600 + self.node, transfer.request)
            assert any(transfer.answer(data) for can_id, data, _ in frames if can_id == 0x580 + self.node)
        return transfer.value


class LockStep:
    """A bench, booted as jtqd boots it, and a commander; `sent` is all that the commander has sent: (ms, COB-ID, data).

    `filter` sees each batch of frames on its way to the commander and may change it: that is how faults are injected.

    drives: 1 to 4, coupled in pairs; the sensor is node 3, or 5 beside more than two. period_ms: of SYNC. profiles: of the
    drives, where they are not as CiA 402 has them.
    """

    def __init__(
        self,
        plant: Any = PLANT,
        profile: str = "rest",
        drives: int = 2,
        period_ms: int = 1,
        profiles: Sequence[DriveProfile] = (),
    ) -> None:
        sources = sources_of(plant, 1, drives)
        self.source: Any = sources[0]
        self.bench = Bench(sources[0], profile, sources[1:])
        self.drives = tuple(profiles) or tuple(DriveProfile(node) for node in range(1, drives + 1))
        self.nodes = range(1, drives + 1)
        self.sensor_node = sensor_node(drives)
        self.sensor_profile = SensorProfile(self.sensor_node, channels=(1,) if drives < 3 else (1, 2))
        self.period_ms = period_ms
        self.now = 1_000 * MS
        self.counter = 0
        self.sent: list[tuple[int, int, bytes]] = []
        self.filter: Filter = lambda frames: frames
        self.sync_runs = True
        self.deaf = False
        self.waiting: Frames = []
        self.bench.tick(self.now)
        settings = BusSettings(sync=Sync(counter_overflow=240))
        for profile_of in (*self.drives, self.sensor_profile):
            boot = NodeBoot(BenchAccess(self, profile_of.node_id), profile_of, settings)
            boot.run(boot.check_device_type())
        self.to_bench(0, b"\x01\x00")

    def sleep(self, duration_s: float) -> None:
        self.now += round(duration_s * 1e9)
        self.waiting += self.texts(self.bench.tick(self.now))

    def texts(self, frames: list[bytes]) -> Frames:
        out = []
        for frame in frames:
            can_id, length, data = FRAME.unpack(frame)
            out.append((can_id, data[:length], self.now))
        return out

    def to_bench(self, can_id: int, data: bytes) -> Frames:
        return self.texts(self.bench.on_frame(can_id, data, self.now, self.now))

    def access(self, node: int) -> BenchAccess:
        return BenchAccess(self, node)

    def drive(self, access: SdoAccess, profile: DriveProfile) -> Drive:
        return Drive(access, profile, self.sleep)

    def commander(
        self,
        setpoints: Setpoints,
        limits: Limits = WIDE,
        timing: Timing | None = None,
        around: Surroundings | None = None,
    ) -> Commander:
        """Set up all drives and make the commander; kept as `self.motion`."""
        period_s = 1e-3 * self.period_ms
        timing = replace(timing or Timing(), period_s=period_s, setpoint_delay_s=0.7 * period_s)
        temperature = math.isfinite(limits.temperature_c)
        round_cycles = sending_order(setpoints.joints, len(self.nodes))[1]
        drives = [self.drive(self.access(profile.node_id), profile) for profile in self.drives]
        for drive in drives:
            drive.switch_off()
        units = [
            drive.set_up(
                CST if drive.node == setpoints.current_joint else CSV,
                round(timing.drive_timeout_s * 1e3),
                temperature=temperature,
                interpolation_ms=round_cycles * self.period_ms,
            )
            for drive in drives
        ]
        sensor = sensor_units(self.access(self.sensor_node), self.sensor_profile)
        self.motion = Commander(
            setpoints, limits, units, sensor, now_ns=self.now, timing=timing, around=around
        )
        return self.motion

    def cycle(self) -> None:
        """One period of SYNC: timers, SYNC, the bench's answers, and 70 % of it later the commander's turn."""
        self.now += self.period_ms * MS
        frames, self.waiting = self.waiting, []
        frames += self.texts(self.bench.tick(self.now))
        if self.sync_runs:
            self.counter = self.counter % 240 + 1
            sync = bytes([self.counter])
            frames.append((0x080, sync, self.now))
            frames += self.to_bench(0x080, sync)
        frames = self.filter(frames)
        if self.deaf:
            self.waiting = frames
            return
        for can_id, data, _ in self.texts(
            self.motion.on_frames(frames, self.now + 7 * self.period_ms * MS // 10)
        ):
            self.sent.append((self.now // MS, can_id, data))
            self.waiting += self.to_bench(can_id, data)

    def run(self, until: Callable[[], bool] | None = None, limit_ms: int = 20_000) -> int:
        """Cycles until the commander is over, or `until` is true; how many they were."""
        for n in range(limit_ms):
            if self.motion.over or (until is not None and until()):
                return n
            self.cycle()
        raise AssertionError(f"still {self.motion.phase} after {limit_ms} ms")

    def run_for(self, ms: int) -> None:
        for _ in range(ms):
            self.cycle()

    def held_up(self, cycles: int) -> None:
        """The commander sees nothing for some cycles, and all their frames in the next one."""
        held: Frames = []
        self.deaf = True
        for _ in range(cycles):
            self.cycle()
            held += self.waiting
            self.waiting = []
        self.deaf = False
        self.waiting = held

    def with_extra(self, can_id: int, data: bytes) -> None:
        """Add a frame to every cycle from here on."""
        self.filter = lambda frames: [*frames, (can_id, data, self.now)]

    def play_until(self, ms: int) -> None:
        """Until set-point number `ms` has been in force."""
        self.run(lambda: self.motion.phase is Phase.PLAYING and self.motion.played_s * 1e3 >= ms)

    @property
    def velocities(self) -> tuple[float, float]:
        """True velocities, joint side."""
        plant = self.source.plant
        one, two = (side.joint.gear_ratio for side in plant.parameters.joints)
        return plant.motor_velocity[0] / one, plant.motor_velocity[1] / two

    @property
    def states(self) -> tuple[int, ...]:
        """jtqd.sim_can.devices states of all drives."""
        return tuple(drive.machine.state for drive in self.bench.drives)

    def setpoints_sent(self, after_ms: int = 0) -> list[tuple[int, int, int]]:
        """(ms, COB-ID, target) of each RPDO that carries a target of an enabled drive."""
        found = []
        for ms, can_id, data in self.sent:
            if ms < after_ms:
                continue
            if can_id & 0x780 == 0x300:
                found.append((ms, can_id, int.from_bytes(data, "little", signed=True)))
            elif can_id & 0x780 == 0x200 and data[:2] == b"\x0f\x00":
                found.append((ms, can_id, int.from_bytes(data[2:], "little", signed=True)))
        return found
