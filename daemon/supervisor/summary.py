"""The final summary of a run of jtqd: timing, accuracy, conditions that happened, counters and the log, as text and JSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from jtqd.daemon.shared.conditions import CATALOGUE, Occurrences
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.events import INFO
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.estimator.text import counted, finite

_LOST = 0.05
"""Share of missed slots beyond which real time is reported as not kept."""


@dataclass(frozen=True)
class Summary:
    """Final figures of one run.

    Attributes:
        view: last reading of the snapshot.
        work_us, late_us: p50, p99 and maximum of the work per cycle and of the SYNC's lateness [us].
        refused: real-time settings that the kernel did not grant.
        recording: the recorder's account; None where nothing was recorded.
        error: the failure that ended the run, if any.
        inputs: late, lost, duplicate and rejected frames of each PDO by its name.
        conditions: those that were present at any time; `first_s` counts from the begin of the run.
        stolen_s: processor time that a hypervisor took (`daemon/loop/realtime.py`).
        contacts: they were watched.
    """

    view: View
    work_us: Sequence[float]
    late_us: Sequence[float]
    refused: Sequence[str] = ()
    recording: dict[str, Any] | None = None
    error: str | None = None
    inputs: dict[str, dict[str, int]] = field(default_factory=dict)
    conditions: Sequence[Occurrences] = ()
    stolen_s: float = 0.0
    contacts: bool = False

    @property
    def exit_status(self) -> int:
        """Return the exit status: 0 done, 1 ended by a failure, 3 done with cycles missing in the log."""
        if self.error:
            return 1
        return 3 if self.recording is not None and self.recording.get("lost", 0) else 0

    def content(self) -> dict[str, Any]:
        """Return the summary as plain data for JSON."""
        view, counters = self.view, self.view.counters

        def by_joint(values: Iterable[Any]) -> dict[str, Any]:
            return {f"joint_{n}": value for n, value in enumerate(values, start=1)}

        return {
            "cycles": counters["cycles"],
            "missed": counters["missed"],
            "stale_inputs": counters["stale_inputs"],
            "work_us": dict(zip(("p50", "p99", "max"), map(finite, self.work_us), strict=True)),
            "late_us": dict(zip(("p50", "p99", "max"), map(finite, self.late_us), strict=True)),
            "rmse_nm": by_joint(map(finite, view.rmse_nm)),
            "rmse_now_nm": by_joint(map(finite, view.rmse_now_nm)),
            "age_ms": by_joint(finite(each.age_ms) for each in view.joints),
            "zeros": by_joint(each.content() for each in view.zeros),
            "contacts": counters["contacts"] if self.contacts else None,
            "deviations": by_joint(self._deviations(n) for n in range(1, len(view.joints) + 1)),
            "conditions": [
                each._asdict() | {"total_s": round(each.total_s, 3), "first_s": round(each.first_s, 3)}
                for each in self.conditions
            ],
            "counters": counters,
            "stolen_s": round(self.stolen_s, 2),
            "not_granted": list(self.refused),
            "inputs": self.inputs,
            "recording": self.recording,
            "error": self.error,
        }

    def _deviations(self, joint: int) -> int:
        return sum(
            each.times
            for each in self.conditions
            if (each.name, each.subject) == ("deviation", f"joint {joint}")
        )

    def _timing(self) -> list[str]:
        counters = self.view.counters
        cycles, missed = counters["cycles"], counters["missed"]
        quantiles = "p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us"
        lines = [
            f"cycles        {cycles}, missed {missed}, stale inputs {counters['stale_inputs']}",
            f"cycle work    {quantiles.format(*self.work_us)} (from wake-up to hand-over)",
            f"SYNC lateness {quantiles.format(*self.late_us)}",
        ]
        if missed > _LOST * (cycles + missed):
            why = " (jtqd was not granted all that it asked for)" if self.refused else ""
            share = 100.0 * missed / (cycles + missed)
            lines.append(
                f"real time     not kept: {share:.0f} % of the slots missed{why}; jtq doctor looks at the machine"
            )
        if self.stolen_s > 0.0:
            lines.append(f"processors    {self.stolen_s:.2f} s stolen by the hypervisor")
        return lines

    def _recorded(self) -> list[str]:
        account = self.recording
        if account is None:
            return ["log           none"]
        lost, parts = account.get("lost", 0), len(account.get("paths", ()))
        nothing = "no trigger" if account.get("flight_recordings") == 0 else "it could not be written"
        shown = account.get("path") or f"none: {account.get('error') or nothing}"
        shown += f" (the last of {parts} parts)" if parts > 1 else ""
        shown += f", {counted(lost, 'cycle')} lost" if lost else ""
        left = [f"              {each} (left by a killed recorder)" for each in account.get("left", [])]
        return [f"log           {shown}", *left]

    def text(self) -> str:
        """Return the summary as text."""
        view, counters, lines = self.view, self.view.counters, self._timing()
        for n, (rmse, now, joint) in enumerate(
            zip(view.rmse_nm, view.rmse_now_nm, view.joints, strict=False)
        ):
            shown = "no reference"
            if isfinite(rmse):
                age = joint.age_ms
                older = f", both {age:.2f} ms old ({now:.3f} Nm against it now)" if age > 0.0 else " now"
                shown = f"{rmse:.3f} Nm against the sensor in motion{older}"
            lines.append(f"RMSE joint {n + 1}  {shown}")
        zeros = enumerate(view.zeros, start=1)
        lines += [f"zeros joint {joint} {each.text}" for joint, each in zeros if each.tracked]
        if self.contacts:
            lines.append(f"contacts      {counters['contacts'] or 'none'}")
        happened = [each for each in self.conditions if CATALOGUE[each.name].severity > INFO]
        for n, each in enumerate(happened):
            times = "once" if each.times == 1 else f"{each.times} times"
            lines.append(
                f"{'' if n else 'conditions':<13} {each.subject}: {each.name.replace('_', ' ')} {times}, "
                f"{each.total_s:.1f} s in all, first after {each.first_s:.1f} s"
            )
        for title, selected in (("no torque", Shown.SUMMARY_TORQUE), ("bus", Shown.SUMMARY_BUS)):
            found = [
                f"{name.removeprefix('fault_').replace('_', ' ')} {counters[name]}"
                for name in shown_in(selected)
                if counters[name]
            ]
            if found:
                lines.append(f"{title:<13} {', '.join(found)}")
        for name, counts in self.inputs.items():
            shown = ", ".join(f"{kind} {count}" for kind, count in counts.items() if count)
            if shown:
                lines.append(f"  {name:<24} {shown}")
        lines += self._recorded()
        if self.error:
            lines.append(f"ended by      {self.error}")
        return "\n".join(lines)


def summary_of(
    reader: SnapshotReader,
    result: dict[str, Any],
    refused: list[str],
    recording: dict[str, Any] | None,
    *,
    history: Sequence[Occurrences],
    began_s: float,
    stolen_s: float,
    contacts: bool = False,
) -> Summary:
    """Return the summary of a finished run.

    Args:
        reader: snapshot of its loop.
        result: last answer of the loop.
        refused, recording, stolen_s, contacts: as in `Summary`.
        history: conditions that were present at any time.
        began_s: begin of the run (CLOCK_MONOTONIC).
    """
    return Summary(
        view=reader.read(),
        work_us=reader.work_us(0.5, 0.99, 1.0),
        late_us=reader.late_us(0.5, 0.99, 1.0),
        refused=refused,
        recording=recording,
        error=result.get("error") or result.get("failed"),
        inputs=result.get("counters", {}),
        conditions=tuple(each._replace(first_s=max(0.0, each.first_s - began_s)) for each in history),
        stolen_s=stolen_s,
        contacts=contacts,
    )
