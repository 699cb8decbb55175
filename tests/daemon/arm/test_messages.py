"""Messages of an arm, decoded by their definitions alone, and the log as mcap's reader and rosbags see it."""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from jtqd.daemon.arm.alignment import Aligned
from jtqd.daemon.arm.arm_file import load_arm
from jtqd.daemon.arm.messages import ArmMessages, texts_of
from jtqd.daemon.arm.model import ArmModel
from jtqd.daemon.arm.process import ArmLog, Viewers
from jtqd.daemon.live import Address
from jtqd.daemon.shared.processes import CannotBegin
from jtqd.estimator.status import DEGRADED, STALE, STARTING, VALID
from tests.daemon.arm import small_arm
from tests.daemon.arm.stub import BEGINS, EVERY, Stub
from tests.daemon.recording.cdr_decoder import Definition

MS = 1_000_000
BEGIN = 70_000 * MS
TOPICS = texts_of(2)
OF = {topic.number: (topic.name, Definition(topic.schema, text)) for topic, text in TOPICS.items()}


def aligned(cycle: int, *status: int) -> Aligned:
    known = np.array([1.0 if each in (VALID, DEGRADED) else np.nan for each in status])
    position = np.array([0.5, -0.25]) + 1e-3 * cycle
    return Aligned(
        BEGIN + cycle * MS,
        position,
        np.array([10.0, 20.0]) * known,
        np.array([0.1, 0.2]) * known,
        np.array(status, np.uint8),
    )


@pytest.fixture
def model() -> ArmModel:
    return ArmModel(small_arm.URDF, ["elbow", "shoulder"], "flange")


def made(model: ArmModel, cycles: int, *status: int) -> list[tuple[list[Any], bool]]:
    """Messages of so many cycles of the stub: topic, log time and decoded message."""
    messages, stub = ArmMessages(model, "flange", MS), Stub(model, 1e-3)
    result = []
    for k in range(cycles):
        numbers = aligned(k, *(status or (VALID, VALID)))
        found, shown = messages.of(numbers, stub.step(*numbers[1:4]), stub.cycle, 17 * 10**17 + k * MS)
        result.append(
            (
                [(OF[each.topic][0], each.time_ns, OF[each.topic][1].decode(each.payload)) for each in found],
                shown,
            )
        )
    return result


def test_every_field_of_a_cycle(model: ArmModel) -> None:
    (name, time_ns, external), (wrench_name, _, wrench), *others = made(model, 21)[-1][0]
    assert (name, time_ns) == ("/arm/external", 17 * 10**17 + 20 * MS)
    assert external["header"]["stamp"] == {"sec": 17 * 10**8, "nanosec": 20 * MS}
    assert external["joints"] == "shoulder elbow"
    assert (external["cycle"], external["monotonic_ns"]) == (20, BEGIN + 20 * MS)
    assert external["position_rad"] == pytest.approx([0.52, -0.23])
    assert (external["torque_nm"], external["torque_sigma_nm"]) == ([10.0, 20.0], [0.1, 0.2])
    assert external["external_nm"] == [20.0, 40.0]
    assert external["sigma_nm"] == pytest.approx([0.3, 0.6])
    assert external["wrench_sigma"] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    assert (external["conditioning"], external["status"]) == (7.5, [VALID, VALID])
    assert (wrench_name, wrench["header"]["frame_id"]) == ("/arm/wrench", "base")
    assert wrench["wrench"] == {
        "force": {"x": 1.0, "y": 2.0, "z": 3.0},
        "torque": {"x": 4.0, "y": 5.0, "z": 6.0},
    }
    found = {name: message for name, _, message in others}
    assert list(found) == ["/arm/contact", "/arm/joint_states"]
    states = found["/arm/joint_states"]
    assert (states["name"], states["velocity"], states["effort"]) == (["shoulder", "elbow"], [], [20.0, 40.0])
    assert states["position"] == external["position_rad"]


def test_rates(model: ArmModel) -> None:
    found = made(model, 1000)
    counts: dict[str, int] = {}
    for messages, _ in found:
        for name, _, _ in messages:
            counts[name] = counts.get(name, 0) + 1
    assert counts == {
        "/arm/external": 1000,
        "/arm/wrench": 1000,
        "/arm/joint_states": 50,
        "/arm/payload": 10,
        "/arm/contact": 50 + 20,  # of the 39 that begin and end 19 do it as a sample is due
    }
    assert sum(shown for _, shown in found) == counts["/arm/contact"]


def test_a_contact_is_sent_at_once_with_its_link_and_its_begin(model: ArmModel) -> None:
    found = made(model, EVERY + 1)
    cycle = found[BEGINS][0]
    (name, _, contact) = cycle[2]
    assert name == "/arm/contact"
    assert (contact["link"], contact["header"]["frame_id"]) == (1, "upper")
    assert contact["since"] == {"sec": 17 * 10**8, "nanosec": BEGINS * MS}
    assert (contact["strength_n"], contact["point_m"], contact["point_sigma_m"]) == (
        20.0,
        [0.1, 0.2, 0.3],
        0.04,
    )
    later = found[2 * 20][0][2][2]
    assert later["since"]["nanosec"] == BEGINS * MS
    ended = found[EVERY][0][2][2]
    assert (ended["link"], ended["header"]["frame_id"]) == (0, "base")


def test_payload(model: ArmModel) -> None:
    name, _, payload = made(model, 1)[0][0][-1]
    assert name == "/arm/payload"
    assert payload["header"]["frame_id"] == "flange"
    assert (payload["mass_kg"], payload["mass_sigma_kg"]) == (1.25, 0.05)
    assert payload["centre_m"] == [0.01, 0.02, 0.03]


def test_the_status_is_that_of_the_torque_until_there_is_an_external_one(model: ArmModel) -> None:
    first, *_, last = (each[0][0][2] for each in made(model, 5, STALE, DEGRADED))
    assert first["status"] == [STALE, STARTING]
    assert last["status"] == [STALE, DEGRADED]
    assert np.isnan(last["external_nm"]).tolist() == [True, False]


def test_a_log_is_read_by_others(model: ArmModel, tmp_path: Path) -> None:
    config = load_arm(small_arm.write(tmp_path, small_arm.content(recording={"rotate_s": 60.0})))
    log, messages, stub = (
        ArmLog(config, tmp_path / "logs"),
        ArmMessages(model, "flange", MS),
        Stub(model, 1e-3),
    )
    assert log.rules.rotate_ns == 60 * 10**9
    for k in range(1500):
        numbers = aligned(k, VALID, VALID)
        log.add(
            messages.of(numbers, stub.step(*numbers[1:4]), k, 17 * 10**17 + k * MS)[0], numbers.instant_ns
        )
    log.end()
    account = log.account()
    (path,) = (tmp_path / "logs").glob(Path(account["files"]).name)
    assert path.name.startswith("jtqd-arm-arm-")
    assert (account["written"], account["lost"], account["complete"]) == (1500, 0, True)
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        attached = {each.name: each.data for each in reader.iter_attachments()}
        assert attached == {"arm.yaml": config.path.read_bytes(), "arm.urdf": small_arm.URDF.encode()}
        found = [message for _, channel, _, message in reader.iter_decoded_messages(topics=["/arm/external"])]
        assert [each.cycle for each in found] == [*range(1500)]
        assert [*found[-1].external_nm] == [20.0, 40.0]
        (wrench, *_) = reader.iter_decoded_messages(topics=["/arm/wrench"])
        assert (wrench[0].name, wrench[1].topic) == ("geometry_msgs/msg/WrenchStamped", "/arm/wrench")
        states = [each for *_, each in reader.iter_decoded_messages(topics=["/arm/joint_states"])]
        assert len(states) == 75
        assert [*states[0].name] == ["shoulder", "elbow"]


def test_viewers_get_the_topics_and_their_definitions(model: ArmModel, tmp_path: Path) -> None:
    viewers = Viewers(load_arm(small_arm.write(tmp_path)), Address(port=0))
    try:
        url = f"ws://127.0.0.1:{viewers.port}"
        with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as client:
            channels: dict[str, Any] = {}
            while len(channels) < len(TOPICS):
                told = json.loads(client.recv(timeout=10.0))
                channels |= {each["topic"]: each for each in told.get("channels", ())}
            assert {name: each["schema"] for name, each in channels.items()} == {
                each.name: text for each, text in TOPICS.items()
            }
            number = channels["/arm/external"]["id"]
            client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 3, "channelId": number}]}))
            numbers, stub = aligned(0, VALID, VALID), Stub(model, 1e-3)
            estimate = stub.step(*numbers[1:4])
            data: Any = ""
            for k in range(500):  # until the server knows of the subscription
                viewers.send(ArmMessages(model, "flange", MS).of(numbers, estimate, 8, k)[0])
                with suppress(TimeoutError):
                    data = client.recv(timeout=0.02)
                if isinstance(data, bytes):
                    break
            message = OF[1][1].decode(data[13:])
            assert (message["cycle"], message["torque_nm"]) == (8, [10.0, 20.0])
    finally:
        viewers.end()


def test_an_address_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(CannotBegin, match=f"127.0.0.1:{port}: Address already in use"):
            Viewers(load_arm(small_arm.write(tmp_path)), Address(port=port))
