"""What a run of jtqd says at its end."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

from daemon.deviation_watch import FAR, LASTING_S


@dataclass(frozen=True)
class Summary:
    """Figures of one run; times in us, torque in Nm. `error` is what ended it, if anything did."""

    cycles: int
    missed: int
    stale_inputs: int
    work_us: tuple[float, float, float]
    late_us: tuple[float, float, float]
    rmse_nm: tuple[float, float]
    counters: dict[str, int]
    refused: tuple[str, ...]
    recording: dict[str, Any] | None
    error: str | None
    inputs: dict[str, dict[str, int]]
    """Late, lost, duplicate and rejected frames of each PDO by its name."""
    deviations: tuple[int, int]
    """How often each joint's estimate stayed far from the sensor (`daemon/deviation_watch.py`)."""

    @property
    def exit_status(self) -> int:
        """0 done, 1 the run ended by a failure, 3 done with cycles missing in the log."""
        if self.error:
            return 1
        return 3 if self.recording is not None and self.recording.get("lost", 0) else 0

    def content(self) -> dict[str, Any]:
        """The same as plain data for JSON."""
        return {
            "cycles": self.cycles,
            "missed": self.missed,
            "stale_inputs": self.stale_inputs,
            "work_us": dict(zip(("p50", "p99", "max"), map(_json, self.work_us), strict=True)),
            "late_us": dict(zip(("p50", "p99", "max"), map(_json, self.late_us), strict=True)),
            "rmse_nm": {"joint_1": _json(self.rmse_nm[0]), "joint_2": _json(self.rmse_nm[1])},
            "deviations": {"joint_1": self.deviations[0], "joint_2": self.deviations[1]},
            "counters": self.counters,
            "not_granted": list(self.refused),
            "inputs": self.inputs,
            "recording": self.recording,
            "error": self.error,
        }

    def text(self) -> str:
        """The same for people."""
        counters = self.counters
        lines = [
            f"cycles        {self.cycles}, missed {self.missed}, stale inputs {self.stale_inputs}",
            "cycle work    p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us (wake-up for the inputs to hand-over)".format(
                *self.work_us
            ),
            "SYNC lateness p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us".format(*self.late_us),
        ]
        for joint, rmse in enumerate(self.rmse_nm, start=1):
            shown = f"{rmse:.3f} Nm against the sensor while it moves" if isfinite(rmse) else "no reference"
            lines.append(f"RMSE joint {joint}  {shown}")
        lines += [
            f"deviation     joint {joint}: {count} times more than {FAR:g} sigma from the sensor for {LASTING_S:g} s"
            for joint, count in enumerate(self.deviations, start=1)
            if count
        ]
        faults = [
            f"{name.replace('_', ' ')} {counters[name]}"
            for name in (
                "sync_gaps",
                "sync_errors",
                "late_frames",
                "duplicate_frames",
                "rejected_frames",
                "foreign_sync",
                "tx_dropped",
                "rx_dropped",
            )
            if counters.get(name)
        ]
        if faults:
            lines.append("bus           " + ", ".join(faults))
        for name, counts in self.inputs.items():
            shown = ", ".join(f"{kind} {count}" for kind, count in counts.items() if count)
            if shown:
                lines.append(f"  {name:<24} {shown}")
        if self.recording is None:
            lines.append("log           none")
        else:
            lost, path = self.recording.get("lost", 0), self.recording.get("path")
            shown = path or f"none: {self.recording.get('error') or 'it could not be written'}"
            lines.append(f"log           {shown}" + (f", {lost} cycles lost" if lost else ""))
            lines += [
                f"              {left} (left by a recorder that died)"
                for left in self.recording.get("left", [])
            ]
        if self.error:
            lines.append(f"ended by      {self.error}")
        return "\n".join(lines)


def _json(value: float) -> float | None:
    return value if isfinite(value) else None
