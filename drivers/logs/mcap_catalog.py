"""The channels and schemas of an MCAP log: topic and ROS type of each channel."""

from __future__ import annotations

import re
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from drivers.logs.mcap_records import PARSE_ERRORS, RecordError, parser
from drivers.logs.ros_image import IMAGE_TYPES
from drivers.logs.ros_motion import MOTION_TYPES

CDR, ROS1 = "cdr", "ros1"  # message encodings
_MAX_CHANNELS = 4096
_MAX_DEFINITION_BYTES = 2**20
_MAX_NAME = 256  # characters
_MAX_ENCODING = 16  # characters


class LogTopic(NamedTuple):
    """Name and type of a topic; type is a ROS name such as sensor_msgs/msg/Image, '' where it cannot be decoded."""

    name: str
    type: str
    aligned: bool = True  # True: CDR; False: the serialisation of ROS 1


class Catalog:
    """The channels and schemas read so far, at most 4096 of each."""

    def __init__(self) -> None:
        self._types: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}

    def add(self, opcode: int, body: memoryview) -> None:
        """Add a schema or channel record; raise RecordError where it is malformed or exceeds the limits."""
        if len(body) > _MAX_DEFINITION_BYTES or max(len(self._types), len(self._channels)) >= _MAX_CHANNELS:
            raise RecordError(
                f"more than {_MAX_CHANNELS} channels or schemas, or one of more than {_MAX_DEFINITION_BYTES} bytes"
            )
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(parser(body))
                self._types[schema.id] = ros_name(schema.name[:_MAX_NAME])
            else:
                channel = Channel.read(parser(body))
                self._channels[channel.id] = _truncated(channel)
        except PARSE_ERRORS as error:
            raise RecordError("a channel or schema record is malformed") from error

    def topic(self, channel_id: int) -> LogTopic | None:
        """Return the topic of a channel, None of an unknown one."""
        channel = self._channels.get(channel_id)
        if channel is None:
            return None
        kind, encoding = self._types.get(channel.schema_id, ""), channel.message_encoding
        # Of ROS 1, images and samples of motion are all that is read.
        known = encoding == CDR or (encoding == ROS1 and kind in (*IMAGE_TYPES, *MOTION_TYPES))
        return LogTopic(channel.topic, kind if known else "", encoding != ROS1)

    def topics(self) -> dict[str, str]:
        """Return topic name -> type."""
        return {topic.name: topic.type for topic in map(self.topic, self._channels) if topic is not None}

    def ids(self, topic: str) -> list[int]:
        """Return the channels of a topic: two recordings merged into one file have one each."""
        return [channel.id for channel in self._channels.values() if channel.topic == topic]


def _truncated(channel: Channel) -> Channel:
    """Return the channel without metadata and with truncated names, so that no log can fill the memory."""
    encoding = channel.message_encoding[:_MAX_ENCODING]
    return Channel(channel.id, channel.topic[:_MAX_NAME], encoding, {}, channel.schema_id)


def ros_name(schema_name: str) -> str:
    """Return package/msg/Type for this, for DDS (sensor_msgs::msg::dds_::Image_) and for ROS 1 (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name
