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

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from drivers.errors import RecordError
from drivers.logs.compression import MAX_RECORD_BYTES
from drivers.logs.log import (
    LATEST_NS,
    MAX_ATTACHMENT_BYTES,
    MAX_DEFINITION_BYTES,
    MAX_DEFINITIONS,
    MAX_NAME,
    Topic,
)
from drivers.logs.record_file import ByteSource, Kind, Packing, Record, RecordFile

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20

_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<16xQII")  # after two times: unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<H4xQ8x")  # channel, log time, without sequence and publish time
_PLACE: Final = struct.Struct("<16xQ")  # after two times: begin of the chunk
# The end of a closed file: head of the footer, start of the summary, CRC of the summary and of what precedes it, magic.
_END: Final = struct.Struct("<BQQ8xI8s")
_CRC_BYTES: Final = 4
_KINDS: Final = {
    Opcode.CHUNK: Kind.CHUNK,
    Opcode.MESSAGE: Kind.MESSAGE,
    Opcode.SCHEMA: Kind.SCHEMA,
    Opcode.CHANNEL: Kind.CHANNEL,
    Opcode.ATTACHMENT: Kind.ATTACHMENT,
    Opcode.CHUNK_INDEX: Kind.PLACE,
    Opcode.DATA_END: Kind.END,
}


class McapFile(RecordFile):
    """A LogFile of one MCAP file; raises DriverError where it cannot be read."""

    magic = end_magic = MAGIC

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, name)
        self._types = {0: ""}  # by schema; 0 stands for none

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

    def _summary_at(self) -> int | None:
        # 1. The footer, which ends a closed file.
        at = max(0, self.size - _END.size)
        end = self.read_bytes(at, _END.size)
        if len(end) < _END.size:
            return None
        opcode, size, start, crc, magic = _END.unpack(end)
        if (opcode, size, magic) != (Opcode.FOOTER, _END.size - _HEAD.size - len(MAGIC), MAGIC):
            return None
        self.is_indexed = start > 0
        # 2. The summary before it.
        section = self.read_bytes(start, at - start) if 0 < start < at <= start + MAX_RECORD_BYTES else b""
        is_right = crc in (0, zlib.crc32(section + end[: -len(MAGIC) - _CRC_BYTES]))
        return start if section and len(section) == at - start and is_right else 0

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
            yield Record(_KINDS.get(opcode, Kind.OTHER), begin, offset, size, is_cut=is_cut)
            if is_cut:
                return
            offset += size

    def _packing(self, chunk: Record) -> Packing:
        head = self.read_bytes(chunk.offset, min(chunk.size, _CHUNK.size + MAX_NAME + _SIZE.size))
        size, crc, name_bytes = _unpacked(_CHUNK, head)
        (packed,) = _unpacked(_SIZE, head[_CHUNK.size + name_bytes :])
        begin = _CHUNK.size + name_bytes + _SIZE.size
        if packed > chunk.size - begin:
            raise RecordError("its content does not match its size and CRC")
        return Packing(bytes(head[_CHUNK.size : _CHUNK.size + name_bytes]), chunk.offset + begin, packed, size, crc)

    def _message(self, source: ByteSource, record: Record) -> tuple[int, int, int]:
        head = source.read_bytes(record.offset, min(record.size, _MESSAGE.size))
        channel, time_ns = _unpacked(_MESSAGE, head)
        return channel, min(time_ns, LATEST_NS), record.offset + _MESSAGE.size

    def _learn(self, source: ByteSource, record: Record) -> None:
        """Names are cut and metadata is left out, so that no log can fill the memory."""
        body = source.content(record.offset, record.size)
        if record.kind is Kind.PLACE:
            self._places += _unpacked(_PLACE, body)
            return
        if len(body) > MAX_DEFINITION_BYTES or max(len(self._types), len(self.topics)) >= MAX_DEFINITIONS:
            raise RecordError(f"more than {MAX_DEFINITIONS} channels or schemas, or a large one")
        if record.kind is Kind.SCHEMA:
            schema = _parsed(Schema, body)
            self._types.setdefault(schema.id, ros_name(schema.name[:MAX_NAME]))
            return
        found = _parsed(Channel, body)
        if found.schema_id not in self._types:
            raise RecordError(f"the schema {found.schema_id} of the channel {found.id} is unknown")
        kind = self._types[found.schema_id] if found.message_encoding in ("cdr", "ros1") else ""
        self.topics.setdefault(found.id, Topic(found.topic[:MAX_NAME], kind, found.message_encoding != "ros1"))


def ros_name(schema_name: str) -> str:
    """Return package/msg/Type for this, for DDS (sensor_msgs::msg::dds_::Image_) and for ROS 1 (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name


def _unpacked(layout: struct.Struct, data: bytes | memoryview) -> tuple[int, ...]:
    """Return the numbers with which a record begins; raise RecordError where it is too short."""
    if len(data) < layout.size:
        raise RecordError(f"{len(data)} bytes of a record are too short")
    return layout.unpack_from(data)


def _parsed(kind: Any, body: memoryview) -> Any:
    """Return a record of mcap; raise RecordError where it is malformed."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise RecordError(f"a {kind.__name__} record is malformed") from error
