"""A bag of ROS 1: how its records are framed and packed, and its index. Format: wiki.ros.org/Bags/Format/2.0.

A record is a header of fields (name=value) and data. The file begins with a record that states where the index is: 0
until the recorder has closed the file, as rosbag renames it from .bag.active then.
"""

from __future__ import annotations

import bz2
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import lz4.frame  # type: ignore[import-untyped]

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
    content,
)
from drivers.logs.log import MAX_RECORD_BYTES, RecordError, widened

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = struct.Struct("<I")
_ENTRY: Final = struct.Struct("<III")  # of an index: seconds, nanoseconds, offset in the chunk
_COUNT: Final = struct.Struct("<II")  # of the description of a chunk: connection, number of messages
_MAX_HEADER_BYTES: Final = 2**16
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_KINDS: Final = {
    _MESSAGE: RecordKind.MESSAGE,
    _INDEX: RecordKind.INDEX,
    _CHUNK: RecordKind.CHUNK,
    _CONNECTION: RecordKind.DEFINITION,
}


class Ros1Bag(ChunkedFile):
    """A Log of one .bag file; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        self._connections: dict[int, Topic] = {}
        self._counts: Counter[int] = Counter()  # by connection
        self._span_ns: tuple[int, int] | None = None
        self._chunk_times: dict[int, int] = {}  # log time of the first message by the begin of the chunk
        super().__init__(path, MAGIC, name)

    def topics(self) -> Mapping[str, str]:
        """Return name -> type, from the index; of a file without one from its first part."""
        return {topic.name: topic.kind for topic in self._connections.values()}

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic by the index, None without it."""
        if not self._has_index:
            return None
        counts = Counter(dict.fromkeys(self.topics(), 0))
        for connection, topic in self._connections.items():
            counts[topic.name] += self._counts[connection]
        return counts

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time by the index; None without it, or without messages."""
        return self._span_ns

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    # The format

    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        offset = start
        while offset + _LENGTH.size <= end:
            begin, size = offset, _length(source, offset)
            offset += _LENGTH.size
            if size > min(end - offset, _MAX_HEADER_BYTES):
                return
            fields, offset = _fields(bytes(source.read(offset, size))), offset + size
            opcode = fields.get(b"op", b"")
            if len(opcode) != 1 or offset + _LENGTH.size > end:
                return
            size, offset = _length(source, offset), offset + _LENGTH.size
            kind, is_cut = _KINDS.get(opcode[0], RecordKind.OTHER), size > end - offset
            if source is self and self._index_begin and begin >= self._index_begin:
                kind = RecordKind.END
            yield Record(kind, begin, offset, size, opcode[0], fields, is_cut)
            if is_cut:
                return
            offset += size

    def _unpack(self, chunk: Record, data: memoryview) -> bytes | memoryview:
        size = _number(chunk, b"size")
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"the chunk unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        compression, unpacked = chunk.fields.get(b"compression"), b""
        try:
            if compression == b"none":
                return data[: size or len(data)]
            if compression == b"bz2":
                unpacked = bz2.BZ2Decompressor().decompress(data, max_length=size)
            elif compression == b"lz4":
                unpacked = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
            else:
                raise RecordError(f"the compression {compression!r} is unknown")
        except (RuntimeError, ValueError, EOFError, OSError, MemoryError) as error:
            raise RecordError(f"the chunk does not unpack: {error}") from error
        if len(unpacked) != size and not chunk.is_cut:
            raise RecordError("the chunk's content does not match its size")
        return unpacked

    def _head(self, source: ByteSource, message: Record) -> MessageHead:
        return MessageHead(_number(message, b"conn"), _time_ns(message, b"time"), message.offset, message.size)

    def _index(self, record: Record) -> tuple[int, Iterator[MessageHead]]:
        connection, body = _number(record, b"conn"), content(self, record.offset, record.size)
        entries = _ENTRY.iter_unpack(body[: len(body) // _ENTRY.size * _ENTRY.size])
        return connection, (MessageHead(connection, sec * 10**9 + nsec, offset) for sec, nsec, offset in entries)

    def _first_ns(self, chunk: Record) -> int:
        return self._chunk_times.get(chunk.begin, -1)

    def _define(self, source: ByteSource, record: Record) -> None:
        if len(self._connections) >= MAX_DEFINITIONS or record.size > MAX_DEFINITION_BYTES:
            raise RecordError(f"more than {MAX_DEFINITIONS} connections, or a large one")
        about = _fields(bytes(content(source, record.offset, record.size)))
        found = record.fields.get(b"topic", b""), about.get(b"type", b"")
        topic, kind = (text[:MAX_NAME].decode("utf-8", "replace") for text in found)
        self._connections[_number(record, b"conn")] = Topic(topic, kind.replace("/", "/msg/", 1), aligned=False)

    def _topic(self, channel: int) -> Topic | None:
        return self._connections.get(channel)

    def _is_closed(self) -> bool:
        return self._has_index

    def _read_index(self) -> bool:
        """Learn connections, and numbers and times of messages, from the records behind the chunks."""
        self._index_begin, self._has_index = 0, False
        try:
            bag = next(self._records(self, self._start, self.size))
            begin = _numbers(bag, b"index_pos", 1, "Q")[0]
            left = _number(bag, b"conn_count") + _number(bag, b"chunk_count")
            if bag.opcode != _BAG or not self._start < begin < self.size:
                return False
            for record in self._records(self, begin, self.size):
                if record.is_cut or not left:
                    break
                left -= 1
                if record.opcode == _CONNECTION:
                    self._define(self, record)
                elif record.opcode == _CHUNK_INFO:
                    self._add_chunk(record)
        except (RecordError, StopIteration, struct.error):
            left = 1
        if left:
            self._counts, self._span_ns, self._chunk_times = Counter(), None, {}
            return False
        self._index_begin = begin
        return True

    def _add_chunk(self, record: Record) -> None:
        """Take note of the description of a chunk."""
        first_ns, last_ns = (_time_ns(record, name) for name in (b"start_time", b"end_time"))
        body = content(self, record.offset, record.size)
        self._chunk_times[_numbers(record, b"chunk_pos", 1, "Q")[0]] = first_ns
        for connection, count in _COUNT.iter_unpack(body[: len(body) // _COUNT.size * _COUNT.size]):
            self._counts[connection] += count
        if len(body) >= _COUNT.size:
            self._span_ns = widened(widened(self._span_ns, first_ns), last_ns)


def _length(source: ByteSource, offset: int) -> int:
    return int.from_bytes(source.read(offset, _LENGTH.size), "little")


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


def _numbers(record: Record, name: bytes, count: int, code: str = "I") -> tuple[int, ...]:
    """Return the numbers in a field of a record; raise RecordError where there are none."""
    try:
        return struct.unpack(f"<{count}{code}", record.fields.get(name, b""))
    except struct.error as error:
        raise RecordError(f"a record has no valid field {name.decode()}") from error


def _number(record: Record, name: bytes) -> int:
    return _numbers(record, name, 1)[0]


def _time_ns(record: Record, name: bytes) -> int:
    seconds, nanoseconds = _numbers(record, name, 2)
    return seconds * 10**9 + nanoseconds
