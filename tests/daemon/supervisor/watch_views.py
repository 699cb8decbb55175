"""Readings of the snapshot for the tests of what watches them."""

from collections.abc import Collection

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.shared.conditions import Conditions
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.snapshot import NO_ZEROS, JointView, View
from jtqd.daemon.supervisor.health import Health
from jtqd.estimator.status import VALID, Zeros

NAN = float("nan")
WELL = JointView(10.0, 0.5, NAN, NAN, NAN, 10.0, 0x27, VALID, 0, 15, 0, 10.0, 1.25)


def view(
    cycle: int,
    one: JointView = WELL,
    two: JointView = WELL,
    *,
    states: dict[int, int] | None = None,
    unconfigured: tuple[int, ...] = (),
    zeros: tuple[Zeros, Zeros] = (NO_ZEROS, NO_ZEROS),
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
        zeros=zeros,
    )


class Observer:
    """Conditions that follow from readings of the snapshot, as in the supervisor."""

    def __init__(self, config: Config | None = None) -> None:
        self.conditions = Conditions()
        self.health = Health(config or load_config(None), self.conditions)

    def lines(
        self, reading: View, now_s: float, absent: Collection[int] = (), cycles_lost: int = 0
    ) -> list[str]:
        """Take a reading; lines for the operator that are due."""
        self.health.observe(reading, now_s, absent=absent, cycles_lost=cycles_lost)
        return [line.text for line in self.conditions.lines(now_s)]

    def present(self) -> list[tuple[str, str]]:
        """(name, subject) of every condition that is present."""
        return [(each.name, each.subject) for each in self.conditions.present()]
