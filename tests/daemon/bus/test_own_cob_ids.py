"""Frames of others with jtqd's COB-IDs: counted by the loop, reported by the service, used for nothing."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.input_pdos import TemperaturePdo
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.loop.process import loop_filters
from jtqd.daemon.shared.counters import word_of
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.own_objects import loop_cob_ids
from tests.daemon.bus.master_bench import OWN, MasterBench
from tests.daemon.loop import cycle_helpers
from tests.daemon.loop.cycle_helpers import PDOS, ExactTime, ScriptedSocket, inputs, make, turn
from tests.daemon.ring_records import frames_of
from tests.daemon.slow_bench import slow_configuration
from tests.drivers.hub_helpers import until_it_listens

LOOP_IDS = (0x1A0, 0x2A0, 0x3A0, 0x4A0, 0x720)
SERVICE_IDS = (0x0A0, 0x5A0)
FALSE = bytes.fromhex("e803e8030505 22 07")
"""10 Nm for both joints, valid."""


def test_the_cob_ids_are_those_of_the_own_node() -> None:
    assert loop_cob_ids(OWN) == LOOP_IDS
    filters = {each.can_id for each in loop_filters(load_config(None))}
    assert set(LOOP_IDS) <= filters
    assert not set(SERVICE_IDS) & filters, (
        "their frames come from the service's socket, which the loop cannot tell"
    )


class EchoingSocket(ScriptedSocket):
    """Gives back what the loop sends with its own COB-IDs, as AF_CAN does, in the next batch."""

    def send(self, data: bytes) -> bool:
        sent = super().send(data)
        if struct.unpack_from("<I", data)[0] in LOOP_IDS:
            self.pending.append((bytes(data), True))
        return sent


@pytest.fixture
def _exact_time(monkeypatch: pytest.MonkeyPatch) -> None:
    ExactTime().install(monkeypatch)
    monkeypatch.setattr(cycle_helpers, "ScriptedSocket", EchoingSocket)
    monkeypatch.setattr(cycle_helpers, "Intake", lambda *known: Intake(*known, own=LOOP_IDS))


@pytest.mark.usefixtures("_exact_time")
def test_the_loop_counts_frames_that_it_did_not_send_and_goes_on(tmp_path: Path) -> None:
    """In the first cycles the boot may still send the heartbeat; echoes are neither counted nor recorded twice."""

    def script(sync: int) -> list[bytes]:
        foreign = (
            [pack(0x1A0, FALSE)] if sync in (10, 60, 61) else [pack(0x720, b"\x05")] if sync == 62 else []
        )
        return [*foreign, *inputs()]

    cycle, _, reader = make(tmp_path, script)
    view = SnapshotReader(tmp_path / "snapshot")
    turn(cycle, 50)
    assert view.read().counters["cob_id_conflicts"] == 0
    cycle.intake.claims = True
    turn(cycle, 11)
    cycle.write_snapshot()
    assert (view.read().counters["cob_id_conflicts"], view.read().conflict_cob_id) == (2, 0x1A0)
    turn(cycle, 21)
    cycle.write_snapshot()
    seen = view.read()
    assert (seen.counters["cob_id_conflicts"], seen.conflict_cob_id) == (3, 0x720)
    assert (seen.counters["unknown_frames"], seen.counters["rejected_frames"]) == (0, 0)
    assert seen.counters["complete"] == 82, "the inputs beside them are used"
    for record in reader.read().records:
        ids = [FRAME.unpack(each)[0] for each, _ in frames_of(record)]
        assert ids.count(0x1A0) == 1, "what was sent"
        assert 0x720 not in ids
        assert FALSE not in [FRAME.unpack(each)[2] for each, _ in frames_of(record)]


def test_an_input_with_such_a_cob_id_stays_an_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive may be mapped to any COB-ID that the configuration gives it, its temperature as well."""
    ExactTime().install(monkeypatch)
    own = [PDOS[0].cob_id, 0x381, *LOOP_IDS]
    monkeypatch.setattr(cycle_helpers, "Intake", lambda *known: Intake(*known, own=own))
    script = lambda sync: [*inputs(), pack(0x381, b"\x64\x00")]  # noqa: E731
    cycle, _, _ = make(tmp_path, script, temperatures=[TemperaturePdo(0x381, 1, "381h", 2000)])
    cycle.intake.claims = True
    turn(cycle, 30)
    assert cycle.intake.fresh(0)
    assert cycle.intake.temperature(0) == pytest.approx(10.0)
    cycle.write_snapshot()
    counters = SnapshotReader(tmp_path / "snapshot").read().counters
    assert (counters["complete"], counters["cob_id_conflicts"]) == (30, 0)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[MasterBench]:
    with MasterBench(tmp_path) as each:
        yield each


def emcys(bench: MasterBench, cob_id: int) -> list[bytes]:
    """EMCY messages of jtqd about a COB-ID: bytes 5 and 6."""
    return [data for data in bench.own(0x080) if data[5:7] == cob_id.to_bytes(2, "little")]


@pytest.mark.parametrize("cob_id", SERVICE_IDS)
def test_the_service_reports_its_own_cob_ids_and_their_end(bench: MasterBench, cob_id: int) -> None:
    bench.sdo(0x1001, 0)  # its own answers are none
    bench.pause(0.1)
    assert not bench.logged("COB-ID")
    bench.send(cob_id, bytes(8))
    assert bench.run(lambda: bool(emcys(bench, cob_id)))
    assert emcys(bench, cob_id) == [bytes.fromhex("5081 11 0000") + cob_id.to_bytes(2, "little") + b"\0"]
    assert f"COB-ID {cob_id:03X}h: another node sends with this COB-ID of jtqd" in bench.lines
    assert [each.name for each in bench.conditions.present()] == ["cob_id_conflict"]
    bench.heard.clear()
    assert bench.run(lambda: bool(emcys(bench, cob_id)))
    assert emcys(bench, cob_id)[0][:5] == bytes.fromhex("0000 00 5081")
    assert bench.logged(f"COB-ID {cob_id:03X}h: only jtqd sends with it after 1.")


def test_the_service_reports_what_the_loop_has_counted(bench: MasterBench) -> None:
    bench.snapshot.conflict[0] = 0x1A0
    bench.pause(0.1)
    assert not bench.logged("COB-ID")
    bench.snapshot.counters[word_of("cob_id_conflicts")] += 1
    assert bench.run(lambda: bench.logged("COB-ID 1A0h: another node sends"))
    bench.snapshot.conflict[0] = 0x720
    bench.snapshot.counters[word_of("cob_id_conflicts")] += 5
    assert bench.run(lambda: bench.logged("COB-ID 720h: another node sends"))
    assert {each.subject for each in bench.conditions.present()} >= {"COB-ID 1A0h", "COB-ID 720h"}


def test_the_whole_daemon_on_a_hub(tmp_path: Path) -> None:
    """A false torque, EMCY, heartbeat and SDO answer of another member of the bus: one line and one EMCY each."""
    bus, ids = f"unix:{tmp_path / 'bus'}", (0x1A0, 0x2A0, 0x3A0, 0x720, 0x0A0, 0x5A0)
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(tmp_path), "LOGS_DIRECTORY": ""}
    bench = subprocess.Popen([sys.executable, "-m", "jtqd.sim_can", "--bus", bus])
    until_it_listens(bus, bench)
    config = slow_configuration(tmp_path, 10_000, estimator={"method": "efficiency"})
    command = [sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", bus, "--record", "none", "--json"]
    jtqd = subprocess.Popen(
        [*command, "--config", config],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    other = open_frame_socket(bus, [exact(0x0A0), exact(0x1A0)])
    heard: list[tuple[int, bytes]] = []

    def listen(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and jtqd.poll() is None:
            other.wait(0.05)
            for n in range(other.receive()):
                can_id, length, data = FRAME.unpack_from(other.frames, 16 * n)
                heard.append((can_id, bytes(data[:length])))

    try:
        end = time.monotonic() + 30.0
        while not any(can_id == 0x1A0 for can_id, _ in heard) and time.monotonic() < end:
            listen(0.2)
        listen(2.5)  # the boot has handed over the heartbeat
        assert not [data for can_id, data in heard if can_id == 0x0A0]
        for cob_id in ids:
            other.send(pack(cob_id, FALSE if cob_id != 0x720 else b"\x05"))
            listen(0.3)
        listen(1.0)
        jtqd.terminate()
        out, err = jtqd.communicate(timeout=20)
    finally:
        jtqd.kill()
        bench.terminate()
        other.close()
        bench.wait(5)
    for cob_id in ids:
        assert f"COB-ID {cob_id:03X}h: another node sends with this COB-ID of jtqd" in err
    reported = {int.from_bytes(d[5:7], "little") for c, d in heard if c == 0x0A0 and d[:2] == b"\x50\x81"}
    assert reported == set(ids), err
    summary = json.loads(out)
    assert summary["counters"]["cob_id_conflicts"] == 4
    assert summary["counters"]["unknown_frames"] == 0
    sequences = [decode(data).sequence for can_id, data in heard if can_id == 0x1A0]
    assert len(sequences) > 200, "estimates go on"
