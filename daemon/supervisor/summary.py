"""The final summary of a run of jtqd: timing, accuracy, conditions that happened, counters and the log, as text and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from jtqd.daemon.shared.conditions import CATALOGUE, Occurrences
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.events import INFO
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.status import Zeros
from jtqd.estimator.text import finite

_LOST = 0.05
"""Part of the slots that a machine on which something else runs may miss at most before it is said."""


@dataclass(frozen=True)
class Summary:
    """Figures of one run; times in us, torque in Nm. `error` is what ended it, if anything did."""

    cycles: int
    missed: int
    stale_inputs: int
    work_us: tuple[float, float, float]
    late_us: tuple[float, float, float]
    rmse_nm: tuple[float, ...]
    """Of each joint in motion, against the sensor as old as the estimate."""
    counters: dict[str, int]
    refused: tuple[str, ...]
    recording: dict[str, Any] | None
    error: str | None
    inputs: dict[str, dict[str, int]]
    """Late, lost, duplicate and rejected frames of each PDO by its name."""
    conditions: tuple[Occurrences, ...] = ()
    """What happened (`jtqd.daemon.shared.conditions`); `first_s` counts from the begin of the run."""
    stolen_s: float = 0.0
    """What a hypervisor took from the processors meanwhile (`daemon/loop/realtime.py`)."""
    rmse_now_nm: tuple[float, ...] = ()
    """Against the sensor now: with the estimate's age as an error, as a controller meets it."""
    age_ms: tuple[float, ...] = ()
    zeros: tuple[Zeros, ...] = ()
    """Of each joint at the end."""
    contacts: int | None = None
    """How many were told; None where nobody watched."""

    @property
    def exit_status(self) -> int:
        """Return the exit status: 0 done, 1 ended by a failure, 3 done with cycles missing in the log."""
        if self.error:
            return 1
        return 3 if self.recording is not None and self.recording.get("lost", 0) else 0

    def content(self) -> dict[str, Any]:
        """Return the summary as plain data for JSON."""
        return {
            "cycles": self.cycles,
            "missed": self.missed,
            "stale_inputs": self.stale_inputs,
            "work_us": dict(zip(("p50", "p99", "max"), map(finite, self.work_us), strict=True)),
            "late_us": dict(zip(("p50", "p99", "max"), map(finite, self.late_us), strict=True)),
            "rmse_nm": {f"joint_{n}": finite(rmse) for n, rmse in enumerate(self.rmse_nm, start=1)},
            "rmse_now_nm": {f"joint_{n}": finite(rmse) for n, rmse in enumerate(self.rmse_now_nm, start=1)},
            "age_ms": {f"joint_{n}": finite(age) for n, age in enumerate(self.age_ms, start=1)},
            "zeros": {f"joint_{n}": each.content() for n, each in enumerate(self.zeros, start=1)},
            "contacts": self.contacts,
            "deviations": {f"joint_{n}": self._deviations(n) for n in range(1, len(self.rmse_nm) + 1)},
            "conditions": [
                each._asdict() | {"total_s": round(each.total_s, 3), "first_s": round(each.first_s, 3)}
                for each in self.conditions
            ],
            "counters": self.counters,
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
        lines = [
            f"cycles        {self.cycles}, missed {self.missed}, stale inputs {self.stale_inputs}",
            "cycle work    p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us (from wake-up to hand-over)".format(
                *self.work_us
            ),
            "SYNC lateness p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us".format(*self.late_us),
        ]
        slots = self.cycles + self.missed
        if self.missed > _LOST * slots:
            why = " (jtqd was not granted all that it asked for)" if self.refused else ""
            share = 100.0 * self.missed / slots
            lines.append(
                f"real time     not kept: {share:.0f} % of the slots missed{why}; jtq doctor looks at the machine"
            )
        if self.stolen_s > 0.0:
            lines.append(f"processors    {self.stolen_s:.2f} s stolen by the hypervisor")
        return lines

    def text(self) -> str:
        """Return the summary as text."""
        counters, lines = self.counters, self._timing()
        for joint, (rmse, now, age) in enumerate(
            zip(self.rmse_nm, self.rmse_now_nm, self.age_ms, strict=False), start=1
        ):
            shown = "no reference"
            if isfinite(rmse):
                older = f", both {age:.2f} ms old ({now:.3f} Nm against it now)" if age > 0.0 else " now"
                shown = f"{rmse:.3f} Nm against the sensor in motion{older}"
            lines.append(f"RMSE joint {joint}  {shown}")
        lines += [
            f"zeros joint {joint} {zeros.text}"
            for joint, zeros in enumerate(self.zeros, start=1)
            if zeros.tracked
        ]
        if self.contacts is not None:
            lines.append(f"contacts      {self.contacts or 'none'}")
        happened = [each for each in self.conditions if CATALOGUE[each.name].severity > INFO]
        for n, each in enumerate(happened):
            times = "once" if each.times == 1 else f"{each.times} times"
            lines.append(
                f"{'' if n else 'conditions':<13} {each.subject}: {each.name.replace('_', ' ')} {times}, "
                f"{each.total_s:.1f} s in all, first after {each.first_s:.1f} s"
            )
        for title, view in (("no torque", Shown.SUMMARY_TORQUE), ("bus", Shown.SUMMARY_BUS)):
            counted = [
                f"{name.removeprefix('fault_').replace('_', ' ')} {counters[name]}"
                for name in shown_in(view)
                if counters[name]
            ]
            if counted:
                lines.append(f"{title:<13} {', '.join(counted)}")
        for name, counts in self.inputs.items():
            shown = ", ".join(f"{kind} {count}" for kind, count in counts.items() if count)
            if shown:
                lines.append(f"  {name:<24} {shown}")
        if self.recording is None:
            lines.append("log           none")
        else:
            lost, path = self.recording.get("lost", 0), self.recording.get("path")
            nothing = (
                "no trigger" if self.recording.get("flight_recordings") == 0 else "it could not be written"
            )
            shown = path or f"none: {self.recording.get('error') or nothing}"
            parts = len(self.recording.get("paths", ()))
            shown += f" (the last of {parts} parts)" if parts > 1 else ""
            lines.append(
                f"log           {shown}" + (f", {lost} cycle{'s' if lost != 1 else ''} lost" if lost else "")
            )
            lines += [
                f"              {left} (left by a killed recorder)" for left in self.recording.get("left", [])
            ]
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
        refused: what the kernel did not grant.
        recording: the recorder's account, None where nothing was recorded.
        history: conditions that happened.
        began_s: begin of the run (CLOCK_MONOTONIC).
        stolen_s: as in `Summary`.
        contacts: they were watched.
    """
    view = reader.read()
    p50, p99, worst = reader.work_us(0.5, 0.99, 1.0)
    late50, late99, late_worst = reader.late_us(0.5, 0.99, 1.0)
    return Summary(
        cycles=view.counters["cycles"],
        missed=view.counters["missed"],
        stale_inputs=view.counters["stale_inputs"],
        work_us=(p50, p99, worst),
        late_us=(late50, late99, late_worst),
        rmse_nm=view.rmse_nm,
        rmse_now_nm=view.rmse_now_nm,
        age_ms=tuple(each.age_ms for each in view.joints),
        zeros=view.zeros,
        counters=view.counters,
        refused=tuple(refused),
        recording=recording,
        error=result.get("error") or result.get("failed"),
        inputs=result.get("counters", {}),
        conditions=tuple(each._replace(first_s=max(0.0, each.first_s - began_s)) for each in history),
        stolen_s=stolen_s,
        contacts=view.counters["contacts"] if contacts else None,
    )
