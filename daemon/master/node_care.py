"""The nodes in service: who needs a boot and is there, and is everybody still configured as at the boot.

It owns the SDO queues of the nodes. Pure but for the boot processes that `returning_nodes` starts: replies and times in,
requests out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from daemon.master.configuration_watch import ConfigurationWatch
from daemon.master.node_watch import LOST, NodeWatch
from daemon.master.returning_nodes import ReturningNodes
from daemon.shared.snapshot import SnapshotReader, View
from drivers.sdo_queue import SdoQueue, SdoResult

_CHECK_S = 0.1
"""Between two objects read to check a node's configuration: two frames, 0.27 % of 1 Mbit/s at most."""
_PROBE_S = 0.25
"""Between two questions whether a node that needs a boot is there."""
_PRESENT_S = 1.0
_OTHERS_S = 1.0
"""A node whose SDO server somebody else uses (it serves one client) is not asked for so long."""
_SDO_TIMEOUT_S = 0.3


class NodeCare:
    """Call `turn` often, and the others for what arrives.

    Args:
        nodes: their node-IDs.
        reader: tells the loop which nodes may be believed.
        returning: boots nodes.
        heartbeats: who is heard; nodes are watched from their boot on.
        say: takes topic, node and line for the operator.

    Attributes:
        changed: nodes that were found to be configured otherwise and have not been configured since.
    """

    def __init__(
        self,
        nodes: Iterable[int],
        reader: SnapshotReader,
        returning: ReturningNodes,
        heartbeats: NodeWatch,
        say: Callable[[str, int, str], None],
    ) -> None:
        self._reader, self._returning, self._heartbeats, self._say = reader, returning, heartbeats, say
        self._queues = {node: SdoQueue() for node in nodes}
        self._out: list[tuple[int, bytes]] = []
        self._checks: dict[int, ConfigurationWatch] = {}
        self._present_until: dict[int, float] = {}
        self._others_until: dict[int, float] = {}
        self._check_due = self._probe_due = self._boot_ended = 0.0
        self._check_turn = 0
        self.changed: set[int] = set()

    @property
    def busy(self) -> int:
        """Node that is being booted; 0: none."""
        return self._returning.busy

    @property
    def absent(self) -> set[int]:
        """Optional nodes that have not been configured yet."""
        return self._returning.absent

    def is_booting(self, now_s: float) -> bool:
        """A boot is under way, or has just ended: NMT commands may be its."""
        return bool(self._returning.busy) or now_s < self._boot_ended

    def on_reply(self, node: int, data: bytes, now_s: float) -> None:
        """A frame 580h + node. Whoever it was that asked: the node is there."""
        self._present_until[node] = now_s + _PRESENT_S
        if node != self._returning.busy:
            self._out += [(node, request) for request in self._queues[node].on_reply(data, now_s)]

    def on_foreign_request(self, node: int, now_s: float) -> None:
        """A frame 600h + node that is not ours."""
        self._others_until[node] = now_s + _OTHERS_S

    def configured(self, node: int, report: dict[str, Any], now_s: float) -> None:
        """The node has been booted, with its part of the boot report."""
        self.changed.discard(node)
        self._heartbeats.watch(node, now_s)
        self._checks[node] = ConfigurationWatch(report)

    def restarted(self, node: int) -> None:
        """A boot-up message: there is no configuration to check."""
        self._checks.pop(node, None)

    def turn(self, view: View, now_s: float) -> list[tuple[int, bytes]]:
        """What is due; returns (node, SDO request) to be sent."""
        self._watch_nodes(view, now_s)
        for node, queue in self._queues.items():
            if node != self._returning.busy:
                self._out += [(node, request) for request in queue.tick(now_s)]
        out, self._out = self._out, []
        return out

    def state(self, node: int, view: View) -> tuple[int, int, int]:
        """NMT state, heartbeat (`daemon.master.node_watch`) and whether it is configured."""
        configured = node not in view.unconfigured and node not in self._returning.absent
        return view.node_states[node], self._heartbeats.state(node), int(configured)

    def sdo_counts(self, node: int) -> dict[str, int]:
        """Requests to a node that were repeated, not answered, refused; answers to none of them."""
        queue = self._queues[node]
        return {
            "repeats": queue.repeats,
            "silences": queue.silences,
            "refusals": queue.refusals,
            "ignored": queue.ignored,
        }

    def _watch_nodes(self, view: View, now_s: float) -> None:
        """Boot what needs it, ask whether it is there, and check the configuration of the others."""
        returning = self._returning
        was_busy = returning.busy
        booted = returning.watch(view, lambda node: self._present(node, now_s), self._reader, now_s)
        if was_busy and not returning.busy:
            self._boot_ended = now_s + _PROBE_S
        if returning.busy and returning.busy != was_busy:
            self._queues[returning.busy].clear()
        if booted is not None:
            self.configured(booted["node"], booted, now_s)
        if now_s >= self._probe_due and not returning.busy:
            self._probe_due = now_s + _PROBE_S
            for node in returning.waiting(view, now_s):
                queue = self._queues.get(node)
                if queue is not None and not queue.busy and not self._others_talk_to(node, now_s):
                    queue.read(0x1000, 0, _nothing, _SDO_TIMEOUT_S)
        if now_s >= self._check_due:
            self._check_due = now_s + _CHECK_S
            self._check_one(view, now_s)

    def _present(self, node: int, now_s: float) -> bool:
        return self._present_until.get(node, 0.0) > now_s or self._heartbeats.heard_within(
            node, _PRESENT_S, now_s
        )

    def _others_talk_to(self, node: int, now_s: float) -> bool:
        return now_s < self._others_until.get(node, 0.0)

    def _check_one(self, view: View, now_s: float) -> None:
        """One object of one node that is operational and left alone."""
        waiting = {*self._returning.waiting(view, now_s), self._returning.busy, *view.unconfigured}
        nodes = [
            node
            for node in self._checks
            if node not in waiting
            and not self._queues[node].busy
            and not self._others_talk_to(node, now_s)
            and self._heartbeats.state(node) != LOST
        ]
        if not nodes:
            return
        self._check_turn += 1
        node = nodes[self._check_turn % len(nodes)]
        check, watch = self._checks[node].next(), self._checks[node]
        self._queues[node].read(
            check.index, check.subindex, partial(self._on_check, node, watch), _SDO_TIMEOUT_S
        )

    def _on_check(self, node: int, watch: ConfigurationWatch, result: SdoResult) -> None:
        if self._checks.get(node) is not watch:
            return
        finding = watch.result(result.value, result.refusal)
        if finding is None:
            return
        self._say("boot", node, f"node {node}: {finding.text}")
        if finding.changed:
            del self._checks[node]
            self.changed.add(node)
            self._reader.note_doubt(node)
            self._returning.request(node, finding.text)


def _nothing(_result: SdoResult) -> None:
    """Of a question whose answer matters only by coming."""
