"""Channels and schemas of an MCAP log, in bounded memory."""

from __future__ import annotations

import struct

import pytest
from mcap.opcode import Opcode

from drivers.logs.mcap_catalog import Catalog, LogTopic, ros_name
from drivers.logs.mcap_records import RecordError

IMAGE = "sensor_msgs/msg/Image"


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def schema(number: int, name: str) -> memoryview:
    return memoryview(struct.pack("<H", number) + text(name) + text("ros2msg") + struct.pack("<I", 0))


def channel(number: int, schema_id: int, topic: str, encoding: str = "cdr") -> memoryview:
    return memoryview(struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + struct.pack("<I", 0))


@pytest.mark.parametrize(
    "name", [IMAGE, "sensor_msgs/Image", "sensor_msgs::msg::dds_::Image_", "sensor_msgs::msg::Image"]
)
def test_a_type_has_one_name(name: str) -> None:
    assert ros_name(name) == IMAGE


def test_topics_have_types_that_can_be_decoded() -> None:
    catalog = Catalog()
    catalog.add(Opcode.SCHEMA, schema(1, IMAGE))
    catalog.add(Opcode.SCHEMA, schema(2, "std_msgs/String"))
    for number, schema_id, encoding in (
        (10, 1, "cdr"),
        (11, 1, "ros1"),
        (12, 2, "ros1"),
        (13, 1, "json"),
        (14, 9, "cdr"),
    ):
        catalog.add(Opcode.CHANNEL, channel(number, schema_id, f"/{number}", encoding))
    assert catalog.topics() == {"/10": IMAGE, "/11": IMAGE, "/12": "", "/13": "", "/14": ""}
    assert catalog.topic(11) == LogTopic("/11", IMAGE, aligned=False) and catalog.topic(99) is None


def test_a_topic_may_have_several_channels() -> None:
    catalog = Catalog()
    for number in (3, 5):
        catalog.add(Opcode.CHANNEL, channel(number, 1, "/a"))
    assert catalog.ids("/a") == [3, 5] and catalog.ids("/b") == []


def test_names_are_cut_and_their_number_is_bounded() -> None:
    catalog = Catalog()
    catalog.add(Opcode.CHANNEL, channel(1, 1, "x" * 1000))
    found = catalog.topic(1)
    assert found is not None and found.name == "x" * 256
    for number in range(2, 4097):
        catalog.add(Opcode.CHANNEL, channel(number, 1, "/a"))
    with pytest.raises(RecordError, match="more than 4096"):
        catalog.add(Opcode.CHANNEL, channel(5000, 1, "/a"))


@pytest.mark.parametrize("opcode", [Opcode.SCHEMA, Opcode.CHANNEL])
def test_malformed_records_are_refused(opcode: int) -> None:
    with pytest.raises(RecordError, match="malformed"):
        Catalog().add(opcode, memoryview(b"\1\0\xff\xff\xff\xff"))
