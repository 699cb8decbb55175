"""Zeros that the estimators track, in a log: a replay from any part of it has the loop's own values.

The loop's cycles run in exact time on a scripted bus that answers with the measurements of an emulated run, with a zero of
both link encoders added; the contents of ring and snapshot become logs, as the recorder makes them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.input_pdos import input_pdos, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.core.status import NEEDED, JointSafety
from jtqd.daemon.logs import read_attachments, read_topic
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData
from jtqd.daemon.recording.messages import CycleMessages, definitions, zeros_of
from jtqd.daemon.replay.logged import Setup, read_setup
from jtqd.daemon.replay.session import Result, models_of, replay
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import Ring, RingReader
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader, View
from jtqd.estimator.status import DEGRADED
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate
from jtqd.sim_can.plant_source import load_any_plant
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import ENABLED, I32, MOTION, SENSOR, ExactTime, ScriptedSocket, frame
from tests.paths import ROOT

GOLDEN = ROOT / "tests/golden/faults.mcap"
CYCLES, ZERO_RAD = 6000, 3e-4
SECOND = 1000
HELD_CYCLES = NEEDED[DEGRADED]
"""Until a lowered status is published as valid again."""


@dataclass(frozen=True)
class Recorded:
    """Records of the cycles of a run of the loop, and views of the snapshot, one a second."""

    attachments: dict[str, bytes]
    records: list[bytes]
    views: list[View]


def frames_of(setup: Setup) -> list[list[bytes]]:
    """The answers of the nodes to each SYNC: both joints go to and fro under a load, both link encoders are off."""
    commands = (
        JointCommand.velocity(lambda t: 0.9 * math.sin(2.6 * t)),
        JointCommand.current(lambda t: 1.8 * math.sin(1.9 * t)),
    )
    run = emulate(load_any_plant(shipped("campaign_plant.yaml")), commands, CYCLES * 1e-3, 5).table
    every = []
    for number, inputs in enumerate(setup.inputs, start=1):
        columns = run.joints[number]
        assert columns.motor_velocity_rad_s is not None
        assert columns.link_position_rad is not None
        assert columns.temperature_c is not None
        every.append(
            [
                np.rint(columns.motor_position_rad / inputs.motor_rad_per_count),
                np.rint((columns.link_position_rad + ZERO_RAD) / inputs.link_rad_per_count),
                np.rint(columns.motor_velocity_rad_s / inputs.motor_rad_s_per_unit),
                np.rint(columns.current_a / inputs.ampere_per_unit),
                np.rint(columns.temperature_c / 0.1),
            ]
        )
    answers = []
    for row in range(CYCLES):
        here = []
        for number, columns in enumerate(every, start=1):
            motor, link, velocity, current, celsius = (int(each[row]) for each in columns)
            here += [
                frame(0x180 + number, I32.pack(motor, link)),
                frame(0x280 + number, MOTION.pack(velocity, current, ENABLED)),
            ]
            if row % 500 == 0:
                here.append(frame(0x380 + number, struct.pack("<h", celsius)))
        answers.append([*here, frame(0x183, SENSOR.pack(0, 0))])
    return answers


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    place = tmp_path_factory.mktemp("loop")
    attachments = read_attachments(GOLDEN)
    assert b"track_zeros: true" in attachments["configuration.yaml"]
    with pytest.MonkeyPatch.context() as patch:
        clock = ExactTime().install(patch)
        setup = read_setup(GOLDEN, attachments, place)
        config, models = setup.config, models_of(setup)
        answers = frames_of(setup)
        snapshot = place / "snapshot"
        cycle = Cycle(
            ScriptedSocket(lambda sync: answers[sync - 1]),  # type: ignore[arg-type]
            Intake(input_pdos(config), joint_temperatures(config)),
            list(zip(setup.inputs, [each.estimator for each in models], strict=True)),
            Ring(place / "ring", 4096, rr.RECORD_SIZE),
            Snapshot(snapshot, config.period_ns * 1e-9, 0.8),
            safety=[
                JointSafety(
                    config.safety, each.settings, each.joint, config.period_ns, each.network is not None
                )
                for each in models
            ],
            node_id=config.node_id,
            counter_overflow=config.counter_overflow,
            wait_ns=0,
            deadline_ns=100_000,
            heartbeat_cycles=100,
            grid=Grid(clock.now_ns, config.period_ns),
        )
        ring, reader = RingReader(place / "ring", rr.RECORD_SIZE), SnapshotReader(snapshot)
        records: list[bytes] = []
        views: list[View] = []
        while len(records) < CYCLES:
            clock.turn(cycle, 500)
            batch = ring.read(500)
            assert batch.lost == 0
            records += [bytes(each) for each in batch.records]
            if len(records) % SECOND == 500:
                views.append(reader.read())
        yield Recorded(attachments, records, views)


def written(path: Path, run: Recorded, first: int = 0, end: int = CYCLES, *, states: bool = True) -> Path:
    """The log of the cycles `first` to `end`; without `states` no state of an estimator is in it."""
    schemas, channels = definitions()
    messages = CycleMessages(2)
    builder = ChunkBuilder(schemas, channels, messages.parts, 10)
    attachments = [NamedData(name, "text/plain", data) for name, data in run.attachments.items()]
    file = McapFile(path.with_name(path.name + ".active"), Head(schemas, channels, attachments), {}, 0)
    views = {view.cycle: view for view in run.views if states}
    for record in run.records[first:end]:
        header = cr.header_of(record)
        block = messages.block(
            record,
            header.cycle,
            header.sync_realtime_ns,
            flags=header.flags,
            sync_counter=header.sync_counter,
            frames=header.frame_count,
        )
        builder.add_block(block, header.sync_realtime_ns)
        view = views.get(header.cycle)
        if view is not None:
            for topic, message in zeros_of(view):
                builder.add(topic.number, header.sync_realtime_ns, message)
    sealed = builder.seal()
    assert sealed is not None
    file.append(sealed)
    file.finish(path.name)
    return path


def replayed(path: Path, **options: Any) -> Result:
    (result,) = replay([path], **options)
    return result


def test_zeros_that_the_loop_learns_are_in_snapshot_and_log(recorded: Recorded, tmp_path: Path) -> None:
    last = recorded.views[-1]
    for zero in last.zeros[:2]:
        assert zero.learned
        assert zero.link_rad == pytest.approx(ZERO_RAD, abs=2e-5)
        assert zero.link_used_rad == pytest.approx(ZERO_RAD, abs=2e-5)
    found = read_topic(written(tmp_path / "run.mcap", recorded), "/joint/2/zeros")
    assert found["cycle"].tolist() == [view.cycle for view in recorded.views]
    assert found["link_rad"].tolist() == [view.zeros[1].link_rad for view in recorded.views]
    assert found["flags"].tolist() == [view.zeros[1].flags for view in recorded.views]


def test_a_whole_run_is_replayed_as_the_loop_was(recorded: Recorded, tmp_path: Path) -> None:
    result = replayed(written(tmp_path / "run.mcap", recorded))
    assert result.identity is not None
    assert result.identity.explained
    assert result.identity.differences == ()
    assert result.identity.whole


@pytest.mark.parametrize("first", [2200, 3497])  # 3497: just behind a state
def test_a_log_from_the_middle_is_the_loop_again_from_its_first_state_on(
    recorded: Recorded, tmp_path: Path, first: int
) -> None:
    """Bit for bit; only a status that was published is held for some cycles more, as everywhere."""
    result = replayed(written(tmp_path / "part.mcap", recorded, first))
    known = min(view.cycle for view in recorded.views if view.cycle >= first) + 1
    found = result.identity
    assert found is not None
    assert found.explained, found
    for logged, again in zip(result.run.joints, result.joints, strict=True):
        behind = logged["cycle"] >= known
        assert behind.any()
        for name in ("torque_nm", "sigma_nm", "physics_nm"):
            assert logged[name][behind].tobytes() == again[name][behind].tobytes()
    assert found.from_cycle is not None
    assert found.from_cycle <= known + HELD_CYCLES


def test_without_the_states_a_log_from_the_middle_is_another_one(recorded: Recorded, tmp_path: Path) -> None:
    """What the states are there for: a zero does not fade as the observer does."""
    result = replayed(written(tmp_path / "part.mcap", recorded, 2200, states=False))
    assert result.identity is not None
    assert not result.identity.explained


def test_a_state_of_the_log_that_is_not_the_replays_is_a_finding(recorded: Recorded, tmp_path: Path) -> None:
    at = 3
    seen = recorded.views[at]
    spoilt = seen.pasts[0][:-8] + b"\0" * 7 + b"\1"
    views = list(recorded.views)
    views[at] = seen._replace(pasts=(spoilt, *seen.pasts[1:]))
    result = replayed(written(tmp_path / "run.mcap", replace(recorded, views=views)))
    assert result.identity is not None
    assert [(each.joint, each.cycle, each.field) for each in result.identity.differences][-1] == (
        1,
        seen.cycle,
        "state",
    )


def test_other_losses_do_not_go_on_from_the_states(recorded: Recorded, tmp_path: Path) -> None:
    """Zeros that were learned with the logged losses do not hold for other ones; the estimate learns its own."""
    models = tmp_path / "models"
    models.mkdir()
    text = recorded.attachments["joint1.yaml"].decode()
    (models / "joint1.yaml").write_text(text.replace("nm_per_a: 0.062", "nm_per_a: 0.0621", 1))
    log = written(tmp_path / "part.mcap", recorded, 3500)
    same, other = replayed(log), replayed(log, model=models)
    assert same.comparisons[0].rms_nm < 0.1
    assert other.comparisons[0].rms_nm > 0.3
