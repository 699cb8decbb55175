"""Readings of the snapshot for the tests of what watches them."""

from jtqd.daemon.shared.snapshot import COUNTERS, JointView, View
from jtqd.estimator.status import VALID

NAN = float("nan")
WELL = JointView(10.0, 0.5, NAN, NAN, NAN, 10.0, 0x27, VALID, 0, 15)


def view(
    cycle: int,
    one: JointView = WELL,
    two: JointView = WELL,
    *,
    states: dict[int, int] | None = None,
    unconfigured: tuple[int, ...] = (),
    **counters: int,
) -> View:
    """One reading; `states` are heartbeat states by node, the rest are operational."""
    nodes = bytearray([5] * 128)
    for node, state in (states or {}).items():
        nodes[node] = state
    return View(
        1,
        cycle,
        1,
        1,
        1e-3,
        0.8,
        (one, two),
        dict.fromkeys(COUNTERS, 0) | {"cycles": cycle} | counters,
        (NAN, NAN),
        bytes(nodes),
        unconfigured,
    )
