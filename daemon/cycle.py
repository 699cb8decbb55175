"""One cycle of the loop, stage by stage. The stages are methods so that a benchmark can time each of them.

    begin    take what came late, send SYNC
    gather   one wake-up for all inputs, then wait for stragglers until the deadline
    observe  scale, estimate, decide the status of both joints
    publish  send the estimate PDO, and every n-th cycle the heartbeat
    record   hand the cycle to the ring, and every n-th cycle the snapshot

No stage raises because of what is on the bus; a bus that is down is a counter and a stale estimate.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isnan, nan

from daemon import cycle_record as cr
from daemon import estimate_pdo
from daemon.grid import Grid
from daemon.intake import Intake
from daemon.ring import Ring
from daemon.snapshot import COUNTERS, LATE_BIN_NS, LATE_BINS, WORK_BIN_NS, WORK_BINS, Snapshot
from drivers.errors import BusDown, BusError
from drivers.frame import pack, worst_case_bits
from drivers.frame_socket import FrameSocket
from estimator import status as st
from estimator.joint_estimator import JointEstimator

_STARTING_CYCLES = 20
"""Cycles at the start that are published as "starting": the arrival bands and the filters see their first inputs."""
_SNAPSHOT_EVERY = 8
_WAIT_STEP_NS = 160
_WAKE_MARGIN_NS = 10_000
_SHORTEST_WAIT_NS = 50_000
_CLOCK_READING_NS = 20_000
"""Both clocks are read within this, or their difference is not taken."""
_STAMP_ACCURACY_NS = 5_000
"""Kernel software stamps differ by a few us from the time on the wire."""
_POWERED = {0x27, 0x07}
"""Operation enabled and quick stop active (6041h masked with 6Fh): the states in which the motor carries current."""
_FAULTS = {0x0F, 0x08}
"""Fault reaction active and fault (6041h masked with 4Fh)."""
_HALF_RANGE, _FULL_RANGE = 1 << 31, 1 << 32
_INDEX = {name: n for n, name in enumerate(COUNTERS)}


@dataclass(frozen=True)
class JointInputs:
    """Where one joint's inputs stand among the intake's PDOs, and what one count of each is worth.

    Attributes:
        position: index of TPDO1 (motor position, link position).
        motion: index of TPDO2 (motor velocity, current, statusword).
        sensor: index of the sensor's PDO, None without reference.
        motor_rad_per_count, motor_rad_s_per_unit, link_rad_per_count, ampere_per_unit, sensor_nm_per_unit: scaling, SI.
    """

    position: int
    motion: int
    sensor: int | None
    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float
    sensor_nm_per_unit: float


class Unwrap:
    """Counts of a 32-bit position without its wrap at 2^31 (object 6064h is an INTEGER32 that rolls over)."""

    __slots__ = ("_last", "_offset")

    def __init__(self) -> None:
        self._last = 0
        self._offset = 0

    def counts(self, raw: int) -> int:
        """Continuous counts; right as long as two samples lie less than 2^31 counts apart."""
        step = raw - self._last
        if not -_HALF_RANGE <= step < _HALF_RANGE:
            self._offset += -_FULL_RANGE if step > 0 else _FULL_RANGE
        self._last = raw
        return raw + self._offset


class _JointState:
    """What the loop keeps of one joint from cycle to cycle."""

    __slots__ = ("estimator", "inputs", "last_ns", "link", "motor", "published", "sample", "status", "view")

    def __init__(self, inputs: JointInputs, estimator: JointEstimator) -> None:
        self.inputs = inputs
        self.estimator = estimator
        self.last_ns = 0
        self.motor, self.link = Unwrap(), Unwrap()
        self.status = st.STARTING
        self.sample: tuple[float, ...] = (nan,) * 11 + (0, 0, 0, 0)
        self.view: tuple[float, ...] = (nan,) * 6 + (0, 0, 0)
        self.published = estimate_pdo.field(nan, inf, st.STARTING)

    def begin_again(self) -> None:
        """The drive restarted: its positions and the observer's past mean nothing any more."""
        self.motor, self.link = Unwrap(), Unwrap()
        self.last_ns = 0
        self.estimator.reset()

    def withdraw(self, status: int = st.STALE) -> None:
        """Take the estimate back: nothing of it goes out or is logged as published."""
        self.published = estimate_pdo.field(nan, inf, status)
        self.status = status
        self.sample = (*self.sample[:5], nan, nan, *self.sample[7:12], status, *self.sample[13:])
        self.view = (nan, nan, *self.view[2:7], status, self.view[8])


class Cycle:
    """State of the loop and its stages.

    Args:
        socket: frame socket with filters for SYNC, the inputs and the nodes' heartbeats, own echo on.
        intake: the rule that says which frame belongs to which cycle.
        joints: inputs and estimator of joint 1 and 2.
        ring, snapshot: shared memory towards recorder and viewers.
        node_id: own node-ID; the estimate PDO is 180h + node_id, the heartbeat 700h + node_id.
        counter_overflow: SYNC counter runs 1..overflow (1019h).
        wait_ns: from SYNC to the wake-up for the inputs at the start; it follows their arrival.
        deadline_ns: from SYNC to the end of the wait for them.
        heartbeat_cycles: cycles between two heartbeats.
        grid: time grid; its slot is the current cycle's.
    """

    def __init__(
        self,
        socket: FrameSocket,
        intake: Intake,
        joints: Sequence[tuple[JointInputs, JointEstimator]],
        ring: Ring,
        snapshot: Snapshot,
        *,
        node_id: int,
        counter_overflow: int,
        wait_ns: int,
        deadline_ns: int,
        heartbeat_cycles: int,
        grid: Grid,
    ) -> None:
        self.socket, self.intake, self.ring, self.snapshot, self.grid = socket, intake, ring, snapshot, grid
        self._joints = [_JointState(inputs, estimator) for inputs, estimator in joints]
        self._states = intake.views()
        self._counters = snapshot.counters
        self._overflow = counter_overflow
        self._wait_ns, self._deadline_ns = wait_ns, deadline_ns
        self._sync_frames = [pack(0x080, bytes((n,))) for n in range(counter_overflow + 1)]
        self._estimate_id = 0x180 + node_id
        self._heartbeat = pack(0x700 + node_id, b"\x05")
        self._heartbeat_cycles = heartbeat_cycles
        self._heartbeat_due = 0
        self._stamp_layouts = [struct.Struct(f"<{n}q") for n in range(cr.FRAME_CAPACITY + 1)]
        self._bits_complete = (
            worst_case_bits(1) + worst_case_bits(8) + sum(worst_case_bits(p.length) for p in intake.pdos)
        )
        self._bits_of = [worst_case_bits(pdo.length) for pdo in intake.pdos]
        self.index = 0
        self.counter = 0
        self.late_ns = 0
        self._flags = 0
        self._frame_count = self._left_out = 0
        self._slot = ring.slot()
        self._sync_ns = self._realtime_offset_ns = self._sync_realtime_ns = self._work_start_ns = 0
        self._before = (0, 0, 0, 0)
        self._bus_errors = 0
        self._configured = bytes(snapshot.configured)

    def begin(self) -> None:
        """Drain what came after the last cycle was closed, then send SYNC."""
        intake, socket = self.intake, self.socket
        self._slot = self.ring.slot()
        self._frame_count = self._left_out = self._flags = 0
        self._before = (
            intake.stale_inputs,
            intake.late_frames,
            intake.duplicate_frames,
            intake.rejected_frames,
        )
        count = self._receive()
        if count:
            intake.drain(socket.frames, socket.stamps_ns, socket.own, count)
            self._keep(count)
        self.counter = self.counter % self._overflow + 1
        intake.begin(self.counter)
        before = time.monotonic_ns()
        realtime = time.time_ns()
        now = time.monotonic_ns()
        if now - before < _CLOCK_READING_NS or not self._realtime_offset_ns:
            self._realtime_offset_ns = realtime - now  # else something came between: the last one is better
        self._send(self._sync_frames[self.counter])
        self._sync_ns = now
        self.late_ns = now - self.grid.slot_ns

    def gather(self) -> None:
        """Take the inputs: one wake-up for all that have come, then wait for the missing ones until the deadline."""
        due = self._sync_ns + self._wait_ns
        pause = due - time.monotonic_ns()
        if pause > 0:
            time.sleep(pause * 1e-9)
        self._work_start_ns = time.monotonic_ns()
        intake, socket = self.intake, self.socket
        deadline = min(self._sync_ns + self._deadline_ns, self.grid.slot_ns + self.grid.period_ns - 100_000)
        done = False
        while True:
            count = self._receive()
            if count:
                done = intake.take(socket.frames, socket.stamps_ns, socket.own, count)
                self._keep(count)
            if done:
                break
            left = deadline - time.monotonic_ns()
            if left <= 0 or not socket.wait(left * 1e-9):
                break
        if intake.close():
            self._flags |= cr.FLAG_COMPLETE
            self._adapt_wait(intake.last_delay_ns)
        if intake.unconfigured:
            self._see_configured()
        if intake.sync_stamp_ns:
            self._flags |= cr.FLAG_SYNC_CONFIRMED
            self._sync_realtime_ns = intake.sync_stamp_ns
        else:
            self._sync_realtime_ns = self._sync_ns + self._realtime_offset_ns

    def observe(self) -> None:
        """Estimate of both joints from the inputs of this cycle."""
        sync_ns = self._sync_realtime_ns - self._realtime_offset_ns
        for number, joint in enumerate(self._joints):
            self._observe(joint, sync_ns, number)

    def publish(self) -> None:
        """Send the estimate PDO, and the heartbeat when it is due. An estimate that is too late is none."""
        one, two = self._joints
        if time.monotonic_ns() >= self.grid.slot_ns + self.grid.period_ns:
            one.withdraw()
            two.withdraw()
        data = estimate_pdo.encode(one.published, two.published, self.counter)
        frame = pack(self._estimate_id, data)
        if self._send(frame):
            self._flags |= cr.FLAG_PUBLISHED
            if time.monotonic_ns() < self.grid.slot_ns + self.grid.period_ns:
                self._flags |= cr.FLAG_BEFORE_NEXT_SYNC
        self._keep_own(frame)
        if self.index >= self._heartbeat_due:
            self._heartbeat_due = self.index + self._heartbeat_cycles
            self._send(self._heartbeat)

    def record(self) -> None:
        """Hand the cycle over to the ring, update counters and, every n-th cycle, the snapshot."""
        intake, slot = self.intake, self._slot
        one, two = self._joints
        stale, late, duplicate, rejected = self._before
        work_ns = time.monotonic_ns() - self._work_start_ns
        cr.HEAD.pack_into(
            slot,
            0,
            self.index,
            self._sync_ns,
            self._sync_realtime_ns,
            self._flags,
            min(work_ns, 0xFFFF_FFFF),
            min(self.late_ns, 0x7FFF_FFFF),
            self.grid.missed & 0xFFFF_FFFF,
            self.counter,
            self._frame_count,
            min(self._left_out, 255),
            min(intake.stale_inputs - stale, 255),
            min(intake.late_frames - late, 255),
            min(intake.duplicate_frames - duplicate, 255),
            min(intake.rejected_frames - rejected, 255),
            0,
            *one.sample,
            *two.sample,
        )
        cr.TAIL.pack_into(slot, cr.TAIL_OFFSET, self.index)
        self.ring.commit()
        self._count(work_ns)
        if self.index % _SNAPSHOT_EVERY == 0:
            self.snapshot.write(self.index, self.counter, self._sync_realtime_ns, (one.view, two.view))
        self.index += 1

    def hold_back(self) -> bool:
        """True when this slot must pass without SYNC, so that late frames can be told from lost ones (see intake)."""
        intake = self.intake
        if not (intake.gap_wanted or intake.in_gap):
            return False
        count = self._receive()
        if count:
            intake.drain(self.socket.frames, self.socket.stamps_ns, self.socket.own, count)
        if not intake.gap_wanted:
            return False
        intake.gap()
        self.index += 1
        return True

    def skip(self, slots: int) -> None:
        """Slots that were missed: the index follows the grid, so that a gap in the log shows where they were."""
        self.index += slots

    def leave(self) -> None:
        """Last words on the bus: an estimate with status off, so that nobody holds on to the last number."""
        one, two = self._joints
        one.withdraw(st.OFF)
        two.withdraw(st.OFF)
        self._send(pack(self._estimate_id, estimate_pdo.encode(one.published, two.published, self.counter)))
        self._counters[_MISSED] = self.grid.missed
        self._flush_counters()
        self.snapshot.write(self.index, self.counter, self._sync_realtime_ns, (one.view, two.view))

    def _observe(self, joint: _JointState, sync_ns: int, number: int) -> None:
        inputs, states = joint.inputs, self._states
        position, motion = states[inputs.position], states[inputs.motion]
        sensor_nm, sensor_status, flags = nan, 0, 0
        if inputs.sensor is not None:
            sensor = states[inputs.sensor]
            if sensor.fresh:
                flags = 4
                raw, sensor_status = sensor.values
                if not sensor_status & 0x07:  # 6150h: not valid, positive or negative overload
                    sensor_nm = raw * inputs.sensor_nm_per_unit
        if not (position.fresh and motion.fresh):
            flags |= position.fresh | motion.fresh << 1
            self._stale(joint, sensor_nm, sensor_status, flags)
            return
        flags |= 3
        motor_counts, link_counts = position.values
        velocity_units, current_units, statusword = motion.values
        current = current_units * inputs.ampere_per_unit
        motor_position = joint.motor.counts(motor_counts) * inputs.motor_rad_per_count
        motor_velocity = velocity_units * inputs.motor_rad_s_per_unit
        link_position = joint.link.counts(link_counts) * inputs.link_rad_per_count
        dt_ns = sync_ns - joint.last_ns if joint.last_ns else 0
        # SYNC keeps an absolute grid: a deviation below the stamps' own accuracy is theirs, not time's.
        if -_STAMP_ACCURACY_NS < dt_ns - self.grid.period_ns < _STAMP_ACCURACY_NS:
            dt_ns = self.grid.period_ns
        dt = dt_ns * 1e-9
        joint.last_ns = sync_ns
        estimate = joint.estimator.step(dt, current, motor_position, motor_velocity, link_position)
        status = estimate.status
        if self.index < _STARTING_CYCLES and status in estimate_pdo.PUBLISHED_STATUSES:
            status = st.STARTING
        if statusword & 0x6F not in _POWERED:
            status = st.DRIVE_FAULT if statusword & 0x4F in _FAULTS else st.OFF
        if status == st.DEGRADED:
            self._counters[_FALLBACKS] += 1
        torque, sigma, tob, efficiency, network = (
            estimate[0],
            estimate[1],
            estimate[3],
            estimate[4],
            estimate[5],
        )
        joint.published = estimate_pdo.field(torque, sigma, status)
        status = joint.published[2]  # 15 where the number does not fit the field: log and bus agree
        if status not in estimate_pdo.PUBLISHED_STATUSES:
            torque = sigma = nan
        joint.status = status
        joint.sample = (
            current,
            motor_position,
            motor_velocity,
            link_position,
            sensor_nm,
            torque,
            sigma,
            tob,
            efficiency,
            network,
            dt,
            statusword,
            status,
            sensor_status,
            flags,
        )
        joint.view = (torque, sigma, tob, efficiency, network, sensor_nm, statusword, status, sensor_status)
        if status in (st.VALID, st.DEGRADED) and not isnan(sensor_nm):
            errors = self.snapshot.errors
            errors[2 * number] += (torque - sensor_nm) ** 2
            errors[2 * number + 1] += 1.0

    def _stale(self, joint: _JointState, sensor_nm: float, sensor_status: int, flags: int) -> None:
        """An input of this cycle is missing: the observer keeps its state (the next dt is longer), nothing is published."""
        joint.published = estimate_pdo.field(nan, inf, st.STALE)
        joint.status = st.STALE
        joint.sample = (nan,) * 4 + (sensor_nm,) + (nan,) * 6 + (0, st.STALE, sensor_status, flags)
        joint.view = (nan,) * 5 + (sensor_nm, 0, st.STALE, sensor_status)

    def _adapt_wait(self, last_delay_ns: int) -> None:
        """Wake up when 99 of 100 times everything has come: each frame waited for is a wake-up more."""
        if last_delay_ns + _WAKE_MARGIN_NS > self._wait_ns:
            self._wait_ns = min(self._wait_ns + 99 * _WAIT_STEP_NS, self._deadline_ns - _WAKE_MARGIN_NS)
        else:
            self._wait_ns = max(self._wait_ns - _WAIT_STEP_NS, _SHORTEST_WAIT_NS)

    def _receive(self) -> int:
        try:
            return self.socket.receive()
        except BusDown:
            self._bus_errors += 1
            return 0

    def _send(self, frame: bytes) -> bool:
        try:
            return self.socket.send(frame)
        except BusDown:
            self._bus_errors += 1
            return False

    def _keep(self, count: int) -> None:
        """Copy received frames and stamps into the record."""
        stored = self._frame_count
        room = cr.FRAME_CAPACITY - stored
        if count > room:
            self._left_out += count - room
            count = room
        if count <= 0:
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self._slot[start : start + 16 * count] = memoryview(self.socket.frames)[: 16 * count]
        self._stamp_layouts[count].pack_into(
            self._slot, cr.STAMPS_OFFSET + 8 * stored, *self.socket.stamps_ns[:count]
        )
        self._frame_count = stored + count

    def _keep_own(self, frame: bytes) -> None:
        stored = self._frame_count
        if stored >= cr.FRAME_CAPACITY:
            self._left_out += 1
            return
        start = cr.FRAMES_OFFSET + 16 * stored
        self._slot[start : start + 16] = frame
        stamp = time.monotonic_ns() + self._realtime_offset_ns
        self._stamp_layouts[1].pack_into(self._slot, cr.STAMPS_OFFSET + 8 * stored, stamp)
        self._frame_count = stored + 1

    def _see_configured(self) -> None:
        """A node that restarted counts again once the supervisor has written its configuration (checked rarely)."""
        now = bytes(self.snapshot.configured)
        for node in self.intake.unconfigured:
            if now[node] != self._configured[node]:
                self.intake.configured(node)
                self.snapshot.unconfigured[node] = 0
                for joint in self._joints:
                    if self.intake.pdos[joint.inputs.position].node_id == node:
                        joint.begin_again()
        self._configured = now

    def _count(self, work_ns: int) -> None:
        counters, flags = self._counters, self._flags
        counters[_CYCLES] += 1
        counters[_MISSED] = self.grid.missed
        bits = self._bits_complete
        if flags & cr.FLAG_COMPLETE:
            counters[_COMPLETE] += 1
        else:
            bits -= sum(b for b, state in zip(self._bits_of, self._states, strict=True) if not state.fresh)
        if flags & cr.FLAG_PUBLISHED:
            counters[_PUBLISHED] += 1
            if not flags & cr.FLAG_BEFORE_NEXT_SYNC:
                counters[_PUBLISHED_LATE] += 1
        counters[_BITS] += bits
        counters[_WORK_MAX] = max(counters[_WORK_MAX], work_ns)
        counters[_LATE_MAX] = max(counters[_LATE_MAX], self.late_ns, 0)
        self.snapshot.work[min(work_ns // WORK_BIN_NS, WORK_BINS - 1)] += 1
        self.snapshot.late[min(max(self.late_ns, 0) // LATE_BIN_NS, LATE_BINS - 1)] += 1
        if self.index % _SNAPSHOT_EVERY == 0:
            self._flush_counters()

    def _flush_counters(self) -> None:
        """Counters that are kept elsewhere, copied where readers see them."""
        counters, intake = self._counters, self.intake
        counters[_INDEX["stale_inputs"]] = intake.stale_inputs
        counters[_INDEX["late_frames"]] = intake.late_frames
        counters[_INDEX["duplicate_frames"]] = intake.duplicate_frames
        counters[_INDEX["rejected_frames"]] = intake.rejected_frames
        counters[_INDEX["unknown_frames"]] = intake.unknown_frames
        counters[_INDEX["foreign_sync"]] = intake.foreign_sync
        counters[_INDEX["sync_errors"]] = intake.sync_errors
        counters[_INDEX["sync_gaps"]] = intake.gaps
        counters[_INDEX["boot_ups"]] = intake.boot_ups
        counters[_INDEX["tx_dropped"]] = self.socket.tx_dropped
        counters[_INDEX["rx_dropped"]] = self.socket.rx_dropped
        counters[_INDEX["bus_errors"]] = self._bus_errors
        for node, state in intake.node_states.items():
            self.snapshot.node_states[node] = state
        for node in intake.unconfigured:
            self.snapshot.unconfigured[node] = 1


_WORK_MAX, _LATE_MAX = _INDEX["work_max_ns"], _INDEX["late_max_ns"]
_CYCLES, _MISSED, _COMPLETE = _INDEX["cycles"], _INDEX["missed"], _INDEX["complete"]
_PUBLISHED, _PUBLISHED_LATE = _INDEX["published"], _INDEX["published_late"]
_BITS = _INDEX["bits_worst_case"]
_FALLBACKS = _INDEX["network_fallbacks"]

__all__ = ["BusError", "Cycle", "JointInputs"]
