"""A soak: faults one after the other, each proved, told and over before the next; at the end all is counted."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.daemon.recording.run_files import read_account
from jtqd.drivers.frame_socket import BusDown, FrameSocket, open_frame_socket
from jtqd.estimator import status as st
from tests.slow.faults.listener import Heard, Proof, joined
from tests.slow.soak.account import EstimateTally, SyncTally, account, read_records
from tests.slow.soak.faults import COMMON, ON_INTERFACE, Fault, NotInjectedError, Scene
from tests.slow.soak.rig import Rig, rss_kb

_RECOVERY_S = 15.0
_TOLD_S = 6.0
"""Lines of a kind come once in 5 s: one that came just before this fault speaks for it too."""
_LOOK_S = 0.05
_WELL_LOOKS = 4
_SAY_EVERY_S = 60.0


SLOPE_KB_S = 10.0
"""A process that grows faster, with the lower end of the interval, leaks: 36 MB in an hour."""


@dataclass
class SoakReport:
    """Seconds until all was well again by kind of fault; slopes of memory (kB/s, half of its interval, kB at the end)."""

    seed: int
    seconds: float = 0.0
    faults: dict[str, list[float]] = field(default_factory=dict)
    slopes: dict[str, tuple[float, float, int]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)

    def add_slopes(self, slopes: dict[str, tuple[float, float, int]]) -> None:
        """Memory; a process that grows is a finding. The bench is not jtqd."""
        self.slopes = slopes
        for name, (slope, half, _) in slopes.items():
            if slope - half > SLOPE_KB_S and name != "bench":
                self.findings.append(f"{name} grows by {slope:.1f} +- {half:.1f} kB/s")

    def as_json(self) -> dict[str, Any]:
        return dict(vars(self))

    def text(self) -> str:
        lines = [
            f"seed {self.seed}, {self.seconds:.0f} s, {sum(map(len, self.faults.values()))} faults",
            f"{'fault':20}{'times':>6}{'recovered after s: median':>27}{'max':>7}",
        ]
        for name, times in sorted(self.faults.items()):
            lines.append(f"{name:20}{len(times):6}{np.median(times):27.2f}{max(times):7.2f}")
        if self.slopes:
            lines.append(f"{'process':20}{'kB/s':>8}{'+- (95 %)':>11}{'end kB':>9}")
        for name, (slope, half, end) in sorted(self.slopes.items()):
            lines.append(f"{name:20}{slope:8.2f}{half:11.2f}{end:9}")
        lines += [f"{name:28}{count:10}" for name, count in self.counts.items()]
        lines += [f"FINDING {each}" for each in self.findings] or ["no finding"]
        return "\n".join(lines)


_SETTLED = 0.3
"""Share of the run after which memory is looked at: caches and histories are full by then."""
_YOUNG_S = 30.0
"""A process fills its buffers for so long after its start; of one that never gets older nothing is said."""


class MemoryWatch:
    """Call `look` now and then; one that was started anew begins again."""

    def __init__(self) -> None:
        self._samples: dict[tuple[str, int], list[tuple[float, int]]] = {}

    def look(self, rig: Rig, now_s: float) -> None:
        for name, pid in rig.processes().items():
            try:
                self._samples.setdefault((name, pid), []).append((now_s, rss_kb(pid)))
            except OSError:
                continue

    def slopes(self, begun_s: float, end_s: float) -> dict[str, tuple[float, float, int]]:
        """kB/s, half of its 95 % interval and the last value, of the process of each name that lived longest."""
        found: dict[str, tuple[float, tuple[float, float, int]]] = {}
        for (name, _), samples in self._samples.items():
            first_s = max(begun_s + _SETTLED * (end_s - begun_s), samples[0][0] + _YOUNG_S)
            late = np.array([each for each in samples if each[0] > first_s], float)
            if len(late) < 10 or late[-1, 0] - late[0, 0] <= found.get(name, (0.0,))[0]:
                continue
            t, y = late[:, 0] - late[:, 0].mean(), late[:, 1]
            slope = float(t @ y / (t @ t))
            rest = y - y.mean() - slope * t
            half = 1.96 * float(np.sqrt(rest @ rest / (len(y) - 2) / (t @ t)))
            found[name] = (late[-1, 0] - late[0, 0], (slope, half, int(y[-1])))
        return {name: value for name, (_, value) in found.items()}


class Soak:
    """One run.

    Args:
        rig: bench and daemon, with a listener.
        seed: of the faults.
        kinds: to draw from.
    """

    def __init__(self, rig: Rig, seed: int, kinds: Sequence[Fault]) -> None:
        self.report = SoakReport(seed)
        self._rig, self._source, self._kinds = rig, random.Random(seed), kinds
        self._socket: FrameSocket = open_frame_socket(rig.bus, [])
        self._scene = Scene(rig, self._socket, self._source)
        self._memory = MemoryWatch()
        self._syncs, self._estimates = SyncTally(), EstimateTally()
        self._kept: list[Heard] = []
        self._order: list[Fault] = []
        self._unheard = 0
        self._begun_s = time.monotonic()

    def run(self, seconds: float, stop: Callable[[], bool] = lambda: False) -> SoakReport:
        say_s = _SAY_EVERY_S
        while self._now_s() < seconds and not stop() and self._rig.daemon.poll() is None:
            self._order = self._order or self._source.sample(self._kinds, len(self._kinds))
            fault = self._order.pop()  # each kind before any comes again
            took_s = self._one(fault)
            if took_s is not None:
                self.report.faults.setdefault(fault.name, []).append(took_s)
            pause_end = time.monotonic() + self._source.uniform(0.3, 2.0)
            while time.monotonic() < pause_end:
                time.sleep(0.1)
                self._listen()
            self._memory.look(self._rig, time.monotonic())
            if self._now_s() > say_s:
                say_s += _SAY_EVERY_S
                self._progress()
        self.report.seconds = self._now_s()
        self.report.add_slopes(self._memory.slopes(self._begun_s, time.monotonic()))
        if self._rig.daemon.poll() is not None:
            self.report.findings.append(f"jtqd ended by itself: {self._rig.said()[-300:]!r}")
            return self.report
        self._rig.end()
        self._listen()
        self._count()
        return self.report

    def _now_s(self) -> float:
        return time.monotonic() - self._begun_s

    def _progress(self) -> None:
        faults, found = sum(map(len, self.report.faults.values())), len(self.report.findings)
        print(f"... {self._now_s():.0f} s, {faults} faults, {found} findings", file=sys.stderr, flush=True)

    def _find(self, finding: str) -> None:
        self.report.findings.append(finding)
        print(f"FINDING {finding}", file=sys.stderr, flush=True)

    def _listen(self) -> None:
        heard = self._rig.listener.heard()
        self._syncs.add(heard)
        self._estimates.add(heard)
        self._kept.append(heard)

    def _one(self, fault: Fault) -> float | None:
        """Seconds until all is well again; None where it never was."""
        try:
            self._socket.receive()  # a link that was down before would be told now, instead of sending
        except BusDown:
            pass
        self._listen()
        self._kept = [joined(self._kept).tail()]
        told, deaf = _Told(self._rig, fault), self._rig.listener.dropped
        at, begun = f"{fault.name} at {self._now_s():.1f} s", time.monotonic()
        proof: Proof | None = None
        try:
            proof = fault.act(self._scene)
        except NotInjectedError as error:
            self._find(f"{at} could not be done: {error}")
        until, well_for, recovered = self._rig.counters()["cycles"], 0, 0.0
        while time.monotonic() - begun < _RECOVERY_S:
            time.sleep(_LOOK_S)
            self._listen()
            well_for = well_for + 1 if self._well(until if fault.recorder else 0) else 0
            if well_for == 1:
                recovered = time.monotonic() - begun
            late = well_for * _LOOK_S > _TOLD_S  # a line may come after all is well
            if well_for >= _WELL_LOOKS and (told.look() or late) and self._quiet():
                break
        if missing := told.missing():
            self._find(f"{at} was not told: {missing}")
        if errors := self._rig.bus_report()["errors"]:
            self._find(f"{at}: errors are not taken back: {errors}")
        if proof is not None and not (seen := proof(joined(self._kept))).ok:
            if self._rig.listener.dropped > deaf:  # what it has not heard says nothing
                self._unheard += 1
            else:
                self._find(f"{at} is not proved: {seen.text}")
        if well_for < _WELL_LOOKS:
            self._find(f"{at}: not well again within {_RECOVERY_S:g} s, said {told.said()!r}")
            return None
        return recovered

    def _well(self, until: int) -> bool:
        """Both joints have a torque and a reference, every node is configured, and the recorder has come beyond a cycle."""
        view = self._rig.reader.read()
        good = (st.VALID, st.DEGRADED, st.STANDSTILL)
        joints = all(joint.status in good and joint.sensor_nm == joint.sensor_nm for joint in view.joints)
        written = read_account(self._rig.runtime / "recorded")
        return joints and not view.unconfigured and written is not None and written.cycles >= until

    def _quiet(self) -> bool:
        return not self._rig.bus_report()["errors"]

    def _count(self) -> None:
        rig, report = self._rig, self.report
        result = rig.result
        lost = int((result.get("recording") or {}).get("lost", 0))
        records = read_records(sorted(rig.logs.glob("*.mcap")))
        found = account(records, self._syncs, result["counters"], lost, rig.listener.dropped)
        estimates = self._estimates
        report.counts = {
            **found.counts,
            "faults that it could not judge": self._unheard,
            "frames lost by the listener": rig.listener.dropped,
            "estimates heard": estimates.count,
            "torques heard": estimates.valid,
        }
        report.findings += found.wrong
        if estimates.leaked or (estimates.old and not rig.listener.dropped):
            report.findings.append(
                f"{estimates.leaked} torques beside another status, {estimates.old} old ones"
            )
        if "Traceback" in rig.said():
            report.findings.append("a traceback on standard error")
        if list(rig.logs.glob("*.active")):
            report.findings.append("an unfinished file was left")
        if rig.status not in (0, 3):
            report.findings.append(f"exit status {rig.status}")


class _Told:
    """Whether the daemon tells of a fault, in each of the ways in which it must."""

    def __init__(self, rig: Rig, fault: Fault) -> None:
        self._rig, self._fault = rig, fault
        self._before = rig.reader.read()
        self._recent = rig.said_lately(_TOLD_S)
        self._begun = len(rig.said())
        self._missing = ""

    def look(self) -> bool:
        fault, view = self._fault, self._rig.reader.read()
        words = self._recent + self._rig.said()[self._begun :]
        missing = []
        if fault.words and not any(word in words for word in fault.words):
            missing.append(f"no line with {' or '.join(map(repr, fault.words))}")
        if fault.counters and not any(view.counters[n] > self._before.counters[n] for n in fault.counters):
            missing.append(f"{' and '.join(fault.counters)} did not rise")
        spent = zip(view.status_cycles, self._before.status_cycles, strict=True)
        if fault.statuses and not any(now[n] > was[n] for now, was in spent for n in fault.statuses):
            missing.append(f"no status {' or '.join(map(str, fault.statuses))}")
        self._missing = ", ".join([*missing, f"said {self.said()!r}"]) if missing else ""
        return not missing

    def said(self) -> str:
        return self._rig.said()[self._begun :][-1000:]

    def missing(self) -> str:
        """What has not been told; "" for nothing."""
        self.look()
        return self._missing


def soak(
    directory: Path,
    seconds: float,
    seed: int,
    interface: str | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> SoakReport:
    """One soak of so many seconds, on a unix bus or on a CAN interface."""
    kinds = COMMON + (ON_INTERFACE if interface else ())
    with Rig(directory, interface, listen=True) as rig:
        return Soak(rig, seed, kinds).run(seconds, stop)
