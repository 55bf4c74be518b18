"""The channels and schemas of an MCAP log: which topic and which ROS type a message's channel number stands for."""

from __future__ import annotations

import re
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from drivers.logs.mcap_records import PARSE_ERRORS, RecordError, parser

_MAX_CHANNELS = 4096
_MAX_DEFINITION_BYTES = 2**20
_MAX_NAME = 256


class LogTopic(NamedTuple):
    """A channel as its messages need it; type is a ROS name such as sensor_msgs/msg/Image, '' where it is not CDR."""

    name: str
    type: str


class Catalog:
    """The channels and schemas seen so far, at most 4096 of each."""

    def __init__(self) -> None:
        self._types: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}

    def add(self, opcode: int, body: memoryview) -> None:
        """Takes a schema or channel record; one that is oversized or malformed raises RecordError."""
        if len(body) > _MAX_DEFINITION_BYTES or max(len(self._types), len(self._channels)) >= _MAX_CHANNELS:
            raise RecordError("more channels, schemas or text in them than any robot has")
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(parser(body))
                self._types[schema.id] = _ros_name(schema.name[:_MAX_NAME])
            else:
                channel = Channel.read(parser(body))
                self._channels[channel.id] = _lean(channel)
        except PARSE_ERRORS as error:
            raise RecordError("a channel or schema record is malformed") from error

    def topic(self, channel_id: int) -> LogTopic | None:
        channel = self._channels.get(channel_id)
        if channel is None:
            return None
        known = channel.message_encoding == "cdr"
        return LogTopic(channel.topic, self._types.get(channel.schema_id, "") if known else "")

    def topics(self) -> dict[str, str]:
        """Topic name -> type."""
        return dict(filter(None, map(self.topic, self._channels)))

    def ids(self, topic: str) -> list[int]:
        """The channels of a topic: two recordings merged into one file have one each."""
        return [channel.id for channel in self._channels.values() if channel.topic == topic]


def _lean(channel: Channel) -> Channel:
    """The channel without its metadata and with names cut to a sane length, so that no log can fill the memory."""
    return Channel(channel.id, channel.topic[:_MAX_NAME], channel.message_encoding[:16], {}, channel.schema_id)


def _ros_name(schema_name: str) -> str:
    """package/msg/Type, also from DDS spelling (sensor_msgs::msg::dds_::Image_) and ROS 1's (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name
