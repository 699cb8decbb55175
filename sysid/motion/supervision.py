"""What must be as it is while the joints move: nodes alive, inputs fresh, drives enabled, sensor valid. Pure."""

from __future__ import annotations

from typing import Final

from sysid.motion.cia402_client import FAULTED, POWERED, State, describe, fast_state
from sysid.motion.inputs import ChannelInput, DriveInput, Inputs, NodeInput
from sysid.motion.result import Timing, Violation

STILL_RAD_S: Final = 0.02
"""Joint side: below this a joint stands."""
_OPERATIONAL: Final = 0x05
_NMT_NAMES: Final = {0x00: "restarted (boot-up message)", 0x04: "stopped", 0x7F: "pre-operational"}
_MS: Final = 1e-6


class Supervision:
    """Looks at `inputs` once per cycle; keeps no state of its own. What is hard makes each drive brake by itself."""

    def __init__(self, inputs: Inputs, timing: Timing) -> None:
        self._inputs = inputs
        self._stale = timing.stale_cycles
        self._beats = timing.heartbeats_missing
        self._temperature_ns = round(timing.temperature_s * 1e9)

    def check(self, now_ns: int, *, enabled: bool) -> Violation | None:
        """First thing that is not as it must be; `enabled`: both drives in operation enabled, else only without fault."""
        inputs = self._inputs
        oldest = inputs.cycle - self._stale
        for drive in inputs.drives:
            found = (
                self._node(drive, now_ns, hard=True)
                or _state(drive, enabled)
                or self._fresh(drive, oldest)
                or self._temperature(drive, now_ns)
            )
            if found is not None:
                return found
        if inputs.sensor is not None:
            found = self._node(inputs.sensor, now_ns, hard=False)
            if found is not None:
                return found
        for channel in inputs.channels:
            if channel.status:
                return Violation(
                    f"sensor: status of channel {channel.channel} is {channel.status:02X}h, expected 00h",
                    False,
                )
            if channel.cycle < oldest:
                return self._stale_channel(channel)
        if inputs.foreign:
            return Violation("another commander is on the bus (its heartbeat has our node number)", True)
        return None

    def missing(self, now_ns: int) -> str | None:
        """Before the start: what has not been heard yet; None when all is there and in order."""
        inputs = self._inputs
        for node in inputs.nodes:
            if node.nmt_state < 0:
                return f"{node.who}: no heartbeat {0x700 + node.node:03X}h"
        for drive in inputs.drives:
            if not (drive.cycle_1 and drive.cycle_2):
                return f"{drive.who}: no TPDO1 or TPDO2; jtqd's boot configures them"
            if drive.units.temperature and drive.temperature_c != drive.temperature_c:
                return f"{drive.who}: no temperature ({0x380 + drive.node:03X}h), which its limit needs"
        for channel in inputs.channels:
            if not channel.cycle:
                return f"sensor: no torque of channel {channel.channel}"
        found = self.check(now_ns, enabled=False)
        return None if found is None else found.reason

    def moving(self) -> str | None:
        """Which joint does not stand, or cannot be seen to; None when both do."""
        oldest = self._inputs.cycle - self._stale
        for drive in self._inputs.drives:
            if not -STILL_RAD_S <= drive.velocity_rad_s <= STILL_RAD_S or drive.cycle_2 < oldest:
                velocity = f"velocity {drive.velocity_rad_s:.3f} rad/s before the start"
                return f"{drive.who}: {velocity}, limit {STILL_RAD_S:g} rad/s"
        return None

    def obeyed(self, turn: int) -> bool:
        """Drive 0 or 1 says, just now, that it follows no set-point any more, or has taken an SDO that said so."""
        drive = self._inputs.drives[turn]
        fresh = drive.cycle_2 >= self._inputs.cycle - self._stale
        return drive.told_by_sdo or (fresh and fast_state(drive.statusword) is not State.OPERATION_ENABLED)

    def both_off(self) -> bool:
        """Both drives say, just now, that their motors are not driven."""
        oldest = self._inputs.cycle - self._stale
        return all(
            fast_state(drive.statusword) not in POWERED and drive.cycle_2 >= oldest
            for drive in self._inputs.drives
        )

    def _node(self, node: NodeInput, now_ns: int, *, hard: bool) -> Violation | None:
        if node.emergency is not None:
            code, register = node.emergency
            return Violation(f"{node.who}: EMCY {code:04X}h (error register {register:02X}h)", hard)
        if node.nmt_state != _OPERATIONAL:
            name = _NMT_NAMES.get(node.nmt_state, f"state {node.nmt_state}")
            return Violation(f"{node.who}: NMT {name}, expected operational", hard)
        age_ns = now_ns - node.beat_ns
        if age_ns > node.heartbeat_ns * self._beats:
            limit = node.heartbeat_ns * self._beats * _MS
            return Violation(
                f"{node.who}: no heartbeat for {age_ns * _MS:.0f} ms, limit {limit:.0f} ms", hard
            )
        return None

    def _fresh(self, drive: DriveInput, oldest: int) -> Violation | None:
        if drive.cycle_1 >= oldest and drive.cycle_2 >= oldest:
            return None
        number, base, cycle = (
            (2, 0x280, drive.cycle_2) if drive.cycle_2 < oldest else (1, 0x180, drive.cycle_1)
        )
        missing = self._inputs.cycle - cycle
        text = f"TPDO{number} ({base + drive.node:03X}h) missing for {missing} cycles, limit {self._stale}"
        return Violation(f"{drive.who}: {text}", drive.cycle_1 < oldest and drive.cycle_2 < oldest)

    def _stale_channel(self, channel: ChannelInput) -> Violation:
        missing = self._inputs.cycle - channel.cycle
        text = (
            f"sensor: torque of channel {channel.channel} missing for {missing} cycles, limit {self._stale}"
        )
        return Violation(text, False)

    def _temperature(self, drive: DriveInput, now_ns: int) -> Violation | None:
        age_ns = now_ns - drive.temperature_ns
        if not drive.units.temperature or age_ns <= self._temperature_ns:
            return None
        limit = self._temperature_ns * 1e-9
        return Violation(f"{drive.who}: no temperature for {age_ns * 1e-9:.1f} s, limit {limit:g} s", False)


def _state(drive: DriveInput, enabled: bool) -> Violation | None:
    state = fast_state(drive.statusword)
    if enabled and state is not State.OPERATION_ENABLED:
        return Violation(f"{drive.who}: {describe(drive.statusword)}, expected operation enabled", True)
    if state in FAULTED:
        return Violation(f"{drive.who}: {describe(drive.statusword)}", True)
    return None
