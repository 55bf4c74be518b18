"""The images of a bag of ROS 1 (.bag, format 2.0), complete, damaged or without an index, in the order of the file.

Records are framed here, as those of MCAP are: each length is checked against the file, each chunk unpacks to a bounded
size, and a bag that was never closed can be read. Format: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]

from drivers.errors import DriverError
from drivers.logs.image_log import LogDamage, LoggedImage, LoggedMotion, logged_message
from drivers.logs.mcap_catalog import ros_name
from drivers.logs.mcap_records import MAX_RECORD_BYTES, RecordError

MAGIC: Final = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7  # field op of a record's header
_SCAN_BYTES: Final = 64 * 2**20  # Topics of a bag without index are searched in its first bytes, up to this number.
_MAX_HEADER_BYTES: Final = 2**16
_MAX_DEFINITION_BYTES: Final = 2**20
_MAX_TOPICS: Final = 4096
_MAX_NAME: Final = 256
_LENGTH, _POSITION, _TIME, _COUNT = (struct.Struct(code) for code in ("<I", "<Q", "<II", "<II"))
_PARSE_ERRORS: Final = (KeyError, ValueError, struct.error, IndexError)

Fields = Mapping[str, bytes]


class _Record(NamedTuple):
    """A record: the fields of its header, and the position of its data."""

    fields: Fields
    offset: int  # bytes
    size: int  # bytes

    @property
    def op(self) -> int:
        """The kind of the record; 0 where it is not stated."""
        return int.from_bytes(self.fields.get("op", b"")[:1], "little")


class _Source:
    """Bytes of known size: the file, or an unpacked chunk."""

    def __init__(self, data: BinaryIO | bytes) -> None:
        self._data = data
        self.size = len(data) if isinstance(data, bytes) else os.fstat(data.fileno()).st_size

    def read(self, offset: int, size: int) -> bytes:
        """Return up to size bytes from offset; none after the file was closed, or where the disk fails."""
        if isinstance(self._data, bytes):
            return self._data[offset : offset + size]
        try:
            return os.pread(self._data.fileno(), size, offset)
        except (OSError, ValueError):
            return b""

    def records(self, start: int) -> Iterator[_Record]:
        """Yield the records from offset start on, up to the first one that is not complete."""
        offset = start
        while True:
            header_size = self._length(offset)
            if header_size is None or header_size > _MAX_HEADER_BYTES:
                return
            header = self.read(offset + _LENGTH.size, header_size)
            size = self._length(offset + _LENGTH.size + header_size)
            offset += 2 * _LENGTH.size + header_size
            if len(header) < header_size or size is None or size > self.size - offset:
                return
            yield _Record(_fields(header), offset, size)
            offset += size

    def _length(self, offset: int) -> int | None:
        data = self.read(offset, _LENGTH.size)
        return int(_LENGTH.unpack(data)[0]) if len(data) == _LENGTH.size else None


class Ros1Bag:
    """An ImageLog of one .bag file; raises DriverError where it cannot be opened."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the bag {self.name!r}: {error.strerror}") from error
        self._source = _Source(self._file)
        self._damage = LogDamage()
        self._topics: dict[int, tuple[str, str]] = {}  # connection -> name, type
        self._counts = self._read_index()
        if self._counts is None:
            self._scan()

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of all topics; of a bag without index those of its first 64 MiB."""
        return dict(self._topics.values())

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None without an index."""
        if self._counts is None:
            return None
        total = Counter[str]()
        for connection, (name, _) in self._topics.items():
            total[name] += self._counts[connection]
        return total

    def messages(self) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the messages in the order of the file."""
        broken, end = 0, len(MAGIC)
        for record in self._source.records(len(MAGIC)):
            end = record.offset + record.size
            try:
                yield from self._of(record, self._source)
            except RecordError:
                broken += 1
            if self._file.closed:
                return
        complete = self._counts is not None and end == self._source.size
        self._damage = LogDamage(
            broken,
            ""
            if complete
            else f"the bag {self.name!r} is cut or was not closed: used the first {end} of its "
            f"{self._source.size} bytes",
        )

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _of(self, record: _Record, source: _Source) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the messages of a record: a message or a chunk; remember the connections."""
        if record.op == _CONNECTION:
            self._add(record, source)
        elif record.op == _CHUNK and source is self._source:
            chunk = _Source(_unpack(record, source))
            for inner in chunk.records(0):
                yield from self._of(inner, chunk)
        elif record.op == _MESSAGE:
            yield from self._message(record, source)

    def _message(self, record: _Record, source: _Source) -> Iterator[LoggedImage | LoggedMotion]:
        try:
            name, kind = self._topics.get(_number(record.fields["conn"]), ("", ""))
            seconds, nanoseconds = _TIME.unpack(record.fields["time"])
        except _PARSE_ERRORS as error:
            raise RecordError("a message record is malformed") from error
        time_ns = seconds * 10**9 + nanoseconds
        logged = logged_message(name, kind, time_ns, partial(_data, source, record), aligned=False)
        if logged is not None:
            yield logged

    def _add(self, record: _Record, source: _Source) -> None:
        try:
            connection = _number(record.fields["conn"])
            name = record.fields["topic"][:_MAX_NAME].decode("utf-8", "replace")
            details = _fields(source.read(record.offset, min(record.size, _MAX_DEFINITION_BYTES)))
            kind = ros_name(details["type"][:_MAX_NAME].decode("utf-8", "replace"))
        except _PARSE_ERRORS as error:
            raise RecordError("a connection record is malformed") from error
        if len(self._topics) < _MAX_TOPICS:
            self._topics.setdefault(connection, (name, kind))

    def _read_index(self) -> Counter[int] | None:
        """Read the connections at the end of a bag; return the messages of each, None of a bag without an index."""
        first = next(self._source.records(len(MAGIC)), None)
        counts = Counter[int]()
        try:
            if first is None or first.op != _BAG:
                return None
            (position,) = _POSITION.unpack(first.fields["index_pos"])
            if not len(MAGIC) < position < self._source.size:
                return None
            for record in self._source.records(position):
                if record.op == _CONNECTION:
                    self._add(record, self._source)
                elif record.op == _CHUNK_INFO:
                    data = self._source.read(record.offset, min(record.size, _MAX_HEADER_BYTES))
                    counts.update(dict(_COUNT.iter_unpack(data[: len(data) // _COUNT.size * _COUNT.size])))
        except (RecordError, *_PARSE_ERRORS):
            return None
        return counts if self._topics else None

    def _scan(self) -> None:
        """Find the connections at the start of a bag without an index."""
        for record in self._source.records(len(MAGIC)):
            if record.offset > _SCAN_BYTES:
                return
            try:
                for _ in self._of(record, self._source):
                    pass
            except RecordError:
                continue


def _fields(header: bytes) -> dict[str, bytes]:
    """Return the fields `name=value` of a header, up to the first one that is not complete."""
    found: dict[str, bytes] = {}
    offset = 0
    while offset + _LENGTH.size <= len(header):
        (size,) = _LENGTH.unpack_from(header, offset)
        offset += _LENGTH.size
        name, equals, value = header[offset : offset + size].partition(b"=")
        if not equals or size > len(header) - offset:
            return found
        found[name.decode("ascii", "replace")] = value
        offset += size
    return found


def _number(field: bytes) -> int:
    return int(_LENGTH.unpack(field)[0])


def _unpack(record: _Record, source: _Source) -> bytes:
    """Return the records of a chunk; raise RecordError where they do not unpack to the size that it states."""
    if record.size > MAX_RECORD_BYTES:
        raise RecordError(f"a chunk of {record.size} bytes is larger than {MAX_RECORD_BYTES}")
    packed = source.read(record.offset, record.size)
    try:
        size, compression = _number(record.fields["size"]), record.fields["compression"]
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"a chunk unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        if compression == b"bz2":
            packed = bz2.BZ2Decompressor().decompress(packed, max_length=size)
        elif compression == b"lz4":
            packed = bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
    except (*_PARSE_ERRORS, OSError, EOFError, RuntimeError, MemoryError) as error:
        raise RecordError(f"a chunk does not unpack: {error}") from error
    if len(packed) != size:
        raise RecordError(f"a chunk has {len(packed)} of {size} bytes")
    return packed


def _data(source: _Source, record: _Record) -> memoryview:
    data = source.read(record.offset, record.size) if record.size <= MAX_RECORD_BYTES else b""
    if len(data) < record.size:
        raise RecordError(f"{len(data)} of {record.size} bytes could be read")
    return memoryview(data)
