"""Bags of ROS 2 in SQLite (.db3), read by Python's sqlite3.

Layout, as `ros2 bag record -s sqlite3` writes it: rosbag2_storage_sqlite3, versions 1 to 4: table topics (id, name,
type, serialization_format, ...) and table messages (id, topic_id, timestamp [ns], data). The files
that a killed recorder leaves next to it are used: a write-ahead log, or a journal, which undoes the last transaction.
"""

from __future__ import annotations

import shutil
import sqlite3
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final
from urllib.parse import quote

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES
from drivers.logs.log import ENTRY, MAX_DEFINITIONS, MAX_NAME, Entries, LogFile, Topic

MAGIC: Final = b"SQLite format 3\0"
# A file that is shorter than it states is read up to its end with a writable schema only; it is opened read-only.
_PRAGMAS: Final = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "writable_schema = ON")
_TABLES: Final = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')"
_TOPICS: Final = (
    f"SELECT id, substr(name, 1, 256), substr(type, 1, 256), serialization_format FROM topics LIMIT {MAX_DEFINITIONS}"
)
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

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(name)
        try:
            self._bag = _opened(path)
            is_bag = self._bag.execute(_TABLES).fetchone()[0] == 2
            rows = self._bag.execute(_TOPICS).fetchall() if is_bag else []
        except (*_FAULTS, OSError) as error:
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
            line = f"is cut or corrupt after {len(found)} messages ({_line(error)}): used those before"
            self.cut = f"the bag {self.name!r} {line}"
        return np.array(found, ENTRY)

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


def _opened(path: Path) -> sqlite3.Connection:
    """Open a file for reading from any thread; it may be damaged or hostile. Raise sqlite3.Error or OSError.

    SQLite must write where it finds a journal, or a write-ahead log in a folder that cannot be written: then all files
    are copied, into $TMPDIR or /tmp; they stay readable when they are deleted. A file that had a write-ahead log is
    read as one that does not change.
    """
    extra_files = [file for suffix in ("-wal", "-journal") if (file := Path(f"{path}{suffix}")).exists()]
    try:
        return _connected(path, "ro")
    except sqlite3.Error:
        if not extra_files:
            return _connected(path, "ro&immutable=1")  # else it locks what nobody writes
    with TemporaryDirectory(prefix="omnid-") as folder:
        for file in (path, *extra_files):
            shutil.copyfile(file, Path(folder, file.name))
        return _connected(Path(folder, path.name), "rw")


def _connected(path: Path, mode: str) -> sqlite3.Connection:
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


def _line(error: Exception) -> str:
    """Return an error in one line: SQLite quotes the file, which may contain anything."""
    return " ".join(str(error).split())[:MAX_NAME] or type(error).__name__
