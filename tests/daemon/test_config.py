"""Configuration: what ships is valid, and every mistake is one line that names file, key, found and expected."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.config import Identity, Realtime, RecordingSettings, SafetySettings, load_config
from jtqd.drivers.bus_load import LIMIT
from jtqd.drivers.drive import CIA_402, DriveObject
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import shipped

BENCH = yaml.safe_load(shipped("bench.yaml").read_text())


def write(directory: Path, change: Any) -> Path:
    content = yaml.safe_load(yaml.safe_dump(BENCH))
    change(content)
    for joint in ("joint_1", "joint_2", "joint_3", "joint_4"):
        if isinstance(content.get(joint), dict):
            content[joint]["file"] = str(shipped(content[joint].get("file", "joint1.yaml")))
            shadows = content[joint].get("shadow_networks", {}).values()
            for network in (content[joint].get("network"), *shadows):
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
    assert (config.input_wait_ns, config.input_deadline_ns) == (500_000, 850_000)
    assert config.estimator == EstimatorSettings(
        method="fused",
        bandwidth_rad_s=200.0,
        torsion_bandwidth_rad_s=800.0,
        track_zeros=True,
        track_torsion=True,
    )
    assert config.realtime == Realtime(80, None, True)
    assert all(joint.network is None and joint.temperature for joint in config.joints)


def test_a_path_may_be_text() -> None:
    path = shipped("bench.yaml")
    assert load_config(str(path)) == load_config(path)


def test_what_is_left_out_has_its_default(tmp_path: Path) -> None:
    """Old configurations say less: two joints are enough, and the times follow from the period and the heartbeat."""

    def change(content: dict[str, Any]) -> None:
        for key in set(content) - {"node_id", "joint_1", "joint_2", "estimator"}:
            del content[key]
        for joint in ("joint_1", "joint_2"):
            del content[joint]["sensor_channel"]
        content["sync"] = {"period_us": 2000}
        content["nodes"] = {"heartbeat_ms": 200}
        content["inputs"] = None

    config = load_config(write(tmp_path, change))
    assert (config.bitrate, config.period_ns, config.counter_overflow) == (1_000_000, 2_000_000, 0)
    assert (config.input_wait_ns, config.input_deadline_ns) == (1_000_000, 1_700_000)
    assert (config.heartbeat_ms, config.heartbeat_timeout_ms, config.emcy_inhibit_ms) == (200, 600, 10)
    assert (config.error_behaviour, config.boot_timeout_s, config.sensor) == (0, 2.0, None)
    assert (config.safety, config.recording) == (SafetySettings(), RecordingSettings())
    assert (config.realtime, config.metrics_file) == (Realtime(80, None, True), None)
    assert config.joints[0].identity == Identity(None, None, None, None, None)
    assert (config.joints[0].given, config.joints[0].mandatory) == ({}, True)


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


def move(key: str, other: str) -> Any:
    def change(content: dict[str, Any]) -> None:
        content[other] = content.pop(key)

    return change


@pytest.mark.parametrize("joints", [1, 2, 3, 4])
def test_a_bus_has_one_to_four_joints(tmp_path: Path, joints: int) -> None:
    def change(content: dict[str, Any]) -> None:
        content["sync"] = {"period_us": 2000}
        del content["inputs"]
        first = yaml.safe_load(yaml.safe_dump(content["joint_1"]))
        for number in range(1, 5):
            content.pop(f"joint_{number}", None)
            if number <= joints:
                content[f"joint_{number}"] = yaml.safe_load(yaml.safe_dump({**first, "node": number}))
        content["sensor"]["node"] = 9

    config = load_config(write(tmp_path, change))
    assert [(joint.number, joint.node_id) for joint in config.joints] == [
        (n, n) for n in range(1, joints + 1)
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("sync.periode_us", 1000), ["sync.periode_us", "period_us"]),
        (put("sync.period_us", "1 ms"), ["sync.period_us", "'1 ms'", "us"]),
        (put("sync.counter_overflow", 1), ["sync.counter_overflow", "found 1"]),
        (put("estimator.method", "magic"), ["estimator.method", "'magic'", "network"]),
        (put("estimator.bandwidth_rad_s", -5), ["estimator.bandwidth_rad_s", "-5", "rad/s"]),
        (drop("joint_1"), ["joint_1", "missing"]),
        (move("joint_2", "joint_3"), ["joint_2", "none", "joint_1 to joint_2 without a gap"]),
        (move("joint_2", "joint_5"), ["joint_5", "unknown"]),
        (put("joint_1.sensor_channel", 2), ["joint_1.sensor_channel", "found 2"]),
        (put("joint_2.node", 1), ["joint_2.node", "found 1", "joint_1.node"]),
        (put("sensor.node", 32), ["sensor.node", "32", "node_id"]),
        (put("sensor", [{"node": 3}, {"node": 5}]), ["'sensor'", "one sensor node with 1 or 2 channels"]),
        (put("sensor_2", {"node": 5}), ["'sensor_2'", "one sensor node with 1 or 2 channels"]),
        (put("sensor.channels", 3), ["sensor.channels", "found 3", "from 1 to 2"]),
        (put("nodes.heartbeat_ms", 0), ["nodes.heartbeat_ms", "found 0"]),
        (put("realtime.priority", 99), ["realtime.priority", "99"]),
        (put("inputs.wait_us", 1001), ["inputs.wait_us", "found 1001", "a number in us from 50 to 1000"]),
        (put("inputs.deadline_us", 499), ["inputs.deadline_us", "found 499", "from 500 to 950"]),
        (put("nodes.heartbeat_timeout_ms", 199), ["nodes.heartbeat_timeout_ms", "from 200 to 65535"]),
        (put("nodes.error_behaviour", "stop"), ["nodes.error_behaviour", "'stop'", "'stopped'"]),
        (put("joint_1.given", {"6091h:1": -1}), ["joint_1.given.6091h:1", "found -1", ">= 0"]),
        (put("joint_1.given", {"6091h:9": 1}), ["joint_1.given.6091h:9", "6091h:1, 6091h:2, 6075h:0"]),
        (put("joint_1.given", {"gear": 1}), ["joint_1.given.gear", "608Fh:1"]),
        (put("joint_1.given", {"6091h:1": 1.5}), ["joint_1.given.6091h:1", "found 1.5", "a whole number"]),
        (put("joint_1.given", {"6091h:1": 1e300}), ["joint_1.given.6091h:1", "found 1e+300"]),
        (put("joint_1.given", {"6091h:1": "a"}), ["joint_1.given.6091h:1", "found 'a'"]),
        (put("sensor.given", {"6132h:1": 30}), ["sensor.given.6132h:1", "found 30", "from 0 to 9"]),
        (put("sensor.unit_words", {"Nm": 1.0}), ["sensor.unit_words.Nm", "0x00560000"]),
        (
            put("joint_1.objects", {"current": {"index": 0x2030}}),
            ["objects.current.factor", "A per unit", "6078h:0"],
        ),
        (put("joint_1.objects", {"curent": {}}), ["joint_1.objects.curent", "did you mean 'current'"]),
        (
            put("joint_1.objects", {"current": {"sign": 0}}),
            ["joint_1.objects.current.sign", "found 0", "1 or -1"],
        ),
        (
            put("joint_1.objects", {"current": {"type": "I32"}}),
            ["joint_1.objects", "found 80 bits", "at most 64"],
        ),
        (
            put("joint_1.objects", {"motor_position": {"type": "I16"}}),
            ["motor_position.type", "expected I32"],
        ),
        (put("joint_1.objects", {"statusword": {"sign": -1}}), ["objects.statusword", "no sign"]),
        (put("joint_1.objects", {"current": {"index": 6}}), ["joint_1.objects.current.index", "found 6"]),
        (put("joint_1.sdo_timeout_ms", 1), ["joint_1.sdo_timeout_ms", "found 1"]),
        (put("joint_1.network", {"file": "/dev/zero", "sha256": "00"}), ["/dev/zero", "no regular file"]),
        (put("metrics", {"file": "a\0b"}), ["metrics.file", "printable"]),
        (put("joint_1.identity", {"software": "\x1b[2J"}), ["joint_1.identity.software", "printable"]),
        (put("joint_1.identity", {"vendor": 1 << 32}), ["joint_1.identity.vendor", "from 0 to 4294967295"]),
        (drop("sensor"), ["joint_1.sensor_channel", "found 1", "no channel without a sensor"]),
        (put("metrics", {}), ["metrics.file", "missing", "a text"]),
        (put("joint_1.temperature", 1), ["joint_1.temperature", "found 1", "true or false"]),
        (
            put("joint_1.objects", {"temperature": {"index": 0x2040}}),
            ["joint_1.objects.temperature.factor", "missing"],
        ),
        (
            put(
                "joint_1",
                {
                    "node": 1,
                    "file": "joint1.yaml",
                    "objects": {"temperature": {"index": 0x2040, "factor": 1}},
                },
            ),
            ["joint_1.temperature", "found False", "true because of objects.temperature"],
        ),
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


def test_objects_of_a_drive_are_those_of_cia_402_with_what_the_file_says(tmp_path: Path) -> None:
    current = {"index": 0x2030, "sub": 2, "type": "I32", "sign": -1, "factor": 0.001}
    velocity = {"type": "I16", "index": 0x2031, "factor": 0.1}
    change = put(
        "joint_2.objects", {"current": current, "motor_velocity": velocity, "link_position": {"sign": -1}}
    )
    one, two = (joint.objects for joint in load_config(write(tmp_path, change)).joints)
    assert one == CIA_402
    assert two.current == DriveObject(0x2030, 2, 32, True, -1, 0.001)
    assert two.motor_velocity == DriveObject(0x2031, 0, 16, True, 1, 0.1)
    assert two.link_position == DriveObject(0x60E4, 1, 32, True, -1)
    assert two.motor_position == CIA_402.motor_position


def test_files_that_would_never_end_are_not_read(tmp_path: Path) -> None:
    """A pipe without a writer, a device: one line, at once."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(ConfigError, match="found no regular file"):
            load_config(path)


def test_a_number_too_large_for_any_quantity_is_refused(tmp_path: Path) -> None:
    joint = yaml.safe_load(shipped("joint1.yaml").read_text())
    (tmp_path / "j.yaml").write_text(yaml.safe_dump({**joint, "gear_ratio": 1e300}))
    path = write(tmp_path, lambda content: None)
    content = yaml.safe_load(path.read_text())
    content["joint_1"]["file"] = str(tmp_path / "j.yaml")
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match=r"'gear_ratio': found 1e\+300, .*at most 1e\+30"):
        load_config(path)


def test_a_network_method_needs_a_network(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["estimator"] |= {"method": "network", "shadow": []}
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


def test_contacts_need_a_cycle_that_sees_them_in_time(tmp_path: Path) -> None:
    def slow(content: dict[str, Any]) -> None:
        content.update(contact={}, sync={"period_us": 10_000}, inputs={})

    with pytest.raises(
        ConfigError, match=r"sync\.period_us.*found 10000.*at most 5000 us with section contact"
    ):
        load_config(write(tmp_path, slow))


def test_contacts_are_off_by_default_and_5_percent_of_rated(tmp_path: Path) -> None:
    assert load_config(None).contact is None
    contact = load_config(write(tmp_path, lambda c: c.update(contact={"opposed": True}))).contact
    assert contact is not None
    assert (contact.threshold_of(40.0), contact.opposed, contact.pdo) == (2.0, True, True)
    contact = load_config(
        write(tmp_path, lambda c: c.update(contact={"threshold_nm": 0.7, "pdo": False}))
    ).contact
    assert contact is not None
    assert (contact.threshold_of(40.0), contact.opposed, contact.pdo) == (0.7, False, False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"contact": {"threshold_nm": 0}}, "key 'contact.threshold_nm': found 0, expected a number in Nm"),
        ({"contact": {"treshold_nm": 1}}, "contact"),
        (
            {"contact": {"opposed": True}, "joint_2": None},
            "key 'contact.opposed': found True, expected false with 1 joints: opposed are joints 1 and 2, 3 and 4",
        ),
        (
            {"contact": {}, "estimator": {"method": "tob"}},
            "key 'estimator.method': found 'tob', expected fused",
        ),
    ],
)
def test_contacts_that_cannot_be_told_are_refused(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    def apply(content: dict[str, Any]) -> None:
        content.update(change)
        if content["joint_2"] is None:
            del content["joint_2"]
        for joint in ("joint_1", "joint_2"):
            if joint in content and "estimator" in change:
                content[joint].pop("network", None)

    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, apply))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_contacts_need_a_torsion(tmp_path: Path) -> None:
    joint = yaml.safe_load(shipped("trained/joint1.yaml").read_text())
    del joint["fused"]["torsion"]
    path = tmp_path / "joint.yaml"
    path.write_text(yaml.safe_dump(joint))

    def apply(content: dict[str, Any]) -> None:
        content["contact"] = {}
        content["joint_1"].pop("network", None)

    config = write(tmp_path, apply)
    content = yaml.safe_load(config.read_text())
    content["joint_1"]["file"] = str(path)
    config.write_text(yaml.safe_dump(content))
    with pytest.raises(
        ConfigError, match=r"key 'fused.torsion': missing, expected because of section contact"
    ):
        load_config(config)


def test_the_contact_pdo_is_part_of_the_bus_load_and_fits_beside_a_sensor(tmp_path: Path) -> None:
    def load(contact: dict[str, Any] | None) -> float:
        return bus_load_of(load_config(write(tmp_path, lambda c: c.update(contact=contact)))).worst

    assert load({}) == pytest.approx(load(None) + 0.095)
    assert load({"pdo": False}) == load(None)
    assert load({}) < LIMIT


# Shadow methods

PAPERS_NETWORK = {
    "file": str(shipped("trained/joint1.onnx")),
    "sha256": hashlib.sha256(shipped("trained/joint1.onnx").read_bytes()).hexdigest(),
}


def shadows(methods: Any, network: Any = PAPERS_NETWORK) -> Any:
    """A change of the bench: joint 1 alone, with these shadow methods and network of method `network`."""

    def change(content: dict[str, Any]) -> None:
        del content["joint_2"]
        content["estimator"] |= {"method": "fused", "shadow": methods}
        content["joint_1"].pop("shadow_networks", None)
        if network is not None:
            content["joint_1"]["shadow_networks"] = {"network": network}

    return change


def test_shadow_methods_are_configurations_that_would_send_them(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, shadows(["tob", "network"])))
    assert config.shadow == ("tob", "network")
    assert [each.estimator for each in config.shadows] == [
        replace(config.estimator, method=method) for method in ("tob", "network")
    ]
    assert config.estimator.method == "fused"
    assert config.joints[0].network is None
    tob, network = (each.joints[0].network for each in config.shadows)
    assert tob is None
    assert network is not None
    assert network.data == shipped("trained/joint1.onnx").read_bytes()
    unused = load_config(write(tmp_path, shadows(["tob"])))
    assert unused.joints[0].shadow_networks == {}


def both(*changes: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        for each in changes:
            each(content)

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shadows("tob"), ["estimator.shadow", "found 'tob'", "expected a list of texts"]),
        (
            shadows(["tob", "magic"]),
            ["estimator.shadow", "'magic'", "expected a list of tob, efficiency, network"],
        ),
        (shadows(["tob", "tob"]), ["estimator.shadow", "'tob', 'tob'", "each at most once"]),
        (shadows(["fused"]), ["estimator.shadow", "fused is the method that is sent"]),
        (
            shadows(["network"], None),
            ["joint_1.shadow_networks.network", "missing", "file and sha256", "estimator.shadow has network"],
        ),
        (
            shadows(["network"], PAPERS_NETWORK | {"sha256": "00"}),
            ["joint1.onnx", "sha256", "found", "expected 00"],
        ),
        (
            both(shadows(["tob"]), put("joint_1.shadow_networks", {"tob": PAPERS_NETWORK})),
            ["joint_1.shadow_networks.tob", "found a network", "expected one of network, fused"],
        ),
        (
            both(
                shadows(["tob"]),
                put("estimator", {"method": "tob", "shadow": ["fused"]}),
                put("joint_1.file", "joint1.yaml"),
            ),
            ["joint1.yaml", "key 'fused'", "missing", "estimator.shadow has fused"],
        ),
        (
            both(
                shadows(["network"]),
                put("estimator", {"method": "efficiency", "shadow": ["network"]}),
                put("joint_1.objects", {"link_position": False}),
            ),
            ["joint_1.objects.link_position", "estimator.shadow network", "a network with the link position"],
        ),
    ],
)
def test_mistakes_in_shadow_methods_are_named(tmp_path: Path, change: Any, words: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, change))
    text = str(error.value)
    assert "\n" not in text
    assert str(tmp_path) in text or "joint1" in text
    for word in words:
        assert word in text
