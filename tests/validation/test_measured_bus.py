"""The measured run over the bus: jtqd against a played run on vcan0, in exact time, scored from its own log."""

import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from jtqd.daemon.logs import read_topic
from jtqd.daemon.logs.read import published_torque
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.estimator.status import STALE, STARTING
from jtqd.models.files import load_yaml, shipped
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from tests.daemon.recording.cdr_decoder import Definition
from validation import measured
from validation.measured_bus import Played, config_file, configured, record, score_log

pytestmark = pytest.mark.native

RUN = "RunTrajectory1"
STARTING_CYCLES = 20


@pytest.mark.parametrize("run", measured.RUNS)
def test_configurations_differ_in_the_fit_alone_and_never_judge_a_run_by_its_own(run: str) -> None:
    before, after = config_file(run, False), config_file(run, True)
    other = measured.RUNS[1 - measured.RUNS.index(run)]
    old, new = load_yaml(before), load_yaml(after)
    for number, joint in zip((1, 2), measured.JOINTS, strict=True):
        assert old[f"joint_{number}"].pop("file") == f"joint{joint}.yaml"
        assert new[f"joint_{number}"].pop("file") == f"joint{joint}.fitted_on_{other}.yaml"
    assert (old["estimator"].pop("method"), new["estimator"].pop("method")) == ("tob", "fused")
    assert old == new
    (joints, settings), (fitted, own) = configured(before), configured(after)
    assert settings == measured.SETTINGS
    assert own == measured.AFTER
    for joint, changed in zip(joints, fitted, strict=True):
        assert changed.fused is not None
        same = {"fused": None, "rotor_inertia_kgm2": joint.rotor_inertia_kgm2, "provenance": joint.provenance}
        assert replace(changed, **same) == joint


@pytest.mark.socketcan
def test_a_played_run_on_vcan_is_the_offline_estimate_and_then_stale(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    config, path = config_file(RUN, False), shipped(f"kinova_gen3/{RUN}.csv.gz")
    table = read_run(path, ColumnMap.load(shipped("kinova_gen3/columns.yaml"))).table
    dump = tmp_path / "dump.log"
    with dump.open("w") as file:
        candump = subprocess.Popen(["candump", "-L", "vcan0,1A0:7FF"], stdout=file)
        log, summary = record("vcan0", path, config, float(table.time_s[-1]), tmp_path)
        candump.terminate()
        candump.wait()
    joints, settings = configured(config)
    assert summary["missed"] == 0
    assert summary["recording"]["lost"] == 0

    frames = read_topic(log, "/can/frames")
    assert np.array_equal(frames["cycle"], np.arange(len(frames)))  # every cycle, none twice
    after = slice(len(table.time_s), None)
    assert len(frames[after]) >= 290
    for index, (number, joint) in enumerate(zip(measured.JOINTS, joints, strict=True)):
        result = score_log(log, index, Played(number, RUN, "before", table, joint, settings))
        assert (result.missed, result.incomplete) == (0, 0)
        assert result.scored == len(table.time_s) - STARTING_CYCLES
        assert np.all(result.status[:STARTING_CYCLES] == STARTING)
        assert np.isnan(result.published_nm[:STARTING_CYCLES]).all()
        # Half a unit of the current (6078h: 1/1000 of the rated current, the joint's rated torque) and of the PDO.
        assert result.offline_difference_nm < joint.rated_torque_nm / 2000.0 + 0.005 + 1e-4
        assert result.replay_difference_nm < 1e-9
        assert result.rmse_nm == pytest.approx(result.offline_rmse_nm, abs=0.002)
        assert np.all(result.status[after] == STALE)
        assert np.isnan(result.published_nm[after]).all()
        assert result.silent_after_end
        # The score is that of the run it claims, not of the other joint's channel.
        other = score_log(log, index, Played(measured.JOINTS[1 - index], RUN, "", table, joint, settings))
        assert other.offline_difference_nm > 1.0

    check_against_the_independent_decoder(log)
    check_against_the_bus(dump, published_torque(frames, 0), published_torque(frames, 1))


def check_against_the_bus(dump, *published) -> None:
    """What the log says was published is what another node saw, and it ends with "off"."""
    seen = [bytes.fromhex(line.rsplit("#", 1)[1]) for line in dump.read_text().splitlines()]
    assert len(seen) == len(published[0]) + 1
    torque = np.array([np.frombuffer(data[:4], "<i2") for data in seen])
    for joint, values in enumerate(published):
        expected = np.where(np.isnan(values), -0x8000, np.nan_to_num(values) * 100.0)
        assert torque[:-1, joint] == pytest.approx(expected, abs=1e-6)
    assert (torque[-1] == -0x8000).all()
    assert seen[-1][6] == 0


def check_against_the_independent_decoder(log) -> None:
    """joint_log gives what a decoder says that reads one message after the other."""
    arrays = {topic: read_topic(log, topic) for topic in ("/joint/2/state", "/can/frames")}
    published = published_torque(arrays["/can/frames"], 1)
    seen = dict.fromkeys(arrays, 0)
    definitions = {}
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(list(arrays)):
            number = seen[channel.topic]
            seen[channel.topic] += 1
            if number % 97:
                continue
            if schema.id not in definitions:
                definitions[schema.id] = Definition(schema.name, schema.data.decode())
            fields = definitions[schema.id].decode(message.data)
            same(arrays[channel.topic][number], fields)
            if channel.topic == "/can/frames":
                data = [
                    bytes(f["data"]) for f in fields["frames"][: fields["frame_count"]] if f["id"] == 0x1A0
                ]
                counts = int.from_bytes(data[0][2:4], "little", signed=True)
                assert (
                    np.isnan(published[number]) if counts == -0x8000 else published[number] == counts * 0.01
                )
    assert seen == {topic: len(array) for topic, array in arrays.items()}


def same(found, expected) -> None:
    if isinstance(expected, dict):
        assert set(found.dtype.names) == set(expected)
        for key, value in expected.items():
            same(found[key], value)
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            same(one, other)
    elif isinstance(expected, str):
        assert found == expected.encode()
    else:
        assert found == expected or (np.isnan(found) and np.isnan(expected))


def test_a_unix_bus_outlives_the_run_that_was_played_on_it(tmp_path) -> None:
    rows = "".join(f"{k / 1000},1,{0.001 * k},1,{0.001 * k}\n" for k in range(30))
    run = tmp_path / "run.csv"
    run.write_text("time_s,j1.current_a,j1.link_position_rad,j2.current_a,j2.link_position_rad\n" + rows)
    bus = f"unix:{tmp_path}/bus"
    play = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, "--play", str(run)],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert play.stderr.readline() == f"bench ready on {bus}\n"
        socket = open_frame_socket(bus, None)
        socket.send(pack(0x000, bytes((1, 0))))
        answers = [answered(socket, 0.05) for _ in range(30)]
        assert answers[0] >= {0x181, 0x281, 0x182, 0x282, 0x183}
        assert not any(answers[-3:])  # at 1 ms or more between SYNCs the run is over long before
        assert play.poll() is None
        socket.send(pack(0x601, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))))
        assert not socket.wait(0.1)  # silent means all services
        socket.close()
        assert play.wait(10) == 0
        assert "the run has ended" in play.stderr.read()
    finally:
        play.kill()
        play.wait()
        play.stderr.close()


def answered(socket, wait_s) -> set[int]:
    """Identifiers of what comes within wait_s of a SYNC."""
    socket.send(pack(0x080, b"\x01"))
    found: set[int] = set()
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0:
        if socket.wait(left):
            count = socket.receive()
            found |= {FRAME.unpack_from(socket.frames, 16 * k)[0] for k in range(count)}
    return found - {0x701, 0x702, 0x703}
