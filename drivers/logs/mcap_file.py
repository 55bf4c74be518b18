"""An MCAP file: how its records are framed and packed, its summary, its attachments. Format: mcap.dev/spec, version 0.

The `mcap` package parses the small records.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from drivers.errors import RecordError
from drivers.logs.chunked_file import ByteSource, ChunkedFile, Record, RecordKind, Summary
from drivers.logs.compression import MAX_RECORD_BYTES, unpack_chunk
from drivers.logs.log import (
    ENTRY,
    LATEST_NS,
    MAX_ATTACHMENT_BYTES,
    MAX_DEFINITION_BYTES,
    MAX_DEFINITIONS,
    MAX_NAME,
    Entries,
    Topic,
)

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20

_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_INDEX: Final = struct.Struct("<HI")  # channel, bytes of the entries: log time, offset in the chunk
_PLACE: Final = struct.Struct("<QQQ")  # first and last log time, begin of the chunk
_ENTRY: Final = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])
_FOOTER: Final = struct.Struct("<QQI")  # start of the summary, of its offsets, CRC of the summary and the footer before
_CRC_BYTES: Final = 4
_PARSE_ERRORS: Final = (McapError, struct.error, ValueError, OverflowError)
_KINDS: Final = {
    Opcode.CHUNK: RecordKind.CHUNK,
    Opcode.MESSAGE_INDEX: RecordKind.INDEX,
    Opcode.MESSAGE: RecordKind.MESSAGE,
    Opcode.SCHEMA: RecordKind.SCHEMA,
    Opcode.CHANNEL: RecordKind.CHANNEL,
    Opcode.ATTACHMENT: RecordKind.ATTACHMENT,
    Opcode.CHUNK_INDEX: RecordKind.PLACE,
    Opcode.DATA_END: RecordKind.END,
}


class McapFile(ChunkedFile):
    """A LogFile of one MCAP file; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str) -> None:
        self._types: dict[int, str] = {}  # by schema
        super().__init__(path, MAGIC, name)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments that are valid and within the limits."""
        found: dict[str, bytes] = {}
        left = MAX_ALL_ATTACHMENTS_BYTES
        for record in self._attached:
            if record.size > min(left, MAX_ATTACHMENT_BYTES):
                continue
            left -= record.size
            with suppress(RecordError):
                body = self.content(record.offset, record.size)
                attachment, crc = _parsed(Attachment, body), int.from_bytes(body[-_CRC_BYTES:], "little")
                if not crc or zlib.crc32(body[:-_CRC_BYTES]) == crc:
                    found[attachment.name[:MAX_NAME]] = attachment.data
        return found

    def _summary(self) -> Summary | None:
        # 1. The footer, which ends a closed file.
        size = _HEAD.size + _FOOTER.size
        end = self.read_bytes(max(0, self.size - size - len(MAGIC)), size + len(MAGIC))
        footer = end[:size]
        if end[size:] != MAGIC or _HEAD.unpack_from(footer) != (Opcode.FOOTER, _FOOTER.size):
            return None
        start, _, crc = _FOOTER.unpack_from(footer, _HEAD.size)
        self.is_indexed = start > 0
        # 2. The summary before it.
        size = self.size - len(MAGIC) - size - start
        section = self.read_bytes(start, size) if start and 0 < size <= MAX_RECORD_BYTES else b""
        if len(section) != size or (crc and zlib.crc32(section + footer[:-_CRC_BYTES]) != crc):
            return Summary()
        records = list(self._records(self, start, start + size))
        places = [record for record in records if record.kind is RecordKind.PLACE and record.size >= _PLACE.size]
        return Summary(
            [record for record in records if record.kind in (RecordKind.SCHEMA, RecordKind.CHANNEL)],
            [_PLACE.unpack(self.content(record.offset, _PLACE.size))[2] for record in places],
        )

    def _is_whole(self, last: Record) -> bool:
        # Where two files were written one after the other, the first one's footer is not at the end.
        end = last.offset + last.size
        ends = (record.offset + record.size for record in self._records(self, end, self.size - len(MAGIC)))
        return last.kind is RecordKind.END and max(ends, default=0) == self.size - len(MAGIC)

    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        offset = start
        while offset + _HEAD.size <= end:
            head = source.read_bytes(offset, _HEAD.size)
            if len(head) < _HEAD.size:
                return
            opcode, size = _HEAD.unpack(head)
            begin, offset = offset, offset + _HEAD.size
            if opcode == 0:
                return
            is_cut = size > end - offset
            yield Record(_KINDS.get(opcode, RecordKind.OTHER), begin, offset, size, is_cut=is_cut)
            if is_cut:
                return
            offset += size

    def _unpack(self, chunk: Record, data: memoryview) -> ByteSource:
        try:
            _, _, size, crc, name_size = _CHUNK.unpack_from(data)
            name_end = _CHUNK.size + name_size
            (packed_size,) = _SIZE.unpack_from(data, name_end)
        except struct.error as error:
            raise RecordError("its header is truncated") from error
        packed = data[name_end + _SIZE.size :][:packed_size]
        unpacked = unpack_chunk(bytes(data[_CHUNK.size : name_end][:MAX_NAME]), packed, size)
        is_right = len(packed) == packed_size and len(unpacked) == size and (not crc or zlib.crc32(unpacked) == crc)
        if not (is_right or chunk.is_cut):
            raise RecordError("its content does not match its size and CRC")
        return ByteSource(unpacked)

    def _plain_begin(self, chunk: Record) -> int:
        head = self.read_bytes(chunk.offset, _CHUNK.size)
        is_plain = len(head) == _CHUNK.size and _CHUNK.unpack(head)[-1] == 0
        return chunk.offset + _CHUNK.size + _SIZE.size if is_plain else 0

    def _head(self, source: ByteSource, message: Record) -> tuple[int, int, int]:
        try:
            found = _MESSAGE.unpack(source.read_bytes(message.offset, min(message.size, _MESSAGE.size)))
        except struct.error as error:
            raise RecordError(f"a message record of {message.size} bytes is too short") from error
        return found[0], min(found[2], LATEST_NS), message.offset + _MESSAGE.size

    def _index(self, record: Record, chunk: int) -> Entries:
        body = self.content(record.offset, record.size)
        try:
            channel, size = _INDEX.unpack_from(body)
        except struct.error as error:
            raise RecordError(f"the index at byte {record.begin} is malformed") from error
        found = np.frombuffer(body[_INDEX.size :][: size // _ENTRY.itemsize * _ENTRY.itemsize], _ENTRY)
        entries = np.empty(len(found), ENTRY)
        entries["channel"], entries["block"] = channel, chunk
        entries["time_ns"], entries["offset"] = np.minimum(found["time_ns"], LATEST_NS), found["offset"]
        return entries

    def _define(self, source: ByteSource, record: Record) -> None:
        """Add a schema or channel. Names are cut and metadata is left out, so that no log can fill the memory."""
        body = source.content(record.offset, record.size)
        if len(body) > MAX_DEFINITION_BYTES or max(len(self._types), len(self.topics)) >= MAX_DEFINITIONS:
            raise RecordError(f"more than {MAX_DEFINITIONS} channels or schemas, or a large one")
        if record.kind is RecordKind.SCHEMA:
            schema = _parsed(Schema, body)
            self._types[schema.id] = ros_name(schema.name[:MAX_NAME])
            return
        found = _parsed(Channel, body)
        if found.schema_id and found.schema_id not in self._types:
            raise RecordError(f"the schema {found.schema_id} of the channel {found.id} is unknown")
        kind = self._types.get(found.schema_id, "") if found.message_encoding in ("cdr", "ros1") else ""
        self.topics[found.id] = Topic(found.topic[:MAX_NAME], kind, found.message_encoding != "ros1")


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
