"""Configuration: what ships is valid, and every mistake is one line that names file, key, found and expected."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.config import load_config
from jtqd.estimator.checked import ConfigError
from jtqd.models.files import shipped

BENCH = yaml.safe_load(shipped("bench.yaml").read_text())


def write(directory: Path, change: Any) -> Path:
    content = yaml.safe_load(yaml.safe_dump(BENCH))
    change(content)
    for joint in ("joint_1", "joint_2"):
        if isinstance(content.get(joint), dict):
            content[joint]["file"] = str(shipped(content[joint].get("file", "joint1.yaml")))
            network = content[joint].get("network")
            if isinstance(network, dict) and "file" in network:
                network["file"] = str(shipped("bench.yaml").parent / network["file"])
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_shipped_configuration_is_read() -> None:
    config = load_config(None)
    assert [joint.node_id for joint in config.joints] == [1, 2]
    assert config.sensor is not None
    assert config.period_ns == 1_000_000
    assert config.node_id == 0x20


def put(key: str, value: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        *path, last = key.split(".")
        for name in path:
            content = content.setdefault(name, {})
        content[last] = value

    return change


def drop(key: str) -> Any:
    def change(content: dict[str, Any]) -> None:
        *path, last = key.split(".")
        for name in path:
            content = content[name]
        del content[last]

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("sync.periode_us", 1000), ["sync.periode_us", "period_us"]),
        (put("sync.period_us", "1 ms"), ["sync.period_us", "'1 ms'", "us"]),
        (put("sync.counter_overflow", 1), ["sync.counter_overflow", "found 1"]),
        (put("estimator.method", "magic"), ["estimator.method", "'magic'", "network"]),
        (put("estimator.bandwidth_rad_s", -5), ["estimator.bandwidth_rad_s", "-5", "rad/s"]),
        (drop("joint_2"), ["joint_2", "missing"]),
        (put("joint_1.sensor_channel", 2), ["joint_1.sensor_channel", "found 2"]),
        (put("joint_2.node", 1), ["joint_2.node", "found 1", "joint_1.node"]),
        (put("sensor.node", 32), ["sensor.node", "32", "node_id"]),
        (put("nodes.heartbeat_ms", 0), ["nodes.heartbeat_ms", "found 0"]),
        (put("realtime.priority", 99), ["realtime.priority", "99"]),
        (put("joint_1.temperature", 1), ["joint_1.temperature", "found 1", "true or false"]),
        (put("joint_1.temperatur", True), ["joint_1.temperatur", "did you mean 'temperature'"]),
        (put("joint_1.network", {"file": "bench.yaml", "sha256": "00"}), ["sha256", "expected 00"]),
        (put("joint_1.network", {"file": "none.onnx", "sha256": "00"}), ["none.onnx", "cannot be read"]),
    ],
)
def test_mistakes_are_named(tmp_path: Path, change: Any, words: list[str]) -> None:
    path = write(tmp_path, change)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def test_a_network_method_needs_a_network(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["estimator"]["method"] = "network"
        content["joint_1"].pop("network", None)

    with pytest.raises(ConfigError, match=r"joint_1\.network.*missing"):
        load_config(write(tmp_path, change))


@pytest.mark.parametrize("text", ["", "- 1\n", "a: [", "\x00", "node_id: 32\nnode_id: 33\n"])
def test_files_that_are_no_configuration(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert "c.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        load_config(tmp_path / "absent.yaml")
