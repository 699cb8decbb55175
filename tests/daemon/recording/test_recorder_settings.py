"""Section `recording` of the configuration, and what the recorder is told of the daemon."""

import hashlib
import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml

from jtqd.daemon.config import RecordingSettings, load_config
from jtqd.daemon.recording.launch import recording_request
from jtqd.daemon.recording.recorder import RecorderRequest
from jtqd.daemon.supervisor.process import SupervisorError, log_directory
from jtqd.estimator.decoder import decode
from jtqd.estimator.errors import ConfigError
from jtqd.models.files import shipped
from tests.daemon.recording.test_dbc import SCALING


def read(**keys):
    return decode(RecordingSettings, keys, "a.yaml", "recording")


def test_defaults():
    assert read() == RecordingSettings()
    assert asdict(read()) == {
        "ring_cycles": 4096,
        "chunk_s": 0.5,
        "rotate_s": 600.0,
        "rotate_mb": 1000.0,
        "budget_mb": None,
        "keep_run": True,
        "reserve_mb": 256.0,
        "flight_recorder_s": None,
    }


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ring_cycles", 100),
        ("chunk_s", 0.0),
        ("chunk_s", 60),
        ("rotate_s", 0.5),
        ("rotate_mb", 0),
        ("budget_mb", 5),
        ("keep_run", 1),
        ("reserve_mb", -1),
        ("flight_recorder_s", 601),
        ("flight_recorder_s", "long"),
        ("rotate", 5),
    ],
)
def test_what_is_wrong_is_named(key, value):
    with pytest.raises(ConfigError, match=rf"^a\.yaml: .*recording\.{key}") as caught:
        read(**{key: value})
    assert "\n" not in str(caught.value)


NODES = {str(n): {"scaling": SCALING} for n in (1, 2)} | {"3": {"scaling": {"nm_per_unit": {"1": 0.001}}}}


def attached(config, tmp_path):
    """The request that the supervisor writes, and the attachments that the recorder makes of it."""
    where = {"runtime": tmp_path, "directory": tmp_path / "logs", "bus": "can0"}
    content = recording_request(config, {"nodes": NODES}, **where)
    (tmp_path / "request.json").write_text(json.dumps(content))
    request = RecorderRequest.from_file(tmp_path / "request.json")
    loaded = request.load_attachments(pytest.fail)
    files = {item.name: item.data for item in loaded}
    assert len(files) == len(loaded), "two attachments of one name"
    return request, files, json.loads(files["provenance.json"])


def test_request_carries_all_that_a_log_must_hold(tmp_path):
    """From the configuration of the paper's chain to the attachments, byte for byte; files by their hashes."""
    request, files, provenance = attached(load_config(shipped("bench_paper.yaml")), tmp_path)
    assert (request.prefix, request.rotate_s, request.reserve_mb) == ("jtqd-can0", 600.0, 256.0)
    assert [tuple(node) for node in request.nodes] == [(1, "drive 1"), (2, "drive 2"), (3, "torque sensor")]
    assert files["configuration.yaml"] == Path(shipped("bench_paper.yaml")).read_bytes()
    assert b"BO_ 385 drive_1_TPDO1" in files["bus.dbc"]
    assert {"drive.eds", "jtqd.eds", "torque_sensor.eds"} <= files.keys()
    assert provenance["configuration"]["sha256"] == hashlib.sha256(files["configuration.yaml"]).hexdigest()
    for number in "12":
        joint = provenance["joints"][number]
        for kind in ("file", "network"):
            assert hashlib.sha256(files[joint[kind]]).hexdigest() == joint[f"{kind}_sha256"]
    assert {"jtqd", "numpy", "onnxruntime", "python"} <= provenance["versions"].keys()
    assert provenance["nodes"] == NODES


def test_a_log_holds_the_networks_of_shadow_methods(tmp_path):
    config = load_config(None)
    request, files, provenance = attached(config, tmp_path)
    assert request.shadow
    for joint in config.joints:
        names = provenance["joints"][str(joint.number)]["shadow_networks"]
        assert names == {"network": f"joint{joint.number}.onnx"}
        assert files[names["network"]] == shipped(f"trained/joint{joint.number}.onnx").read_bytes()
    plain, _, provenance = attached(load_config(shipped("bench_paper.yaml")), tmp_path)
    assert not plain.shadow
    assert provenance["joints"]["1"]["shadow_networks"] == {}


def test_what_is_attached_is_what_was_read_whatever_becomes_of_the_files(tmp_path):
    """Files edited, or gone, after the configuration was read: a recorder that starts later attaches what is in force."""
    shutil.copytree(shipped("bench.yaml").parent / "trained", tmp_path / "trained")
    shutil.copy(shipped("bench_paper.yaml"), tmp_path / "bench.yaml")
    read = {path.name: path.read_bytes() for path in (tmp_path / "trained").iterdir()}
    config = load_config(tmp_path / "bench.yaml")
    (tmp_path / "trained" / "joint1.yaml").write_text("name: edited without a reload\n")
    for network in (tmp_path / "trained").glob("*.onnx"):
        network.unlink()
    (tmp_path / "bench.yaml").write_text("node_id: 1\n")
    _, files, provenance = attached(config, tmp_path)
    joint = provenance["joints"]["1"]
    assert files["joint1.yaml"] == read["joint1.yaml"]
    assert joint["file_sha256"] == hashlib.sha256(read["joint1.yaml"]).hexdigest()
    assert files[joint["network"]] == read[joint["network"]]
    assert files["configuration.yaml"] == Path(shipped("bench_paper.yaml")).read_bytes()


def test_two_joints_with_files_of_one_name_have_two_attachments(tmp_path):
    content = yaml.safe_load(shipped("bench.yaml").read_text())
    content["estimator"] = {"method": "efficiency"}
    for number in (1, 2):
        (tmp_path / f"arm{number}").mkdir()
        (tmp_path / f"arm{number}" / "joint.yaml").write_bytes(shipped(f"joint{number}.yaml").read_bytes())
        content[f"joint_{number}"]["file"] = f"arm{number}/joint.yaml"
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    _, files, provenance = attached(load_config(tmp_path / "c.yaml"), tmp_path)
    for number in (1, 2):
        name = provenance["joints"][str(number)]["file"]
        assert files[name] == shipped(f"joint{number}.yaml").read_bytes()


@pytest.mark.parametrize("record", ["file", "file/below", "/proc/nothing", ""])
def test_a_path_that_can_be_no_directory_is_refused(tmp_path, monkeypatch, record):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SupervisorError, match=r"^--record "):
        log_directory(record)


def test_log_directory_is_made(tmp_path):
    assert log_directory(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert (tmp_path / "a" / "b").is_dir()
    assert log_directory("none") is None
