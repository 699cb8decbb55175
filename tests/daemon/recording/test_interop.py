"""Other people's readers on a log of the bench: rosbags (Apache-2.0), which shares no code with ours or with mcap."""

import math

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from jtqd.daemon.recording import messages
from tests.daemon.live.viewer_log import Log, bench_log

pytestmark = pytest.mark.native


@pytest.fixture(scope="module")
def log():
    return Log(bench_log())


def test_rosbags_finds_every_topic_with_type_and_count(log):
    with Reader(bench_log()) as reader:
        found = {each.topic: (each.msgtype, each.msgcount) for each in reader.connections}
        assert found == {
            topic.name: (topic.schema, len(log.messages.get(topic.name, [])))
            for topic in messages.topics_of(2, shadow=True)
        }
        for each in reader.connections:
            assert each.msgdef.format is MessageDefinitionFormat.MSG
            assert each.msgdef.data == log.texts.get(each.topic, each.msgdef.data)
        assert reader.message_count == sum(map(len, log.messages.values()))


@pytest.mark.parametrize("topic", [topic.name for topic in messages.topics_of(2, shadow=True)])
def test_rosbags_decodes_every_message_as_it_was_meant(log, topic):
    with AnyReader([bench_log()], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        connections = [each for each in reader.connections if each.topic == topic]
        messages = [reader.deserialize(raw, each.msgtype) for each, _, raw in reader.messages(connections)]
    assert len(messages) == len(log.messages[topic])
    for number in (0, len(messages) // 2, len(messages) - 1):
        assert_same(messages[number], log.decoded(topic, number))


def test_rosbags_gives_our_times(log):
    with AnyReader([bench_log()], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        connections = [each for each in reader.connections if each.topic == "/joint/1/state"]
        for connection, stamp, raw in reader.messages(connections):
            header = reader.deserialize(raw, connection.msgtype).header.stamp
            assert stamp == header.sec * 1_000_000_000 + header.nanosec


def assert_same(theirs, ours):
    """Every field, all the way down."""
    for name, value in ours.items():
        other = getattr(theirs, name)
        if isinstance(value, dict):
            assert_same(other, value)
        elif isinstance(value, list):
            assert len(other) == len(value)
            for one, two in zip(other, value, strict=True):
                if isinstance(two, dict):
                    assert_same(one, two)
                else:
                    assert one == two or (math.isnan(one) and math.isnan(two))
        else:
            assert other == value or (math.isnan(other) and math.isnan(value)), name
