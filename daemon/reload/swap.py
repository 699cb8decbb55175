"""The running loop takes over new estimators between two cycles, and no cycle is late or missing for it.

The blocks of the new estimators lie in a file (`daemon/reload/block_file.py`), with the cycle up to which they have followed
the loop's inputs. The loop loads them in small steps, where it would sleep anyway: after a cycle, and between SYNC and its
wake-up for the inputs.

    read      some kilobytes of the file, hashed
    header    the whole file is the one that was written, and of this program
    joint     joint and settings of one joint
    limits    its limits and checks
    blocks    its estimator is put together
    follow    one cycle that the new estimators have not seen yet, from the ring
    swap      none is left: what was learned is handed over, and from the next cycle on they are in force

A step begins only when the pause is longer than such a step has taken so far; after a third of PATIENCE_S it may delay the
next SYNC by a tenth of a period. Until `swap` nothing of the loop has changed. Everything else that the loop knows - the
bus, its nodes, the time grid, what is latched - stays where it is.
"""

from __future__ import annotations

import io
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.reload.block_file import BlockFileError, build, decoded, encoded
from jtqd.daemon.reload.order import Order
from jtqd.daemon.reload.shadow import follow
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.ring import RingReader
from jtqd.estimator.blocks import estimator_of, made_of
from jtqd.estimator.learned import hand_over
from jtqd.estimator.sample import Estimator
from jtqd.estimator.sha256 import sha256

PATIENCE_S: Final = 20.0
_MARGIN_NS: Final = 40_000
"""Kept free before what follows the pause, beyond what the steps have taken so far."""
_CHUNK: Final = 16_384
_FIRST_NS: Final = 50_000
"""Expected of a step that has not been taken yet."""
_FACTOR: Final = 2.0
"""Allowance on what steps of a kind have taken: caches are cold after a sleep."""
_REHEARSALS: Final = 5
_KEPT: Final = 20

Report = Callable[..., None]
"""Called with `swapped=True` and what became of it, or with `not_swapped=why`."""


class Swap:
    """Loads and swaps, in steps.

    Args:
        cycle: the running loop's.
        ring: file of its ring of cycles.
        safety: settings of its limits, which stay.
        report: tells the supervisor what became of an order.

    Attributes:
        next_step: its name.

    Raises:
        jtqd.daemon.shared.ring.RingError: there is no such ring.
    """

    def __init__(self, cycle: Cycle, ring: Path, safety: SafetySettings, report: Report) -> None:
        self._cycle, self._safety, self._report = cycle, safety, report
        self._reader = RingReader(ring, cr.layout_of(len(cycle.joints)).size)
        self._steps: Iterator[str] | None = None
        self.next_step = ""
        self._costs_ns: defaultdict[str, deque[int]] = defaultdict(lambda: deque([_FIRST_NS], maxlen=_KEPT))
        self._began_ns = 0
        self._missed = 0
        build()  # of the program that runs, not of one that is installed meanwhile

    @property
    def active(self) -> bool:
        """Return whether an order is being carried out: then every pause is wanted."""
        return self._steps is not None

    def begin(self, order: Order) -> None:
        """Take an order, in place of one that has not come to its end."""
        self._began_ns, self._missed = time.monotonic_ns(), self._cycle.grid.missed
        try:
            source = open(order.path, "rb", buffering=0)  # noqa: SIM115 - closed by the steps
        except OSError as error:
            self._refuse(f"{order.path}: {error.strerror}")
            return
        self._steps, self.next_step = self._all_steps(source, order), "read"

    def after_cycle(self) -> None:
        """Use the pause before the next slot."""
        grid = self._cycle.grid
        self.work(grid.slot_ns + grid.period_ns)

    def after_sync(self) -> None:
        """Use the pause before the wake-up for the inputs."""
        self.work(self._cycle.sync_ns + self._cycle.wake_up.wait_ns)

    def work(self, until_ns: int) -> None:
        """Take the steps that end before until_ns (CLOCK_MONOTONIC)."""
        while self._steps is not None:
            now_ns, needed_ns = time.monotonic_ns(), self._needed_ns(self.next_step)
            if now_ns > self._began_ns + PATIENCE_S * 1e9:
                needed = f"step '{self.next_step}' needs {needed_ns / 1000:.0f} us"
                self._refuse(f"no time in the pauses of {PATIENCE_S:g} s: {needed}")
                return
            if now_ns + needed_ns > until_ns + self._more_ns(now_ns):
                return
            self.take_step()

    def take_step(self) -> None:
        """Take the next step, whatever time there is."""
        assert self._steps is not None
        began, name = time.monotonic_ns(), self.next_step
        try:
            self.next_step = next(self._steps)
        except StopIteration:
            self._steps = None
        except (BlockFileError, OSError, ValueError) as error:
            self._refuse(str(error))
        except MemoryError:  # locked memory has a limit, too
            self._refuse("there is no memory for the new estimators")
        self._costs_ns[name].append(time.monotonic_ns() - began)

    def rehearse(self, estimators: Sequence[Estimator]) -> None:
        """Load these estimators some times without using them: the loop's first steps are then none."""
        try:
            content = encoded(estimators, self._reader.position)
        except ValueError:  # a network that only its runtime evaluates: no estimator to rehearse with
            return
        order = Order(Path(), len(content), sha256(content).hexdigest())
        for _ in range(_REHEARSALS):
            steps, name = self._all_steps(io.BytesIO(content), order), "read"
            while name != "swap":
                began = time.monotonic_ns()
                done, name = name, next(steps)
                self._costs_ns[done].append(time.monotonic_ns() - began)

    def _needed_ns(self, name: str) -> int:
        """Without the longest ones: these were interrupted, or the first of their kind."""
        costs = sorted(self._costs_ns[name])
        return round(_FACTOR * costs[len(costs) * 3 // 4])

    def _more_ns(self, now_ns: int) -> int:
        """How much longer than the pause a step may take."""
        patient = now_ns - self._began_ns < PATIENCE_S * 1e9 / 3
        return -_MARGIN_NS if patient else self._cycle.grid.period_ns // 10

    def _refuse(self, why: str) -> None:
        self._steps = None
        self._report(not_swapped=why)

    # Steps: each yields the name of the next one ----------------------------------------------------------------------

    def _all_steps(self, source: io.RawIOBase | io.BytesIO, order: Order) -> Iterator[str]:
        content = memoryview(bytearray(order.length))
        with source:
            yield from self._read(source, order, content)
        yield "header"
        position, blocks = decoded(content)
        joints = self._cycle.joints
        if len(blocks) != len(joints):
            raise BlockFileError(f"found estimators of {len(blocks)} joints, expected {len(joints)}")
        new: list[tuple[Estimator, JointSafety]] = []
        for each in blocks:
            yield "joint"
            made = made_of(each.plain)
            yield "limits"
            limits = JointSafety(self._safety, made.settings, made.joint, self._cycle.grid.period_ns)
            yield "blocks"
            new.append((estimator_of(each, made), limits))
        yield from self._follow(position, [estimator for estimator, _ in new])
        zeros: dict[str, str] = {}
        for joint, (estimator, limits) in zip(joints, new, strict=True):
            became = hand_over(joint.estimator, estimator)
            if became:
                zeros[f"joint_{joints.index(joint) + 1}"] = became
            joint.use(estimator, limits)
        if self._cycle.contacts is not None:
            self._cycle.contacts.restart()  # loads by other files step without a contact
        told = {"zeros": zeros} if zeros else {}
        missed = self._cycle.grid.missed - self._missed
        self._report(swapped=True, cycle=self._cycle.index, missed=missed, **told)

    def _read(self, source: io.RawIOBase | io.BytesIO, order: Order, content: memoryview) -> Iterator[str]:
        digest, at = sha256(), 0
        while at < len(content):
            count = source.readinto(content[at : at + _CHUNK]) or 0
            if not count:
                break
            digest.update(content[at : at + count])
            at += count
            yield "read"
        if at < len(content) or source.read(1):
            raise BlockFileError(f"{order.path}: found another length, expected {len(content)} bytes")
        if digest.hexdigest() != order.sha256:
            raise BlockFileError(f"{order.path}: found another SHA-256, expected {order.sha256[:16]}...")

    def _follow(self, position: int, estimators: Sequence[Estimator]) -> Iterator[str]:
        reader = self._reader
        reader.seek(position)
        while True:
            yield "follow" if reader.backlog else "swap"
            if not reader.backlog:
                return  # and swap, before there is another one
            batch = reader.read(1)
            if batch.lost:
                raise BlockFileError("the ring has lost cycles that the new estimators have not seen")
            for record in batch.records:
                for number, estimator in enumerate(estimators, start=1):
                    follow(estimator, cr.joint_of(record, number))
