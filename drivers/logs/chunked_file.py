"""A file of records, most of which are packed in chunks, whole, cut, corrupt or malicious: MCAP files and ROS 1 bags.

Both formats are framed here and not by their libraries, whose readers refuse a file that was cut, end at the first
corrupt chunk, accept a short read as a message and unpack without a bound.

The index behind a chunk says where its messages are; a chunk without one is unpacked to see. A message is read where
the index says, and must be of the channel and the time that the index says.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum, auto
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES
from drivers.logs.log import ENTRY, MAX_DEFINITIONS, Entries, Topic

_KEPT_CHUNKS: Final = 4  # that stay unpacked: both cameras, wheels and gyro may have been written one after the other
_NO_CHUNK: Final = 0  # block of a message outside of chunks, whose offset is in the file


class RecordKind(Enum):
    """What a record is for the reader."""

    CHUNK = auto()
    INDEX = auto()  # of the chunk before it
    MESSAGE = auto()
    SCHEMA = auto()
    CHANNEL = auto()
    ATTACHMENT = auto()
    END = auto()  # of chunks and messages
    PLACE = auto()  # of a chunk, behind that end
    OTHER = auto()


_DEFINITIONS: Final = (RecordKind.SCHEMA, RecordKind.CHANNEL)
_ENDS: Final = (RecordKind.END, RecordKind.PLACE)


class Record(NamedTuple):
    """Position of a record's content in its source."""

    kind: RecordKind
    begin: int  # of the whole record, bytes
    offset: int  # of its content
    size: int  # of its content
    fields: Mapping[bytes, bytes] = {}  # of a bag's record
    is_cut: bool = False  # the source ends within the content


class Summary(NamedTuple):
    """What a closed file states behind its data; nothing where that is corrupt."""

    definitions: Sequence[Record] = ()
    chunks: Sequence[int] = ()  # where they begin


class ByteSource:
    """Bytes of known size: an unpacked chunk."""

    def __init__(self, data: bytes | memoryview) -> None:
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


class ChunkedFile(ByteSource, ABC):
    """A LogFile, and the source of its bytes. A format states how records are framed, packed and read."""

    is_indexed = True

    def __init__(self, path: Path, magic: bytes, name: str) -> None:
        """Open the file, which begins with `magic`; raise DriverError where it cannot be read.

        name: for messages, where it is not the path.
        """
        super().__init__(b"")
        self.name, self._start, self.cut = name, len(magic), ""
        self.topics: dict[int, Topic] = {}
        self.faults: Counter[str] = Counter()
        self._attached: list[Record] = []
        self._indexed: dict[int, int] = {}  # number of messages of a chunk by its index
        self._named: set[int] = set()  # channels that are in an index
        self._chunks: dict[int, tuple[ByteSource, Entries]] = {}  # the last ones that were unpacked
        self._plain: dict[int, int] = {}  # by chunk: `_plain_begin`
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size

    # What a format states

    @abstractmethod
    def _summary(self) -> Summary | None:
        """Return what the writer has stated at the end of the file; None where it has not closed the file."""

    @abstractmethod
    def _is_whole(self, last: Record) -> bool:
        """True if a closed file is complete, of which this is the record that ends the data, or the last one found."""

    @abstractmethod
    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        """Yield the records from offset start on; the last one may be cut. What is no record ends them."""

    @abstractmethod
    def _unpack(self, chunk: Record, data: memoryview) -> ByteSource:
        """Return the records of a chunk; raise RecordError where they are not those that were written.

        Of a chunk that is cut, return the first of them.
        """

    @abstractmethod
    def _plain_begin(self, chunk: Record) -> int:
        """Return where in the file the records of a chunk begin, 0 where they are compressed."""

    @abstractmethod
    def _head(self, source: ByteSource, message: Record) -> tuple[int, int, int]:
        """Return channel, time [ns] and offset of the data of a message; raise RecordError where it is malformed."""

    @abstractmethod
    def _index(self, record: Record, chunk: int) -> Entries:
        """Return the entries of an index of the chunk that begins there; raise RecordError."""

    @abstractmethod
    def _define(self, source: ByteSource, record: Record) -> None:
        """Learn a channel or a schema; raise RecordError where it is malformed or exceeds the limits."""

    # The LogFile

    def read_bytes(self, offset: int, size: int) -> bytes:
        """Return up to size bytes of the file from offset; none after close, or where the disk fails."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), offset)
        except (OSError, ValueError):
            return b""

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def attachments(self) -> dict[str, bytes]:
        """Return none: a format may have no attachments."""
        return {}

    def entries(self) -> Iterator[Entries]:
        """Yield the places of all messages, chunk by chunk."""
        summary = self._summary()
        for record in summary.definitions if summary else ():
            with suppress(RecordError):  # then the data has the definition
                self._define(self, record)
        chunk: Record | None = None  # the newest one, and the index behind it
        index, last = list[Record](), Record(RecordKind.OTHER, 0, 0, self._start)
        for record in self._with_jumps(summary):
            last = record
            if record.kind is RecordKind.INDEX:
                index.append(record)
                continue
            if chunk is not None:
                yield self._of_chunk(chunk, index)
            chunk, index = (record if record.kind is RecordKind.CHUNK else None), []
            if record.kind is RecordKind.ATTACHMENT and len(self._attached) < MAX_DEFINITIONS:
                self._attached.append(record)
            elif chunk is None:
                yield self._scanned(self, [record], _NO_CHUNK, is_cut=True)
        is_whole = summary is not None and self._is_whole(last)
        if chunk is not None:
            yield self._of_chunk(chunk, index if is_whole else [])
        # Channels that are defined nowhere else are defined in chunks.
        for begin in self._indexed:
            if self._named <= self.topics.keys():
                break
            with suppress(RecordError):  # which is reported when the chunk is read
                self._chunk(begin)
        if not is_whole:
            end = min(last.offset + last.size, self.size)
            self.cut = f"the log {self.name!r} is cut or corrupt after byte {end} of {self.size}: used the data before"

    def _with_jumps(self, summary: Summary | None) -> Iterator[Record]:
        """Yield the records up to the end of the data, and behind holes in the file those from the next chunk on."""
        places, begin = sorted(summary.chunks) if summary else [], self._start
        while begin:
            end = begin
            for record in self._records(self, begin, self.size):
                # A length that exceeds a file which was closed is a corrupt one; in another, its last chunk is cut.
                if record.is_cut and (record.kind is not RecordKind.CHUNK or summary):
                    break
                yield record
                if record.kind in _ENDS:
                    return
                end = record.offset + record.size
            begin = next((place for place in places if place > end), 0)
            if begin:
                self.faults[f"the {begin - end} bytes from byte {end} on are no records"] += 1

    def read(self, channel: int, time_ns: int, block: int, offset: int, most: int = 0) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written.

        most: so many of the first ones are enough, whether the others are right or not; 0: all.
        """
        source, begin = self._where(block, offset, is_all=not most)
        try:
            record = next(self._records(source, begin, source.size), None)
            if record is not None and record.kind is RecordKind.MESSAGE:
                *head, data = self._head(source, record)
                if head == [channel, time_ns]:
                    size = record.offset + record.size - data
                    return source.content(data, min(size, most) if most else size)
        except RecordError as error:
            raise RecordError(f"the chunk at byte {block}: {error}") from error
        raise RecordError(f"the chunk at byte {block} has at its byte {offset} not what its index says")

    def _where(self, block: int, offset: int, *, is_all: bool) -> tuple[ByteSource, int]:
        """Return the source of a message and where it begins there: in the file, or in a chunk, which is checked."""
        if block == _NO_CHUNK:
            return self, offset
        if not is_all:
            if block not in self._plain:
                chunk = next(self._records(self, block, self.size), None)
                self._plain[block] = 0 if chunk is None else self._plain_begin(chunk)
            if self._plain[block]:
                return self, self._plain[block] + offset
        return self._chunk(block)[0], offset

    def _of_chunk(self, chunk: Record, index: Sequence[Record]) -> Entries:
        """Return the entries of a chunk, by the index behind it or, without a valid one, by its content."""
        with suppress(RecordError):
            if index:
                found = np.concatenate([self._index(record, chunk.begin) for record in index])
                self._indexed[chunk.begin] = len(found)
                self._named.update(found["channel"].tolist())
                return found
        try:
            return self._chunk(chunk.begin)[1]
        except RecordError as error:
            self.faults[str(error)] += 1
            return np.empty(0, ENTRY)

    def _chunk(self, begin: int) -> tuple[ByteSource, Entries]:
        """Return content and entries of a chunk, and learn the channels that it defines; raise RecordError."""
        found = self._chunks.pop(begin, None)
        if found is None:
            chunk = next(self._records(self, begin, self.size), None)
            try:
                if chunk is None:
                    raise RecordError("it is gone")
                source = self._unpack(chunk, self.content(chunk.offset, min(chunk.size, self.size - chunk.offset)))
            except RecordError as error:
                raise RecordError(f"the chunk at byte {begin}: {error}") from error
            entries = self._scanned(source, self._records(source, 0, source.size), begin, is_cut=chunk.is_cut)
            if len(entries) != self._indexed.get(begin, len(entries)):
                counts = f"{len(entries)} messages, {self._indexed[begin]} by its index"
                self.faults[f"the chunk at byte {begin} has {counts}"] += 1
            found = source, entries
        self._chunks[begin] = found
        if len(self._chunks) > _KEPT_CHUNKS:
            del self._chunks[next(iter(self._chunks))]
        return found

    def _scanned(self, source: ByteSource, records: Iterable[Record], block: int, *, is_cut: bool) -> Entries:
        """Return the entries of the messages among records, and learn what the others define.

        is_cut: the last one need not be whole.
        """
        found, end = [], 0
        for record in records:
            if record.is_cut:
                break
            end = record.offset + record.size
            try:
                if record.kind in _DEFINITIONS:
                    self._define(source, record)
                elif record.kind is RecordKind.MESSAGE:
                    channel, time_ns, _ = self._head(source, record)
                    found.append((channel, time_ns, block, record.begin))
            except RecordError as error:
                self.faults[f"the record at byte {record.begin} of the block at byte {block}: {error}"] += 1
        if not is_cut and end != source.size:
            self.faults[f"the chunk at byte {block}: its last record is not whole"] += 1
        return np.array(found, ENTRY)
