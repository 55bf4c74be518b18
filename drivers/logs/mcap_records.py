"""The records of an MCAP file, read one at a time from a file or chunk that may be cut, corrupt or hostile.

The `mcap` package's own stream reader believes every length field: a short read passes for a message, and one bad byte
can ask for gigabytes. So records are framed here, each checked against what is really there, and mcap parses the small
ones. Format: mcap.dev/spec, version 0.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from drivers.errors import DriverError

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 256 * 2**20

RECORD_HEADER = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK = struct.Struct("<QQQII")  # first log time, last log time, unpacked size, CRC, length of the compression's name
_SIZE = struct.Struct("<Q")

PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError)

_FOREIGN = {
    b"SQLite f": "an SQLite bag: convert it with `ros2 bag convert` to storage mcap",
    b"#ROSBAG ": "a ROS 1 bag: convert it with `rosbags-convert --dst-storage mcap`",
    b"\x28\xb5\x2f\xfd": "a zstd-compressed file: unpack it with `zstd -d`",
}


class RecordError(Exception):
    """A record's content contradicts itself; the records after it may be whole."""


class ByteSource(Protocol):
    """Bytes with a known end: a file or an unpacked chunk."""

    size: int

    def read(self, at: int, size: int) -> bytes | memoryview:
        """Gives up to size bytes from at."""


class Record(NamedTuple):
    """Where a record's content lies in its source."""

    opcode: int
    at: int
    size: int


class ByteBuffer:
    """A Source of bytes in memory; what it gives are views."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._view = memoryview(data)
        self.size = len(self._view)

    def read(self, at: int, size: int) -> memoryview:
        return self._view[at : at + size]


class LogFile:
    """An opened MCAP file as a Source; raises DriverError where there is none.

    A folder stands for the one .mcap file in it, since that is what `ros2 bag record` makes.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            self.path = _file_in(Path(path))
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size
        try:
            self._refuse_foreign()
        except DriverError:
            self.close()
            raise

    def read(self, at: int, size: int) -> bytes:
        """Up to size bytes from at; nothing after close, nor where the disk fails to deliver."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), at)
        except (OSError, ValueError):
            return b""

    @property
    def closed(self) -> bool:
        return self._file.closed

    def close(self) -> None:
        self._file.close()

    def _refuse_foreign(self) -> None:
        start = self.read(0, len(MAGIC))
        if start == MAGIC:
            return
        found = next((text for magic, text in _FOREIGN.items() if start.startswith(magic)), None)
        found = found or (f"it starts with {start!r}: give a .mcap file" if start else "it is empty: record it again")
        raise DriverError(f"{str(self.path)!r} is not an MCAP log: {found}")


def _file_in(path: Path) -> Path:
    if not path.is_dir():
        if path.exists() and not path.is_file():
            raise DriverError(f"cannot read the log {str(path)!r}: it is no regular file; give a .mcap file")
        return path
    logs = sorted(path.glob("*.mcap"))
    if len(logs) != 1:
        names = ", ".join(log.name for log in logs[:8]) or "none"
        raise DriverError(f"{str(path)!r} is a folder with not one but these .mcap files: {names}; give one file")
    return logs[0]


def records(source: ByteSource, start: int, end: int) -> Iterator[Record]:
    """The records from start on, up to the first one that is cut or does not fit before end."""
    at = start
    while at + RECORD_HEADER.size <= end:
        head = source.read(at, RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            return
        opcode, size = RECORD_HEADER.unpack(head)
        at += RECORD_HEADER.size
        if opcode == 0 or size > end - at:
            return
        yield Record(opcode, at, size)
        at += size


def read_content(source: ByteSource, record: Record) -> memoryview:
    """What the record holds; raises RecordError where that is too much, or not all there."""
    if record.size > MAX_RECORD_BYTES:
        raise RecordError(f"{record.size} bytes are more than {MAX_RECORD_BYTES}")
    data = source.read(record.at, record.size)
    if len(data) < record.size:
        raise RecordError(f"{len(data)} of {record.size} bytes could be read")
    return memoryview(data)


def parser(body: memoryview) -> ReadDataStream:
    """The stream mcap's record classes parse from; they then raise one of PARSE_ERRORS or give what is there."""
    return ReadDataStream(BytesIO(body))


def unpack_chunk(body: memoryview) -> ByteBuffer:
    """The records inside a chunk record; raises RecordError where size or CRC contradict them."""
    try:
        _, _, size, crc, name_size = _CHUNK.unpack_from(body)
        at = _CHUNK.size + name_size
        (packed_size,) = _SIZE.unpack_from(body, at)
    except struct.error as error:
        raise RecordError("the chunk's head is cut") from error
    packed = body[at + _SIZE.size : at + _SIZE.size + packed_size]
    data = _decompress(bytes(body[_CHUNK.size : at][:16]), packed, size)
    if len(packed) != packed_size or len(data) != size or (crc and zlib.crc32(data) != crc):
        raise RecordError("the chunk's content does not match its size and CRC")
    return ByteBuffer(data)


def _decompress(kind: bytes, packed: memoryview, size: int) -> bytes | memoryview:
    """At most size bytes out of packed: the announced size is a limit, not a promise."""
    if size > MAX_RECORD_BYTES:
        raise RecordError(f"the chunk unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
    try:
        if kind == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size))
        if kind == b"zstd":
            return zstandard.ZstdDecompressor().stream_reader(packed).read(size)
    except (RuntimeError, ValueError, EOFError, MemoryError, zstandard.ZstdError) as error:
        raise RecordError(f"the chunk does not unpack: {error}") from error
    if kind:
        raise RecordError(f"the compression {kind!r} is unknown")
    return packed
