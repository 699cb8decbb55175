"""The measured run over the bus: jtqd against a played run on vcan0, in exact time, scored from its own log."""

from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from estimator.status import STALE, STARTING
from models.files import load_yaml, shipped
from sim_can.run_files import ColumnMap, read_run
from sysid import measured
from sysid.joint_log import read_topic
from sysid.measured_bus import config_file, record
from sysid.measured_bus_score import Played, configured, published_torque, score_log
from tests.cdr_decoder import Definition

RUN = "RunTrajectory1"
STARTING_CYCLES = 20


@pytest.mark.parametrize("run", measured.RUNS)
def test_configurations_differ_in_friction_alone_and_never_judge_a_run_by_its_own_fit(run: str) -> None:
    before, after = config_file(run, False), config_file(run, True)
    other = measured.RUNS[1 - measured.RUNS.index(run)]
    old, new = load_yaml(before)[0], load_yaml(after)[0]
    for number, joint in zip((1, 2), measured.JOINTS, strict=True):
        assert old[f"joint_{number}"].pop("file") == f"joint{joint}.yaml"
        assert new[f"joint_{number}"].pop("file") == f"joint{joint}.fitted_on_{other}.yaml"
    assert old == new
    (joints, settings), (fitted, _) = configured(before), configured(after)
    assert settings == measured.SETTINGS
    for joint, changed in zip(joints, fitted, strict=True):
        assert changed != joint
        assert replace(changed, friction=joint.friction, provenance=joint.provenance) == joint


@pytest.mark.socketcan
def test_a_played_run_on_vcan_is_the_offline_estimate_and_then_stale(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    config, path = config_file(RUN, False), shipped(f"kinova_gen3/{RUN}.csv.gz")
    table = read_run(path, ColumnMap.load(shipped("kinova_gen3/columns.yaml"))).table
    log, summary = record("vcan0", path, config, float(table.time_s[-1]), tmp_path)
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
