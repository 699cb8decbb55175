"""Nodes that the loop waits for: used again once the supervisor has configured them. Rare, and therefore Python."""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.shared.snapshot import Snapshot


class ConfiguredNodes:
    """Nodes that restarted, are in doubt or were absent at the start; they are used after the supervisor configured them.

    It looks at the snapshot's `configured` while a node waits. What counts is a configuration that was noted after the node
    had begun to wait: one that was only stopped is configured again without ever waiting, and that must not answer for its
    next restart. And it must have begun after the node's last boot-up message: a node may restart when its boot has just
    ended and is not yet noted.
    """

    def __init__(self, snapshot: Snapshot, intake: Intake, joints: Sequence[JointCycle]) -> None:
        self._snapshot, self._intake, self._joints = snapshot, intake, joints
        self._since = {node: snapshot.configured[node] for node in intake.unconfigured}
        self._doubts = list(snapshot.doubts)

    def look(self) -> None:
        """Check for configured nodes between the inputs of a cycle and its estimate."""
        intake, snapshot = self._intake, self._snapshot
        for node in intake.unconfigured:
            now = snapshot.configured[node]
            if self._since.setdefault(node, now) == now:
                continue
            if snapshot.configured_for[node] != intake.nodes.restarts.get(node, 0):
                self._since[node] = now
                continue
            del self._since[node]
            intake.configured(node)
            snapshot.unconfigured[node] = 0
            for joint in self._joints:
                if joint.node_id == node:
                    joint.begin_again()
                joint.rescale(node, snapshot.factors(node))

    def doubt(self) -> None:
        """Stop using, between two cycles, the nodes that the supervisor found differently configured."""
        doubts = self._snapshot.doubts
        for node, (before, now) in enumerate(zip(self._doubts, doubts, strict=True)):
            if now != before:
                self._doubts[node] = now
                self._intake.nodes.doubt(node)
