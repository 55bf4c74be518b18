"""A bag of ROS 1: how its records are framed and packed, and its index. Format: wiki.ros.org/Bags/Format/2.0.

A record is a header of fields (name=value) and data. The file begins with a record that states where the index is: 0
until the recorder has closed the file, as rosbag renames it from .bag.active then.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

from drivers.errors import RecordError
from drivers.logs.log import MAX_DEFINITION_BYTES, MAX_DEFINITIONS, MAX_NAME, Topic
from drivers.logs.record_file import ByteSource, Kind, Packing, Record, RecordFile

MAGIC: Final = b"#ROSBAG V2.0\n"

_LENGTH: Final = struct.Struct("<I")
_KINDS: Final = {2: Kind.MESSAGE, 5: Kind.CHUNK, 6: Kind.PLACE, 7: Kind.CHANNEL}


class Ros1Bag(RecordFile):
    """A LogFile of one .bag file; raises DriverError where it cannot be read."""

    magic = MAGIC

    def _summary_at(self) -> int | None:
        try:
            bag = next(self._records(self, len(MAGIC), self.size))
            begin = _field(bag, b"index_pos", "<Q")[0]
            expected = _field(bag, b"conn_count")[0] + _field(bag, b"chunk_count")[0]
        except (StopIteration, RecordError):
            return None
        if not len(MAGIC) < begin < self.size:
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
            yield Record(_KINDS.get(opcode[0], Kind.OTHER), begin, offset, size, fields, is_cut)
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
