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
CHANGED: Final = "one byte of it was changed"
_NO_CHUNK: Final = -1  # offset of an entry outside of chunks, whose block is the begin of its record


class RecordKind(Enum):
    """What a record is for the reader."""

    CHUNK = auto()
    INDEX = auto()  # of the chunk before it
    MESSAGE = auto()
    SCHEMA = auto()
    CHANNEL = auto()
    ATTACHMENT = auto()
    PLACE = auto()  # of a chunk, in the summary
    END = auto()  # of chunks and messages
    OTHER = auto()


class Record(NamedTuple):
    """Position of a record's content in its source."""

    kind: RecordKind
    begin: int  # of the whole record, bytes
    offset: int  # of its content
    size: int  # of its content
    fields: Mapping[bytes, bytes] = {}  # of a bag's record
    is_cut: bool = False  # the source ends within the content

    @property
    def is_definition(self) -> bool:
        """True if it defines a channel or the type of one."""
        return self.kind in (RecordKind.SCHEMA, RecordKind.CHANNEL)


class MessageHead(NamedTuple):
    """What a message's record says beside its data."""

    channel: int
    time_ns: int
    offset: int  # of its data in the source
    size: int


class ByteSource:
    """Bytes of known size: an unpacked chunk."""

    def __init__(self, data: bytes | memoryview, damaged: Sequence[int] = ()) -> None:
        """damaged: offsets of bytes of which one was changed."""
        self._view, self.damaged = memoryview(data), damaged
        self.size = len(self._view)

    def read_bytes(self, offset: int, size: int) -> bytes | memoryview:
        """Return up to size bytes from offset."""
        return self._view[offset : offset + size]

    def content(self, offset: int, size: int) -> memoryview:
        """Return bytes from offset; raise RecordError where they are too many, incomplete or damaged."""
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"{size} bytes are more than {MAX_RECORD_BYTES}")
        data = self.read_bytes(offset, size)
        if len(data) < size:
            raise RecordError(f"{len(data)} of {size} bytes could be read")
        if any(offset <= at < offset + size for at in self.damaged):
            raise RecordError(CHANGED)
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
        self._chunks: dict[int, ByteSource] = {}  # the last ones that were unpacked
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size

    # What a format states

    @abstractmethod
    def _summary(self) -> Iterator[Record]:
        """Yield the definitions and places of chunks behind the data of a closed file; none where it is corrupt."""

    @abstractmethod
    def _place(self, record: Record) -> int:
        """Return where the chunk begins whose place a record of the summary states; raise RecordError."""

    @abstractmethod
    def _is_closed(self) -> bool:
        """True if the writer has completed the file, of which a part may have been lost since."""

    @abstractmethod
    def _is_whole(self, last: Record) -> bool:
        """True if the last record of a file that is closed is the one that ends it."""

    @abstractmethod
    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        """Yield the records from offset start on; the last one may be cut. What is no record ends them."""

    @abstractmethod
    def _unpack(self, chunk: Record, data: memoryview) -> ByteSource:
        """Return the records of a chunk; raise RecordError where they are not those that were written.

        Of a chunk that is cut, return the first of them.
        """

    @abstractmethod
    def _head(self, source: ByteSource, message: Record) -> MessageHead:
        """Return the head of a message; raise RecordError where it is malformed."""

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
        is_closed, places = self._is_closed(), list[int]()
        for record in self._summary() if is_closed else ():
            with suppress(RecordError):  # then the data has the definition
                if record.is_definition:
                    self._define(self, record)
                elif record.kind is RecordKind.PLACE:
                    places.append(self._place(record))
        chunk: Record | None = None  # the newest one, and the index behind it
        index: list[Record] = []
        last = Record(RecordKind.OTHER, 0, 0, self._start)
        for record in self._with_jumps(sorted(places), is_closed=is_closed):
            last = record
            if record.kind is RecordKind.INDEX:
                index.append(record)
                continue
            if chunk is not None:
                yield self._of_chunk(chunk, index)
            chunk, index = (record if record.kind is RecordKind.CHUNK else None), []
            if record.kind is RecordKind.MESSAGE or record.is_definition:
                yield _entries([(head, at, _NO_CHUNK) for at, head in self._heads(self, [record]).items()])
            elif record.kind is RecordKind.ATTACHMENT and len(self._attached) < MAX_DEFINITIONS:
                self._attached.append(record)
        is_whole = is_closed and self._is_whole(last)
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

    def _with_jumps(self, places: Sequence[int], *, is_closed: bool) -> Iterator[Record]:
        """Yield the records up to the one that ends them, and behind holes in the file those from the next chunk on.

        places: begins of the chunks by the summary, sorted.
        """
        begin: int | None = self._start
        while begin is not None:
            end = begin
            for record in self._records(self, begin, self.size):
                # A length that exceeds a file which was closed is a corrupt one; in another, its last chunk is cut.
                if record.is_cut and (record.kind is not RecordKind.CHUNK or is_closed):
                    break
                yield record
                if record.kind is RecordKind.END:
                    return
                end = record.offset + record.size
            begin = next((place for place in places if place > end), None)
            if begin is not None:
                self.faults[f"the {begin - end} bytes from byte {end} on are no records"] += 1

    def read(self, channel: int, time_ns: int, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""
        is_loose = offset == _NO_CHUNK
        source, begin = (self, block) if is_loose else (self._chunk(block), offset)
        try:
            record = next(self._records(source, begin, source.size), None)
            if record is not None and record.kind is RecordKind.MESSAGE:
                head = self._head(source, record)
                if head[:2] == (channel, time_ns):
                    return source.content(begin, head.offset + head.size - begin)[head.offset - begin :]
        except RecordError as error:
            raise RecordError(f"the chunk at byte {block}: {error}") from error
        fault = f": {CHANGED}" if source.damaged else f" has at its byte {offset} not what its index says"
        raise RecordError(f"the chunk at byte {block}{fault}")

    def _of_chunk(self, chunk: Record, index: Sequence[Record]) -> Entries:
        """Return the entries of a chunk, by the index behind it or, without a valid one, by its content."""
        with suppress(RecordError):
            if index:
                found = np.concatenate([self._index(record, chunk.begin) for record in index])
                self._indexed[chunk.begin] = len(found)
                self._named.update(found["channel"].tolist())
                return found[np.argsort(found["offset"])]
        try:
            source = self._chunk(chunk.begin)
        except RecordError as error:
            self.faults[str(error)] += 1
            return _entries([])
        heads = self._heads(source, self._records(source, 0, source.size))
        return _entries([(head, chunk.begin, offset) for offset, head in heads.items()])

    def _chunk(self, begin: int) -> ByteSource:
        """Return the content of a chunk, and learn the channels that it defines; raise RecordError."""
        found = self._chunks.pop(begin, None)
        if found is None:
            chunk = next(self._records(self, begin, self.size), None)
            if chunk is None:
                raise RecordError(f"the chunk at byte {begin} is gone")
            try:
                found = self._unpack(chunk, self.content(chunk.offset, min(chunk.size, self.size - chunk.offset)))
            except RecordError as error:
                raise RecordError(f"the chunk at byte {begin}: {error}") from error
            heads = self._heads(found, self._records(found, 0, found.size), of=begin, is_cut=chunk.is_cut)
            if found.damaged:  # which may be what _heads has found as well
                self.faults[f"the chunk at byte {begin}: {CHANGED}"] += 1
            elif begin in self._indexed and self._indexed[begin] != len(heads):
                counts = f"{len(heads)} messages, {self._indexed[begin]} by its index"
                self.faults[f"the chunk at byte {begin} has {counts}"] += 1
        self._chunks[begin] = found
        if len(self._chunks) > _KEPT_CHUNKS:
            del self._chunks[next(iter(self._chunks))]
        return found

    def _heads(
        self, source: ByteSource, records: Iterable[Record], *, of: int = 0, is_cut: bool = True
    ) -> dict[int, MessageHead]:
        """Return the heads of the messages among records by their begins, and learn what the others define.

        of: begin of their chunk. is_cut: the last one need not be whole.
        """
        heads, end = {}, 0
        for record in records:
            if record.is_cut:
                break
            end = record.offset + record.size
            try:
                if record.is_definition:
                    self._define(source, record)
                elif record.kind is RecordKind.MESSAGE:
                    heads[record.begin] = self._head(source, record)
            except RecordError as error:
                if not source.damaged:
                    self.faults[f"the record at byte {record.begin} of the block at byte {of}: {error}"] += 1
        if not (is_cut or source.damaged) and end != source.size:
            self.faults[f"the chunk at byte {of}: its last record is not whole"] += 1
        return heads


def _entries(found: list[tuple[MessageHead, int, int]]) -> Entries:
    """Return heads of messages with block and offset as entries."""
    return np.array([(head.channel, head.time_ns, block, offset) for head, block, offset in found], ENTRY)
