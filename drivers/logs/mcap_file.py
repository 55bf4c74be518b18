"""An MCAP file: how its records are framed and packed, its summary, its attachments. Format: mcap.dev/spec, version 0.

The `mcap` package parses the small records.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Schema, Statistics

from drivers.logs.chunked_file import (
    MAX_DEFINITION_BYTES,
    MAX_DEFINITIONS,
    MAX_NAME,
    ByteSource,
    ChunkedFile,
    MessageHead,
    Record,
    RecordKind,
    Topic,
    Unpacked,
    content,
)
from drivers.logs.log import MAX_RECORD_BYTES, RecordError

MAGIC: Final = b"\x89MCAP0\r\n"
# Bounds of what is kept in memory, whatever a file states.
MAX_ATTACHMENT_BYTES: Final = 16 * 2**20
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20
_MAX_ATTACHMENTS: Final = 32
_MAX_SUMMARY_BYTES: Final = 64 * 2**20

_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_INDEX: Final = struct.Struct("<HI")  # channel, bytes of the entries: log time, offset in the chunk
_ENTRY: Final = struct.Struct("<QQ")
_FOOTER: Final = struct.Struct("<QQI")  # start of the summary, of its offsets, CRC of the summary and the footer before
_CRC_BYTES: Final = 4
_TIME_BYTES: Final = 8
_MAX_NAMES: Final = 1024  # bytes of an attachment beside its data
_PARSE_ERRORS: Final = (McapError, struct.error, ValueError, OverflowError)
_KINDS: Final = {
    Opcode.CHUNK: RecordKind.CHUNK,
    Opcode.MESSAGE_INDEX: RecordKind.INDEX,
    Opcode.MESSAGE: RecordKind.MESSAGE,
    Opcode.SCHEMA: RecordKind.DEFINITION,
    Opcode.CHANNEL: RecordKind.DEFINITION,
    Opcode.DATA_END: RecordKind.END,
}


class McapFile(ChunkedFile):
    """A Log of one MCAP file; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        self._types: dict[int, str] = {}  # by schema
        self._channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._attachments: list[int] = []  # offsets by the summary
        super().__init__(path, MAGIC, name)

    def topics(self) -> Mapping[str, str]:
        """Return name -> type, from the summary; of a file without one from its first part."""
        return {topic.name: topic.kind for topic in map(self._topic, self._channels) if topic is not None}

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic by the statistics, None without them."""
        if self._statistics is None or not self._statistics.channel_message_counts:
            return None
        counts = Counter(dict.fromkeys(self.topics(), 0))
        for number, count in self._statistics.channel_message_counts.items():
            topic = self._topic(number)
            if topic is not None:
                counts[topic.name] += count
        return counts

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time by the statistics; None without them, or without messages."""
        found = self._statistics
        return (found.message_start_time, found.message_end_time) if found and found.message_count else None

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the valid attachments in the limits; without a summary those before the messages."""
        found: dict[str, bytes] = {}
        left = MAX_ALL_ATTACHMENTS_BYTES
        records = self._at(self._attachments) if self._attachments else self._records(self, len(MAGIC), self.size)
        for record in records:
            ends = (RecordKind.CHUNK, RecordKind.MESSAGE, RecordKind.END)
            if record.kind in ends or record.is_cut or len(found) >= _MAX_ATTACHMENTS:
                break
            if record.opcode == Opcode.ATTACHMENT and record.size <= min(left, MAX_ATTACHMENT_BYTES + _MAX_NAMES):
                left -= record.size
                found.update(self._attachment(record))
        return found

    def _at(self, offsets: Iterable[int]) -> Iterator[Record]:
        """Yield the records that begin at the offsets."""
        for offset in offsets:
            yield from islice(self._records(self, offset, self.size), 1)

    def _attachment(self, record: Record) -> dict[str, bytes]:
        """Return name -> bytes of one attachment, empty where it is malformed, too large or its CRC is wrong."""
        try:
            body = content(self, record.offset, record.size)
            attachment = _parsed(Attachment, body)
        except RecordError:
            return {}
        crc = int.from_bytes(body[-_CRC_BYTES:], "little")
        if (crc and zlib.crc32(body[:-_CRC_BYTES]) != crc) or len(attachment.data) > MAX_ATTACHMENT_BYTES:
            return {}
        return {attachment.name[:MAX_NAME]: attachment.data}

    # The format

    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        offset = start
        while offset + _HEAD.size <= end:
            head = source.read(offset, _HEAD.size)
            if len(head) < _HEAD.size:
                return
            opcode, size = _HEAD.unpack(head)
            begin, offset = offset, offset + _HEAD.size
            if opcode == 0:
                return
            is_cut = size > end - offset
            yield Record(_KINDS.get(opcode, RecordKind.OTHER), begin, offset, size, opcode, is_cut=is_cut)
            if is_cut:
                return
            offset += size

    def _unpack(self, chunk: Record, data: memoryview) -> bytes | memoryview:
        """Return at most as many bytes as the chunk states; raise RecordError where they are not those."""
        try:
            _, _, size, crc, name_size = _CHUNK.unpack_from(data)
            name_end = _CHUNK.size + name_size
            (packed_size,) = _SIZE.unpack_from(data, name_end)
        except struct.error as error:
            raise RecordError("the chunk's header is truncated") from error
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"the chunk unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        packed = data[name_end + _SIZE.size :][:packed_size]
        unpacked: bytes | memoryview = packed
        compression = bytes(data[_CHUNK.size : name_end][:MAX_NAME])
        try:
            if compression == b"lz4":
                unpacked = bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
            elif compression == b"zstd":
                unpacked = zstandard.ZstdDecompressor().stream_reader(packed).read(size)
            elif compression:
                raise RecordError(f"the compression {compression!r} is unknown")
        except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError) as error:
            raise RecordError(f"the chunk does not unpack: {error}") from error
        is_whole = len(packed) == packed_size and len(unpacked) == size and (not crc or zlib.crc32(unpacked) == crc)
        if not (is_whole or chunk.is_cut):
            raise RecordError("the chunk's content does not match its size and CRC")
        return unpacked

    def _head(self, source: ByteSource, message: Record) -> MessageHead:
        try:
            found = _MESSAGE.unpack(source.read(message.offset, min(message.size, _MESSAGE.size)))
        except struct.error as error:
            raise RecordError(f"a message record of {message.size} bytes is too short") from error
        return MessageHead(found[0], found[2], message.offset + _MESSAGE.size, message.size - _MESSAGE.size)

    def _index(self, record: Record) -> tuple[int, Iterator[MessageHead]]:
        body = content(self, record.offset, record.size)
        try:
            channel, size = _INDEX.unpack_from(body)
        except struct.error as error:
            raise RecordError("the index of a chunk is malformed") from error
        entries = body[_INDEX.size :][:size]
        whole = _ENTRY.iter_unpack(entries[: len(entries) // _ENTRY.size * _ENTRY.size])
        return channel, (MessageHead(channel, time_ns, offset) for time_ns, offset in whole)

    def _first_ns(self, chunk: Record) -> int:
        return int.from_bytes(self.read(chunk.offset, _TIME_BYTES), "little")

    def _define(self, source: ByteSource, record: Record) -> None:
        """Add a schema or channel. Names are cut and metadata is left out, so that no log can fill the memory."""
        body = content(source, record.offset, record.size)
        if len(body) > MAX_DEFINITION_BYTES or max(len(self._types), len(self._channels)) >= MAX_DEFINITIONS:
            raise RecordError(f"more than {MAX_DEFINITIONS} channels or schemas, or a large one")
        if record.opcode == Opcode.SCHEMA:
            schema = _parsed(Schema, body)
            self._types[schema.id] = ros_name(schema.name[:MAX_NAME])
        else:
            found = _parsed(Channel, body)
            topic, encoding = found.topic[:MAX_NAME], found.message_encoding[:MAX_NAME]
            self._channels[found.id] = Channel(found.id, topic, encoding, {}, found.schema_id)

    def _topic(self, channel: int) -> Topic | None:
        known = self._channels.get(channel)
        if known is None:
            return None
        kind, encoding = self._types.get(known.schema_id, ""), known.message_encoding
        return Topic(known.topic, kind if encoding in ("cdr", "ros1") else "", encoding != "ros1")

    def _is_closed(self) -> bool:
        return self._footer() is not None

    def _footer(self) -> bytes | None:
        """Return the footer record of a complete file, None without one."""
        size = _HEAD.size + _FOOTER.size
        end = self.read(max(0, self.size - size - len(MAGIC)), size + len(MAGIC))
        if len(end) < size + len(MAGIC) or not end.endswith(MAGIC):
            return None
        return end[:size] if _HEAD.unpack_from(end) == (Opcode.FOOTER, _FOOTER.size) else None

    def _read_index(self) -> bool:
        """Learn channels, statistics and places of attachments from the summary."""
        footer = self._footer()
        start, _, crc = _FOOTER.unpack_from(footer, _HEAD.size) if footer else (0, 0, 0)
        size = self.size - len(MAGIC) - len(footer or b"") - start
        if footer is None or not start or not 0 < size <= _MAX_SUMMARY_BYTES:
            return False
        section = self.read(start, size)
        if len(section) < size or (crc and zlib.crc32(section + footer[:-_CRC_BYTES]) != crc):
            return False
        summary, attachments = Unpacked(section), list[int]()
        try:
            for record in self._records(summary, 0, summary.size):
                body = content(summary, record.offset, record.size)
                if record.kind is RecordKind.DEFINITION:
                    self._define(summary, record)
                elif record.opcode == Opcode.STATISTICS:
                    self._statistics = _parsed(Statistics, body)
                elif record.opcode == Opcode.ATTACHMENT_INDEX and len(attachments) < _MAX_ATTACHMENTS:
                    attachments.append(_parsed(AttachmentIndex, body).offset)
        except RecordError:
            self._types, self._channels, self._statistics = {}, {}, None
            return False
        self._attachments = attachments
        # A writer may repeat channels there without their schemas: then their types are in the data only.
        return bool(self._channels) and all(
            not channel.schema_id or channel.schema_id in self._types for channel in self._channels.values()
        )


def ros_name(schema_name: str) -> str:
    """Return package/msg/Type for this, for DDS (sensor_msgs::msg::dds_::Image_) and for ROS 1 (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name


def _parsed(kind: Any, body: memoryview) -> Any:
    """Return a record of mcap; raise RecordError where it is malformed."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except _PARSE_ERRORS as error:
        raise RecordError(f"a {kind.__name__} record is malformed") from error
