"""An MCAP file, whole, cut, corrupt or malicious: topics, messages in the order of log time, attachments, contents.

The `mcap` package parses the small records. The records are framed and the chunks unpacked here, because its readers
refuse a file that was cut, end at the first corrupt chunk, accept a short read as a message and unpack lz4 without a
bound. Format: mcap.dev/spec, version 0.
"""

from __future__ import annotations

import heapq
import os
import re
import struct
import zlib
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Schema, Statistics

from drivers.errors import DriverError
from drivers.logs.log import MAX_RECORD_BYTES, LogDamage, LoggedMessage, RecordError
from drivers.logs.ros_messages import IMAGE_TYPES, MOTION_TYPES

MAGIC: Final = b"\x89MCAP0\r\n"
# Bounds of what is kept in memory, whatever a file states.
MAX_ATTACHMENT_BYTES: Final = 16 * 2**20
MAX_ALL_ATTACHMENTS_BYTES: Final = 64 * 2**20
_MAX_ATTACHMENTS: Final = 32
_MAX_SUMMARY_BYTES: Final = 64 * 2**20
_MAX_DEFINITIONS: Final = 4096  # channels, and schemas
_MAX_DEFINITION_BYTES: Final = 2**20
_MAX_NAME: Final = 256  # characters of a topic, a type or an attachment
_MAX_UNPACKED_BYTES: Final = 64 * 2**20  # of the chunks that are kept unpacked, beside the newest one
_MAX_WAITING: Final = 2**18  # messages that wait for earlier ones
# Topics of a file without summary are searched in this part of it: some seconds of both cameras, wheels and gyro.
_SCAN_BYTES: Final = 64 * 2**20

_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<QQQII")  # first and last log time, unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER: Final = struct.Struct("<QQI")  # start of the summary, of its offsets, CRC of the summary and the footer before
_CRC_BYTES: Final = 4
_TIME_BYTES: Final = 8
_LOG_TIME_OFFSET: Final = 6  # in a message record, after channel and sequence
_LATEST_NS: Final = 2**64
_MAX_NAMES: Final = 1024  # bytes of an attachment beside its data
_RUN_BYTES: Final = 2**20  # of records outside of chunks that are sorted as one chunk is
_PARSE_ERRORS: Final = (McapError, struct.error, ValueError, OverflowError)
_OTHER_FORMATS: Final = {  # first bytes -> advice
    b"\x28\xb5\x2f\xfd": "a zstd-compressed file: unpack it with `zstd -d`",
    b"\x1f\x8b": "a gzip-compressed file: unpack it with `gzip -d`, or `tar -xf` where it is an archive",
    b"PK\x03\x04": "a zip archive: unpack it with `unzip`",
}


class ByteSource(Protocol):
    """Bytes of known size: the file or an unpacked chunk."""

    size: int

    def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return up to size bytes from offset."""


class Record(NamedTuple):
    """Position of a record's content in its source."""

    opcode: int
    offset: int  # bytes
    size: int  # bytes


class _Unpacked:
    """A ByteSource in memory; it returns views."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._view = memoryview(data)
        self.size = len(self._view)

    def read(self, offset: int, size: int) -> memoryview:
        """Return up to size bytes from offset."""
        return self._view[offset : offset + size]


class _Block(NamedTuple):
    """A chunk, or successive records outside of chunks; sorts by time, then by its place in the file."""

    first_ns: int  # log time of its first message
    offset: int  # bytes
    size: int  # bytes
    is_chunk: bool


class _Topic(NamedTuple):
    """Name and type of a channel; kind: "" where its messages cannot be decoded."""

    name: str
    kind: str
    aligned: bool  # True: CDR; False: the serialisation of ROS 1


class _Waiting(NamedTuple):
    """A message whose turn has not come; sorts by log time, then by its place in the file."""

    log_time_ns: int
    block_offset: int
    offset: int  # of its data in the file or in the unpacked chunk, bytes
    size: int
    topic: _Topic
    block: _Block


class McapFile:
    """A Log of one MCAP file, and a ByteSource; raises DriverError where the path is no such file."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size
        start = self.read(0, len(MAGIC))
        if start != MAGIC:
            self.close()
            advice = f"it starts with {start!r}: give a .mcap file" if start else "it is empty: record it again"
            advice = next((known for magic, known in _OTHER_FORMATS.items() if start.startswith(magic)), advice)
            raise DriverError(f"{self.name!r} is not an MCAP log: {advice}")
        self._damage: LogDamage | None = None
        self._broken = 0  # chunks and records that the present call of messages() has skipped
        self._unpacked: OrderedDict[int, _Unpacked] = OrderedDict()  # the last chunks that were read, by offset
        self._types: dict[int, str] = {}  # by schema
        self._channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._attachments: list[int] = []  # offsets by the summary
        self._read_summary()
        self._has_index_of_channels = bool(self._channels)
        if not self._channels:
            self._define_all(block for block in self._blocks()[0] if block.offset <= _SCAN_BYTES)

    @property
    def name(self) -> str:
        """The path, for error messages."""
        return str(self.path)

    def read(self, offset: int, size: int) -> bytes:
        """Return up to size bytes of the file from offset; none after close, or where the disk fails."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), offset)
        except (OSError, ValueError):
            return b""

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

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

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time; those of one time in the order of the file.

        A chunk is unpacked when all messages before its first one are through, so that a file whose topics were
        written one after the other needs little more memory than others.
        """
        blocks, self._damage = self._blocks()
        in_order = sorted(blocks)
        if blocks != in_order and not self._has_index_of_channels:
            self._define_all(blocks)  # A block may use a channel that one of a later time defines.
        self._broken = 0
        for message in self._by_time(in_order, topics):
            if self._file.closed:
                return
            yield message
        self._damage = self._damage._replace(broken=self._broken)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the valid attachments in the limits; without a summary those before the messages."""
        found: dict[str, bytes] = {}
        left = MAX_ALL_ATTACHMENTS_BYTES
        records = self._at(self._attachments) if self._attachments else _records(self, len(MAGIC), self.size)
        for record in records:
            if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END) or len(found) >= _MAX_ATTACHMENTS:
                break
            if record.opcode == Opcode.ATTACHMENT and record.size <= min(left, MAX_ATTACHMENT_BYTES + _MAX_NAMES):
                left -= record.size
                found.update(self._attachment(record))
        return found

    def damage(self) -> LogDamage:
        """Return the faults that are known: where the file ends, and the chunks that messages() has skipped."""
        if self._damage is None:
            self._damage = self._blocks()[1]
        return self._damage

    def _blocks(self) -> tuple[list[_Block], LogDamage]:
        """Return the blocks of the data section in the order of the file, and where it ends too early."""
        blocks: list[_Block] = []
        run: _Block | None = None  # records outside of chunks, up to _RUN_BYTES
        end, ended = len(MAGIC), False
        for record in _records(self, len(MAGIC), self.size):
            if record.opcode == Opcode.DATA_END:
                ended = True
                break
            begin, end = record.offset - _HEAD.size, record.offset + record.size
            if run is not None and (record.opcode == Opcode.CHUNK or end - run.offset > _RUN_BYTES):
                blocks.append(run)
                run = None
            if record.opcode == Opcode.CHUNK:
                first_ns = int.from_bytes(self.read(record.offset, _TIME_BYTES), "little")
                blocks.append(_Block(first_ns, record.offset, record.size, is_chunk=True))
            elif record.opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                if record.opcode == Opcode.MESSAGE:
                    first_ns = int.from_bytes(self.read(record.offset + _LOG_TIME_OFFSET, _TIME_BYTES), "little")
                else:
                    first_ns = _LATEST_NS if run else max((block.first_ns for block in blocks[-1:]), default=0)
                run = run or _Block(first_ns, begin, 0, is_chunk=False)
                run = run._replace(first_ns=min(run.first_ns, first_ns), size=end - run.offset)
        blocks += [run] if run is not None else []
        if ended and self._footer() is not None:
            return blocks, LogDamage()
        line = f"the log {self.name!r} is cut or corrupt after byte {end} of {self.size}: used the data before"
        return blocks, LogDamage(0, line, end)

    def _by_time(self, blocks: Iterable[_Block], topics: Collection[str] | None) -> Iterator[LoggedMessage]:
        """Yield the messages of blocks, which are in the order of their first messages."""
        waiting: list[_Waiting] = []
        for block in blocks:
            while waiting and waiting[0][:2] < block[:2]:
                yield self._logged(heapq.heappop(waiting))
            self._forget_chunks_but({message.block_offset for message in waiting})
            for message in self._messages_of(block, topics):
                heapq.heappush(waiting, message)
                if len(waiting) > _MAX_WAITING:
                    yield self._logged(heapq.heappop(waiting))
        while waiting:
            yield self._logged(heapq.heappop(waiting))

    def _messages_of(self, block: _Block, topics: Collection[str] | None) -> Iterator[_Waiting]:
        """Yield the messages of a block, and learn its channels; what is corrupt is counted and skipped."""
        try:
            source = self._source(block)
            end = block.offset + block.size if source is self else source.size
            last = block.offset if source is self else 0
            for record in _records(source, last, end):
                last = record.offset + record.size
                try:
                    if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                        self._define(record.opcode, _content(source, record))
                    elif record.opcode == Opcode.MESSAGE:
                        channel, _, time_ns, _ = _message_head(source, record)
                        topic = self._topic(channel)
                        if topic is not None and (topics is None or topic.name in topics):
                            data = record.offset + _MESSAGE.size, record.size - _MESSAGE.size
                            yield _Waiting(time_ns, block.offset, *data, topic, block)
                except RecordError:
                    self._broken += 1
            if last != end:
                raise RecordError("the last record of a chunk is not whole")
        except RecordError:
            self._broken += 1

    def _logged(self, found: _Waiting) -> LoggedMessage:
        record = Record(Opcode.MESSAGE, found.offset, found.size)

        def read() -> memoryview:
            return _content(self._source(found.block), record)

        return LoggedMessage(found.topic.name, found.topic.kind, found.log_time_ns, read, found.topic.aligned)

    def _source(self, block: _Block) -> ByteSource:
        """Return the file or the unpacked chunk that a block's records are in; raise RecordError for a corrupt chunk.

        Where many chunks overlap in time, only the last 64 MiB are kept unpacked, and others are unpacked again.
        """
        if not block.is_chunk:
            return self
        found = self._unpacked.get(block.offset)
        if found is None:
            found = _unpack(_content(self, Record(Opcode.CHUNK, block.offset, block.size)))
            self._unpacked[block.offset] = found
            while len(self._unpacked) > 1 and sum(kept.size for kept in self._unpacked.values()) > _MAX_UNPACKED_BYTES:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(block.offset)
        return found

    def _forget_chunks_but(self, offsets: Collection[int]) -> None:
        """Free the unpacked chunks of which no message waits."""
        for offset in self._unpacked.keys() - offsets:
            del self._unpacked[offset]

    def _define_all(self, blocks: Iterable[_Block]) -> None:
        """Learn the channels of blocks."""
        for block in blocks:
            for _ in self._messages_of(block, ()):
                pass

    def _define(self, opcode: int, body: memoryview) -> None:
        """Add a schema or channel; raise RecordError where it is malformed or exceeds the limits.

        Names are cut and metadata is left out, so that no log can fill the memory.
        """
        if len(body) > _MAX_DEFINITION_BYTES or max(len(self._types), len(self._channels)) >= _MAX_DEFINITIONS:
            raise RecordError(f"more than {_MAX_DEFINITIONS} channels or schemas, or a large one")
        if opcode == Opcode.SCHEMA:
            schema = _parsed(Schema, body)
            self._types[schema.id] = ros_name(schema.name[:_MAX_NAME])
        else:
            found = _parsed(Channel, body)
            topic, encoding = found.topic[:_MAX_NAME], found.message_encoding[:_MAX_NAME]
            self._channels[found.id] = Channel(found.id, topic, encoding, {}, found.schema_id)

    def _topic(self, channel_id: int) -> _Topic | None:
        """Return the topic of a channel, None of an unknown one."""
        channel = self._channels.get(channel_id)
        if channel is None:
            return None
        kind, encoding = self._types.get(channel.schema_id, ""), channel.message_encoding
        # Of ROS 1, images and samples of motion are all that is read.
        known = encoding == "cdr" or (encoding == "ros1" and kind in (*IMAGE_TYPES, *MOTION_TYPES))
        return _Topic(channel.topic, kind if known else "", encoding != "ros1")

    def _footer(self) -> bytes | None:
        """Return the footer record of a complete file, None without one."""
        size = _HEAD.size + _FOOTER.size
        end = self.read(max(0, self.size - size - len(MAGIC)), size + len(MAGIC))
        if len(end) < size + len(MAGIC) or not end.endswith(MAGIC):
            return None
        return end[:size] if _HEAD.unpack_from(end) == (Opcode.FOOTER, _FOOTER.size) else None

    def _read_summary(self) -> None:
        """Learn channels, statistics and places of attachments from the summary; nothing where it is not valid."""
        footer = self._footer()
        start, _, crc = _FOOTER.unpack_from(footer, _HEAD.size) if footer else (0, 0, 0)
        size = self.size - len(MAGIC) - len(footer or b"") - start
        if footer is None or not start or not 0 < size <= _MAX_SUMMARY_BYTES:
            return
        section = self.read(start, size)
        if len(section) < size or (crc and zlib.crc32(section + footer[:-_CRC_BYTES]) != crc):
            return
        summary, attachments = _Unpacked(section), list[int]()
        try:
            for record in _records(summary, 0, summary.size):
                body = _content(summary, record)
                if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._define(record.opcode, body)
                elif record.opcode == Opcode.STATISTICS:
                    self._statistics = _parsed(Statistics, body)
                elif record.opcode == Opcode.ATTACHMENT_INDEX and len(attachments) < _MAX_ATTACHMENTS:
                    attachments.append(_parsed(AttachmentIndex, body).offset)
        except RecordError:
            self._types, self._channels, self._statistics = {}, {}, None
            return
        self._attachments = attachments

    def _at(self, offsets: Iterable[int]) -> Iterator[Record]:
        """Yield the records that begin at the offsets."""
        for offset in offsets:
            yield from islice(_records(self, offset, self.size), 1)

    def _attachment(self, record: Record) -> dict[str, bytes]:
        """Return name -> bytes of one attachment, empty where it is malformed, too large or its CRC is wrong."""
        try:
            body = _content(self, record)
            attachment = _parsed(Attachment, body)
        except RecordError:
            return {}
        crc = int.from_bytes(body[-_CRC_BYTES:], "little")
        if (crc and zlib.crc32(body[:-_CRC_BYTES]) != crc) or len(attachment.data) > MAX_ATTACHMENT_BYTES:
            return {}
        return {attachment.name[:_MAX_NAME]: attachment.data}


def ros_name(schema_name: str) -> str:
    """Return package/msg/Type for this, for DDS (sensor_msgs::msg::dds_::Image_) and for ROS 1 (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name


def _records(source: ByteSource, start: int, end: int) -> Iterator[Record]:
    """Yield the records from offset start on, up to the first one that is truncated or does not end before end."""
    offset = start
    while offset + _HEAD.size <= end:
        head = source.read(offset, _HEAD.size)
        if len(head) < _HEAD.size:
            return
        opcode, size = _HEAD.unpack(head)
        offset += _HEAD.size
        if opcode == 0 or size > end - offset:
            return
        yield Record(opcode, offset, size)
        offset += size


def _content(source: ByteSource, record: Record) -> memoryview:
    """Return the content of a record; raise RecordError where it is too large or incomplete."""
    if record.size > MAX_RECORD_BYTES:
        raise RecordError(f"{record.size} bytes are more than {MAX_RECORD_BYTES}")
    data = source.read(record.offset, record.size)
    if len(data) < record.size:
        raise RecordError(f"{len(data)} of {record.size} bytes could be read")
    return memoryview(data)


def _parsed(kind: Any, body: memoryview) -> Any:
    """Return a record of mcap; raise RecordError where it is malformed."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except _PARSE_ERRORS as error:
        raise RecordError(f"a {kind.__name__} record is malformed") from error


def _message_head(source: ByteSource, record: Record) -> tuple[int, int, int, int]:
    """Return channel, sequence, log time and publish time of a message."""
    try:
        return _MESSAGE.unpack(source.read(record.offset, min(record.size, _MESSAGE.size)))
    except struct.error as error:
        raise RecordError(f"a message record of {record.size} bytes is too short") from error


def _unpack(chunk: memoryview) -> _Unpacked:
    """Return the records of a chunk, at most as many bytes as it states; raise RecordError where they are not those."""
    try:
        _, _, size, crc, name_size = _CHUNK.unpack_from(chunk)
        name_end = _CHUNK.size + name_size
        (packed_size,) = _SIZE.unpack_from(chunk, name_end)
    except struct.error as error:
        raise RecordError("the chunk's header is truncated") from error
    if size > MAX_RECORD_BYTES:
        raise RecordError(f"the chunk unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
    packed = chunk[name_end + _SIZE.size :][:packed_size]
    data: bytes | memoryview = packed
    compression = bytes(chunk[_CHUNK.size : name_end][:_MAX_NAME])
    try:
        if compression == b"lz4":
            data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
        elif compression == b"zstd":
            data = zstandard.ZstdDecompressor().stream_reader(packed).read(size)
        elif compression:
            raise RecordError(f"the compression {compression!r} is unknown")
    except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError) as error:
        raise RecordError(f"the chunk does not unpack: {error}") from error
    if len(packed) != packed_size or len(data) != size or (crc and zlib.crc32(data) != crc):
        raise RecordError("the chunk's content does not match its size and CRC")
    return _Unpacked(data)
