"""The running loop swaps its estimators: bit by bit those that followed its inputs, between two cycles, or not at all."""

import hashlib
import json
import math
import os
import signal
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.loop.process import Duties
from jtqd.daemon.reload import block_file, swap
from jtqd.daemon.reload.block_file import encoded
from jtqd.daemon.reload.order import Order
from jtqd.daemon.reload.prepare import write
from jtqd.daemon.reload.shadow import Shadow, follow
from jtqd.daemon.reload.swap import Swap
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import RECORD_SIZE
from jtqd.daemon.shared.ring import RingReader
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.network import FusedNetwork
from jtqd.estimator.sample import Estimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import INVALID
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import (
    I32,
    ExactTime,
    ScriptedSocket,
    estimates,
    frame,
    make,
    moving,
)
from tests.estimator.effects.effect_signals import extended
from tests.estimator.fused_configuration import joint_of, network_of
from tests.estimator.test_fused_estimator import NARROW
from tests.estimator.test_zeros import ON, driven

FAR = 1 << 62
"""A pause without end."""
SAFETY = SafetySettings()


def others(kind: str) -> list[Estimator]:
    """New estimators of both joints."""
    if kind in ("tob", "efficiency"):
        return [
            make_estimator(load_joint(shipped(f"joint{n}.yaml")), EstimatorSettings(method=kind))
            for n in (1, 2)
        ]
    settings = EstimatorSettings(method="fused")
    if kind == "fused":
        return [make_estimator(joint_of(n), settings, FusedNetwork(network_of(n))) for n in (1, 2)]
    effects = (
        ("hysteresis", {"torque_nm": 1.5, "travel_rad": 2e-4}),
        ("torque_constant", {"torque_constant_nm_per_a": 0.07}),
    )
    return [make_estimator(extended(joint_of(n), *effects), settings) for n in (1, 2)]


def limits(number: int) -> JointSafety:
    settings = EstimatorSettings(method="efficiency")
    return JointSafety(SAFETY, settings, load_joint(shipped(f"joint{number}.yaml")), 10_000_000)


class Loop:
    """A running loop on a scripted bus, and what its swap reports."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.directory = tmp_path
        self.clock = ExactTime().install(monkeypatch)
        self.cycle: Cycle
        self.socket: ScriptedSocket
        self.cycle, self.socket, self.reader = make(
            tmp_path, moving, slots=4096, safety=[limits(1), limits(2)]
        )
        self.reports: list[dict[str, Any]] = []
        self.swap = Swap(
            self.cycle, tmp_path / "ring", SAFETY, lambda **content: self.reports.append(content)
        )

    def turn(self, count: int) -> None:
        self.clock.turn(self.cycle, count)

    def prepared(self, new: list[Estimator]) -> Order:
        """As the preparing process does it."""
        shadow = Shadow(self.directory / "ring", new)
        shadow.catch_up()
        return self.ordered(encoded(new, shadow.position))

    def ordered(self, content: bytes) -> Order:
        path = self.directory / "estimators"
        write(path, content)
        return Order(path, len(content), hashlib.sha256(content).hexdigest())

    def refused(self, order: Order) -> str:
        """Carry out an order that comes to nothing; return the reason. The loop has not changed."""
        before = [(joint.estimator, joint.safety) for joint in self.cycle.joints]
        self.swap.begin(order)
        self.swap.work(FAR)
        assert [(joint.estimator, joint.safety) for joint in self.cycle.joints] == before
        assert not self.swap.active
        (report,) = self.reports
        assert [*report] == ["not_swapped"]
        self.reports.clear()
        self.turn(3)
        return str(report["not_swapped"])


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Loop:
    return Loop(tmp_path, monkeypatch)


@pytest.mark.parametrize("changed", ["sigma", "torsion"])
def test_zeros_are_kept_where_what_they_were_learned_with_is_the_same(loop: Loop, changed: str) -> None:
    fused = NARROW.fused
    assert fused is not None
    assert fused.torsion is not None
    new = {
        "sigma": replace(fused, sigma=replace(fused.sigma, torsion_nm=0.3)),
        "torsion": replace(fused, torsion=replace(fused.torsion, zero_rad=1e-4)),
    }[changed]
    for joint in loop.cycle.joints:
        old = make_estimator(NARROW, ON)
        old.run(*driven(link_zero_rad=2e-4)[0])
        joint.use(old, limits(1))
    loop.turn(100)
    known = [joint.estimator.past for joint in loop.cycle.joints]
    loop.swap.begin(loop.prepared([make_estimator(replace(NARROW, fused=new), ON) for _ in (1, 2)]))
    loop.swap.work(FAR)
    became = "kept" if changed == "sigma" else "forgotten"
    (report,) = loop.reports
    assert report["zeros"] == {"joint_1": became, "joint_2": became}
    assert [joint.estimator.past == past for joint, past in zip(loop.cycle.joints, known, strict=True)] == [
        became == "kept"
    ] * 2


@pytest.mark.parametrize("kind", ["tob", "fused", "effects"])
@pytest.mark.parametrize("between", [0, 1, 200])
def test_from_the_swap_on_the_estimates_are_those_of_estimators_that_followed_all_inputs(
    loop: Loop, kind: str, between: int
) -> None:
    loop.turn(700)
    order = loop.prepared(others(kind))
    loop.turn(between)  # cycles that the preparing process has not seen
    loop.swap.begin(order)
    loop.swap.work(FAR)
    assert loop.reports == [{"swapped": True, "cycle": 700 + between, "missed": 0}]
    loop.turn(300)
    records = RingReader(loop.directory / "ring", RECORD_SIZE).read(4096).records
    assert len(records) == 1000 + between
    compared = 0
    for number, fresh in enumerate(others(kind), start=1):
        for n, record in enumerate(records):
            was = cr.joint_of(record, number)
            found = follow(fresh, was)
            if found is None or n < 700 + between:
                continue
            assert str((found.tob_nm, found.physics_nm, found.network_nm)) == str(
                (was.tob_nm, was.physics_nm, was.network_nm)
            )
            if not math.isnan(was.torque_nm):
                assert (found.torque_nm, found.sigma_nm) == (was.torque_nm, was.sigma_nm)
                compared += 1
    assert compared > 300


def test_the_bus_shows_no_trace_of_a_swap_to_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("plain", "swapped"):
        (tmp_path / name).mkdir()
    plain = Loop(tmp_path / "plain", monkeypatch)
    begin_ns = plain.clock.now_ns
    plain.turn(900)
    swapped = Loop(tmp_path / "swapped", monkeypatch)
    swapped.clock.now_ns = begin_ns
    for _ in range(3):
        swapped.turn(300)
        swapped.swap.begin(swapped.prepared(others("efficiency")))
        swapped.swap.work(FAR)
    assert [each["swapped"] for each in swapped.reports] == [True] * 3
    assert swapped.socket.sent == plain.socket.sent
    assert len(estimates(swapped.socket)) == 900


def test_nothing_happens_in_a_pause_that_is_too_short(loop: Loop) -> None:
    loop.turn(50)
    loop.swap.begin(loop.prepared(others("tob")))
    for _ in range(20):
        loop.swap.work(swap.time.monotonic_ns() + 10_000)
        loop.turn(1)
    assert loop.swap.active
    assert loop.reports == []
    loop.swap.work(FAR)
    assert loop.reports == [{"swapped": True, "cycle": 70, "missed": 0}]


class SlowTime:
    """A clock of the swap's own: each look at it takes 1 us."""

    def __init__(self) -> None:
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns


def one_step(loop: Loop, clock: SlowTime) -> None:
    needed_ns = loop.swap._needed_ns(loop.swap.next_step)
    loop.swap.work(clock.now_ns + 1000 + needed_ns + swap._MARGIN_NS)


@pytest.mark.parametrize("first", [0, 1, 2])
@pytest.mark.parametrize("steps", [2, 3])
def test_with_few_steps_per_cycle_no_cycle_is_left_out(
    loop: Loop, monkeypatch: pytest.MonkeyPatch, steps: int, first: int
) -> None:
    """Two steps per cycle catch up with one cycle; the last one must not leave out what came before it."""
    clock = SlowTime()
    loop.turn(400)
    order = loop.prepared(others("fused"))
    seen: list[str] = []
    monkeypatch.setattr(swap, "time", clock)
    loop.swap.begin(order)
    left = first
    while loop.swap.active:
        while left and loop.swap.active:
            left -= 1
            seen.append(loop.swap.next_step)
            one_step(loop, clock)
        if loop.swap.active:
            left = steps
            loop.turn(1)
    assert {*seen} == {"read", "header", "joint", "limits", "blocks", "follow", "swap"}
    (report,) = loop.reports
    loop.turn(10)
    records = RingReader(loop.directory / "ring", RECORD_SIZE).read(4096).records
    assert report["cycle"] == len(records) - 10
    (fresh, _) = others("fused")
    for n, record in enumerate(records):
        was = cr.joint_of(record, 1)
        found = follow(fresh, was)
        if found is not None and n >= report["cycle"]:
            assert (found.tob_nm, found.physics_nm, found.network_nm) == pytest.approx(
                (was.tob_nm, was.physics_nm, was.network_nm), abs=0.0, nan_ok=True
            )


def test_a_loop_without_pauses_gives_up_and_says_what_it_needs(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SlowTime()
    loop.turn(50)
    order = loop.prepared(others("tob"))
    monkeypatch.setattr(swap, "time", clock)
    loop.swap.begin(order)
    loop.swap.work(0)
    assert loop.swap.active
    clock.now_ns += 21_000_000_000
    loop.swap.work(FAR)
    assert loop.reports == [{"not_swapped": "no time in the pauses of 20 s: step 'read' needs 100 us"}]
    assert not loop.swap.active


def test_patience_ends_in_a_delay_of_a_tenth_of_a_period(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SlowTime()
    loop.turn(50)
    monkeypatch.setattr(swap, "time", clock)
    order = loop.prepared(others("tob"))
    loop.swap.begin(order)
    loop.swap.work(clock.now_ns)
    assert loop.swap.next_step == "read"
    clock.now_ns += 7_000_000_000
    began_ns = clock.now_ns
    while loop.swap.active:
        loop.swap.work(began_ns)  # of a period of 10 ms: up to 1 ms late
    assert loop.reports[0]["swapped"]
    assert clock.now_ns < began_ns + loop.cycle.grid.period_ns // 10


def test_the_pauses_are_those_after_sync_and_after_the_cycle(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    until: list[int] = []
    monkeypatch.setattr(loop.swap, "work", until.append)
    loop.turn(1)
    loop.swap.after_cycle()
    loop.swap.after_sync()
    grid, cycle = loop.cycle.grid, loop.cycle
    assert until == [grid.slot_ns + grid.period_ns, cycle.sync_ns + cycle.wake_up.wait_ns]


def test_what_is_latched_stays_latched(loop: Loop) -> None:
    loop.turn(60)
    script = loop.socket.script
    far = frame(0x181, I32.pack(2_000_000, 0))
    loop.socket.script = lambda sync: [far if each[:2] == far[:2] else each for each in script(sync)]
    loop.turn(1)
    loop.socket.script = script
    loop.turn(5)
    one, two = loop.cycle.joints
    assert one.latched  # its encoder has jumped
    latched, counter = one.latched, loop.cycle.counter
    loop.swap.begin(loop.prepared(others("tob")))
    loop.swap.work(FAR)
    assert loop.reports == [{"swapped": True, "cycle": 66, "missed": 0}]
    assert (one.latched, one.status, loop.cycle.counter) == (latched, INVALID, counter)
    loop.turn(200)
    assert (one.latched, one.status, two.latched) == (latched, INVALID, 0)
    assert estimates(loop.socket)[-1][:2] == b"\x00\x80"
    loop.cycle.reset_faults()
    loop.turn(200)
    assert one.latched == 0
    assert any(each[:2] != b"\x00\x80" for each in estimates(loop.socket)[-200:])


def test_the_limits_are_those_of_the_new_files(loop: Loop) -> None:
    loop.turn(50)
    settings = EstimatorSettings(method="tob", torque_limit=2.0, network_limit=0.5)
    joints = [replace(load_joint(shipped(f"joint{n}.yaml")), rated_torque_nm=10.0 * n) for n in (1, 2)]
    before = [joint.safety.plausibility for joint in loop.cycle.joints]
    loop.swap.begin(loop.prepared([make_estimator(joint, settings) for joint in joints]))
    loop.swap.work(FAR)
    found = [(each.safety.torque_limit_nm, each.safety.network_limit_nm) for each in loop.cycle.joints]
    assert found == [(20.0, 5.0), (40.0, 10.0)]
    for joint, old in zip(loop.cycle.joints, before, strict=True):
        assert joint.safety.plausibility not in (None, old)
        assert joint.safety.settings is SAFETY


# What is refused, and nothing has changed -----------------------------------------------------------------------------


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes((content[at] ^ 1,)) + content[at + 1 :]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda data: data[:-1], "found another length"),
        (lambda data: data[:100], "found another length"),
        (lambda data: b"", "found another length"),
        (lambda data: data + b"\0", "found another length"),
        (lambda data: flipped(data, 3), "found another SHA-256"),
        (lambda data: flipped(data, 200), "found another SHA-256"),
        (lambda data: flipped(data, len(data) // 2), "found another SHA-256"),
        (lambda data: flipped(data, len(data) - 1), "found another SHA-256"),
    ],
)
def test_a_file_that_is_not_the_one_that_was_written(
    loop: Loop, change: Callable[[bytes], bytes], why: str
) -> None:
    loop.turn(50)
    order = loop.prepared(others("fused"))
    order.path.write_bytes(change(order.path.read_bytes()))
    assert why in loop.refused(order)


def test_a_file_that_is_not_there(loop: Loop) -> None:
    order = Order(loop.directory / "none", 5, "")
    assert loop.refused(order) == f"{loop.directory / 'none'}: No such file or directory"


def test_a_file_of_another_layout_of_the_right_hash(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    loop.turn(50)
    content = encoded(others("tob"), 50)
    assert "at its beginning, expected" in loop.refused(loop.ordered(b"another " + content))
    (length,) = struct.unpack_from("<I", content, 8)
    header = json.loads(content[12 : 12 + length])
    header["joints"][0]["sizes"][0] -= 8
    shorter = json.dumps(header).encode()
    cut = content[:8] + struct.pack("<I", len(shorter)) + shorter + content[12 + length + 8 :]
    assert "found a block of" in loop.refused(loop.ordered(cut))
    one = encoded(others("tob")[:1], 50)
    assert loop.refused(loop.ordered(one)) == "found estimators of 1 joints, expected 2"
    order = loop.ordered(content)
    monkeypatch.setattr(block_file, "build", lambda: "another")
    assert "the program has changed since jtqd started" in loop.refused(order)


def test_no_memory(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    loop.turn(50)
    order = loop.prepared(others("tob"))

    def full(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(swap, "estimator_of", full)
    assert loop.refused(order) == "there is no memory for the new estimators"


def test_estimators_that_are_too_far_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = Loop(tmp_path, monkeypatch)
    loop.turn(10)
    order = loop.prepared(others("tob"))
    loop.turn(4200)
    assert loop.refused(order) == "the ring has lost cycles that the new estimators have not seen"


def test_an_order_takes_the_place_of_one_that_has_not_come_to_its_end(loop: Loop) -> None:
    loop.turn(50)
    loop.swap.begin(loop.prepared(others("tob")))
    loop.swap.work(0)
    loop.swap.begin(loop.prepared(others("fused")))
    loop.swap.work(FAR)
    assert loop.reports == [{"swapped": True, "cycle": 50, "missed": 0}]
    assert loop.cycle.joints[0].estimator.settings.method == "fused"
    loop.turn(10)
    loop.swap.begin(loop.prepared(others("tob")))
    loop.swap.work(FAR)
    assert loop.reports[1:] == [{"swapped": True, "cycle": 60, "missed": 0}]


def test_a_rehearsal_changes_nothing_and_learns_what_steps_take(loop: Loop) -> None:
    loop.turn(50)
    before = [(joint.estimator, joint.safety) for joint in loop.cycle.joints]
    loop.swap.rehearse(others("fused"))
    assert [(joint.estimator, joint.safety) for joint in loop.cycle.joints] == before
    assert (loop.swap.active, loop.reports) == (False, [])
    for name in ("read", "header", "joint", "limits", "blocks"):
        assert len(loop.swap._costs_ns[name]) > 5, name


# The loop's duties ----------------------------------------------------------------------------------------------------


class Fed:
    """In place of the watchdog."""

    def advanced(self, cycles: int) -> None:
        """Nothing to feed."""


def test_an_order_comes_by_signal_and_standard_input(loop: Loop) -> None:
    read, write_end = os.pipe()
    with open(read) as orders, open(write_end, "w") as supervisor:
        handler = signal.getsignal(signal.SIGUSR2)
        duties = Duties(loop.cycle, Fed(), loop.swap, orders)  # type: ignore[arg-type]
        try:
            loop.turn(50)
            idle = duties.slots()
            assert idle > 1
            signal.raise_signal(signal.SIGUSR2)  # somebody else's: there is no order
            assert duties.slots() == 1
            duties()
            assert (duties.slots(), duties.after_sync) == (idle, None)
            supervisor.write(json.dumps(loop.prepared(others("tob")).to_mapping()) + "\n")
            supervisor.flush()
            duties()
            assert not loop.swap.active, "not before the signal"
            signal.raise_signal(signal.SIGUSR2)
            duties()
            assert (duties.slots(), duties.after_sync) == (1, loop.swap.after_sync)
            for _ in range(100):
                if loop.swap.active:
                    loop.cycle.grid.slot_ns = time.monotonic_ns()
                    duties()
                    loop.turn(1)
            assert loop.reports[0]["swapped"]
            assert (duties.slots(), duties.after_sync) == (idle, None)
            supervisor.close()
            signal.raise_signal(signal.SIGUSR2)  # the supervisor has gone
            duties()
            assert not loop.swap.active
        finally:
            signal.signal(signal.SIGUSR2, handler)
