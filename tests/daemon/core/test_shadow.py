"""Shadow methods in the cycle: the same numbers as the method that is sent would have, and no effect on what is sent."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.logs import export, read_topic, recover, topics_of
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.recorder import RecorderRequest, Session
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import RingReader
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.estimator import Estimator, PythonEstimator, make_estimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import TorqueNetwork
from jtqd.estimator.settings import EstimatorSettings, recommended
from jtqd.estimator.status import DEGRADED, INVALID, OFF, STALE, STANDSTILL, STARTING, VALID, Estimate
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import ExactTime, ScriptedSocket, estimates, make, moving, turn
from tests.daemon.recording.cdr_decoder import Definition

PAPER = ("tob", "efficiency", "network")
CYCLES = 400


def joint(number: int) -> Joint:
    return load_joint(shipped(f"trained/joint{number}.yaml"))


@cache
def network_of(number: int) -> TorqueNetwork:
    return TorqueNetwork(str(shipped(f"trained/joint{number}.onnx")))


def estimator(method: str, number: int) -> Estimator:
    """Of the shipped bench, with the settings of its configuration but for the method."""
    network = network_of(number) if method == "network" else None
    settings = recommended("fused")
    values = {name: getattr(settings, name) for name in EstimatorSettings.__dataclass_fields__}
    return make_estimator(joint(number), EstimatorSettings(**(values | {"method": method})), network)


def shadow_of(record: bytes, number: int) -> dict[str, float]:
    """Shadow block of joint `number`, from 1 on."""
    at = cr.layout_of(2, True).shadow_offset + (number - 1) * cr.SHADOW.size
    return dict(zip(cr.SHADOW_FIELDS, cr.SHADOW.unpack_from(record, at), strict=True))


class Runs:
    """Runs of a method with shadow methods over the same inputs, at the same exact times."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._root, self._monkeypatch, self._count = directory, monkeypatch, 0
        self.directory = directory
        """Of the memory of the last run."""

    def __call__(
        self,
        method: str,
        shadows: Sequence[Sequence[Any]],
        script: Callable[[int], list[bytes]] = moving,
    ) -> tuple[Cycle, ScriptedSocket, list[bytes]]:
        """Return the cycle, the socket and the records of all cycles."""
        ExactTime().install(self._monkeypatch).now_ns = 1_700_000_000_000_000_000
        self._count += 1
        self.directory = self._root / str(self._count)
        self.directory.mkdir()
        sent = [estimator(method, number) for number in (1, 2)]
        safety = [JointSafety(None, each.settings, each.joint, 10_000_000) for each in sent]
        cycle, socket, reader = make(
            self.directory, script, estimators=sent, safety=safety, slots=CYCLES + 8, shadows=shadows
        )
        turn(cycle, CYCLES)
        return cycle, socket, records(reader)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    return Runs(tmp_path, monkeypatch)


def records(reader: RingReader) -> list[bytes]:
    found: list[bytes] = []
    while batch := reader.read().records:
        found += batch
    return found


def both(methods: Sequence[str] = PAPER) -> list[list[Estimator]]:
    return [[estimator(method, number) for method in methods] for number in (1, 2)]


def test_a_shadow_is_bit_for_bit_the_method_that_is_sent(runs: Runs) -> None:
    """`moving` leaves an input out every 41 cycles; numbers of the sent method are there in cycles with a torque."""
    _, _, found = runs("fused", both())
    assert len(found) == CYCLES
    for method in PAPER:
        _, _, alone = runs(method, ())
        for number in (1, 2):
            compared = 0
            for one, other in zip(found, alone, strict=True):
                shadow, sent = shadow_of(one, number), cr.joint_of(other, number)
                if sent.status in (VALID, DEGRADED, STANDSTILL):
                    compared += 1
                    assert shadow[f"{method}_torque_nm"] == sent.torque_nm
                    assert shadow[f"{method}_sigma_nm"] == sent.sigma_nm
                if sent.status != STALE and not math.isnan(sent.dt_s):
                    np.testing.assert_array_equal(shadow[f"{method}_reference_nm"], sent.reference_nm)
                assert shadow[f"{method}_age_ms"] == 5.0
            assert compared > 0.5 * CYCLES


def test_what_is_sent_is_the_same_with_and_without(runs: Runs) -> None:
    _, with_shadows, found = runs("fused", both())
    _, without, plain = runs("fused", ())
    assert with_shadows.sent == without.sent
    assert len(estimates(without)) == CYCLES
    layout = cr.layout_of(2)
    assert all(len(one) == layout.size for one in plain)
    for one, other in zip(found, plain, strict=True):
        for number in (1, 2):
            np.testing.assert_array_equal(cr.joint_of(one, number), cr.joint_of(other, number))


class Wrong:
    """An estimator of a shadow method that raises, or gives what is no number."""

    def __init__(self, number: int, answer: Callable[[], Any]) -> None:
        self.joint, self.settings, self.answer = joint(number), recommended("tob"), answer
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def step(self, *_: float) -> Any:
        return self.answer()


def raising() -> Any:
    raise RuntimeError("broken on purpose")


def not_finite() -> Any:
    return Estimate(math.inf, math.nan, VALID, math.nan, math.nan, math.nan)


@pytest.mark.parametrize("answer", [raising, not_finite])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_broken_shadow_never_touches_the_estimate(runs: Runs, answer: Callable[[], Any]) -> None:
    shadows = [[PythonEstimator(Wrong(n, answer)), estimator("efficiency", n)] for n in (1, 2)]
    cycle, socket, found = runs("fused", shadows)
    cycle.write_snapshot()
    view = SnapshotReader(runs.directory / "snapshot").read()
    _, without, _ = runs("fused", ())
    assert socket.sent == without.sent
    _, _, good = runs("fused", both(["efficiency"]))
    for one, other in zip(found, good, strict=True):
        broken, sound = shadow_of(one, 1), shadow_of(other, 1)
        assert not math.isfinite(broken["tob_torque_nm"])
        if answer is raising:
            assert broken["tob_status"] in (INVALID, STALE)
        for name in ("torque_nm", "sigma_nm", "reference_nm", "status"):
            np.testing.assert_array_equal(broken[f"efficiency_{name}"], sound[f"efficiency_{name}"])
    assert math.isnan(view.shadows[0]["tob"].rmse_nm)
    assert view.shadows[0]["efficiency"].rmse_nm > 0.0


def test_errors_in_the_snapshot_are_those_of_the_records(runs: Runs) -> None:
    """In motion, where the joint published a torque, against the sensor as old as the shadow's estimate and now."""
    cycle, _, found = runs("fused", both())
    cycle.write_snapshot()
    view = SnapshotReader(runs.directory / "snapshot").read()
    for number in (1, 2):
        assert tuple(view.shadows[number - 1]) == PAPER
        for method in PAPER:
            aligned, now = [], []
            for record in found:
                shadow, sent = shadow_of(record, number), cr.joint_of(record, number)
                error = shadow[f"{method}_torque_nm"] - shadow[f"{method}_reference_nm"]
                if sent.status in (VALID, DEGRADED) and not math.isnan(error):
                    aligned.append(error)
                    now.append(shadow[f"{method}_torque_nm"] - sent.sensor_torque_nm)
            seen = view.shadows[number - 1][method]
            assert len(aligned) > 0.5 * CYCLES
            assert seen.rmse_nm == pytest.approx(math.sqrt(np.mean(np.square(aligned))), rel=1e-12)
            assert seen.rmse_now_nm == pytest.approx(math.sqrt(np.mean(np.square(now))), rel=1e-12)
            last = shadow_of(found[-1], number)
            assert (seen.torque_nm, seen.sigma_nm) == (
                last[f"{method}_torque_nm"],
                last[f"{method}_sigma_nm"],
            )
            assert (seen.age_ms, seen.status) == (5.0, last[f"{method}_status"])


def test_a_missing_input_is_no_number_and_a_restart_forgets(runs: Runs) -> None:
    def script(sync: int) -> list[bytes]:
        return moving(sync)[1:] if sync == CYCLES - 20 else moving(sync)

    cycle, _, found = runs("fused", both(["tob"]), script)
    last, before = shadow_of(found[-21], 1), shadow_of(found[-22], 1)
    assert (before["tob_status"], last["tob_status"]) == (VALID, STALE)
    assert all(math.isnan(last[f"tob_{name}"]) for name in ("torque_nm", "sigma_nm", "reference_nm"))
    assert last["tob_age_ms"] == 5.0
    assert (last["network_status"], math.isnan(last["network_age_ms"])) == (OFF, True)
    cycle.joints[0].begin_again()
    reader = RingReader(runs.directory / "ring", cr.layout_of(2, True).size)
    reader.position += reader.backlog
    turn(cycle, 1)
    (record,) = reader.read().records
    assert (shadow_of(record, 1)["tob_status"], shadow_of(record, 2)["tob_status"]) == (STARTING, VALID)
    seen = [Wrong(number, not_finite) for number in (1, 2)]
    cycle, _, _ = runs("fused", [[PythonEstimator(each)] for each in seen])
    cycle.joints[0].begin_again()
    assert [each.resets for each in seen] == [1, 0]


def test_the_message_is_the_record(runs: Runs) -> None:
    _, _, found = runs("fused", both())
    cycles = messages.CycleMessages(2, shadow=True)
    definition = Definition(
        messages.SHADOW_SCHEMA, messages.schemas_of(2, shadow=True)[messages.SHADOW_SCHEMA]
    )
    assert [topic for topic, _ in cycles.parts] == [1, 2, 14, 15, 3]
    record = found[-1]
    header = cr.header_of(record)
    block = cycles.block(record, header.cycle, 77, flags=0, sync_counter=5, frames=1)
    payloads = dict(cycles.payloads(block))
    for number, topic in ((1, 14), (2, 15)):
        message = definition.decode(payloads[topic])
        assert message.pop("header") == {"stamp": {"sec": 0, "nanosec": 77}, "frame_id": f"joint_{number}"}
        assert message.pop("cycle") == header.cycle
        assert message.pop("sync_monotonic_ns") == header.sync_monotonic_ns
        assert set(message) == set(cr.SHADOW_FIELDS)
        for name, value in shadow_of(record, number).items():
            np.testing.assert_array_equal(message[name], value)
    plain = messages.CycleMessages(2)
    assert dict(plain.payloads(plain.block(record, header.cycle, 77, flags=0, sync_counter=5, frames=1))) == {
        topic: payload for topic, payload in payloads.items() if topic not in (14, 15)
    }


def test_without_the_key_there_is_no_topic() -> None:
    assert messages.SHADOW_SCHEMA not in messages.schemas_of(2)
    assert not any("shadow" in topic.name for topic in messages.topics_of(4))
    assert [topic.name for topic in messages.topics_of(2, shadow=True) if "shadow" in topic.name] == [
        "/joint/1/shadow",
        "/joint/2/shadow",
    ]


def test_the_log_tools_read_the_topic_as_any_other(runs: Runs, tmp_path: Path) -> None:
    """Recorded, read back and exported: the numbers of the records. A damaged chunk costs all topics its cycles."""
    _, _, found = runs("fused", both())
    request = RecorderRequest(ring=tmp_path, directory=tmp_path / "logs", repair=False, shadow=True)
    session = Session(request, Account(), pytest.fail)
    for record in found:
        session.recording.add(record)
    log = Path(session.finish()["path"])
    assert {"/joint/1/shadow", "/joint/2/shadow"} <= topics_of(log).keys()
    read = read_topic(log, "/joint/2/shadow")
    for name in cr.SHADOW_FIELDS:
        np.testing.assert_array_equal(read[name], [shadow_of(record, 2)[name] for record in found])
    table = tmp_path / "shadow.csv"
    assert export.main(["csv", str(log), "--topic", "/joint/2/shadow", "--out", str(table)]) == 0
    head, *rows = table.read_text().splitlines()
    assert set(cr.SHADOW_FIELDS) <= set(head.split(","))
    assert len(rows) == CYCLES
    damaged, (topic,) = bytearray(log.read_bytes()), [each.number for each in messages.SHADOWS[:1]]
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = [each for each in summary.chunk_indexes if topic in each.message_index_offsets]
    assert len(chunks) > 3
    damaged[chunks[1].chunk_start_offset + chunks[1].chunk_length // 2] ^= 0xFF
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(damaged)
    assert recover.main([str(broken)]) == 3
    kept = {topic: read_topic(broken, topic)["cycle"] for topic in ("/joint/1/state", "/joint/1/shadow")}
    assert 0 < len(kept["/joint/1/state"]) < CYCLES
    np.testing.assert_array_equal(kept["/joint/1/state"], kept["/joint/1/shadow"])
