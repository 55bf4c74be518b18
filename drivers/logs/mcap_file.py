"""MCAP files (mcap.dev/spec, version 0), whole, cut, corrupt or malicious.

They are framed here and not by the package `mcap`, whose readers refuse a file that was cut, end at the first corrupt
chunk, accept a short read as a message and unpack without a bound. That package parses the small records.

No index of a file is used: the head of each message is read where it is. The summary only tells what was defined and
counted in a corrupt chunk.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema, Statistics

from drivers.errors import DriverError, RecordError
from drivers.logs.log import ENTRY, LATEST_NS, MAX_ATTACHMENT_BYTES, MAX_RECORD_BYTES, Entries, LogFile, Topic

MAGIC: Final = b"\x89MCAP0\r\n"
_KEPT_CHUNKS: Final = 4  # that stay unpacked: both cameras, wheels and gyro may have been written one after the other
_NO_CHUNK: Final = 0  # block of a message outside of chunks, whose offset is in the file
_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CHUNK: Final = struct.Struct("<16xQII")  # after two times: unpacked size, CRC, length of the compression's name
_SIZE: Final = struct.Struct("<Q")
_CRC: Final = struct.Struct("<I")
_MESSAGE: Final = struct.Struct("<H4xQ8x")  # channel, log time, without sequence and publish time
# The end of a closed file: head of the footer, start of the summary, CRC of the summary and of what precedes it, magic.
_END: Final = struct.Struct("<BQQ8xI8s")
_FAULTS: Final = (McapError, struct.error, OSError, EOFError, RuntimeError, ValueError, MemoryError, OverflowError)


class _FileBytes:
    """The bytes of a file that had this size when it was opened; those that are gone since then are left out.

    They are read and not mapped: a mapped file that is truncated meanwhile would kill the process.
    """

    def __init__(self, path: Path) -> None:
        self.file = path.open("rb", buffering=0)
        self._size = os.fstat(self.file.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> memoryview:
        begin, end, _ = part.indices(self._size)
        try:
            return memoryview(os.pread(self.file.fileno(), max(0, min(end - begin, MAX_RECORD_BYTES)), begin))
        except (OSError, ValueError):  # a fault of the disk, or it was closed
            return memoryview(b"")


class Record(NamedTuple):
    """A record; the content of one that is cut is shorter."""

    opcode: int
    begin: int  # of the whole record in its source, bytes
    end: int
    content: memoryview


def _records(source: _FileBytes | memoryview, begin: int) -> Iterator[Record]:
    """Yield the records of a file or of an unpacked chunk; the last one may be cut. What is no record ends them."""
    while len(head := source[begin : begin + _HEAD.size]) == _HEAD.size:
        opcode, size = _HEAD.unpack(head)
        if opcode == 0:
            return
        end = begin + _HEAD.size + size
        yield Record(opcode, begin, end, source[begin + _HEAD.size : end])
        begin = end


class McapFile(LogFile):
    """A LogFile of one MCAP file; raises DriverError where it cannot be read."""

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(name)
        self._attached: list[int] = []  # where they begin
        self._types = {0: ""}  # by schema; 0 stands for none
        self._chunk = lru_cache(_KEPT_CHUNKS)(self._unpacked)
        try:
            self._data = _FileBytes(path)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error}") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._data.file.close()

    def entries(self) -> Entries:
        """Return the places of all messages, chunk by chunk."""
        # 1. The summary of a closed file.
        found, end, is_whole = [np.empty(0, ENTRY)], len(MAGIC), False
        summary_at, footer_at = self._summary()
        for record in _records(self._data, summary_at) if summary_at else ():
            with suppress(RecordError):  # then the data has the definition
                self._learn(record)
        # 2. The data. In a file that was not closed, its last chunk may be cut.
        for record in _records(self._data, end):
            is_cut = record.end > len(self._data)
            if is_cut and (record.opcode != Opcode.CHUNK or footer_at):
                break
            end = min(record.end, len(self._data))
            if record.opcode == Opcode.DATA_END:
                is_whole = end == summary_at
                break
            if record.opcode == Opcode.ATTACHMENT:
                self._attached.append(record.begin)
            elif record.opcode == Opcode.CHUNK:
                try:
                    data = self._chunk(record.begin)
                    found.append(self._scanned(_records(data, 0), len(data), record.begin, is_cut=is_cut))
                except RecordError as error:
                    self.faults[record.begin] = f"the chunk at byte {record.begin}: {error}"
            else:
                found.append(self._scanned([record], record.end, _NO_CHUNK))
        if not is_whole:
            used = ": used the data before" if any(map(len, found)) else ""
            self.cut = f"the log {self.name!r} is cut or corrupt after byte {end} of {len(self._data)}{used}"
        return np.concatenate(found)

    def read(self, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are gone."""
        if block != _NO_CHUNK:
            return next(_records(self._chunk(block), offset)).content[_MESSAGE.size :]
        record = self._record(offset)
        if len(record.content) != record.end - offset - _HEAD.size:
            raise RecordError(f"the record at byte {offset}: it is not whole")
        return record.content[_MESSAGE.size :]

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments that are valid and within the limit."""
        found: dict[str, bytes] = {}
        for begin in self._attached:
            with suppress(RecordError):
                if _CRC.size < len(content := self._record(begin).content) <= MAX_ATTACHMENT_BYTES:
                    attachment, (crc,) = _parsed(Attachment, content), _CRC.unpack(content[-_CRC.size :])
                    if crc in (0, zlib.crc32(content[: -_CRC.size])):
                        found[attachment.name] = attachment.data
        return found

    def _summary(self) -> tuple[int, int]:
        """Return where the summary and the footer begin, which is one place without a summary; 0, 0 of a cut file.

        The first one is 0 where the summary is not valid.
        """
        at = len(self._data) - _END.size
        if at <= 0 or len(end := self._data[at:]) != _END.size:
            return 0, 0
        opcode, size, start, crc, magic = _END.unpack(end)
        if (opcode, size, magic) != (Opcode.FOOTER, _END.size - _HEAD.size - len(MAGIC), MAGIC):
            return 0, 0
        start = start or at
        is_valid = start <= at and crc in (0, zlib.crc32(self._data[start : -len(MAGIC) - _CRC.size]))
        return start if is_valid else 0, at

    def _record(self, begin: int) -> Record:
        """Return a record of the file; raise RecordError where it is gone."""
        if (record := next(_records(self._data, begin), None)) is None:
            raise RecordError(f"the record at byte {begin}: it cannot be read")
        return record

    def _unpacked(self, begin: int) -> memoryview:
        """Return the content of a chunk; raise RecordError where it is not the one that was written."""
        record = self._record(begin)
        try:
            size, crc, name_bytes = _CHUNK.unpack_from(record.content)
            at = _CHUNK.size + name_bytes + _SIZE.size
            (packed_bytes,) = _SIZE.unpack_from(record.content, at - _SIZE.size)
        except struct.error as error:
            raise RecordError("it is too short") from error
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"it unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        packed, compression = record.content[at:][:packed_bytes], bytes(record.content[_CHUNK.size : at - _SIZE.size])
        # One byte more than stated shows that there are more.
        try:
            if compression == b"lz4":
                data = memoryview(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
            elif compression == b"zstd":
                data = memoryview(zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1))
            elif compression:
                raise RecordError(f"its compression {compression!r} is unknown")
            else:
                data = packed
        except (*_FAULTS, zstandard.ZstdError) as error:
            raise RecordError(f"it does not unpack: {error}") from error
        is_whole = len(packed) == packed_bytes and len(data) == size and crc in (0, zlib.crc32(data))
        if not is_whole and record.end <= len(self._data):
            raise RecordError("its content does not match its size and CRC")
        return data

    def _scanned(self, records: Iterable[Record], size: int, block: int, *, is_cut: bool = False) -> Entries:
        """Return the entries of the messages among records, and learn what the others define.

        size: where the last one ends. is_cut: the last one need not be whole.
        """
        found, at = [], 0
        for record in records:
            if record.end > size:
                break
            at = record.end
            try:
                if record.opcode != Opcode.MESSAGE:
                    self._learn(record)
                    continue
                if len(record.content) < _MESSAGE.size:
                    raise RecordError("it is too short")
                channel, time_ns = _MESSAGE.unpack_from(record.content)
                header_ns = self.header_ns(channel, record.content[_MESSAGE.size :])
                found.append((channel, min(time_ns, LATEST_NS), header_ns, block, record.begin))
            except RecordError as error:
                self.faults.setdefault(block or record.begin, f"the record at byte {record.begin}: {error}")
        if at != size and not is_cut:
            self.faults.setdefault(block, f"the chunk at byte {block}: its last record is not whole")
        return np.array(found, ENTRY)

    def _learn(self, record: Record) -> None:
        """Add a channel, a schema or the counts of messages."""
        if record.opcode == Opcode.STATISTICS:
            self.stated.update(_parsed(Statistics, record.content).channel_message_counts)
        elif record.opcode == Opcode.SCHEMA:
            found = _parsed(Schema, record.content)
            self._types.setdefault(found.id, _ros_name(found.name))
        elif record.opcode == Opcode.CHANNEL:
            found = _parsed(Channel, record.content)
            if found.schema_id not in self._types:
                raise RecordError(f"the schema {found.schema_id} of the channel {found.id} is unknown")
            kind = self._types[found.schema_id] if found.message_encoding in ("cdr", "ros1") else ""
            self.topics.setdefault(found.id, Topic(found.topic, kind, found.message_encoding != "ros1"))


def _ros_name(schema_name: str) -> str:
    """Return package/msg/Type for this, for DDS (sensor_msgs::msg::dds_::Image_) and for ROS 1 (sensor_msgs/Image)."""
    parts = [part for part in re.split(r"/|::", schema_name) if part not in ("msg", "dds_")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else schema_name


def _parsed(kind: Any, content: memoryview) -> Any:
    """Return a record of mcap; raise RecordError where it is malformed."""
    try:
        return kind.read(ReadDataStream(BytesIO(content)))
    except _FAULTS as error:
        raise RecordError(f"a {kind.__name__} record is malformed") from error
