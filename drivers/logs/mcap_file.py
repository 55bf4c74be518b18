"""MCAP files (mcap.dev/spec, version 0), whole, cut, corrupt or malicious.

They are framed here and not by the package `mcap`, whose readers refuse a file that was cut, end at the first corrupt
chunk, accept a short read as a message and unpack without a bound. That package parses the records but messages.

No index or summary of a file is used: the head of each message is read where it is.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Schema

from drivers.errors import DriverError, RecordError
from drivers.logs.log import ENTRY, KEPT_CHUNKS, LATEST_NS, MAX_RECORD_BYTES, Entries, LogFile, Topic

MAGIC: Final = b"\x89MCAP0\r\n"
_HEAD: Final = struct.Struct("<BQ")  # of a record: opcode, length of the content
_CRC: Final = struct.Struct("<I")
_MESSAGE: Final = struct.Struct("<H4xQ8x")  # channel, log time, without sequence and publish time
_FAULTS: Final = (McapError, struct.error, OSError, EOFError, RuntimeError, ValueError, MemoryError, OverflowError)


def _read(source: BinaryIO, begin: int, size: int) -> bytes:
    """Return the bytes from a place on, fewer where they are gone: a file may be truncated or closed meanwhile.

    They are read and not mapped: a mapped file that is truncated would kill the process.
    """
    try:
        source.seek(begin)
        return source.read(max(0, min(size, MAX_RECORD_BYTES)))
    except (OSError, ValueError):
        return b""


class _Record(NamedTuple):
    """A record in a file or in an unpacked chunk."""

    opcode: int
    begin: int  # of the whole record, bytes
    end: int
    source: BinaryIO

    def content(self) -> memoryview:
        """Return the content; raise RecordError where it is not whole."""
        size = self.end - self.begin - _HEAD.size
        if len(found := _read(self.source, self.begin + _HEAD.size, size)) != size:
            raise RecordError(f"the record at byte {self.begin}: it is not whole")
        return memoryview(found)

    def parsed(self, kind: Any) -> Any:
        """Return it as a record of mcap; raise RecordError where it is malformed."""
        try:
            return kind.read(ReadDataStream(BytesIO(self.content())))
        except _FAULTS as error:
            raise RecordError(f"a {kind.__name__} record is malformed") from error


def _records(source: BinaryIO, begin: int = 0) -> Iterator[_Record]:
    """Yield the records of a file or of a chunk; the last one may be longer than is left. What is none ends them."""
    while len(head := _read(source, begin, _HEAD.size)) == _HEAD.size and head[0]:
        opcode, size = _HEAD.unpack(head)
        yield _Record(opcode, begin, begin + _HEAD.size + size, source)
        begin += _HEAD.size + size


class McapFile(LogFile):
    """A LogFile of one MCAP file; raises DriverError where it cannot be read."""

    magic = MAGIC

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._attached: list[_Record] = []
        self._types = {0: ""}  # by schema; 0 stands for none
        self._chunk = lru_cache(KEPT_CHUNKS)(self._unpacked)
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error}") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def entries(self) -> Entries:
        """Return the places of all messages: of those in chunks the block is where the chunk begins, else 0."""
        # 1. The records of the file, up to the first one that was cut.
        blocks, has_end, end, size = list[_Record](), False, len(MAGIC), os.fstat(self._file.fileno()).st_size
        for record in _records(self._file, end):
            if record.end > size:
                break
            end = record.end
            has_end |= record.opcode == Opcode.DATA_END
            if record.opcode == Opcode.ATTACHMENT:
                self._attached.append(record)
            elif not has_end:  # the summary follows the end of the data
                blocks.append(record)
        is_closed = has_end and _read(self._file, size - len(MAGIC), len(MAGIC)) == MAGIC
        # 2. What they define, and the messages.
        found = [np.empty(0, ENTRY)]
        for record in blocks:
            try:
                is_chunk = record.opcode == Opcode.CHUNK
                records = _records(self._chunk(record.begin)) if is_chunk else [record]
                found.append(self._scanned(records, record.begin * is_chunk))
            except RecordError as error:
                self.faults[record.begin] = f"the chunk at byte {record.begin}: {error}"
        if not is_closed:
            used = ": used the data before" if any(map(len, found)) else ""
            self.cut = f"the log {self.name!r} is cut or corrupt after byte {end} of {size}{used}"
        return np.concatenate(found)

    def read(self, channel: int, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are gone."""
        return self._record(self._chunk(block) if block else self._file, offset).content()[_MESSAGE.size :]

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments that are valid."""
        found: dict[str, bytes] = {}
        for record in self._attached:
            with suppress(RecordError):
                attachment, content = record.parsed(Attachment), record.content()
                if content[-_CRC.size :] in (bytes(_CRC.size), _CRC.pack(zlib.crc32(content[: -_CRC.size]))):
                    found[attachment.name] = attachment.data
        return found

    def _record(self, source: BinaryIO, begin: int) -> _Record:
        """Return a record; raise RecordError where it is gone."""
        if (record := next(_records(source, begin), None)) is None:
            raise RecordError(f"the record at byte {begin}: it cannot be read")
        return record

    def _unpacked(self, begin: int) -> BinaryIO:
        """Return the content of a chunk; raise RecordError where it is not the one that was written."""
        chunk: Chunk = self._record(self._file, begin).parsed(Chunk)
        size, packed = chunk.uncompressed_size, chunk.data
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"it unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        # One byte more than stated shows that there are more.
        try:
            if chunk.compression == "lz4":
                packed = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            elif chunk.compression == "zstd":
                packed = zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1)
            elif chunk.compression:
                raise RecordError(f"its compression {chunk.compression!r} is unknown")
        except (*_FAULTS, zstandard.ZstdError) as error:
            raise RecordError(f"it does not unpack: {error}") from error
        if len(packed) != size or chunk.uncompressed_crc not in (0, zlib.crc32(packed)):
            raise RecordError("its content does not match its size and CRC")
        return BytesIO(packed)

    def _scanned(self, records: Iterable[_Record], block: int) -> Entries:
        """Return the entries of the messages among records, and learn what the others define."""
        found = []
        for record in records:
            try:
                if record.opcode != Opcode.MESSAGE:
                    self._learn(record)
                    continue
                content = record.content()
                if len(content) < _MESSAGE.size:
                    raise RecordError("it is too short")
                channel, time_ns = _MESSAGE.unpack_from(content)
                header_ns = self.header_ns(channel, content[_MESSAGE.size :])
                found.append((channel, min(time_ns, LATEST_NS), header_ns, block, record.begin))
            except RecordError as error:
                self.faults.setdefault(block or record.begin, f"the record at byte {record.begin}: {error}")
        return np.array(found, ENTRY)

    def _learn(self, record: _Record) -> None:
        """Add a channel or a schema; raise RecordError where it is malformed."""
        if record.opcode == Opcode.SCHEMA:
            found = record.parsed(Schema)
            self._types.setdefault(found.id, found.name)
        elif record.opcode == Opcode.CHANNEL:
            found = record.parsed(Channel)
            if found.schema_id not in self._types:
                raise RecordError(f"the schema {found.schema_id} of the channel {found.id} is unknown")
            kind = self._types[found.schema_id] if found.message_encoding == "cdr" else ""
            self.topics.setdefault(found.id, Topic(found.topic, kind))
