"""Which nodes may be believed: what their heartbeats say, who has restarted, who has been configured since. Pure.

A node that sent its boot-up message has lost its PDO mapping. None of its PDOs is used or waited for until `configured`. The
same holds for one that was found to be configured otherwise (`doubt`), and for an optional one that is absent.
"""

from __future__ import annotations

from collections.abc import Sequence

from daemon.loop.input_state import InputState

_HEARTBEAT_BASE = 0x700
_BOOT_UP = 0
_NMT_STATES = frozenset((_BOOT_UP, 4, 5, 127))
"""What a heartbeat may say (CiA 301): boot-up, stopped, operational, pre-operational."""


class NodeTrust:
    """The producers of the input PDOs.

    Args:
        pdos: states of all input PDOs; `wanted` of each is kept here.

    Attributes:
        heartbeats: node-ID by COB-ID of its heartbeat.
        wanted: number of PDOs whose node is believed.
        unconfigured: nodes that are not, because they restarted, are in doubt or absent.
        absent: those of them that are missed by nobody.
        states: last heartbeat state of each node (CiA 301: 0 boot-up, 4 stopped, 5 operational, 127 pre-operational).
        heard_ns: kernel stamp of that heartbeat, CLOCK_REALTIME.
        boot_ups: boot-up messages of all nodes.
        restarts: boot-up messages of each node that has sent one.
    """

    def __init__(self, pdos: Sequence[InputState]) -> None:
        self._pdos = tuple(pdos)
        self.heartbeats = {_HEARTBEAT_BASE + state.pdo.node_id: state.pdo.node_id for state in pdos}
        self.wanted = len(self._pdos)
        self.unconfigured: frozenset[int] = frozenset()
        self.absent: frozenset[int] = frozenset()
        self.states: dict[int, int] = {}
        self.heard_ns: dict[int, int] = {}
        self.boot_ups = 0
        self.restarts: dict[int, int] = {}

    def heartbeat(self, node_id: int, state: int, stamp_ns: int) -> bool:
        """A heartbeat of one byte; False for one that says an impossible state: it is none."""
        if state not in _NMT_STATES:
            return False
        self.states[node_id] = state
        self.heard_ns[node_id] = stamp_ns
        if state == _BOOT_UP:  # the mapping is back to the device's default
            self.boot_ups += 1
            self.restarts[node_id] = self.restarts.get(node_id, 0) + 1
            self.doubt(node_id)
        return True

    def configured(self, node_id: int) -> None:
        """The node's mapping has been written and read back: its PDOs count from the next cycle on."""
        self.absent -= {node_id}
        self._set(node_id, self.unconfigured - {node_id}, wanted=1)

    def leave_out(self, node_id: int) -> None:
        """An optional node that was not there at the start: like one that restarted, but its PDOs are not missed."""
        self.absent |= {node_id}
        self.doubt(node_id)

    def doubt(self, node_id: int) -> None:
        """Nothing of this node is used from now on."""
        self._set(node_id, self.unconfigured | {node_id}, wanted=0)

    def _set(self, node_id: int, unconfigured: frozenset[int], *, wanted: int) -> None:
        self.unconfigured = unconfigured
        for state in self._pdos:
            if state.pdo.node_id == node_id:
                state.wanted = wanted
                state.debt = 0
                state.probation = False
        self.wanted = sum(state.wanted for state in self._pdos)
