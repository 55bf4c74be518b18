"""A file of records, most of which are packed in chunks, whole, cut, corrupt or malicious: MCAP files and ROS 1 bags.

Both formats are framed here and not by their libraries, whose readers refuse a file that was cut, end at the first
corrupt chunk, accept a short read as a message and unpack without a bound.

What an index says of the messages in a chunk is not used: the head of each message is read where it is, of chunks that
are not compressed without the rest. A summary only tells what was defined in a corrupt chunk, and where others begin.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import suppress
from enum import Enum, auto
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

_KEPT_CHUNKS: Final = 4  # that stay unpacked: both cameras, wheels and gyro may have been written one after the other
_NO_CHUNK: Final = 0  # block of a message outside of chunks, whose offset is in the file


class Kind(Enum):
    """What a record is for the reader."""

    CHUNK = auto()
    MESSAGE = auto()
    SCHEMA = auto()
    CHANNEL = auto()
    ATTACHMENT = auto()
    END = auto()  # of chunks and messages
    PLACE = auto()  # of a chunk, behind that end
    COUNTS = auto()  # of the messages, behind that end
    OTHER = auto()


_DEFINITIONS: Final = (Kind.SCHEMA, Kind.CHANNEL)
_ENDS: Final = (Kind.END, Kind.PLACE)


class Record(NamedTuple):
    """Position of a record's content in its source."""

    kind: Kind
    begin: int  # of the whole record, bytes
    offset: int  # of its content
    size: int  # of its content
    fields: Mapping[bytes, bytes] = {}  # of a bag's record
    is_cut: bool = False  # the source ends within the content

    @property
    def end(self) -> int:
        """Where the record ends, bytes."""
        return self.offset + self.size


class Packing(NamedTuple):
    """How the records of a chunk are packed."""

    compression: bytes  # lz4, zstd, bz2 or nothing
    offset: int  # of the packed records in the file
    packed_bytes: int
    unpacked_bytes: int
    crc: int = 0  # of the unpacked records; 0: unknown


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


class RecordFile(LogFile, ByteSource):
    """A log of records, and the source of its bytes. A format states how records are framed, packed and read."""

    magic = b""  # at the begin of a file
    end_magic = b""  # at the end of a closed one

    def __init__(self, path: Path, name: str) -> None:
        """Open a file that begins with the magic; raise DriverError where it cannot be read."""
        LogFile.__init__(self, name)
        ByteSource.__init__(self)
        self._attached: list[Record] = []
        self._places: list[int] = []  # of chunks, by the summary
        self._chunks: dict[int, ByteSource] = {}  # the last ones that were unpacked
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size

    # What a format states. All but the first two raise RecordError for a record that is malformed.

    @abstractmethod
    def _summary_at(self) -> int | None:
        """Return where a closed file begins its summary, 0 without a valid one; None: it is not closed."""

    @abstractmethod
    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        """Yield the records from offset start on; the last one may be cut. What is no record ends them."""

    @abstractmethod
    def _packing(self, chunk: Record) -> Packing:
        """Return how a chunk is packed."""

    @abstractmethod
    def _message(self, source: ByteSource, record: Record) -> tuple[int, int, int]:
        """Return channel, time [ns] and offset of the data of a message."""

    @abstractmethod
    def _learn(self, source: ByteSource, record: Record) -> None:
        """Add a channel, a schema, the place of a chunk or counts of messages, within the limits."""

    # The log file

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
        summary_at, data_end = self._summary_at(), self.size - len(self.end_magic)
        for record in self._records(self, summary_at, data_end) if summary_at else ():
            with suppress(RecordError):  # then the data has the definition
                if record.kind in (*_DEFINITIONS, Kind.PLACE, Kind.COUNTS):
                    self._learn(self, record)
        found, last = [np.empty(0, ENTRY)], Record(Kind.OTHER, 0, 0, len(self.magic))
        for record in self._with_jumps(is_closed=summary_at is not None):
            last = record
            if record.kind is Kind.CHUNK:
                found.append(self._of_chunk(record))
            elif record.kind is Kind.ATTACHMENT and len(self._attached) < MAX_DEFINITIONS:
                self._attached.append(record)
            else:
                found.append(self._scanned(self, record.begin, record.end, _NO_CHUNK, is_cut=True))
        # Where two files were written one after the other, the first one's end is not that of the file.
        ends = [record.end for record in self._records(self, last.end, data_end)] or [last.end]
        if summary_at is None or last.kind not in _ENDS or ends[-1] != data_end:
            end = min(last.end, self.size)
            used = ": used the data before" if any(map(len, found)) else ""
            self.cut = f"the log {self.name!r} is cut or corrupt after byte {end} of {self.size}{used}"
        return np.concatenate(found)

    def _with_jumps(self, *, is_closed: bool) -> Iterator[Record]:
        """Yield the records up to the end of the data, and behind holes in the file those from the next chunk on."""
        begin = len(self.magic)
        while begin:
            end = begin
            for record in self._records(self, begin, self.size):
                # A length that exceeds a file which was closed is a corrupt one; in another, its last chunk is cut.
                if record.is_cut and (record.kind is not Kind.CHUNK or is_closed):
                    break
                yield record
                if record.kind in _ENDS:
                    return
                end = record.end
            begin = min((place for place in self._places if place > end), default=0)
            if begin:
                self.faults[end] = f"the {begin - end} bytes from byte {end} on are no records"

    def read(self, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""
        try:
            source = self if block == _NO_CHUNK else self._chunk(block)
            record = next(self._records(source, offset, source.size), None)
            if record is None or record.kind is not Kind.MESSAGE:
                raise RecordError(f"at its byte {offset} is no message any more")
            at = self._message(source, record)[2]
            return source.content(at, record.end - at)
        except RecordError as error:
            raise RecordError(f"the chunk at byte {block}: {error}" if block else str(error)) from error

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

    def _chunk(self, begin: int) -> ByteSource:
        """Return the content of a chunk; raise RecordError where it is not the one that was written."""
        if begin not in self._chunks:
            chunk = next(self._records(self, begin, self.size), None)
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
        for record in self._records(source, begin, end):
            if record.is_cut:
                break
            at = record.end
            try:
                if record.kind in _DEFINITIONS:
                    self._learn(source, record)
                elif record.kind is Kind.MESSAGE:
                    channel, time_ns, at_data = self._message(source, record)
                    start = source.read_bytes(at_data, min(record.end - at_data, HEADER_BYTES))
                    if is_packed_message(start):
                        start = source.content(at_data, record.end - at_data)
                    found.append((channel, time_ns, self.header_ns(channel, start), block, record.begin))
            except RecordError as error:
                self.faults.setdefault(block or record.begin, f"the record at byte {record.begin}: {error}")
        if at != end and not is_cut:
            self.faults.setdefault(block, f"the chunk at byte {block}: its last record is not whole")
        return np.array(found, ENTRY)


# MCAP: mcap.dev/spec, version 0. The `mcap` package parses the small records.

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20

_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<16xQII")  # after two times: unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<H4xQ8x")  # channel, log time, without sequence and publish time
_PLACE: Final = struct.Struct("<16xQ")  # after two times: begin of the chunk
# The end of a closed file: head of the footer, start of the summary, CRC of the summary and of what precedes it, magic.
_END: Final = struct.Struct("<BQQ8xI8s")
_CRC_BYTES: Final = 4
_MCAP_KINDS: Final = {
    Opcode.CHUNK: Kind.CHUNK,
    Opcode.MESSAGE: Kind.MESSAGE,
    Opcode.SCHEMA: Kind.SCHEMA,
    Opcode.CHANNEL: Kind.CHANNEL,
    Opcode.ATTACHMENT: Kind.ATTACHMENT,
    Opcode.CHUNK_INDEX: Kind.PLACE,
    Opcode.DATA_END: Kind.END,
    Opcode.STATISTICS: Kind.COUNTS,
}


class McapFile(RecordFile):
    """A LogFile of one MCAP file; raises DriverError where it cannot be read."""

    magic = end_magic = MCAP_MAGIC

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
        if (opcode, size, magic) != (Opcode.FOOTER, _END.size - _HEAD.size - len(MCAP_MAGIC), MCAP_MAGIC):
            return None
        self.is_indexed = start > 0
        # 2. The summary before it.
        section = self.read_bytes(start, at - start) if 0 < start < at <= start + MAX_RECORD_BYTES else b""
        is_right = crc in (0, zlib.crc32(section + end[: -len(MCAP_MAGIC) - _CRC_BYTES]))
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
            yield Record(_MCAP_KINDS.get(opcode, Kind.OTHER), begin, offset, size, is_cut=is_cut)
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
        if record.kind is Kind.COUNTS:
            self.stated.update(_parsed(Statistics, body).channel_message_counts)
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


# Bags of ROS 1: wiki.ros.org/Bags/Format/2.0. A record is a header of fields (name=value) and data. The file begins
# with a record that states where the index is: 0 until the recorder has closed the file.

BAG_MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = struct.Struct("<I")
_BAG_KINDS: Final = {2: Kind.MESSAGE, 5: Kind.CHUNK, 6: Kind.PLACE, 7: Kind.CHANNEL}


class Ros1Bag(RecordFile):
    """A LogFile of one .bag file; raises DriverError where it cannot be read."""

    magic = BAG_MAGIC

    def _summary_at(self) -> int | None:
        try:
            bag = next(self._records(self, len(BAG_MAGIC), self.size))
            begin = _field(bag, b"index_pos", "<Q")[0]
            expected = _field(bag, b"conn_count")[0] + _field(bag, b"chunk_count")[0]
        except (StopIteration, RecordError):
            return None
        if not len(BAG_MAGIC) < begin < self.size:
            return None
        found = sum(not record.is_cut for record in self._records(self, begin, self.size))
        return begin if found >= expected else None

    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        offset = start
        while offset + _LENGTH.size <= end:
            begin, size = offset, _length(source, offset)
            offset += _LENGTH.size
            if size > min(end - offset, MAX_DEFINITION_BYTES):
                return
            fields, offset = _fields(bytes(source.read_bytes(offset, size))), offset + size
            opcode = fields.get(b"op", b"")
            if len(opcode) != 1 or offset + _LENGTH.size > end:
                return
            size, offset = _length(source, offset), offset + _LENGTH.size
            is_cut = size > end - offset
            yield Record(_BAG_KINDS.get(opcode[0], Kind.OTHER), begin, offset, size, fields, is_cut)
            if is_cut:
                return
            offset += size

    def _packing(self, chunk: Record) -> Packing:
        compression = chunk.fields.get(b"compression", b"").replace(b"none", b"")
        # The recorder states the size of a chunk when it ends it.
        return Packing(compression, chunk.offset, chunk.size, _field(chunk, b"size")[0] or chunk.size)

    def _message(self, source: ByteSource, record: Record) -> tuple[int, int, int]:
        seconds, nanoseconds = _field(record, b"time", "<II")
        return _field(record, b"conn")[0], seconds * 10**9 + nanoseconds, record.offset

    def _learn(self, source: ByteSource, record: Record) -> None:
        if record.kind is Kind.PLACE:
            self._places += _field(record, b"chunk_pos", "<Q")
            counts = np.frombuffer(source.content(record.offset, record.size // 8 * 8), "<u4").reshape(-1, 2)
            self.stated.update(dict(counts.tolist()))
            return
        if len(self.topics) >= MAX_DEFINITIONS or record.size > MAX_DEFINITION_BYTES:
            raise RecordError(f"more than {MAX_DEFINITIONS} connections, or a large one")
        about = _fields(bytes(source.content(record.offset, record.size)))
        found = record.fields.get(b"topic", b""), about.get(b"type", b"")
        topic, kind = (text[:MAX_NAME].decode("utf-8", "replace") for text in found)
        self.topics.setdefault(_field(record, b"conn")[0], Topic(topic, kind.replace("/", "/msg/", 1), aligned=False))


def _length(source: ByteSource, offset: int) -> int:
    return int.from_bytes(source.read_bytes(offset, _LENGTH.size), "little")


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return name -> value of the fields of a header, as far as it is well-formed."""
    found: dict[bytes, bytes] = {}
    offset = 0
    while offset + _LENGTH.size <= len(header):
        (size,) = _LENGTH.unpack_from(header, offset)
        name, equals, value = header[offset + _LENGTH.size : offset + _LENGTH.size + size].partition(b"=")
        if not equals:
            break
        found[name] = value
        offset += _LENGTH.size + size
    return found


def _field(record: Record, name: bytes, layout: str = "<I") -> tuple[int, ...]:
    """Return the numbers in a field of a record; raise RecordError where there are none."""
    try:
        return struct.unpack(layout, record.fields.get(name, b""))
    except struct.error as error:
        raise RecordError(f"a record has no valid field {name.decode()}") from error
