"""Bags of ROS 2 in SQLite (.db3), read by Python's sqlite3.

Layout, as `ros2 bag record -s sqlite3` writes it: rosbag2_storage_sqlite3, versions 1 to 4: table topics (id, name,
type, serialization_format, ...) and table messages (id, topic_id, timestamp [ns], data). What a recorder that was
killed leaves beside the file counts: a write-ahead log, or a journal by which the last transaction is undone.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES, scratch_folder
from drivers.logs.log import ENTRY, MAX_DEFINITIONS, MAX_NAME, Entries, LogFile, Topic

MAGIC: Final = b"SQLite format 3\0"
# A file that is shorter than it states is read up to its end with a writable schema only; it is opened read-only.
_PRAGMAS: Final = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "writable_schema = ON")
_TABLES: Final = (
    "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages') "
    "AND sql LIKE 'CREATE TABLE%'"
)
# The pragma lists no computed columns. The small columns come first, so that reading them never reads a whole row.
_COLUMNS: Final = "SELECT name FROM pragma_table_info('messages') LIMIT 4"
_EXPECTED: Final = [("id",), ("topic_id",), ("timestamp",), ("data",)]
_TOPICS: Final = (
    f"SELECT id, substr(name, 1, 256), substr(type, 1, 256), serialization_format FROM topics LIMIT {MAX_DEFINITIONS}"
)
# Indexes are not used: a damaged one would leave rows out without an error. A message that is compressed by itself,
# which begins as a frame of zstd, is read whole for its header.
_ROWS: Final = (
    "SELECT topic_id, timestamp, rowid, typeof(data) = 'blob', "
    "CASE substr(data, 1, 4) WHEN x'28B52FFD' THEN data ELSE substr(data, 1, 12) END "
    "FROM messages NOT INDEXED WHERE rowid >= ? ORDER BY rowid"
)
_LOG_HEAD: Final = struct.Struct(">8xI4x8s8x")  # page size, salts
_FRAME_HEAD: Final = struct.Struct(">II8s8x")  # page; pages of the database where a transaction ends, else 0; salts
_FAULTS: Final = (sqlite3.Error, OverflowError)


class SqliteBag(LogFile):
    """A LogFile of one .db3 file; raises DriverError where it is no bag."""

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(name)
        self._file, self._beside = path, [Path(f"{path}{suffix}") for suffix in ("-wal", "-journal")]
        try:
            self._bag = self._opened()
            has_tables = self._bag.execute(_TABLES).fetchone()[0] == 2
            is_bag = has_tables and self._bag.execute(_COLUMNS).fetchall() == _EXPECTED
            rows = self._bag.execute(_TOPICS).fetchall() if is_bag else []
        except (*_FAULTS, OSError, ValueError) as error:
            raise DriverError(
                f"cannot read the bag {self.name!r}: {_line(error)}; if the recording was cut, try: "
                "`sqlite3 FILE .recover`"
            ) from error
        if not is_bag:
            self.close()
            raise DriverError(
                f"{self.name!r} is an SQLite file, but no bag of ROS 2: it has no tables topics and "
                "messages as one has; give the .db3 file that `ros2 bag record` wrote"
            )
        self.topics = {
            key: Topic(str(name), str(kind) if encoding == "cdr" else "")
            for key, name, kind, encoding in rows
            if isinstance(key, int)
        }
        frames = [*_frames(self._beside[0])]
        if frames and not (frames[-1].is_whole and frames[-1].pages):
            self.cut = f"the write-ahead log of the bag {self.name!r} is cut within a transaction: used those before"

    def entries(self) -> Entries:
        """Return the places of all messages; behind pages that cannot be read, those from the next readable one on."""
        found: list[tuple[int, ...]] = []
        start, row, count = -sys.maxsize, -sys.maxsize - 1, 0
        while True:
            try:
                for channel, time_ns, row, is_blob, head in self._bag.execute(_ROWS, (start,)):
                    count += 1
                    try:
                        if not (isinstance(channel, int) and isinstance(time_ns, int) and is_blob):
                            raise RecordError("it has no topic, time or data")
                        found.append((channel, time_ns, self.header_ns(channel, head), 0, row))
                    except RecordError as error:
                        self.faults[row] = f"row {row} of the table messages: {error}"
                break
            except _FAULTS as error:
                next_row = self._next_readable(row + 1)
                if next_row is None or next_row <= start:
                    line = f"is cut or corrupt after {count} messages ({_line(error)}): used those before"
                    self.cut = f"the bag {self.name!r} {line}"
                    break
                self.faults[row] = f"rows {row + 1} to {next_row - 1} of the table messages: {_line(error)}"
                start = next_row
        return np.array(found, ENTRY)

    def _next_readable(self, row: int) -> int | None:
        """Return the first row from which on rows can be read; None where the last one cannot."""
        try:
            end = int(self._bag.execute("SELECT max(rowid) FROM messages").fetchone()[0])
        except (*_FAULTS, TypeError):  # TypeError: no row at all
            return None
        while row < end:
            middle = (row + end) // 2
            try:
                self._bag.execute(f"{_ROWS} LIMIT 1", (middle,)).fetchone()
                end = middle
            except _FAULTS:
                row = middle + 1
        return end

    def read(self, block: int, offset: int) -> bytes:
        """Return the bytes of the message of an entry; raise RecordError where they cannot be read."""
        try:
            row = self._bag.execute("SELECT data FROM messages WHERE rowid = ?", (offset,)).fetchone()
        except _FAULTS as error:
            raise RecordError(f"row {offset} of the table messages: {_line(error)}") from error
        if row is None or not isinstance(row[0], bytes):
            raise RecordError(f"row {offset} of the table messages has no data")
        return row[0]

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._bag.close()

    def _opened(self) -> sqlite3.Connection:
        """Open the file for reading from any thread; it may be damaged or hostile. Raise sqlite3.Error.

        SQLite must write where it finds a journal, or a write-ahead log in a folder that cannot be written: then all
        files are copied. A file that had a write-ahead log is read as one that does not change. Of a file whose first
        page was not written yet, the write-ahead log has that page, without which SQLite would delete this log.
        """
        has_head, beside = is_database(self._file), [file for file in self._beside if file.exists()]
        try:
            if has_head:
                return self._connected(self._file, "ro")
        except sqlite3.Error:
            if not beside:
                return self._connected(self._file, "ro&immutable=1")  # else it locks what nobody writes
        files = [self._file, *beside]
        with scratch_folder(self.name, sum(file.stat().st_size for file in files)) as folder:
            for file in files:
                shutil.copyfile(file, folder / file.name)
            copy = folder / self._file.name
            page = next((frame for frame in _frames(self._beside[0]) if frame.page == 1), None)
            if not has_head and page is not None:
                with copy.open("r+b") as head, self._beside[0].open("rb") as log:
                    log.seek(page.offset)
                    head.write(log.read(page.size))
            return self._connected(copy, "rw")

    def _connected(self, path: Path, mode: str) -> sqlite3.Connection:
        """Connect to a file, and read from it for the first time."""
        uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD_BYTES)
            for pragma in _PRAGMAS:
                database.execute(f"PRAGMA {pragma}")
            database.text_factory = partial(str, encoding="utf-8", errors="replace")
            database.execute(_TABLES).fetchone()
        except BaseException:
            database.close()
            raise
        return database


class _LogFrame(NamedTuple):
    """One page in a write-ahead log."""

    page: int
    pages: int  # of the database where a transaction ends, else 0
    offset: int  # of the content in the log
    size: int
    is_whole: bool


def _frames(log: Path) -> Iterator[_LogFrame]:
    """Yield the frames of a write-ahead log, if there is one (sqlite.org/walformat).

    Frames with other salts than the head are of earlier transactions, which have ended.
    """
    with suppress(OSError), log.open("rb") as file:
        head = file.read(_LOG_HEAD.size)
        size, salts = _LOG_HEAD.unpack(head) if len(head) == _LOG_HEAD.size else (0, b"")
        while size and len(frame := file.read(_FRAME_HEAD.size)) == _FRAME_HEAD.size:
            page, pages, found = _FRAME_HEAD.unpack(frame)
            if found != salts:
                return
            offset, end = file.tell(), file.seek(size, os.SEEK_CUR)
            yield _LogFrame(page, pages, offset, size, end <= os.fstat(file.fileno()).st_size)


def is_database(path: Path) -> bool:
    """True if a file begins as a database does."""
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def _line(error: Exception) -> str:
    """Return an error in one line: SQLite quotes the file, which may contain anything."""
    return " ".join(str(error).split())[:MAX_NAME] or type(error).__name__
