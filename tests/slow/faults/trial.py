"""jtqd behind the gateway, in exact time, and each estimate judged by the plant's torque of its SYNC.

The cycle is the compiled one of the loop process, built from a configuration as the daemon builds it; its clocks and its bus
are those of this file, and go on by what the cycle waits for. Conditions and their EMCY are the supervisor's, twenty times a
second. What is judged are the eight bytes on the bus.
"""

from __future__ import annotations

import heapq
import random
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core import cycle as cycle_module
from jtqd.daemon.core.cycle import RUN_ENDED, SLOT_PASSED
from jtqd.daemon.core.schedule import PythonClock
from jtqd.daemon.loop.process import build_cycle, build_estimator
from jtqd.daemon.shared.conditions import Change, Conditions
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.daemon.supervisor.health import Health
from jtqd.estimator.arrays import BoolArray, FloatArray
from tests.shipped_bench import shipped_bench
from tests.slow.faults.gateway import Active, Gateway
from tests.slow.faults.runs import Played, Units, joint_files, runs_of

MS: Final = 1_000_000
ESTIMATE: Final = 0x1A0
SYNC: Final = 0x080
_LAYOUT: Final = struct.Struct("<hhBBBB")
NO_TORQUE: Final = -0x8000
VALID, DEGRADED, STANDSTILL = 2, 3, 6
WITH_TORQUE: Final = (VALID, STANDSTILL, DEGRADED)
_RANK: Final = {VALID: 0, STANDSTILL: 0, DEGRADED: 1}
WIDEST_NM: Final = 255 * 0.05
"""Sigma 255 on the wire is this or more; a receiver knows no more than this."""
WRONG_NM, WRONG_SIGMAS = 2.0, 4.0
_SUPERVISE_NS: Final = 50 * MS
_CONFIGURE_CYCLES: Final = 300
_ECHO_NS: Final = 60_000
_FLOWING: Final = frozenset(
    {"cycles", "complete", "published", "bits_worst_case", "work_max_ns", "late_max_ns", "network_outside",
     "network_fallbacks", "contacts"}
)  # fmt: skip
"""Counters that rise in good health too."""


class Clock:
    """Time of the cycle and its bus: it goes on only by what is waited for. `step_ns`: of CLOCK_REALTIME."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000 * MS
        self.step_ns = 1_700_000_000_000 * MS

    def monotonic_ns(self) -> int:
        return self.now_ns

    def time_ns(self) -> int:
        return self.now_ns + self.step_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Bus:
    """Frame socket of the cycle: answers each SYNC with what comes through the gateway, keeps the estimates.

    estimates: (cycle of the run, sequence expected, data) of each 1A0h.
    """

    def __init__(self, clock: Clock, gateway: Gateway) -> None:
        self.frames, self.stamps_ns, self.own = bytearray(16 * 64), [0] * 64, [False] * 64
        self.tx_dropped = self.rx_dropped = 0
        self.estimates: list[tuple[int, int, bytes]] = []
        self.cycle = -1
        self._clock, self._gateway = clock, gateway
        self._first_ns = -1
        self._sequence = 0
        self._queue: list[tuple[int, int, bytes, bool]] = []
        self._number = 0

    def fileno(self) -> int:
        return -1

    def _push(self, due_ns: int, can_id: int, data: bytes, own: bool) -> None:
        self._number += 1
        frame = struct.pack("<IB3x8s", can_id, len(data), data)
        heapq.heappush(self._queue, (due_ns, self._number, frame, own))

    def send(self, data: bytes) -> bool:
        can_id, length, content = struct.unpack("<IB3x8s", data)
        now_ns = self._clock.now_ns
        if can_id == SYNC:
            if self._first_ns < 0:
                self._first_ns = now_ns
            self.cycle = (now_ns - self._first_ns + MS // 2) // MS
            self._sequence = content[0]
            self._push(now_ns + _ECHO_NS, can_id, content[:length], True)
            for at_us, answer_id, answer in self._gateway.answers(self.cycle):
                self._push(now_ns + round(1000.0 * at_us), answer_id, answer, False)
        elif can_id == ESTIMATE:
            self.estimates.append((self.cycle, self._sequence, content[:length]))
        return True

    def receive(self) -> int:
        queue, now_ns, count = self._queue, self._clock.now_ns, 0
        while queue and queue[0][0] <= now_ns and count < 64:
            due_ns, _, frame, own = heapq.heappop(queue)
            self.frames[16 * count : 16 * count + 16] = frame
            self.stamps_ns[count], self.own[count] = due_ns + self._clock.step_ns, own
            count += 1
        return count

    def wait(self, timeout_s: float) -> bool:
        end_ns = self._clock.now_ns + round(timeout_s * 1e9)
        if self._queue and self._queue[0][0] <= end_ns:
            self._clock.now_ns = max(self._clock.now_ns, self._queue[0][0])
            return True
        self._clock.now_ns = end_ns
        return False


@contextmanager
def _clock() -> Iterator[Clock]:
    before, clock = cycle_module.clock, Clock()
    cycle_module.clock = PythonClock(clock)
    try:
        yield clock
    finally:
        cycle_module.clock = before


class Watched(NamedTuple):
    """What a run gave, by cycle: torque, sigma [n, 2] (NaN where none), status [n, 2] (-1: no estimate); what was reported:
    EMCY (cycle, code) and counters (cycle, name) in their order; latched: a fault was latched at its end.
    """

    torque_nm: FloatArray
    sigma_nm: FloatArray
    status: Any
    emcy: tuple[tuple[int, int], ...]
    counters: dict[str, int]
    counted: tuple[tuple[int, str], ...]
    latched: bool


@cache
def _config(plant: str, directory: str) -> Config:
    content = shipped_bench()
    for number, path in zip((1, 2), joint_files(plant), strict=True):
        joint = content[f"joint_{number}"]
        joint["file"] = str(path)
        joint.pop("network", None)
    path = Path(directory) / f"{plant.replace(' ', '_')}.yaml"
    path.write_text(yaml.safe_dump(content))
    return load_config(path)


_DIRECTORY: Final = TemporaryDirectory(prefix="jtq")


def _report(units: tuple[Units, Units]) -> dict[str, Any]:
    nodes: dict[str, Any] = {
        str(node): {"scaling": unit.scaling} for node, unit in zip((1, 2), units, strict=True)
    }
    nodes["3"] = {"scaling": {"nm_per_unit": {"1": 0.001}}}
    return {"nodes": nodes}


def watch(run: Played, faults: Sequence[Active] = (), steps: Sequence[tuple[int, float]] = ()) -> Watched:
    """Run jtqd through a run with these faults. steps: (cycle, seconds) by which CLOCK_REALTIME is set."""
    config = _config(run.plant, _DIRECTORY.name)
    directory = Path(_DIRECTORY.name)
    with _clock() as clock:
        bus = Bus(clock, Gateway(run.at, faults))
        request = {"snapshot": directory / "snapshot", "ring": directory / "ring", "worst_load": 0.8}
        estimators = [build_estimator(config, joint) for joint in config.joints]
        cycle, grid = build_cycle(config, request, _report(run.units), bus, estimators)  # type: ignore[arg-type]
        cycle.intake.claims = True
        grid.slot_ns = clock.now_ns + 2 * MS
        supervisor = _Supervisor(config, directory / "snapshot", grid.slot_ns)
        end_ns = grid.slot_ns + len(run.frames) * MS
        left = sorted(steps)
        passed = False
        while True:
            outcome = cycle.go_on(1 if passed or left else 10, end_ns)
            if outcome == RUN_ENDED:
                break
            passed = outcome == SLOT_PASSED
            if passed:
                continue
            if left and bus.cycle >= left[0][0]:
                clock.step_ns += round(left.pop(0)[1] * 1e9)
            supervisor.look(clock.now_ns, bus.cycle)
            cycle.skip(grid.advance(clock.now_ns))
        cycle.write_snapshot()
        supervisor.look(clock.now_ns, bus.cycle, last=True)
    return _watched(bus.estimates, len(run.frames), supervisor)


class _Supervisor:
    """What the supervisor does with the snapshot: conditions, their EMCY, nodes configured again."""

    def __init__(self, config: Config, snapshot: Path, first_ns: int) -> None:
        self._reader = SnapshotReader(snapshot, supervisor=True)
        self._conditions = Conditions()
        self._conditions.subscribe(self._on_change)
        self._health = Health(config, self._conditions)
        self._due_ns, self._cycle = first_ns, 0
        self._waiting: dict[int, int] = {}
        self._before: dict[str, int] = {}
        self.emcy: list[tuple[int, int]] = []
        self.counted: list[tuple[int, str]] = []
        self.counters: dict[str, int] = {}
        self.latched = False

    def _on_change(self, change: Change) -> None:
        if change.present and change.definition.emcy is not None:
            self.emcy.append((self._cycle, change.definition.emcy.code))

    def look(self, now_ns: int, cycle: int, *, last: bool = False) -> None:
        if now_ns < self._due_ns and not last:
            return
        self._due_ns += _SUPERVISE_NS
        self._cycle = cycle
        view = self._reader.read()
        self._health.observe(view, now_ns * 1e-9)
        for name, value in view.counters.items():
            if value > self._before.get(name, 0) and name not in _FLOWING:
                self.counted.append((cycle, name))
        self._before = self.counters = view.counters
        for node in view.unconfigured:
            since = self._waiting.setdefault(node, cycle)
            if cycle - since >= _CONFIGURE_CYCLES:
                self._reader.note_configured(node, view.restarts[node])
        self._waiting = {node: since for node, since in self._waiting.items() if node in view.unconfigured}
        self.latched = any(joint.latched for joint in view.joints)


def _watched(estimates: Sequence[tuple[int, int, bytes]], count: int, supervisor: _Supervisor) -> Watched:
    torque, sigma = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    status = np.full((count, 2), -1)
    for cycle, expected, data in estimates:
        one, two, sigma_1, sigma_2, both, sequence = _LAYOUT.unpack(data)
        if cycle >= count:
            continue
        if sequence != expected:
            raise AssertionError(f"cycle {cycle}: found sequence {sequence}, expected {expected}")
        for n, (value, spread, code) in enumerate(((one, sigma_1, both & 15), (two, sigma_2, both >> 4))):
            status[cycle, n] = code
            if (value == NO_TORQUE) != (code not in WITH_TORQUE):
                raise AssertionError(f"cycle {cycle}: found {value} with status {code}")
            if value != NO_TORQUE:
                torque[cycle, n], sigma[cycle, n] = 0.01 * value, 0.05 * spread
    return Watched(
        torque,
        sigma,
        status,
        tuple(supervisor.emcy),
        supervisor.counters,
        tuple(supervisor.counted),
        supervisor.latched,
    )


# The judge -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """One or two faults in one run.

    row: of the table, by name; injected: what exactly; begin, end: first cycle of the first fault, and the one after the
    last.
    """

    row: str
    group: str
    plant: str
    state: str
    run_seed: int
    injected: str
    begin: int
    end: int
    faults: tuple[Active, ...]
    steps: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class Outcome:
    """How jtqd met a case, over both joints and from the begin of the fault to the end of the run.

    dangerous, dangerous_nm: cycles with status 2 or 6 that are more than WRONG_NM and WRONG_SIGMAS off, and the largest
    error among them; valid_nm: largest error with status 2 or 6; degraded, degraded_beyond, degraded_nm: cycles of status 3,
    those beyond WRONG_SIGMAS, largest error; sent_share: largest error of all torques that were sent, in rated torques;
    reported_s, reported_by: until the first status, EMCY or counter that shows the fault; harmless: no error is beyond
    WRONG_NM and WRONG_SIGMAS; right_s: from the end of the fault until status and error are as without it from then on,
    None: not in this run. What is wrong without the fault, too, does not count.
    """

    case: Case = field(repr=False)
    dangerous: int
    dangerous_nm: float
    valid_nm: float
    degraded: int
    degraded_beyond: int
    degraded_nm: float
    sent_share: float
    reported_s: float | None
    reported_by: str
    harmless: bool
    right_s: float | None
    latched: bool

    @property
    def unreported(self) -> bool:
        """Neither harmless nor reported within 0.1 s."""
        return not self.harmless and (self.reported_s is None or self.reported_s > 0.1)


@cache
def healthy(plant: str, state: str, seed: int) -> Watched:
    """Return the same run without a fault."""
    return watch(runs_of(plant, seed)[state])


def beyond(seen: Watched, true_nm: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the error [n, 2] and where it is beyond WRONG_SIGMAS of what is on the wire."""
    error = np.abs(seen.torque_nm - true_nm)
    with np.errstate(invalid="ignore"):
        return error, error > WRONG_SIGMAS * seen.sigma_nm


def judge(case: Case) -> Outcome:
    """Run and judge a case."""
    run = runs_of(case.plant, case.run_seed)[case.state]
    twin = healthy(case.plant, case.state, case.run_seed)
    return judged(case, run, watch(run, case.faults, case.steps), twin)


def judged(case: Case, run: Played, seen: Watched, twin: Watched) -> Outcome:
    """Judge what a case gave; twin: the same run without its faults."""
    error, far = beyond(seen, run.true_nm)
    own_error, own_far = beyond(twin, run.true_nm)
    n = len(run.frames)
    counted = np.zeros((n, 2), bool)
    counted[case.begin :] = True
    good = np.isin(seen.status, (VALID, STANDSTILL)) & counted
    lowered = (seen.status == DEGRADED) & counted
    own_wrong = own_far & (own_error > WRONG_NM)
    wrong = good & far & (error > WRONG_NM) & ~own_wrong
    sent = np.where(counted & (seen.status >= 0), error, np.nan)
    reported_s, reported_by = _reported(case, seen, twin)
    right_s = None
    rated = run.units[0].rated_nm
    bad = _ranks(seen.status) > _ranks(twin.status)
    bad |= far & (error > WRONG_NM) & ~own_wrong
    last = np.flatnonzero(bad[case.end :].any(axis=1))
    if case.end < n and (not len(last) or last[-1] < n - case.end - 1):
        right_s = 0.0 if not len(last) else 1e-3 * float(last[-1] + 1)
    return Outcome(
        case,
        int(wrong.sum()),
        _largest(error[wrong]),
        _largest(error[good]),
        int(lowered.sum()),
        int((lowered & far & ~own_far).sum()),
        _largest(error[lowered]),
        _largest(sent[np.isfinite(sent)]) / rated,
        reported_s,
        reported_by,
        not (far & counted & ~own_far & (error > WRONG_NM)).any(),
        right_s,
        seen.latched,
    )


def _largest(values: FloatArray) -> float:
    return float(values.max()) if values.size else 0.0


def _ranks(status: Any) -> Any:
    """Return 0 for valid and standstill, 1 for degraded, 2 for no torque."""
    ranks = np.full(status.shape, 2)
    for code, rank in _RANK.items():
        ranks[status == code] = rank
    return ranks


def _reported(case: Case, seen: Watched, twin: Watched) -> tuple[float | None, str]:
    """Return when and by what the fault is reported first, against the run without it; (None, "") where nothing is."""
    found: list[tuple[int, str]] = []
    worse = np.argwhere(_ranks(seen.status[case.begin :]) > _ranks(twin.status[case.begin :]))
    if len(worse):
        cycle, joint = worse[0]
        found.append((int(cycle) + case.begin, f"status {seen.status[cycle + case.begin, joint]}"))
    healthy_codes, healthy_names = set(twin.emcy), {name for _, name in twin.counted}
    found += [
        (cycle, f"EMCY {code:04X}h")
        for cycle, code in seen.emcy
        if cycle >= case.begin and (cycle, code) not in healthy_codes
    ][:1]
    found += [
        (cycle, name) for cycle, name in seen.counted if cycle >= case.begin and name not in healthy_names
    ][:1]
    if not found:
        return None, ""
    cycle, by = min(found)
    return 1e-3 * (cycle - case.begin), by


@dataclass(frozen=True)
class Baseline:
    """Runs of a plant without faults: shares of valid cycles in motion, of cycles of status 3 and without torque; cycles of
    status 2 or 6 that are wrong, of status 3 beyond WRONG_SIGMAS; counters that rose; runs that end latched."""

    plant: str
    valid_share: float
    degraded_share: float
    none_share: float
    wrong: int
    degraded_beyond: int
    counted: tuple[str, ...]
    latched: int


def baseline(plant: str, states: Sequence[str], seeds: Sequence[int]) -> Baseline:
    """Return the figures of a plant's runs of these seeds."""
    valid: list[BoolArray] = []
    shares = np.zeros((3,))
    wrong = degraded_beyond = latched = 0
    names: set[str] = set()
    for seed in seeds:
        for state in states:
            run, seen = runs_of(plant, seed)[state], healthy(plant, state, seed)
            error, far = beyond(seen, run.true_nm)
            after = np.arange(len(run.frames)) >= 100
            status = seen.status[after]
            ranks = _ranks(status)
            valid.append((status == VALID)[run.moving[after]])
            shares += [np.mean(ranks == rank) for rank in range(3)]
            good = np.isin(seen.status, (VALID, STANDSTILL))
            wrong += int((good & far & (error > WRONG_NM)).sum())
            degraded_beyond += int(((seen.status == DEGRADED) & far).sum())
            names |= {name for _, name in seen.counted}
            latched += seen.latched
    shares /= len(seeds) * len(states)
    return Baseline(
        plant,
        float(np.concatenate(valid).mean()),
        float(shares[1]),
        float(shares[2]),
        wrong,
        degraded_beyond,
        tuple(sorted(names)),
        latched,
    )


def rng_of(*parts: object) -> random.Random:
    """Return the generator of a case: the same parts give the same draws."""
    return random.Random(" ".join(map(str, parts)))
