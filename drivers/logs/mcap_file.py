"""MCAP files (mcap.dev/spec, version 0), whole, cut, corrupt or malicious.

They are framed here and not by the package `mcap`, whose readers refuse a file that was cut, end at the first corrupt
chunk, accept a short read as a message and unpack without a bound. That package parses the small records.

What an index says of the messages in a chunk is not used: the head of each message is read where it is, of chunks that
are not compressed without the rest. The summary only tells what was defined and counted in a corrupt chunk.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema, Statistics

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES, is_packed_message, unpack_chunk
from drivers.logs.log import (
    ENTRY,
    LATEST_NS,
    MAX_ATTACHMENT_BYTES,
    MAX_DEFINITION_BYTES,
    MAX_DEFINITIONS,
    MAX_NAME,
    Entries,
    LogFile,
    Topic,
)
from drivers.logs.ros_messages import HEADER_BYTES

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20
_KEPT_CHUNKS: Final = 4  # that stay unpacked: both cameras, wheels and gyro may have been written one after the other
_NO_CHUNK: Final = 0  # block of a message outside of chunks, whose offset is in the file
_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<16xQII")  # after two times: unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<H4xQ8x")  # channel, log time, without sequence and publish time
# The end of a closed file: head of the footer, start of the summary, CRC of the summary and of what precedes it, magic.
_END: Final = struct.Struct("<BQQ8xI8s")
_CRC_BYTES: Final = 4


class Record(NamedTuple):
    """Position of a record's content in its source."""

    opcode: int
    begin: int  # of the whole record, bytes
    offset: int  # of its content
    size: int  # of its content
    is_cut: bool  # the source ends within the content

    @property
    def end(self) -> int:
        """Where the record ends, bytes."""
        return self.offset + self.size


class Packing(NamedTuple):
    """How the records of a chunk are packed."""

    compression: bytes
    offset: int  # of the packed records in the file
    packed_bytes: int
    unpacked_bytes: int
    crc: int  # of the unpacked records; 0: unknown


class ByteSource:
    """Bytes of known size: an unpacked chunk."""

    def __init__(self, data: bytes | memoryview = b"") -> None:
        self._view = memoryview(data)
        self.size = len(self._view)

    def read_bytes(self, offset: int, size: int) -> bytes | memoryview:
        """Return up to size bytes from offset."""
        return self._view[offset : offset + size]

    def content(self, offset: int, size: int) -> memoryview:
        """Return bytes from offset; raise RecordError where they are too many or incomplete."""
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"{size} bytes are more than {MAX_RECORD_BYTES}")
        data = self.read_bytes(offset, size)
        if len(data) < size:
            raise RecordError(f"{len(data)} of {size} bytes could be read")
        return memoryview(data)

    def records(self, start: int, end: int) -> Iterator[Record]:
        """Yield the records from offset start on; the last one may be cut. What is no record ends them."""
        offset = start
        while offset + _HEAD.size <= end:
            head = self.read_bytes(offset, _HEAD.size)
            if len(head) < _HEAD.size:
                return
            opcode, size = _HEAD.unpack(head)
            if opcode == 0:
                return
            record = Record(opcode, offset, offset + _HEAD.size, size, is_cut=size > end - offset - _HEAD.size)
            yield record
            if record.is_cut:
                return
            offset = record.end


class McapFile(LogFile, ByteSource):
    """A LogFile of one MCAP file, and the source of its bytes; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str) -> None:
        LogFile.__init__(self, name)
        ByteSource.__init__(self)
        self._attached: list[Record] = []
        self._chunks: dict[int, ByteSource] = {}  # the last ones that were unpacked
        self._types = {0: ""}  # by schema; 0 stands for none
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size

    def read_bytes(self, offset: int, size: int) -> bytes:
        """Return up to size bytes of the file from offset; none after close, or where the disk fails."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), offset)
        except (OSError, ValueError):
            return b""

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def entries(self) -> Entries:
        """Return the places of all messages, chunk by chunk."""
        # 1. The summary of a closed file.
        footer_at, summary_at, is_valid = self._summary()
        for record in self.records(summary_at, footer_at) if is_valid else ():
            with suppress(RecordError):  # then the data has the definition
                self._learn(self, record)
        # 2. The data. In a file that was not closed, its last chunk may be cut.
        found, end = [np.empty(0, ENTRY)], len(MAGIC)
        is_whole = False
        for record in self.records(end, self.size):
            if record.is_cut and (record.opcode != Opcode.CHUNK or footer_at):
                break
            end = record.end
            if record.opcode == Opcode.DATA_END:
                is_whole = end == (summary_at or footer_at) and (is_valid or not summary_at)
                break
            if record.opcode == Opcode.CHUNK:
                found.append(self._of_chunk(record))
            elif record.opcode == Opcode.ATTACHMENT and len(self._attached) < MAX_DEFINITIONS:
                self._attached.append(record)
            else:
                found.append(self._scanned(self, record.begin, record.end, _NO_CHUNK, is_cut=True))
        if not is_whole:
            used = ": used the data before" if any(map(len, found)) else ""
            self.cut = f"the log {self.name!r} is cut or corrupt after byte {min(end, self.size)} of {self.size}{used}"
        return np.concatenate(found)

    def read(self, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""
        try:
            source = self if block == _NO_CHUNK else self._chunk(block)
            record = next(source.records(offset, source.size), None)
            if record is None or record.opcode != Opcode.MESSAGE:
                raise RecordError(f"at its byte {offset} is no message any more")
            at = record.offset + _MESSAGE.size
            return source.content(at, record.end - at)
        except RecordError as error:
            raise RecordError(f"the chunk at byte {block}: {error}" if block else str(error)) from error

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

    def _summary(self) -> tuple[int, int, bool]:
        """Return where the footer and the summary begin, 0 without one, and whether the summary is valid."""
        at = max(0, self.size - _END.size)
        end = self.read_bytes(at, _END.size)
        if len(end) < _END.size:
            return 0, 0, False
        opcode, size, start, crc, magic = _END.unpack(end)
        if (opcode, size, magic) != (Opcode.FOOTER, _END.size - _HEAD.size - len(MAGIC), MAGIC):
            return 0, 0, False
        section = self.read_bytes(start, at - start) if 0 < start < at <= start + MAX_RECORD_BYTES else b""
        is_right = crc in (0, zlib.crc32(section + end[: -len(MAGIC) - _CRC_BYTES]))
        return at, start, len(section) == at - start and is_right

    def _of_chunk(self, chunk: Record) -> Entries:
        """Return the entries of a chunk; one that is not compressed is checked when its messages are read."""
        try:
            packing = self._packing(chunk)
            if packing.compression:
                source = self._chunk(chunk.begin)
                return self._scanned(source, 0, source.size, chunk.begin, is_cut=chunk.is_cut)
            end = min(packing.offset + packing.packed_bytes, self.size)
            found = self._scanned(self, packing.offset, end, chunk.begin, is_cut=chunk.is_cut)
        except RecordError as error:
            self.faults[chunk.begin] = f"the chunk at byte {chunk.begin}: {error}"
            return np.empty(0, ENTRY)
        found["offset"] -= packing.offset
        return found

    def _packing(self, chunk: Record) -> Packing:
        head = self.read_bytes(chunk.offset, min(chunk.size, _CHUNK.size + MAX_NAME + _SIZE.size))
        size, crc, name_bytes = _unpacked(_CHUNK, head)
        (packed,) = _unpacked(_SIZE, head[_CHUNK.size + name_bytes :])
        begin = _CHUNK.size + name_bytes + _SIZE.size
        if packed > chunk.size - begin:
            raise RecordError("its content does not match its size and CRC")
        return Packing(bytes(head[_CHUNK.size : _CHUNK.size + name_bytes]), chunk.offset + begin, packed, size, crc)

    def _chunk(self, begin: int) -> ByteSource:
        """Return the content of a chunk; raise RecordError where it is not the one that was written."""
        if begin not in self._chunks:
            chunk = next(self.records(begin, self.size), None)
            if chunk is None:
                raise RecordError("it is gone")
            packing = self._packing(chunk)
            packed = self.content(packing.offset, min(packing.packed_bytes, self.size - packing.offset))
            data = unpack_chunk(packing.compression, packed, packing.unpacked_bytes)
            is_whole = len(packed) == packing.packed_bytes and len(data) == packing.unpacked_bytes
            if not (chunk.is_cut or (is_whole and packing.crc in (0, zlib.crc32(data)))):
                raise RecordError("its content does not match its size and CRC")
            self._chunks[begin] = ByteSource(data)
        self._chunks[begin] = self._chunks.pop(begin)  # the newest one
        if len(self._chunks) > _KEPT_CHUNKS:
            del self._chunks[next(iter(self._chunks))]
        return self._chunks[begin]

    def _scanned(self, source: ByteSource, begin: int, end: int, block: int, *, is_cut: bool) -> Entries:
        """Return the entries of the messages among records, and learn what the others define.

        is_cut: the last one need not be whole.
        """
        found, at = [], begin
        for record in source.records(begin, end):
            if record.is_cut:
                break
            at = record.end
            try:
                if record.opcode == Opcode.MESSAGE:
                    head = source.read_bytes(record.offset, min(record.size, _MESSAGE.size))
                    channel, time_ns = _unpacked(_MESSAGE, head)
                    at_data = record.offset + _MESSAGE.size
                    start = source.read_bytes(at_data, min(record.end - at_data, HEADER_BYTES))
                    if is_packed_message(start):
                        start = source.content(at_data, record.end - at_data)
                    header_ns = self.header_ns(channel, start)
                    found.append((channel, min(time_ns, LATEST_NS), header_ns, block, record.begin))
                else:
                    self._learn(source, record)
            except RecordError as error:
                self.faults.setdefault(block or record.begin, f"the record at byte {record.begin}: {error}")
        if at != end and not is_cut:
            self.faults.setdefault(block, f"the chunk at byte {block}: its last record is not whole")
        return np.array(found, ENTRY)

    def _learn(self, source: ByteSource, record: Record) -> None:
        """Add a channel, a schema or the counts of messages; names are cut, so that no log can fill the memory."""
        if record.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            return
        if record.size > MAX_DEFINITION_BYTES or max(len(self._types), len(self.topics)) >= MAX_DEFINITIONS:
            raise RecordError(f"more than {MAX_DEFINITIONS} channels or schemas, or a large one")
        body = source.content(record.offset, record.size)
        if record.opcode == Opcode.STATISTICS:
            self.stated.update(_parsed(Statistics, body).channel_message_counts)
        elif record.opcode == Opcode.SCHEMA:
            schema = _parsed(Schema, body)
            self._types.setdefault(schema.id, ros_name(schema.name[:MAX_NAME]))
        else:
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
