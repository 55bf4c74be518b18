"""A bag of ROS 1: how its records are framed and packed, and its index. Format: wiki.ros.org/Bags/Format/2.0.

A record is a header of fields (name=value) and data. The file begins with a record that states where the index is: 0
until the recorder has closed the file, as rosbag renames it from .bag.active then.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import RecordError
from drivers.logs.chunked_file import ByteSource, ChunkedFile, Record, RecordKind, Summary
from drivers.logs.compression import unpack_chunk
from drivers.logs.log import ENTRY, MAX_DEFINITION_BYTES, MAX_DEFINITIONS, MAX_NAME, Entries, Topic

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = struct.Struct("<I")
_ENTRY: Final = np.dtype([(name, "<u4") for name in ("seconds", "nanoseconds", "offset")])  # of an index
_KINDS: Final = {
    2: RecordKind.MESSAGE,
    4: RecordKind.INDEX,
    5: RecordKind.CHUNK,
    6: RecordKind.PLACE,
    7: RecordKind.CHANNEL,
}


class Ros1Bag(ChunkedFile):
    """A LogFile of one .bag file; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, MAGIC, name)

    def _summary(self) -> Summary | None:
        try:
            bag = next(self._records(self, self._start, self.size))
            (begin,) = _numbers(bag, b"index_pos", 1, "Q")
            expected = _number(bag, b"conn_count") + _number(bag, b"chunk_count")
        except (StopIteration, RecordError):
            return None
        if not self._start < begin < self.size:
            return None
        records = [record for record in self._records(self, begin, self.size) if not record.is_cut]
        places = [record for record in records if record.kind is RecordKind.PLACE and b"chunk_pos" in record.fields]
        definitions = [record for record in records if record.kind is RecordKind.CHANNEL]
        found = Summary(definitions, [int.from_bytes(place.fields[b"chunk_pos"], "little") for place in places])
        return found if len(records) >= expected else None

    def _is_whole(self, last: Record) -> bool:
        return last.kind is RecordKind.PLACE

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
            yield Record(_KINDS.get(opcode[0], RecordKind.OTHER), begin, offset, size, fields, is_cut)
            if is_cut:
                return
            offset += size

    def _unpack(self, chunk: Record, data: memoryview) -> ByteSource:
        compression, size = chunk.fields.get(b"compression", b""), _number(chunk, b"size")
        unpacked = unpack_chunk(compression.replace(b"none", b""), data, size or len(data))
        if len(unpacked) != size and not chunk.is_cut:
            raise RecordError("its content does not match its size")
        return ByteSource(unpacked)

    def _plain_begin(self, chunk: Record) -> int:
        return chunk.offset if chunk.fields.get(b"compression") == b"none" else 0

    def _head(self, source: ByteSource, message: Record) -> tuple[int, int, int]:
        seconds, nanoseconds = _numbers(message, b"time", 2)
        return _number(message, b"conn"), seconds * 10**9 + nanoseconds, message.offset

    def _index(self, record: Record, chunk: int) -> Entries:
        body = self.content(record.offset, record.size)
        found = np.frombuffer(body[: len(body) // _ENTRY.itemsize * _ENTRY.itemsize], _ENTRY)
        entries = np.empty(len(found), ENTRY)
        entries["channel"], entries["block"], entries["offset"] = _number(record, b"conn"), chunk, found["offset"]
        entries["time_ns"] = found["seconds"].astype(np.int64) * 10**9 + found["nanoseconds"]
        return entries

    def _define(self, source: ByteSource, record: Record) -> None:
        if len(self.topics) >= MAX_DEFINITIONS or record.size > MAX_DEFINITION_BYTES:
            raise RecordError(f"more than {MAX_DEFINITIONS} connections, or a large one")
        about = _fields(bytes(source.content(record.offset, record.size)))
        found = record.fields.get(b"topic", b""), about.get(b"type", b"")
        topic, kind = (text[:MAX_NAME].decode("utf-8", "replace") for text in found)
        self.topics[_number(record, b"conn")] = Topic(topic, kind.replace("/", "/msg/", 1), aligned=False)


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


def _numbers(record: Record, name: bytes, count: int, code: str = "I") -> tuple[int, ...]:
    """Return the numbers in a field of a record; raise RecordError where there are none."""
    try:
        return struct.unpack(f"<{count}{code}", record.fields.get(name, b""))
    except struct.error as error:
        raise RecordError(f"a record has no valid field {name.decode()}") from error


def _number(record: Record, name: bytes) -> int:
    return _numbers(record, name, 1)[0]
