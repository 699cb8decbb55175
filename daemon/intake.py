"""Which frames belong to this cycle: the rule that keeps a stale input from being taken for a fresh one.

A TPDO carries no cycle number. It counts as an input of SYNC k only when it arrived after SYNC k and no earlier frame of
the same PDO can still be under way:

* frames arrive in order: one before the echo of the cycle's own SYNC belongs to an earlier cycle: late, dropped, counted;
  without that echo, or with the echo of an earlier SYNC (it waited in the transmit queue), nothing is used;
* after a cycle without its frame the PDO has a *debt*: the missing frame was lost, or it is late and will be met in a later
  cycle, looking just like that cycle's own. While there is a debt nothing is believed. It is paid by a surplus
  frame (two in one cycle), or written off in one of two ways:
  - the arrivals have been so regular that their delay tells: one frame came, in the usual band, and no other until the
    next SYNC: the missing one was lost;
  - otherwise the loop is asked for a *gap*: slots without SYNC, in which only late frames can come, until one passes
    without any. What has not come by then was lost.
* a surplus frame with other bytes, when no debt was left, shows that an account was closed too early; after that, and after
  each gap, a PDO is used again only when some cycles in a row have brought exactly one frame each.
  A constant delay of more than one cycle thus never becomes valid, however irregular the arrivals are. This relies on the
  frames of one PDO keeping their order, as they do in a CAN controller;
* two frames in one cycle are harmless with equal bytes and a conflict with others (one is late, or there are two senders):
  then the input is not used in that cycle;
* a wrong length, a 29-bit identifier or a remote frame under one of our identifiers is rejected and counted;
* a SYNC that is not our own echo makes every input of the cycle doubtful: none is used;
* a node that sent its boot-up message has lost its PDO mapping: its PDOs are not used until it is configured again.

A joint's temperature (TPDO3) is not bound to SYNC: it belongs to no cycle, nobody waits for it, and none of the above but
the last two rules concerns it (`daemon/temperature.py`).

Pure: bytes and stamps in, values and counters out; no clock, no socket.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from daemon.temperature import JointTemperature

_HEAD = struct.Struct("<IB")
_SYNC_COB_ID = 0x080
_IDENTIFIER_MASK = 0x1FFF_FFFF
_EFF_FLAG = 0x8000_0000
_RTR_FLAG = 0x4000_0000
_HEARTBEAT_BASE = 0x700
_BAND_MARGIN_NS = 50_000
"""Allowance around the learned delays: one frame of 135 bits may have been in the way less than twice."""
_NARROW_NS = 200_000
"""A band wider than this cannot tell a late frame from one in time."""
_LONGEST_GAP = 10
"""Slots; after that SYNC goes on and the debts stay."""
_QUARANTINE = 5
"""Cycles with exactly one frame each before a PDO is used again whose account was closed without its frame."""
_GAP_PAUSE = 20
"""Cycles between two gaps: a bus that loses frames all the time must not lose its SYNC as well."""
_BAND_LEAK = 1.0 / 1024.0
"""The band shrinks towards what is seen now with a time constant of about a second at 1 kHz."""


@dataclass(frozen=True)
class InputPdo:
    """One synchronous TPDO that the loop waits for.

    Attributes:
        cob_id: 11-bit identifier.
        length: bytes of its mapping; any other length is rejected (CiA 301: 8210h).
        layout: precompiled unpacking of the mapped objects.
        node_id: its producer.
        name: as it appears in counters and events, e.g. "181h drive 1 TPDO1".
    """

    cob_id: int
    length: int
    layout: struct.Struct
    node_id: int
    name: str


class _State:
    """What is known of one PDO; slots because five of them are touched in every cycle."""

    __slots__ = (
        "band_high_ns",
        "band_low_ns",
        "conflict",
        "data",
        "debt",
        "duplicates",
        "fresh",
        "late",
        "length",
        "lost",
        "pdo",
        "probation",
        "quarantine",
        "rejected",
        "stamp_ns",
        "unpack",
        "values",
    )

    def __init__(self, pdo: InputPdo) -> None:
        self.pdo = pdo
        self.length = pdo.length
        self.unpack = pdo.layout.unpack_from
        self.values: tuple[int, ...] = (0,) * len(pdo.layout.unpack(bytes(pdo.length)))
        self.data = b""
        self.fresh = False
        self.conflict = False
        self.debt = 0
        self.probation = False
        self.quarantine = 0
        self.stamp_ns = 0
        self.band_low_ns = 1 << 62
        self.band_high_ns = 0
        self.late = self.lost = self.duplicates = self.rejected = 0


class Intake:
    """Inputs of one cycle after the other.

    Use per cycle: `begin()` when the SYNC has been sent, `take(...)` for each batch of frames until it returns True or the
    deadline has passed, `close()`, then read `values` and `fresh`; `drain(...)` for what arrives before the next SYNC. Where
    `gap_wanted` is then True, `gap()` takes the place of the next cycle, and no SYNC is sent in its slot.

    Args:
        pdos: the expected PDOs; results are indexed in this order.
        temperatures: joint temperatures that may come at any time.
    """

    def __init__(self, pdos: Sequence[InputPdo], temperatures: Sequence[JointTemperature] = ()) -> None:
        self.pdos = tuple(pdos)
        self.temperatures = tuple(temperatures)
        self._temperature_by_id = {temperature.cob_id: temperature for temperature in temperatures}
        self._states = [_State(pdo) for pdo in pdos]
        self._by_id = {state.pdo.cob_id: state for state in self._states}
        if len({*self._by_id, *self._temperature_by_id}) != len(self._states) + len(self.temperatures):
            raise ValueError("two inputs share a COB-ID")
        self._of_node: dict[int, list[_State]] = {}
        for state in self._states:
            self._of_node.setdefault(state.pdo.node_id, []).append(state)
        self._heartbeats = {_HEARTBEAT_BASE + node: node for node in self._of_node}
        self._unconfigured: set[int] = set()
        self._missing = 0
        self._foreign_sync_now = False
        self._after_gap = False
        self._gap_pause = 0
        self._gap_length = 0
        self._gap_arrivals = 0
        self.gap_wanted = False
        self.gaps = 0
        """Slots without SYNC so far."""
        self.last_delay_ns = 0
        """Delay of the last input after the SYNC, in the last cycle that had them all."""
        self.sync_stamp_ns = 0
        """CLOCK_REALTIME stamp of the own SYNC's echo, 0 while it has not been seen in this cycle."""
        self._counter = 0
        self.foreign_sync = 0
        self.sync_errors = 0
        """Echoes of an earlier SYNC than the one of the cycle: the transmit queue holds it back."""
        self.unknown_frames = 0
        self.late_frames = self.duplicate_frames = self.rejected_frames = 0
        self.stale_inputs = 0
        self.boot_ups = 0
        self.node_states: dict[int, int] = {}
        """Last heartbeat state of each node (CiA 301: 4 stopped, 5 operational, 127 pre-operational)."""

    def begin(self, counter: int) -> None:
        """SYNC number `counter` (1..240) has just been sent: nothing is fresh any more."""
        self._counter = counter
        indebted = False
        for state in self._states:
            state.fresh = False
            state.conflict = False
            if state.debt:
                if state.probation or (self._after_gap and not self._gap_arrivals):
                    state.lost += state.debt
                    state.debt = 0
                    state.probation = False
                    if self._after_gap:
                        state.quarantine = _QUARANTINE
                else:
                    indebted = True
        self._after_gap = False
        self._gap_length = 0
        if self._gap_pause:
            self._gap_pause -= 1
        # With a debt one more frame may come: then only the deadline ends the wait.
        self._missing = len(self._states) + indebted
        self.sync_stamp_ns = 0

    def take(self, frames: bytearray, stamps_ns: Sequence[int], own: Sequence[bool], count: int) -> bool:
        """Sort `count` frames in.

        Args:
            frames: `count` times 16 bytes of `struct can_frame`.
            stamps_ns: kernel receive stamps, CLOCK_REALTIME.
            own: True for echoes of our own frames.
            count: number of frames.

        Returns:
            True when every expected PDO of this cycle is there.
        """
        by_id = self._by_id
        unpack_head = _HEAD.unpack_from
        for n in range(count):
            offset = 16 * n
            can_id, length = unpack_head(frames, offset)
            state = by_id.get(can_id)
            if state is None:
                self._other(can_id, frames, offset, stamps_ns[n], own=own[n])
                continue
            if length != state.length:
                state.rejected += 1
                self.rejected_frames += 1
                continue
            stamp = stamps_ns[n]
            if state.fresh:
                self._second(state, frames, offset, stamp)
            else:
                state.fresh = True
                state.values = state.unpack(frames, offset + 8)
                state.data = bytes(frames[offset + 8 : offset + 16])
                state.stamp_ns = stamp
                self._missing -= 1
        return self._missing == 0

    def close(self) -> bool:
        """The deadline has passed, or all are there: decide what may be used.

        Returns:
            True when every expected PDO is a valid input of this cycle.
        """
        sync_ns = self.sync_stamp_ns
        complete = True
        last_ns = 0
        for state in self._states:
            if state.fresh:
                delay = state.stamp_ns - sync_ns if sync_ns else -1
                if state.debt:
                    state.fresh = False
                    state.probation = self._usual(state, delay)
                    if not state.probation and not self._gap_pause:
                        self.gap_wanted = True
                elif state.quarantine:
                    state.quarantine -= 1
                    state.fresh = False
                elif delay >= 0:
                    self._learn(state, delay)
                    last_ns = max(last_ns, delay)
                if state.conflict:
                    state.fresh = False
            else:
                state.debt += 1
                state.probation = False
            if (
                not sync_ns
                or self._foreign_sync_now
                or (self._unconfigured and state.pdo.node_id in self._unconfigured)
            ):
                state.fresh = False
            if not state.fresh:
                self.stale_inputs += 1
                complete = False
        self._foreign_sync_now = False  # one that comes from here on belongs to the next cycle
        if complete and last_ns:
            self.last_delay_ns = last_ns
        return complete

    def drain(self, frames: bytearray, stamps_ns: Sequence[int], own: Sequence[bool], count: int) -> None:
        """Frames that came after the cycle was closed: late for it, or a second copy of what was used."""
        for n in range(count):
            can_id, length = _HEAD.unpack_from(frames, 16 * n)
            state = self._by_id.get(can_id)
            if state is None:
                self._other(can_id, frames, 16 * n, stamps_ns[n], own=own[n])
            elif length != state.length:
                state.rejected += 1
                self.rejected_frames += 1
            elif state.debt:
                self._late(state)
                state.probation = False
                self._gap_arrivals += 1
            else:
                state.duplicates += 1
                self.duplicate_frames += 1
                if frames[16 * n + 8 : 16 * n + 16] != state.data:
                    state.quarantine = _QUARANTINE
        if self._after_gap and self._gap_arrivals and self._gap_length < _LONGEST_GAP:
            self.gap_wanted = any(state.debt for state in self._states)

    def gap(self) -> None:
        """This slot has no SYNC: what comes in it is late, what has not come by the end of a silent one was lost."""
        self.gaps += 1
        self.gap_wanted = False
        self._after_gap = True
        self._gap_arrivals = 0
        self._gap_length += 1
        self._gap_pause = _GAP_PAUSE

    def configured(self, node_id: int) -> None:
        """The node's mapping has been written and read back: its PDOs count again."""
        self._unconfigured.discard(node_id)
        for state in self._of_node.get(node_id, ()):
            state.debt = 0

    @property
    def in_gap(self) -> bool:
        """The last slot passed without SYNC."""
        return self._after_gap

    @property
    def unconfigured(self) -> frozenset[int]:
        """Nodes that restarted and have not been configured since."""
        return frozenset(self._unconfigured)

    def fresh(self, index: int) -> bool:
        """True when PDO `index` is an input of the cycle just closed."""
        return self._states[index].fresh

    def values(self, index: int) -> tuple[int, ...]:
        """Raw integers of PDO `index`, in the order of its mapping; meaningful only when fresh."""
        return self._states[index].values

    def views(self) -> list[_State]:
        """The states themselves, for the loop's fast path: `.fresh` and `.values`."""
        return self._states

    def counters(self) -> dict[str, dict[str, int]]:
        """Late, lost, duplicate and rejected frames by the PDO's name; of a temperature, how often it became unknown."""
        counts = {
            state.pdo.name: {
                "late": state.late,
                "lost": state.lost,
                "duplicate": state.duplicates,
                "rejected": state.rejected,
            }
            for state in self._states
        }
        for each in self.temperatures:
            counts[each.name] = {"late": 0, "lost": each.lost, "duplicate": 0, "rejected": each.rejected}
        return counts

    def _late(self, state: _State) -> None:
        state.late += 1
        self.late_frames += 1
        if state.debt:
            state.debt -= 1

    def _own_sync(self, counter: int, stamp: int) -> None:
        """The echo of our SYNC: what came before it, in order of arrival, answers an earlier one."""
        if counter != self._counter:
            self.sync_errors += 1
            return
        self.sync_stamp_ns = stamp
        for state in self._states:
            if state.fresh:
                state.fresh = False
                state.conflict = False
                self._missing += 1
                self._late(state)

    def _second(self, state: _State, frames: bytearray, offset: int, stamp: int) -> None:
        data = bytes(frames[offset + 8 : offset + 16])
        if state.debt:
            self._late(state)
        else:
            state.duplicates += 1
            self.duplicate_frames += 1
            if data != state.data:
                state.quarantine = _QUARANTINE
        if data != state.data:
            state.conflict = True
        state.values = state.unpack(data)
        state.data = data
        state.stamp_ns = stamp

    @staticmethod
    def _usual(state: _State, delay_ns: int) -> bool:
        """One frame came while an earlier one is missing: does its delay tell that it is this cycle's own?"""
        low, high = state.band_low_ns, state.band_high_ns
        return (
            delay_ns >= 0
            and high - low <= _NARROW_NS
            and low - _BAND_MARGIN_NS <= delay_ns <= high + _BAND_MARGIN_NS
        )

    @staticmethod
    def _learn(state: _State, delay_ns: int) -> None:
        if delay_ns < state.band_low_ns:
            state.band_low_ns = delay_ns
        else:
            state.band_low_ns += int((delay_ns - state.band_low_ns) * _BAND_LEAK)
        if delay_ns > state.band_high_ns:
            state.band_high_ns = delay_ns
        else:
            state.band_high_ns -= int((state.band_high_ns - delay_ns) * _BAND_LEAK)

    def _other(self, can_id: int, frames: bytearray, offset: int, stamp: int, *, own: bool) -> None:
        if can_id == _SYNC_COB_ID:
            if own:
                self._own_sync(frames[offset + 8], stamp)
            else:
                self.foreign_sync += 1
                self._foreign_sync_now = True
            return
        node = self._heartbeats.get(can_id)
        if node is not None and frames[offset + 4] == 1:
            state = frames[offset + 8]
            self.node_states[node] = state
            if state == 0:  # boot-up: the mapping is back to the device's default
                self.boot_ups += 1
                self._unconfigured.add(node)
            return
        temperature = self._temperature_by_id.get(can_id)
        if temperature is not None:
            if temperature.node_id not in self._unconfigured and not temperature.receive(frames, offset):
                self.rejected_frames += 1
            return
        identifier = can_id & _IDENTIFIER_MASK
        named = self._by_id.get(identifier) or self._temperature_by_id.get(identifier)
        if named is not None and can_id & (_EFF_FLAG | _RTR_FLAG):
            named.rejected += 1
            self.rejected_frames += 1
        elif identifier == _SYNC_COB_ID or identifier in self._heartbeats:
            self.rejected_frames += 1
        elif not own:
            self.unknown_frames += 1
