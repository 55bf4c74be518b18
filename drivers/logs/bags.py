"""Bags of ROS 2 in SQLite (.db3), read by Python's sqlite3, and bags of ROS 1 (.bag), whose index rosbags reads.

Layout of the former, as `ros2 bag record -s sqlite3` writes it: rosbag2_storage_sqlite3, versions 1 to 4: table topics
(id, name, type, serialization_format, ...) and table messages (id, topic_id, timestamp [ns], data). The write-ahead log
that a killed recorder leaves next to it is used. A bag of ROS 1 that was cut must be repaired by `rosbag reindex`.
"""

from __future__ import annotations

import bz2
import os
import sqlite3
from functools import lru_cache, partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from struct import Struct
from typing import Final
from urllib.parse import quote

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import IndexData, ReaderError, decompressors
from rosbags.typesys import Stores

from drivers.errors import DriverError, RecordError, one_line
from drivers.logs.log import ENTRY, KEPT_CHUNKS, MAX_RECORD_BYTES, Entries, LogFile, Topic
from drivers.logs.ros_messages import CDR, HEADER, STAMPED_TYPES, typestore

# A file that is shorter than it states is read up to its end with a writable schema only; it is opened read-only.
_PRAGMAS: Final = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "writable_schema = ON")
_TOPICS: Final = "SELECT id, name, type, serialization_format FROM topics"
# Indexes are not used: a damaged one would leave rows out without an error. A message that is compressed by itself,
# which begins as a frame of zstd, is read whole for its header.
_ROWS: Final = (
    "SELECT topic_id, timestamp, rowid, typeof(data) = 'blob', "
    "CASE substr(data, 1, 4) WHEN x'28B52FFD' THEN data ELSE substr(data, 1, 12) END "
    "FROM messages NOT INDEXED ORDER BY rowid"
)
_FAULTS: Final = (sqlite3.Error, OverflowError)


class SqliteBag(LogFile):
    """A LogFile of one .db3 file; raises DriverError where it is no bag."""

    magic = b"SQLite format 3\0"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # A file without a write-ahead log or a journal is read as one that does not change: SQLite would lock it.
        changes = any(Path(f"{path}{suffix}").exists() for suffix in ("-wal", "-journal"))
        uri = f"file:{quote(str(path.resolve()))}?mode=ro{'' if changes else '&immutable=1'}"
        try:
            self._bag = sqlite3.connect(uri, uri=True, check_same_thread=False)
            self._bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD_BYTES)
            for pragma in _PRAGMAS:
                self._bag.execute(f"PRAGMA {pragma}")
            self._bag.text_factory = partial(str, encoding="utf-8", errors="replace")
            rows = self._bag.execute(_TOPICS).fetchall()
        except _FAULTS as error:
            raise DriverError(
                f"cannot read the bag {self.name!r}: {one_line(error)}; a recording that was cut needs `sqlite3 FILE "
                ".recover`, and the files beside it a folder that can be written"
            ) from error
        self.topics = {
            key: Topic(str(topic), str(kind) if encoding == "cdr" else "")
            for key, topic, kind, encoding in rows
            if isinstance(key, int)
        }

    def entries(self) -> Entries:
        """Return the places of all messages, up to a page that cannot be read."""
        found: list[tuple[int, ...]] = []
        try:
            for channel, time_ns, row, is_blob, head in self._bag.execute(_ROWS):
                try:
                    if not (isinstance(channel, int) and isinstance(time_ns, int) and is_blob):
                        raise RecordError("it has no topic, time or data")
                    found.append((channel, time_ns, self.header_ns(channel, head), 0, row))
                except RecordError as error:
                    self.faults[row] = f"row {row} of the table messages: {error}"
        except _FAULTS as error:
            line = f"is cut or corrupt after {len(found)} messages ({one_line(error)}): used those before"
            self.cut = f"the bag {self.name!r} {line}"
        return np.array(found, ENTRY)

    def read(self, channel: int, block: int, offset: int) -> bytes:
        """Return the bytes of the message of an entry; raise RecordError where they cannot be read."""
        try:
            row = self._bag.execute("SELECT data FROM messages WHERE rowid = ?", (offset,)).fetchone()
        except _FAULTS as error:
            raise RecordError(f"row {offset} of the table messages: {one_line(error)}") from error
        if row is None or not isinstance(row[0], bytes):
            raise RecordError(f"row {offset} of the table messages has no data")
        return row[0]

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._bag.close()


class _IndexReader(Reader):
    """The index of a bag of ROS 1, refused where chunks share its records: a short file could list any number."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._left = path.stat().st_size  # bytes of index records that may still be read

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Add the messages of the index record at the place of the file."""
        assert self.bio
        begin = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._left -= self.bio.tell() - begin
        if self._left < 0:
            raise ReaderError("its index has more bytes than the file")


# rosbags' functions unpack without a bound; by these, the classes that have one.
_UNPACKERS: Final = {
    decompressors["bz2"]: bz2.BZ2Decompressor,
    decompressors["lz4"]: lz4.frame.LZ4FrameDecompressor,
}
_LENGTH: Final = Struct("<I")  # of the head of a record, and of its data, before each (wiki.ros.org/Bags/Format/2.0)


class Ros1Bag(LogFile):
    """A LogFile of one .bag file; raises DriverError where it cannot be read."""

    magic = b"#ROSBAG V2.0\n"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._bag = _IndexReader(path)
        try:
            self._bag.open()
            self._file = path.open("rb", buffering=0)
        except Exception as error:  # of any kind, as it trusts the lengths in the bytes
            reason = f"{one_line(error)}; if its recorder was stopped, try `rosbag reindex`"
            raise DriverError(f"cannot read the bag {self.name!r}: {reason}") from error
        for of in self._bag.connections:
            self.topics[of.id] = Topic(of.topic, of.msgtype)
        self._chunk = lru_cache(KEPT_CHUNKS)(self._unpacked)

    def entries(self) -> Entries:
        """Return the places of all messages by the index, chunk by chunk."""
        places = (
            (place.chunk_pos, place.offset, channel, place.time)
            for channel, found in self._bag.indexes.items()
            for place in found
        )
        found = []
        for block, messages in groupby(sorted(places), itemgetter(0)):
            try:
                self._chunk(block)  # once, as what does not unpack may take long
            except RecordError as error:
                self.faults[block] = str(error)
                continue
            for _, offset, channel, time_ns in messages:
                try:
                    # Sequence, seconds and nanoseconds: as in CDR, which begins with the byte order instead.
                    header_ns = self.header_ns(channel, CDR + self._message(block, offset)[len(CDR) : HEADER.size])
                    found.append((channel, time_ns, header_ns, block, offset))
                except RecordError as error:
                    self.faults.setdefault(block, str(error))
        return np.array(found, ENTRY)

    def read(self, channel: int, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry, in CDR those of STAMPED_TYPES; raise RecordError for others."""
        kind, message = self.topics[channel].kind, self._message(block, offset)
        try:
            return typestore(Stores.ROS2_HUMBLE).ros1_to_cdr(message, kind) if kind in STAMPED_TYPES else message
        except Exception as error:  # of any kind, as it trusts the lengths in the bytes
            raise RecordError(f"the chunk at byte {block}: a {kind} at its byte {offset} is not valid") from error

    def _message(self, block: int, offset: int) -> memoryview:
        """Return the bytes of a message as ROS 1 writes them; raise RecordError where it is not whole."""
        data = self._chunk(block)
        for _ in ("head", "data"):
            size = int.from_bytes(data[offset : offset + _LENGTH.size], "little")
            begin, offset = offset + _LENGTH.size, offset + _LENGTH.size + size
        if not begin < offset <= len(data):
            raise RecordError(f"the chunk at byte {block}: the message at its byte {offset} is not whole")
        return data[begin:offset]

    def _unpacked(self, block: int) -> memoryview:
        """Return the content of a chunk; raise RecordError where it does not unpack, or to too much."""
        chunk = self._bag.chunks[block]
        try:
            data = os.pread(self._file.fileno(), min(chunk.datasize, MAX_RECORD_BYTES), chunk.datapos)
            if chunk.decompressor in _UNPACKERS:
                unpacker = _UNPACKERS[chunk.decompressor]()
                data = unpacker.decompress(data, max_length=MAX_RECORD_BYTES)
                if not unpacker.eof:
                    raise RecordError(f"it is cut, or unpacks to more than {MAX_RECORD_BYTES} bytes")
        except Exception as error:  # of any kind that a decompressor or a closed file raises
            raise RecordError(f"the chunk at byte {block}: it does not unpack: {one_line(error)}") from error
        return memoryview(data)

    def close(self) -> None:
        """Close the file; may be called twice."""
        if not self._file.closed:
            self._file.close()
            self._bag.close()
