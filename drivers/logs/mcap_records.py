"""The records of an MCAP file, read one at a time from a file or chunk that may be truncated, corrupt or malicious.

The `mcap` package's own stream reader trusts every length field: it accepts a short read as a message, and one wrong
byte can make it allocate gigabytes. So records are framed here, each length is checked against the size of the source,
and mcap parses the small ones. Format: mcap.dev/spec, version 0.
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

RECORD_HEADER = struct.Struct("<BQ")  # opcode, length of the content
_CHUNK = struct.Struct("<QQQII")  # first log time, last log time, unpacked size, CRC, length of the compression's name
_SIZE = struct.Struct("<Q")
_MAX_COMPRESSION_NAME = 16  # bytes
_MAX_LISTED = 8  # files in an error message

PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError)

_CONVERT = "convert it with `rosbags-convert --src {} --dst NEW_FOLDER --dst-storage mcap`, which comes with omnid"
_OTHER_FORMATS = {  # first bytes -> advice
    b"SQLite f": f"part of an SQLite bag: {_CONVERT.format('ITS_FOLDER')}",
    b"#ROSBAG ": f"a ROS 1 bag: {_CONVERT.format('FILE')}",
    b"\x28\xb5\x2f\xfd": "a zstd-compressed file: unpack it with `zstd -d`",
    b"\x1f\x8b": "a gzip-compressed file: unpack it with `gzip -d`, or `tar -xf` where it is an archive",
    b"PK\x03\x04": "a zip archive: unpack it with `unzip`",
}


class RecordError(Exception):
    """A record with invalid content; the records after it may be valid."""


class ByteSource(Protocol):
    """Bytes of known size: a file or a decompressed chunk."""

    size: int

    def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return up to size bytes from offset."""


class Record(NamedTuple):
    """Position of a record's content in its source."""

    opcode: int
    offset: int  # bytes
    size: int  # bytes


class ByteBuffer:
    """A ByteSource in memory; it returns views."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._view = memoryview(data)
        self.size = len(self._view)

    def read(self, offset: int, size: int) -> memoryview:
        """Return up to size bytes from offset."""
        return self._view[offset : offset + size]


class LogFile:
    """An open MCAP file as a ByteSource; raises DriverError where the path is no MCAP file.

    path: the file, or a folder with one .mcap file in it, as `ros2 bag record` makes it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        try:
            self.path = _file_in(Path(path))
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size
        try:
            self._require_magic()
        except DriverError:
            self.close()
            raise

    def read(self, offset: int, size: int) -> bytes:
        """Return up to size bytes from offset; none after close, or where the disk fails."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), offset)
        except (OSError, ValueError):
            return b""

    @property
    def closed(self) -> bool:
        """True after close."""
        return self._file.closed

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def _require_magic(self) -> None:
        """Raise DriverError, with advice for known formats, where the file does not start as an MCAP file."""
        start = self.read(0, len(MAGIC))
        if start == MAGIC:
            return
        reason = f"it starts with {start!r}: give a .mcap file" if start else "it is empty: record it again"
        for magic, advice in _OTHER_FORMATS.items():
            if start.startswith(magic):
                reason = advice
        raise DriverError(f"{str(self.path)!r} is not an MCAP log: {reason}")


def _file_in(path: Path) -> Path:
    """Return the file, or the only .mcap file of a folder; raise DriverError otherwise."""
    if not path.is_dir():
        if path.exists() and not path.is_file():
            raise DriverError(f"cannot read the log {str(path)!r}: it is no regular file; give a .mcap file")
        return path
    logs = sorted(path.glob("*.mcap"))
    if not logs and any(path.glob("*.db3")):
        raise DriverError(f"{str(path)!r} is an SQLite bag: {_CONVERT.format(path)}")
    if len(logs) != 1:
        names = ", ".join(log.name for log in logs[:_MAX_LISTED]) or "none"
        raise DriverError(f"{str(path)!r} must contain exactly one .mcap file; found: {names}; give one file")
    return logs[0]


def records(source: ByteSource, start: int, end: int) -> Iterator[Record]:
    """Yield the records from offset start on, up to the first one that is truncated or does not end before end."""
    offset = start
    while offset + RECORD_HEADER.size <= end:
        head = source.read(offset, RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size:
            return
        opcode, size = RECORD_HEADER.unpack(head)
        offset += RECORD_HEADER.size
        if opcode == 0 or size > end - offset:
            return
        yield Record(opcode, offset, size)
        offset += size


def read_content(source: ByteSource, record: Record) -> memoryview:
    """Read the content of a record; raise RecordError where it is too large or incomplete."""
    if record.size > MAX_RECORD_BYTES:
        raise RecordError(f"{record.size} bytes are more than {MAX_RECORD_BYTES}")
    data = source.read(record.offset, record.size)
    if len(data) < record.size:
        raise RecordError(f"{len(data)} of {record.size} bytes could be read")
    return memoryview(data)


def parser(body: memoryview) -> ReadDataStream:
    """Return the stream that mcap's record classes parse; these raise one of PARSE_ERRORS for invalid content."""
    return ReadDataStream(BytesIO(body))


def unpack_chunk(body: memoryview) -> ByteBuffer:
    """Decompress the records of a chunk; raise RecordError where its size or CRC is wrong."""
    try:
        _, _, size, crc, name_size = _CHUNK.unpack_from(body)
        name_end = _CHUNK.size + name_size
        (packed_size,) = _SIZE.unpack_from(body, name_end)
    except struct.error as error:
        raise RecordError("the chunk's header is truncated") from error
    start = name_end + _SIZE.size
    packed = body[start : start + packed_size]
    data = _decompress(bytes(body[_CHUNK.size : name_end][:_MAX_COMPRESSION_NAME]), packed, size)
    if len(packed) != packed_size or len(data) != size or (crc and zlib.crc32(data) != crc):
        raise RecordError("the chunk's content does not match its size and CRC")
    return ByteBuffer(data)


def records_of_chunk(source: ByteSource, chunk: Record) -> Iterator[tuple[ByteBuffer, Record]]:
    """Yield the records of a chunk, each with the source that it is in.

    Raise RecordError where the chunk does not unpack, and at its end where the last record is not whole.
    """
    unpacked, end = unpack_chunk(read_content(source, chunk)), 0
    for record in records(unpacked, 0, unpacked.size):
        end = record.offset + record.size
        yield unpacked, record
    if end != unpacked.size:
        raise RecordError("the last record of a chunk is not whole")


def _decompress(kind: bytes, packed: memoryview, size: int) -> bytes | memoryview:
    """Decompress at most size bytes, the size that the chunk states, whatever the data contains."""
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
