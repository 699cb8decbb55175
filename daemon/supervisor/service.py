"""Services of a running daemon to its operator: systemd, the control socket, the metrics file.

They reach the loop through shared memory only. The metrics are a Prometheus text file for a node
exporter's textfile collector: off unless the configuration has `metrics: {file: PATH}`; a name without a directory lies in
the runtime directory.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from jtqd.daemon.config import MASTER, Config
from jtqd.daemon.shared.conditions import CATALOGUE, Condition, Conditions
from jtqd.daemon.shared.counters import RECORDER_LOST, TABLE
from jtqd.daemon.shared.events import OperatorLog, Priority
from jtqd.daemon.shared.processes import Notifier
from jtqd.daemon.shared.runtime_dir import write_whole
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.daemon.supervisor.control import FILE, Answer, ControlError, ControlServer, Reply
from jtqd.estimator import status as st

_SHARES = (0.5, 0.99, 1.0)
_OF_JOINTS = (
    ("torque_nm", "Estimated torque, joint side."),
    ("sigma_nm", "Its standard deviation."),
    ("status", "Status as in the estimate PDO."),
)
"""Fields of a `JointView`."""
_OF_ZEROS = (
    ("link_zero_rad", "gauge", "Offset of the link encoder.", "link_rad"),
    ("link_zero_sigma_rad", "gauge", "Its standard deviation.", "link_sigma_rad"),
    ("link_zero_used_rad", "gauge", "What of it is taken off the reading.", "link_used_rad"),
    ("link_zero_jumps_total", "counter", "How often it has jumped.", "jumps"),
)
"""Fields of `Zeros`."""


def metrics_text(
    view: View, reader: SnapshotReader, bus: str, recorder_lost: int, conditions: Sequence[Condition] = ()
) -> str:
    """Return the text of the metrics file; the label `bus` distinguishes daemons."""
    label = bus.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    lines: list[str] = []

    def metric(name: str, kind: str, text: str, rows: list[tuple[str, float]]) -> None:
        lines.extend((f"# HELP jtqd_{name} {text}", f"# TYPE jtqd_{name} {kind}"))
        lines.extend(f'jtqd_{name}{{bus="{label}"{more}}} {_number(value)}' for more, value in rows)

    for each in (*TABLE, RECORDER_LOST):
        value = recorder_lost if each is RECORDER_LOST else view.counters[each.name]
        name, kind = (each.name, "gauge") if each.is_maximum else (f"{each.name}_total", "counter")
        metric(name, kind, f"{each.text[0].upper()}{each.text[1:]} (docs/bus.md).", [("", value)])
    joints = [(f',joint="{n}"', each) for n, each in enumerate(view.joints, start=1)]
    for name, text in _OF_JOINTS:
        metric(name, "gauge", text, [(at, getattr(each, name)) for at, each in joints])
    if any(each.tracked for each in view.zeros):
        tracked = [(f',joint="{n}"', each) for n, each in enumerate(view.zeros, start=1) if each.tracked]
        for name, kind, text, field in _OF_ZEROS:
            metric(name, kind, text, [(at, getattr(each, field)) for at, each in tracked])
    present = Counter(each.name for each in conditions)
    text = "Number of joints, nodes, ... with this condition (docs/testing.md)."
    metric("condition", "gauge", text, [(f',name="{name}"', present[name]) for name in CATALOGUE])
    for name, text, values in (
        ("work_us", "Work per cycle by quantile.", reader.work_us(*_SHARES)),
        ("late_us", "Lateness of SYNC by quantile.", reader.late_us(*_SHARES)),
    ):
        rows = [(f',quantile="{share}"', value) for share, value in zip(_SHARES, values, strict=True)]
        metric(name, "gauge", text, rows)
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(value)


_STATUS_PERIOD_S = _METRICS_PERIOD_S = 5.0
_RESET_S = 2.0
_NOT_READY = (st.STARTING, st.STALE, st.INVALID)
"""Statuses of a joint whose inputs or estimator are not there yet. A drive that is off or in fault is no reason to wait:
others switch it on, and perhaps only when we are ready."""


class Service:
    """Services of one run: systemd, orders, metrics.

    directory: runtime directory; bus: name for the metrics; save: has the flight recording written, False where there is no
    recorder.
    """

    def __init__(
        self,
        config: Config,
        directory: Path,
        bus: str,
        log: OperatorLog,
        *,
        save: Callable[[], bool],
        conditions: Conditions,
    ) -> None:
        self._config, self._directory, self._bus, self._log = config, directory, bus, log
        self._save, self._conditions = save, conditions
        self._notifier = Notifier()
        self._control: ControlServer | None = None
        self._reader: SnapshotReader | None = None
        self._ready = False
        self._status_due = self._metrics_due = 0.0

    def open(self, reader: SnapshotReader) -> None:
        """Accept orders when the loop runs. Raises OSError."""
        self._reader = reader
        handlers: dict[str, Callable[[Reply], Reply | Answer]] = {
            "ping": self._ping,
            "reset": self._reset,
            "save": self._ask_save,
        }
        self._control = ControlServer(self._directory / FILE, handlers)

    @property
    def descriptors(self) -> list[int]:
        """For select."""
        return [] if self._control is None else self._control.descriptors

    def serve(self, view: View, recorder_lost: int) -> None:
        """Run the due services."""
        if self._control is not None:
            self._control.serve()
        now = time.monotonic()
        if not self._ready and self._estimating(view):
            self._ready = True
            self._notifier.send("READY=1", f"STATUS={_status(view)}")
            self._status_due = now + _STATUS_PERIOD_S
        elif now >= self._status_due:
            self._status_due = now + _STATUS_PERIOD_S
            self._notifier.send(f"STATUS={_status(view)}")
        if self._config.metrics_file is not None and now >= self._metrics_due:
            self._metrics_due = now + _METRICS_PERIOD_S
            self._write_metrics(view, recorder_lost)

    def stopping(self) -> None:
        """Report the begin of the shutdown."""
        text = "ending: the nodes go to pre-operational, the log is finished"
        self._notifier.send("STOPPING=1", f"STATUS={text}")

    def close(self) -> None:
        """Stop accepting orders."""
        if self._control is not None:
            self._control.close()

    # Orders --------------------------------------------------------------------------------------------------------------

    def _ping(self, request: Reply) -> Reply:
        assert self._reader is not None
        view = self._reader.read()
        who = {"ok": True, "bus": self._bus, "pid": os.getpid(), "loop": view.pid}
        return who | {"cycle": view.cycle, "ready": self._ready}

    def _ask_save(self, request: Reply) -> Reply:
        if not self._save():
            raise ControlError("recording is off")
        self._log("flight recording written on request", Priority.NOTICE, "save")
        return {"ok": True}

    def _reset(self, request: Reply) -> Answer:
        reader = self._reader
        assert reader is not None
        before = sum(each.latched for each in reader.read().joints)
        number, until = reader.ask_reset(), time.monotonic() + _RESET_S
        self._log("latched faults reset on request", Priority.NOTICE, "reset")

        def answer() -> Reply | None:
            if reader.resets_done >= number:
                return {"ok": True, "released": "some" if before else "none was latched"}
            late = time.monotonic() > until
            return {"ok": False, "error": "the loop did not answer"} if late else None

        return answer

    # State ---------------------------------------------------------------------------------------------------------------

    def _estimating(self, view: View) -> bool:
        """Return whether the loop publishes and every mandatory joint has inputs and a settled estimator."""
        if self._config.role != MASTER:  # its master may be started later
            return True
        joints = zip(self._config.joints, view.joints, strict=True)
        waits = any(configured.mandatory and joint.status in _NOT_READY for configured, joint in joints)
        return view.counters["published"] > 0 and not waits

    def _write_metrics(self, view: View, recorder_lost: int) -> None:
        assert self._config.metrics_file is not None
        assert self._reader is not None
        path = self._directory / self._config.metrics_file  # an absolute one stays what it is
        try:
            present = self._conditions.present()
            write_whole(path, metrics_text(view, self._reader, self._bus, recorder_lost, present), 0o644)
        except OSError as error:
            self._log(f"metrics: {path}: {error.strerror}", Priority.WARNING, "metrics")


def _status(view: View) -> str:
    joints = "; ".join(
        f"joint {number}: {st.NAMES[joint.status]}"
        + ("" if math.isnan(joint.torque_nm) else f" {joint.torque_nm:+.2f} Nm")
        for number, joint in enumerate(view.joints, start=1)
    )
    return f"{joints}; {view.counters['cycles']} cycles, {view.counters['missed']} missed"
