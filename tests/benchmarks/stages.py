"""`stages`: where the time of jtqd's cycle goes, by timing its stages from outside; product code is not changed.

Every timed call costs two clock readings and a Python call itself; that is measured in the same process and taken off.
What is no stage (sleeping and waking up twice, the loop between the stages) is the rest of a round of the same process
without any timer.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.loop import process as loop
from jtqd.estimator.methods import AnyEstimator, load_network, make_estimator
from tests.benchmarks.contender import serve
from tests.benchmarks.contender_jtqd import JtqdLoop, _never, loop_start, measured
from tests.benchmarks.measure import SETTLE_CYCLES, CycleMeter, quantile

STAGES = {
    "receive": "two recvmmsg calls: what came late, then all inputs at once",
    "decode": "intake: sort frames in, unpack, decide what is of this cycle",
    "observe": "scaling, observer, loss, validity of both joints",
    "network": "two runs of the 6-20-40-10-1 network",
    "encode": "estimate PDO: fields and eight bytes",
    "send": "SYNC and estimate PDO, every 100th cycle the heartbeat",
    "hand over": "record of the cycle with its raw frames into the ring, counters",
    "sleep": "wall time asleep until the inputs are due (not part of the sum)",
}


cycle_module: Any = importlib.import_module("jtqd.daemon.loop.cycle")
joint_module: Any = importlib.import_module("jtqd.daemon.loop.joint")
"""Their names `estimate_pdo` and `time` are exchanged for timed ones during a round."""


class StageTimer:
    """Time spent per stage and cycle; nested stages are taken off the one around them."""

    def __init__(self) -> None:
        self.now = dict.fromkeys(STAGES, 0)
        self.cycles: list[dict[str, int]] = []
        self._inner = 0
        self._cost_inside, self._cost_around = self._calibrate()

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function` with its time booked on `stage`."""
        clock = time.perf_counter_ns

        def call(*arguments: Any) -> Any:
            outer, self._inner = self._inner, 0
            start = clock()
            try:
                return function(*arguments)
            finally:
                spent = clock() - start
                self.now[stage] += spent - self._inner - self._cost_inside
                self._inner = outer + spent + self._cost_around

        return call

    def end_cycle(self) -> None:
        """Keep this cycle's times and start the next one's."""
        self.cycles.append(self.now)
        self.now = dict.fromkeys(STAGES, 0)

    def _calibrate(self) -> tuple[int, int]:
        """(what a timer adds to its own stage, what it adds to the stage around it) [ns]."""
        self._cost_inside = self._cost_around = 0
        clock = time.perf_counter_ns
        timed = self.timed("sleep", _nothing)
        inside, around = [], []
        for _ in range(2000):
            self.now["sleep"] = 0
            start = clock()
            timed()
            middle = clock()
            _nothing()
            end = clock()
            plain = end - middle
            inside.append(self.now["sleep"] - plain)
            around.append(middle - start - plain - inside[-1])
        self.now = dict.fromkeys(STAGES, 0)
        self._inner = 0
        return round(quantile([*map(float, inside)], 0.5)), round(quantile([*map(float, around)], 0.5))


class StagedLoop(JtqdLoop):
    """jtqd's loop with timers around the calls that make up the stages."""

    def run(self, cycles: int) -> dict[str, Any]:
        """One plain round for the whole, one with timers for the parts."""
        plain = super().run(cycles)
        timer = StageTimer()
        pdo, clock = cycle_module.estimate_pdo, cycle_module.time
        estimators = self.estimators
        cycle_module.estimate_pdo = joint_module.estimate_pdo = SimpleNamespace(
            field=timer.timed("encode", estimate_pdo.field),
            encode=timer.timed("encode", estimate_pdo.encode),
            PUBLISHED_STATUSES=estimate_pdo.PUBLISHED_STATUSES,
        )
        cycle_module.time = SimpleNamespace(
            monotonic_ns=time.monotonic_ns, time_ns=time.time_ns, sleep=timer.timed("sleep", time.sleep)
        )
        self.estimators = [with_timed_network(self, number, timer) for number in (0, 1)]
        try:
            self._timed_round(cycles, timer)
        finally:
            cycle_module.estimate_pdo = joint_module.estimate_pdo = pdo
            cycle_module.time, self.estimators = clock, estimators
        kept = timer.cycles[SETTLE_CYCLES:]
        parts = {
            name: {
                "median_us": quantile([each[name] * 1e-3 for each in kept], 0.5),
                "p99_us": quantile([each[name] * 1e-3 for each in kept], 0.99),
            }
            for name in STAGES
        }
        return {"stages": parts, "plain": plain}

    def _timed_round(self, cycles: int, timer: StageTimer) -> None:
        cycle, grid, socket = self.connect()
        intake, timed = cycle.intake, timer.timed
        wrap(socket, "receive", timed, "receive")
        wrap(socket, "send", timed, "send")
        for name in ("begin", "take", "close", "drain"):
            wrap(intake, name, timed, "decode")
        wrap(cycle._frames, "keep", timed, "hand over")
        wrap(cycle._frames, "keep_one", timed, "hand over")
        wrap(cycle, "observe", timed, "observe")
        meter = CycleMeter()
        measured(cycle, meter)
        record = timed("hand over", cycle.record)

        def end_of_cycle() -> None:
            record()
            timer.end_cycle()

        cycle.record = end_of_cycle  # type: ignore[method-assign]
        loop_start(grid)
        loop.run(cycle, grid, _never, grid.slot_ns + cycles * grid.period_ns)
        socket.close()


def _nothing() -> None:
    """What the calibration times."""


def wrap(target: Any, name: str, timed: Callable[..., Any], stage: str) -> None:
    """Put a timer around a method of one object."""
    setattr(target, name, timed(stage, getattr(target, name)))


def with_timed_network(staged: StagedLoop, number: int, timer: StageTimer) -> AnyEstimator:
    """The estimator of one joint again, its network timed."""
    joint = staged.config.joints[number]
    assert joint.network is not None
    settings = staged.config.estimator
    network = load_network(settings.method, str(joint.network.path), joint.network.sha256)
    network.run_one = timer.timed("network", network.run_one)  # type: ignore[method-assign]
    estimator = make_estimator(joint.joint, settings, network)
    loop.warm_up([estimator])
    return estimator


if __name__ == "__main__":
    sys.exit(serve(StagedLoop))
