"""Errors that the loop has counted or noted in the snapshot, as EMCY of jtqd and lines for the operator. Pure.

Deadlines and lengths of PDOs (`daemon/master/pdo_watch.py`), faults of the joints, another SYNC producer, lost frames.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from daemon.config import Config
from daemon.loop.input_pdos import watched_pdos
from daemon.master.own_errors import OwnErrors
from daemon.master.pdo_watch import PdoWatch
from daemon.shared.snapshot import View
from daemon.supervisor.rate_limit import RateLimit
from drivers import emcy
from drivers.devices import SYNC_COB_ID

_QUIET_S = 1.0
"""An error that shows by a counter is over when the counter has stood still for so long."""
_OVERRUN_RX, _OVERRUN_TX = 1, 2


class LoopErrors:
    """Call `watch` with each reading of the snapshot.

    Args:
        config: in force.
        errors: where they come and go.
        say: takes topic, node and line for the operator.
    """

    def __init__(self, config: Config, errors: OwnErrors, say: Callable[[str, int, str], None]) -> None:
        self._config, self._errors, self._say = config, errors, say
        self._pdos = PdoWatch(watched_pdos(config))
        self._limit = RateLimit()
        self._counted: dict[str, int] = {}
        self._counter_until: dict[tuple[int, int], float] = {}

    def watch(self, view: View, absent: Collection[int], now_s: float) -> bool:
        """True when the loop's calls have met an interface that is down; PDOs of `absent` nodes are not missed."""
        self._watch_pdos(view, absent, now_s)
        self._watch_counters(view, now_s)
        self._watch_faults(view)
        return self._rose(view, "bus_errors")

    def _watch_pdos(self, view: View, absent: Collection[int], now_s: float) -> None:
        for code, pdo, present in self._pdos.events(view.inputs, absent, now_s):
            if not present:
                self._errors.gone(code, pdo.cob_id)
                continue
            new = self._errors.come(code, pdo.cob_id, joints=pdo.joints)
            # What is missing the operator is told by joint (`daemon/supervisor/input_watch.py`).
            if (
                new
                and code != emcy.PDO_TIMEOUT
                and self._limit.may_say((code, pdo.cob_id), now_s) is not None
            ):
                self._say("pdo", pdo.node, f"{pdo.name}: {emcy.name_of(code)} ({code:04X}h): it is not used")

    def _watch_faults(self, view: View) -> None:
        """EMCY of the joints' faults; the operator is told by `daemon/supervisor/fault_watch.py`."""
        for n, (joint, seen) in enumerate(zip(self._config.joints, view.joints, strict=True)):
            for code, bits in (
                (emcy.JOINT_FAULT, seen.input_flags >> 8 | seen.latched),
                (emcy.FAULT_LATCHED, seen.latched),
            ):
                if bits:
                    self._errors.come(code, joint.node_id, joints=1 << n, register=emcy.MANUFACTURER)
                else:
                    self._errors.gone(code, joint.node_id)

    def _watch_counters(self, view: View, now_s: float) -> None:
        """Errors that show by a counter of the loop."""
        foreign = "another SYNC producer: no input of its cycles is used"
        self._counter_error(view, "foreign_sync", emcy.COB_ID_COLLISION, SYNC_COB_ID, foreign, now_s)
        lost = "received frames were lost: the loop's socket was read too late"
        self._counter_error(view, "rx_dropped", emcy.CAN_OVERRUN, _OVERRUN_RX, lost, now_s)
        full = "frames could not be sent: the transmit queue is full"
        self._counter_error(view, "tx_dropped", emcy.CAN_OVERRUN, _OVERRUN_TX, full, now_s)

    def _rose(self, view: View, name: str) -> bool:
        value = view.counters[name]
        before, self._counted[name] = self._counted.get(name, 0), value
        return value > before

    def _counter_error(  # noqa: PLR0917 - a table row
        self, view: View, name: str, code: int, detail: int, text: str, now_s: float
    ) -> None:
        error = code, detail
        if self._rose(view, name):
            self._counter_until[error] = now_s + _QUIET_S
            if self._errors.come(code, detail, joints=3) and self._limit.may_say(error, now_s) is not None:
                self._say("sync" if name == "foreign_sync" else "bus", 0, f"bus: {text}")
        elif now_s >= self._counter_until.get(error, 0.0):
            self._errors.gone(code, detail)
