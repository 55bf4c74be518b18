"""A log of records, most of which are packed in chunks, whole, cut, corrupt or malicious: MCAP files and ROS 1 bags.

Both formats are framed here and not by their libraries, whose readers refuse a file that was cut, end at the first
corrupt chunk, accept a short read as a message and unpack without a bound.
"""

from __future__ import annotations

import heapq
import os
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from enum import Enum, auto
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from drivers.errors import DriverError
from drivers.logs.file_order import FileOrder, Position
from drivers.logs.log import MAX_RECORD_BYTES, LogDamage, LoggedMessage, RecordError
from drivers.logs.ros_messages import IMAGE_TYPES

# Bounds of what is kept in memory, whatever a file states.
MAX_DEFINITIONS: Final = 4096  # channels, and schemas
MAX_DEFINITION_BYTES: Final = 2**20
MAX_NAME: Final = 256  # characters of a topic, a type or an attachment
_MAX_UNPACKED_BYTES: Final = 64 * 2**20  # of the chunks that are kept unpacked, beside the newest one
_MAX_WAITING: Final = 2**18  # messages that wait for earlier ones, and those of a chunk whose order is regarded
# Topics of a file without index are searched in this part of it: some seconds of both cameras, wheels and gyro.
_SCAN_BYTES: Final = 64 * 2**20
_RUN_BYTES: Final = 2**20  # of records outside of chunks that are sorted as one chunk is


class ByteSource(Protocol):
    """Bytes of known size: the file or an unpacked chunk."""

    size: int

    def read(self, offset: int, size: int) -> bytes | memoryview:
        """Return up to size bytes from offset."""


class RecordKind(Enum):
    """What a record is for the reader."""

    CHUNK = auto()
    INDEX = auto()  # of the chunk before it
    MESSAGE = auto()
    DEFINITION = auto()  # of a channel or a schema
    END = auto()  # of chunks and messages
    OTHER = auto()


class Record(NamedTuple):
    """Position of a record's content in its source."""

    kind: RecordKind
    begin: int  # of the whole record, bytes
    offset: int  # of its content
    size: int  # of its content
    opcode: int
    fields: Mapping[bytes, bytes] = {}  # of a bag's record
    is_cut: bool = False  # the source ends within the content

    @property
    def end(self) -> int:
        """Offset behind the record."""
        return self.offset + self.size


class Unpacked:
    """A ByteSource in memory; it returns views."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._view = memoryview(data)
        self.size = len(self._view)

    def read(self, offset: int, size: int) -> memoryview:
        """Return up to size bytes from offset."""
        return self._view[offset : offset + size]


class Topic(NamedTuple):
    """Name and type of a channel; kind: "" where its messages cannot be decoded."""

    name: str
    kind: str
    aligned: bool  # True: CDR; False: the serialisation of ROS 1


class MessageHead(NamedTuple):
    """What is known of a message before its data is read."""

    channel: int
    log_time_ns: int
    offset: int  # of its data in the source, or, of an index, of the record in the unpacked chunk
    size: int = 0


class _Block(NamedTuple):
    """A chunk, or successive records outside of chunks; sorts by time, then by its place in the file."""

    first_ns: int  # log time of its first message
    begin: int  # bytes
    end: int  # bytes
    chunk: Record | None = None  # None: records outside of chunks
    index_end: int = 0  # end of the index behind the chunk; 0: none


class _Waiting(NamedTuple):
    """A message whose turn has not come; sorts by log time, then by its place in the file."""

    log_time_ns: int
    block_begin: int
    offset: int  # of its data in the file or in the unpacked chunk, bytes
    size: int
    topic: Topic
    block: _Block


class ChunkedFile(ABC):
    """A Log of one file, and a ByteSource of its bytes. A format states how records are framed, packed and read."""

    def __init__(self, path: Path, magic: bytes, name: str | None = None) -> None:
        """Open the file, which begins with `magic`; raise DriverError where it cannot be read.

        name: for error messages, where it is not the path.
        """
        self.name, self._start = name or str(path), len(magic)
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise DriverError(f"cannot read the log {self.name!r}: {error.strerror}") from error
        self.size = os.fstat(self._file.fileno()).st_size
        self._damage: LogDamage | None = None
        self._broken = 0  # chunks and records that the present call of messages() has skipped
        self._unpacked: OrderedDict[int, Unpacked] = OrderedDict()  # the last chunks that were read, by offset
        self._segments: tuple[int, FileOrder] | None = None  # number of blocks then, their order
        self._has_index = self._read_index()
        if not self._has_index:
            self._define_all(block for block in self._blocks()[0] if block.begin <= _SCAN_BYTES)

    # What a format states

    @abstractmethod
    def _read_index(self) -> bool:
        """Learn topics, counts and span from the index at the end of the file; False without a valid one."""

    @abstractmethod
    def _is_closed(self) -> bool:
        """True if the writer has completed the file."""

    @abstractmethod
    def _records(self, source: ByteSource, start: int, end: int) -> Iterator[Record]:
        """Yield the records from offset start on; the last one may be cut. What is no record ends them."""

    @abstractmethod
    def _unpack(self, chunk: Record, data: memoryview) -> bytes | memoryview:
        """Return the records of a chunk; raise RecordError where they are not those that were written.

        Of a chunk that is cut, return the first of them.
        """

    @abstractmethod
    def _head(self, source: ByteSource, message: Record) -> MessageHead:
        """Return the head of a message; raise RecordError where it is malformed."""

    @abstractmethod
    def _index(self, record: Record) -> tuple[int, Iterator[MessageHead]]:
        """Return the channel of an index of a chunk, and the heads of its messages; raise RecordError."""

    @abstractmethod
    def _define(self, source: ByteSource, record: Record) -> None:
        """Learn a channel or a schema; raise RecordError where it is malformed or exceeds the limits."""

    @abstractmethod
    def _topic(self, channel: int) -> Topic | None:
        """Return the topic of a channel, None of an unknown one."""

    @abstractmethod
    def _first_ns(self, chunk: Record) -> int:
        """Return the log time of the first message of a chunk, -1 where only its index states it."""

    # The Log

    def read(self, offset: int, size: int) -> bytes:
        """Return up to size bytes of the file from offset; none after close, or where the disk fails."""
        try:
            return os.pread(self._file.fileno(), min(size, MAX_RECORD_BYTES), offset)
        except (OSError, ValueError):
            return b""

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def damage(self) -> LogDamage:
        """Return the faults that are known: where the file ends, and the chunks that messages() has skipped."""
        if self._damage is None:
            self._damage = self._blocks()[1]
        return self._damage

    def image_spans_ns(self) -> Mapping[str, tuple[int, int]]:
        """Return the first and last log time of each topic of images."""
        return self._order(self._blocks()[0]).spans_ns

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time; those of one time in the order of the file.

        A chunk is unpacked when all messages before its first one are through, so that a file whose topics were
        written one after the other needs little more memory than others. Where the recorder's clock was set back, the
        messages after it follow those before it.
        """
        blocks, self._damage = self._blocks()
        if not self._has_index and blocks != sorted(blocks):
            self._define_all(blocks)  # A block may use a channel that one of a later time defines.
        order = self._order(blocks)
        self._broken = 0
        for segment in range(order.segments):
            first, last = order.bounds(segment)
            some = sorted(
                block
                for block in blocks
                if (first is None or block.begin >= first[0]) and (last is None or block.begin <= last[0])
            )
            for message in self._by_time(some, topics, order, segment):
                if self._file.closed:
                    return
                yield message
        self._damage = self._damage._replace(broken=self._broken)

    def _blocks(self) -> tuple[list[_Block], LogDamage]:
        """Return the blocks of the data section in the order of the file, and where it ends too early."""
        blocks: list[_Block] = []
        run: _Block | None = None  # records outside of chunks, up to _RUN_BYTES
        end, ended, is_closed = self._start, False, self._is_closed()
        for record in self._records(self, self._start, self.size):
            # A length that exceeds a file which was closed is a corrupt one; in another, its last chunk is cut.
            if record.kind is RecordKind.END or (record.is_cut and (record.kind is not RecordKind.CHUNK or is_closed)):
                ended = not record.is_cut
                break
            if run is not None and (record.kind is RecordKind.CHUNK or record.end - run.begin > _RUN_BYTES):
                blocks.append(run)
                run = None
            if record.kind is RecordKind.CHUNK:
                blocks.append(_Block(self._first_ns(record), record.begin, record.end, record))
            elif record.kind is RecordKind.INDEX and blocks and run is None:
                blocks[-1] = blocks[-1]._replace(index_end=record.end)
            elif record.kind in (RecordKind.MESSAGE, RecordKind.DEFINITION):
                first_ns = blocks[-1].first_ns if blocks else 0
                if record.kind is RecordKind.MESSAGE:
                    with suppress(RecordError):
                        first_ns = self._head(self, record).log_time_ns
                elif run is not None:
                    first_ns = run.first_ns
                run = run or _Block(first_ns, record.begin, record.end)
                run = run._replace(first_ns=min(run.first_ns, first_ns), end=record.end)
            end = min(record.end, self.size)
        blocks += [run] if run is not None else []
        blocks = [block if block.first_ns >= 0 else self._timed(block) for block in blocks]
        if ended and is_closed:
            return blocks, LogDamage()
        line = f"the log {self.name!r} is cut or corrupt after byte {end} of {self.size}: used the data before"
        return blocks, LogDamage(cut=line)

    def _timed(self, block: _Block) -> _Block:
        """Return a chunk with the time of its first message, by its index."""
        return block._replace(first_ns=min((head.log_time_ns for head in self._heads(block)), default=0))

    def _heads(self, block: _Block, *, only_images: bool = False) -> list[MessageHead]:
        """Return the heads of a block's messages in the order of the file, by its index where there is one."""
        found: list[MessageHead] = []
        with suppress(RecordError):
            if block.chunk is not None and block.index_end:
                for record in self._records(self, block.chunk.end, block.index_end):
                    channel, heads = self._index(record)
                    if not only_images or self._is_image(channel):
                        found += islice(heads, _MAX_WAITING)
            else:
                source = self._source(block)
                for record in islice(self._records(source, *self._span_of(source, block)), _MAX_WAITING):
                    if record.kind is RecordKind.MESSAGE and not record.is_cut:
                        found.append(self._head(source, record)._replace(offset=record.begin))
        return sorted(found, key=lambda head: head.offset)

    def _order(self, blocks: list[_Block]) -> FileOrder:
        """Return the segments of the file, by the messages of its images; kept until the file has grown."""
        if self._segments is None or self._segments[0] != len(blocks):
            order = FileOrder()
            for block in blocks:
                for head in self._heads(block, only_images=True):
                    topic = self._topic(head.channel)
                    if topic is not None and self._is_image(head.channel):
                        order.add(topic.name, head.log_time_ns, (block.begin, head.offset))
            order.finish()
            self._segments = len(blocks), order
        return self._segments[1]

    def _is_image(self, channel: int) -> bool:
        topic = self._topic(channel)
        return topic is not None and topic.kind in IMAGE_TYPES

    def _by_time(
        self, blocks: Iterable[_Block], topics: Collection[str] | None, order: FileOrder, segment: int
    ) -> Iterator[LoggedMessage]:
        """Yield the messages of a segment from blocks, which are in the order of their first messages."""
        waiting: list[_Waiting] = []
        for block in blocks:
            while waiting and waiting[0][:2] < block[:2]:
                yield self._logged(heapq.heappop(waiting))
            self._forget_chunks_but({message.block_begin for message in waiting})
            for position, message in self._messages_of(block, topics):
                if order.segments > 1 and order.segment(message.topic.name, position) != segment:
                    continue
                heapq.heappush(waiting, message)
                if len(waiting) > _MAX_WAITING:
                    yield self._logged(heapq.heappop(waiting))
        while waiting:
            yield self._logged(heapq.heappop(waiting))

    def _messages_of(self, block: _Block, topics: Collection[str] | None) -> Iterator[tuple[Position, _Waiting]]:
        """Yield the messages of a block with their positions, and learn its channels; count and skip what is corrupt.

        Of a chunk that is cut, the messages before are whole.
        """
        try:
            source = self._source(block)
            last, end = self._span_of(source, block)
            for record in self._records(source, last, end):
                if record.is_cut:
                    break
                last = record.end
                try:
                    if record.kind is RecordKind.DEFINITION:
                        self._define(source, record)
                    elif record.kind is RecordKind.MESSAGE:
                        head = self._head(source, record)
                        topic = self._topic(head.channel)
                        if topic is None:
                            raise RecordError(f"the channel {head.channel} of a message is unknown")
                        if topics is None or topic.name in topics:
                            place = block.begin, head.offset, head.size
                            yield (block.begin, record.begin), _Waiting(head.log_time_ns, *place, topic, block)
                except RecordError:
                    self._broken += 1
            if last != end and not (block.chunk and block.chunk.is_cut):
                raise RecordError("the last record of a chunk is not whole")
        except RecordError:
            self._broken += 1

    def _logged(self, found: _Waiting) -> LoggedMessage:
        def read() -> memoryview:
            return content(self._source(found.block), found.offset, found.size)

        return LoggedMessage(found.topic.name, found.topic.kind, found.log_time_ns, read, found.topic.aligned)

    def _source(self, block: _Block) -> ByteSource:
        """Return the file or the unpacked chunk that a block's records are in; raise RecordError for a corrupt chunk.

        Where many chunks overlap in time, only the last 64 MiB are kept unpacked, and others are unpacked again.
        """
        if block.chunk is None:
            return self
        found = self._unpacked.get(block.begin)
        if found is None:
            size = min(block.chunk.size, self.size - block.chunk.offset)
            found = Unpacked(self._unpack(block.chunk, content(self, block.chunk.offset, size)))
            self._unpacked[block.begin] = found
            while len(self._unpacked) > 1 and sum(kept.size for kept in self._unpacked.values()) > _MAX_UNPACKED_BYTES:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(block.begin)
        return found

    def _span_of(self, source: ByteSource, block: _Block) -> tuple[int, int]:
        """Return begin and end of a block's records in their source."""
        return (0, source.size) if block.chunk else (block.begin, block.end)

    def _forget_chunks_but(self, begins: Collection[int]) -> None:
        """Free the unpacked chunks of which no message waits."""
        for begin in self._unpacked.keys() - begins:
            del self._unpacked[begin]

    def _define_all(self, blocks: Iterable[_Block]) -> None:
        """Learn the channels of blocks."""
        for block in blocks:
            for _ in self._messages_of(block, ()):
                pass


def content(source: ByteSource, offset: int, size: int) -> memoryview:
    """Return bytes of a source; raise RecordError where they are too many or incomplete."""
    if size > MAX_RECORD_BYTES:
        raise RecordError(f"{size} bytes are more than {MAX_RECORD_BYTES}")
    data = source.read(offset, size)
    if len(data) < size:
        raise RecordError(f"{len(data)} of {size} bytes could be read")
    return memoryview(data)
