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
* the PDOs of a node that is not believed (`NodeTrust`) are not used.

A joint's temperature (TPDO3) is not bound to SYNC: it belongs to no cycle, nobody waits for it, and none of the above but
the last two rules concerns it (`daemon/loop/input_pdos.py`).

Pure: bytes and stamps in, values and counters out; no clock, no socket.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from jtqd.daemon.loop.input_pdos import InputPdo, InputState, JointTemperature
from jtqd.drivers.devices import SYNC_COB_ID
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_RTR_FLAG
from jtqd.drivers.nmt import BOOT_UP, HEARTBEAT_BASE, STATES

_LONGEST = 10
"""Slots; after that SYNC goes on and the debts stay."""
_PAUSE = 20
"""Cycles between two gaps: a bus that loses frames all the time must not lose its SYNC as well."""


class Gaps:
    """Slots without SYNC: what comes in one is late, and what has not come by the end of a silent one was lost.

    `Intake` asks for a gap where the delay of a frame does not tell whether it is a late one.

    Attributes:
        count: slots without SYNC so far.
        wanted: the next slot shall pass without SYNC.
        open: the last slot did.
        arrivals: late frames in the last slot.
        pause: cycles before the next gap.
        length: slots of the present gap.
    """

    __slots__ = ("arrivals", "count", "length", "open", "pause", "wanted")

    def __init__(self) -> None:
        self.count = self.arrivals = self.pause = self.length = 0
        self.wanted = self.open = False

    def pass_slot(self) -> None:
        """Pass a slot without SYNC."""
        self.count += 1
        self.wanted, self.open = False, True
        self.arrivals = 0
        self.length += 1
        self.pause = _PAUSE

    @property
    def may_go_on(self) -> bool:
        """Return whether one more slot may pass, as late frames came in the last one."""
        return self.open and self.arrivals > 0 and self.length < _LONGEST


class NodeTrust:
    """Which producers of the input PDOs may be believed: heartbeats, who has restarted, who has been configured since.

    A node that sent its boot-up message has lost its PDO mapping. None of its PDOs is used or waited for until `configured`.
    The same holds for one that was found to be configured otherwise (`doubt`), and for an optional one that is absent.

    Args:
        pdos: states of all input PDOs; `wanted` of each is kept here.

    Attributes:
        heartbeats: node-ID by COB-ID of its heartbeat.
        wanted: number of PDOs whose node is believed.
        unconfigured: nodes that are not, because they restarted, are in doubt or absent.
        absent: those of them that are missed by nobody.
        states: last heartbeat state of each node (`drivers.nmt.STATES`).
        heard_ns: kernel stamp of that heartbeat, CLOCK_REALTIME.
        boot_ups: boot-up messages of all nodes.
        restarts: boot-up messages of each node that has sent one.
    """

    def __init__(self, pdos: Sequence[InputState]) -> None:
        self._pdos = tuple(pdos)
        self.heartbeats = {HEARTBEAT_BASE + state.pdo.node_id: state.pdo.node_id for state in pdos}
        self.wanted = len(self._pdos)
        self.unconfigured: frozenset[int] = frozenset()
        self.absent: frozenset[int] = frozenset()
        self.states: dict[int, int] = {}
        self.heard_ns: dict[int, int] = {}
        self.boot_ups = 0
        self.restarts: dict[int, int] = {}

    def heartbeat(self, node_id: int, state: int, stamp_ns: int) -> bool:
        """Take a heartbeat of one byte; return False for an impossible state."""
        if state not in STATES:
            return False
        self.states[node_id] = state
        self.heard_ns[node_id] = stamp_ns
        if state == BOOT_UP:  # the mapping is back to the device's default
            self.boot_ups += 1
            self.restarts[node_id] = self.restarts.get(node_id, 0) + 1
            self.doubt(node_id)
        return True

    def configured(self, node_id: int) -> None:
        """Accept a configured node: its PDOs count from the next cycle on."""
        self.absent -= {node_id}
        self._set(node_id, self.unconfigured - {node_id}, wanted=1)

    def leave_out(self, node_id: int) -> None:
        """Leave out an optional node that is absent at the start; its PDOs are not counted as missing."""
        self.absent |= {node_id}
        self.doubt(node_id)

    def doubt(self, node_id: int) -> None:
        """Stop using this node."""
        self._set(node_id, self.unconfigured | {node_id}, wanted=0)

    def _set(self, node_id: int, unconfigured: frozenset[int], *, wanted: int) -> None:
        self.unconfigured = unconfigured
        for state in self._pdos:
            if state.pdo.node_id == node_id:
                state.wanted = wanted
                state.debt = 0
                state.probation = False
        self.wanted = sum(state.wanted for state in self._pdos)


_HEAD = struct.Struct("<IB")
_QUARANTINE = 5
"""Cycles with exactly one frame each before a PDO is used again whose account was closed without its frame."""


class Intake:
    """Inputs of one cycle after the other.

    Use per cycle: `begin()` when the SYNC has been sent, `take(...)` for each batch of frames until it returns True or the
    deadline has passed, `close()`, then read `values` and `fresh`; `drain(...)` for what arrives before the next SYNC. Where
    `gaps.wanted` is then True, `gaps.pass_slot()` takes the place of the next cycle, and no SYNC is sent in its slot.

    Args:
        pdos: the expected PDOs; results are indexed in this order.
        temperatures: joint temperatures that may come at any time.

    Attributes:
        nodes: which of their producers may be believed.
        gaps: slots without SYNC.
        last_delay_ns: delay of the last input after the SYNC, in the last cycle that had them all.
        sync_stamp_ns: CLOCK_REALTIME stamp of the own SYNC's echo, 0 while it has not been seen in this cycle.
        sync_errors: echoes of an earlier SYNC than the one of the cycle: the transmit queue holds it back.
    """

    def __init__(self, pdos: Sequence[InputPdo], temperatures: Sequence[JointTemperature] = ()) -> None:
        self.pdos = tuple(pdos)
        self.temperatures = tuple(temperatures)
        self._temperature_by_id = {temperature.cob_id: temperature for temperature in temperatures}
        self._states = [InputState(pdo) for pdo in pdos]
        self._by_id = {state.pdo.cob_id: state for state in self._states}
        if len({*self._by_id, *self._temperature_by_id}) != len(self._states) + len(self.temperatures):
            raise ValueError("two inputs share a COB-ID")
        self.nodes = NodeTrust(self._states)
        self._missing = 0
        self._foreign_sync_now = False
        self.gaps = Gaps()
        self.last_delay_ns = self.sync_stamp_ns = self._counter = 0
        self.foreign_sync = self.sync_errors = self.unknown_frames = 0
        self.late_frames = self.duplicate_frames = self.rejected_frames = self.stale_inputs = 0

    def begin(self, counter: int) -> None:
        """Begin a cycle after SYNC number `counter` (1..240) was sent: no input is fresh."""
        self._counter = counter
        gaps, indebted = self.gaps, False
        for state in self._states:
            state.fresh = False
            state.conflict = False
            if state.debt and state.wanted:
                if state.probation or (gaps.open and not gaps.arrivals):
                    state.lost += state.debt
                    state.debt = 0
                    state.probation = False
                    if gaps.open:
                        state.quarantine = _QUARANTINE
                else:
                    indebted = True
        gaps.open = False
        gaps.length = 0
        if gaps.pause:
            gaps.pause -= 1
        # With a debt one more frame may come: then only the deadline ends the wait.
        self._missing = self.nodes.wanted + indebted
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
                state.wrong_length(length)
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
                self._missing -= state.wanted
        return self._missing == 0

    def close(self) -> bool:
        """Close the cycle at the deadline, or when all inputs are received: decide which are used.

        Returns:
            True when every PDO of the nodes that are configured is a valid input of this cycle.
        """
        sync_ns = self.sync_stamp_ns
        complete = True
        last_ns = 0
        for state in self._states:
            if state.fresh:
                delay = state.stamp_ns - sync_ns if sync_ns else -1
                if state.debt or state.quarantine or not state.wanted:
                    self._doubt(state, delay)
                elif delay >= 0:
                    state.learn(delay)
                    last_ns = max(last_ns, delay)
                if state.conflict or not sync_ns or self._foreign_sync_now:
                    state.fresh = False
            elif state.wanted:
                state.debt += 1
                state.probation = False
            if state.fresh:
                state.in_a_row = 0
                continue
            state.missed += 1
            state.in_a_row += 1
            if state.wanted or state.pdo.node_id not in self.nodes.absent:
                self.stale_inputs += 1
                complete = False
        self._foreign_sync_now = False  # one that comes from here on belongs to the next cycle
        if complete and last_ns:
            self.last_delay_ns = last_ns
        return complete

    def _doubt(self, state: InputState, delay_ns: int) -> None:
        """A frame came, but it may be an earlier cycle's, or of a node that nobody has configured: it is not used."""
        state.fresh = False
        if not state.wanted:
            return
        if state.debt:
            state.probation = state.usual(delay_ns)
            if not state.probation and not self.gaps.pause:
                self.gaps.wanted = True
        else:
            state.quarantine -= 1

    def drain(self, frames: bytearray, stamps_ns: Sequence[int], own: Sequence[bool], count: int) -> None:
        """Take frames received after the cycle was closed: late, or duplicates."""
        for n in range(count):
            can_id, length = _HEAD.unpack_from(frames, 16 * n)
            state = self._by_id.get(can_id)
            if state is None:
                self._other(can_id, frames, 16 * n, stamps_ns[n], own=own[n])
            elif length != state.length:
                state.wrong_length(length)
                self.rejected_frames += 1
            elif not state.wanted:
                continue  # of a node with a mapping that nobody has checked
            elif state.debt:
                self._late(state)
                state.probation = False
                self.gaps.arrivals += 1
            else:
                state.duplicates += 1
                self.duplicate_frames += 1
                if frames[16 * n + 8 : 16 * n + 16] != state.data:
                    state.quarantine = _QUARANTINE
        if self.gaps.may_go_on:
            self.gaps.wanted = any(state.debt for state in self._states)

    def configured(self, node_id: int) -> None:
        """See `NodeTrust.configured`."""
        self.nodes.configured(node_id)

    def absent(self, node_id: int) -> None:
        """See `NodeTrust.leave_out`."""
        self.nodes.leave_out(node_id)

    @property
    def unconfigured(self) -> frozenset[int]:
        """Return the nodes that are not used until they have been configured."""
        return self.nodes.unconfigured

    def fresh(self, index: int) -> bool:
        """Return whether PDO `index` is an input of the cycle just closed."""
        return self._states[index].fresh

    def values(self, index: int) -> tuple[int, ...]:
        """Return the raw integers of PDO `index`, in the order of its mapping; meaningful only when fresh."""
        return self._states[index].values

    def views(self) -> list[InputState]:
        """Return the states for the loop's fast path: `.fresh` and `.values`."""
        return self._states

    def _late(self, state: InputState) -> None:
        state.late += 1
        self.late_frames += 1
        state.debt = max(0, state.debt - 1)

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
                self._missing += state.wanted
                self._late(state)

    def _second(self, state: InputState, frames: bytearray, offset: int, stamp: int) -> None:
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

    def _other(self, can_id: int, frames: bytearray, offset: int, stamp: int, *, own: bool) -> None:
        if can_id == SYNC_COB_ID:
            if own:
                self._own_sync(frames[offset + 8], stamp)
            else:
                self.foreign_sync += 1
                self._foreign_sync_now = True
            return
        nodes = self.nodes
        node = nodes.heartbeats.get(can_id)
        if node is not None and frames[offset + 4] == 1:
            if not nodes.heartbeat(node, frames[offset + 8], stamp):
                self.rejected_frames += 1
            return
        temperature = self._temperature_by_id.get(can_id)
        if temperature is not None:
            if temperature.node_id not in nodes.unconfigured and not temperature.receive(frames, offset):
                self.rejected_frames += 1
            return
        identifier = can_id & CAN_EFF_MASK
        named = self._by_id.get(identifier) or self._temperature_by_id.get(identifier)
        if named is not None and can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG):
            named.rejected += 1
            self.rejected_frames += 1
        elif identifier == SYNC_COB_ID or identifier in nodes.heartbeats:
            self.rejected_frames += 1
        elif not own:
            self.unknown_frames += 1
