"""Bags of ROS 2 in SQLite (.db3), read by Python's sqlite3.

Layout, as `ros2 bag record -s sqlite3` writes it: rosbag2_storage_sqlite3, versions 1 to 4: table topics (id, name,
type, serialization_format, ...) and table messages (id, topic_id, timestamp [ns], data). What a recorder that was
killed leaves beside the file counts: a write-ahead log, or a journal by which the last transaction is undone.

Each row has bytes of its own in a file that is whole. So a file of N bytes, with its write-ahead log, has at most N / 8
rows with N bytes of data, and what has more is damaged: its pages are named more than once.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from drivers.errors import DriverError
from drivers.logs.file_order import FileOrder
from drivers.logs.log import MAX_RECORD_BYTES, LogDamage, LoggedMessage, widened
from drivers.logs.packed_file import scratch_folder
from drivers.logs.ros_messages import IMAGE_TYPES

MAGIC: Final = b"SQLite format 3\0"
_BESIDE: Final = ("-wal", "-journal")
_MAX_TOPICS: Final = 4096
_MAX_REASON: Final = 120  # characters
_LEAST_ROW_BYTES: Final = 8  # pointer, sizes, number, and the types of four columns
_ROW_INSTRUCTIONS: Final = 100  # Instructions of SQLite that a row may take; it needs 10 to 20.
_FEWEST_INSTRUCTIONS: Final = 1_000_000
_BLOCK: Final = 10_000  # instructions of SQLite's virtual machine between two calls of the progress handler
# A file that is shorter than it states is read up to its end with a writable schema only; it is opened read-only.
_PRAGMAS: Final = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "writable_schema = ON")
_TABLES: Final = (
    "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages') "
    "AND sql LIKE 'CREATE TABLE%'"
)
# The pragma lists no computed columns. The small columns come first, so that reading them never reads a whole row.
_COLUMNS: Final = "SELECT name FROM pragma_table_info('messages') LIMIT 4"
_EXPECTED: Final = ["id", "topic_id", "timestamp", "data"]
_TOPICS: Final = (
    f"SELECT id, substr(name, 1, 256), substr(type, 1, 256), serialization_format FROM topics LIMIT {_MAX_TOPICS}"
)
# Indexes are not used: a damaged one would leave rows out without an error.
_TIMES: Final = "SELECT topic_id, timestamp, rowid FROM messages NOT INDEXED ORDER BY rowid"
_AS_WRITTEN: Final = (
    "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({ids}) THEN data END FROM messages NOT INDEXED ORDER BY rowid"
)
_DATA: Final = "SELECT data FROM messages WHERE rowid = ?"
_TOO_MANY: Final = "it has more rows than its size allows"
_FAULTS: Final = (sqlite3.Error, OverflowError)


@dataclass(slots=True)
class _Times:
    """What a look at the times of all messages has found."""

    counts: Counter[object] = field(default_factory=Counter)  # by topic
    span_ns: tuple[int, int] | None = None
    in_order: bool = True
    order: FileOrder = field(default_factory=FileOrder)
    fault: str = ""  # why it ended early


class SqliteBag:
    """A Log of one .db3 file; raises DriverError where it is no bag."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        """name: for error messages, where it is not the path."""
        self.name, self._bytes = name or str(path), 0
        self._damage, self._closed = LogDamage(), False
        self._found: _Times | None = None
        self._files = [path, *(Path(f"{path}{suffix}") for suffix in _BESIDE)]
        try:
            self._bag = self._opened()
            is_bag = self._bag.execute(_TABLES).fetchone()[0] == 2 and self._columns() == _EXPECTED
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
        self._topics = {
            key: (str(name), str(kind) if encoding == "cdr" else "")
            for key, name, kind, encoding in rows
            if isinstance(key, int)
        }

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of all topics."""
        return dict(self._topics.values())

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where the file is damaged."""
        found = self._times()
        return None if found.fault else {name: found.counts[key] for key, (name, _) in self._topics.items()}

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time; None without messages, and where the file is damaged."""
        found = self._times()
        return None if found.fault else found.span_ns

    def image_spans_ns(self) -> Mapping[str, tuple[int, int]]:
        """Return the first and last log time of each topic of images."""
        return self._times().order.spans_ns

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time.

        Where the recorder's clock was set back, the messages after it follow those before it.
        """
        wanted = {key: topic for key, topic in self._topics.items() if topics is None or topic[0] in topics}
        broken, count, fault = 0, 0, self._times().fault
        rows = self._as_written(wanted) if self._times().in_order else self._sorted(wanted)
        try:
            for key, time_ns, data in rows:
                if self._closed:
                    return
                if key not in wanted:
                    continue
                if isinstance(data, bytes) and isinstance(time_ns, int):
                    count += 1
                    yield LoggedMessage(*wanted[key], time_ns, partial(bytes, data))
                else:
                    broken += 1
        except _FAULTS as error:
            fault = _line(error)
        if self._closed:
            return
        line = f"the bag {self.name!r} is cut or corrupt after {count} messages ({fault}): used those before"
        self._damage = LogDamage(broken, line if fault else "")

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._closed = True
        self._bag.close()

    def _as_written(self, wanted: Collection[Any]) -> Iterator[tuple[Any, ...]]:
        """Yield topic, time and data of rows; data of other topics than the wanted ones is not read."""
        yield from self._rows(_AS_WRITTEN.format(ids=", ".join(map(str, wanted))))

    def _sorted(self, wanted: Mapping[Any, tuple[str, str]]) -> Iterator[tuple[Any, ...]]:
        """Yield topic, time and data of the wanted rows by time, as far as they can be read.

        Their times are sorted in a database of their own, which is on the disk where it does not fit the memory.
        """
        order = self._times().order
        with closing(sqlite3.connect("", check_same_thread=False)) as sorting:
            sorting.execute("CREATE TABLE rows (segment, timestamp, id, topic)")
            sorting.executemany("INSERT INTO rows VALUES (?, ?, ?, ?)", self._placed(wanted, order))
            for key, time_ns, row in sorting.execute(
                "SELECT topic, timestamp, id FROM rows ORDER BY segment, timestamp, id"
            ):
                try:
                    data = self._bag.execute(_DATA, (row,)).fetchone()
                except _FAULTS:
                    data = None
                yield key, time_ns, data[0] if data else None

    def _placed(self, wanted: Mapping[Any, tuple[str, str]], order: FileOrder) -> Iterator[tuple[Any, ...]]:
        """Yield segment, time, number and topic of the wanted rows up to the first damage."""
        try:
            for key, time_ns, row in self._rows(_TIMES):
                if key in wanted and isinstance(time_ns, int):
                    yield order.segment(wanted[key][0], (0, row)), time_ns, row, key
        except _FAULTS:
            return

    def _times(self) -> _Times:
        """Return counts, span and order of the messages, as far as they can be read."""
        if self._found is not None:
            return self._found
        found = self._found = _Times()
        try:
            for key, time_ns, row in self._rows(_TIMES):
                found.counts[key] += 1
                if not isinstance(time_ns, int):
                    continue
                found.in_order = found.in_order and (not found.span_ns or time_ns >= found.span_ns[1])
                found.span_ns = widened(found.span_ns, time_ns)
                name, kind = self._topics.get(key, ("", ""))
                if kind in IMAGE_TYPES:
                    found.order.add(name, time_ns, (0, row))
        except _FAULTS as error:
            found.fault = _line(error)
        found.order.finish()
        return found

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, as many and as large as the file can hold; then raise sqlite3.DatabaseError."""
        self._bound_work(self._bag)
        rows = total_bytes = 0
        for row in self._bag.execute(query):
            rows, total_bytes = rows + 1, total_bytes + sum(len(value) for value in row if isinstance(value, bytes))
            if max(rows * _LEAST_ROW_BYTES, total_bytes) > self._bytes and (
                max(rows * _LEAST_ROW_BYTES, total_bytes) > self._measured_bytes()
            ):
                raise sqlite3.DatabaseError(_TOO_MANY)
            yield row

    def _columns(self) -> list[str]:
        return [name for (name,) in self._bag.execute(_COLUMNS)]

    def _opened(self) -> sqlite3.Connection:
        """Open the file for reading from any thread; it may be damaged or hostile. Raise sqlite3.Error.

        SQLite must write where it finds a journal, or a write-ahead log in a folder that cannot be written: then all
        files are copied. A file that had a write-ahead log is read as one that does not change.
        """
        self._measured_bytes()
        try:
            return self._connected(self._files[0], "ro")
        except sqlite3.Error:
            if not any(file.exists() for file in self._files[1:]):
                return self._connected(self._files[0], "ro&immutable=1")  # else it locks what nobody writes
        with scratch_folder(self.name, self._bytes) as folder:
            for file in filter(Path.exists, self._files):
                shutil.copyfile(file, folder / file.name)
            return self._connected(folder / self._files[0].name, "rw")

    def _connected(self, path: Path, mode: str) -> sqlite3.Connection:
        """Connect to a file, and read from it for the first time."""
        uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD_BYTES)
            for pragma in _PRAGMAS:
                database.execute(f"PRAGMA {pragma}")
            database.text_factory = partial(str, encoding="utf-8", errors="replace")
            self._bound_work(database)
            database.execute(_TABLES).fetchone()
        except BaseException:
            database.close()
            raise
        return database

    def _measured_bytes(self) -> int:
        """Return the size of the file and of what is beside it; they grow while it is recorded."""
        sizes = [file.stat().st_size for file in self._files if file.exists()]
        self._bytes = max(sum(sizes), self._bytes)
        return self._bytes

    def _bound_work(self, database: sqlite3.Connection) -> None:
        """Bound the instructions of the next queries by the number of rows that fit; beyond it sqlite3.Error.

        In a hostile file many pages refer to the same one, so that a query over a small file may never end.
        """
        rows = self._measured_bytes() // _LEAST_ROW_BYTES
        left = max(_FEWEST_INSTRUCTIONS, rows * _ROW_INSTRUCTIONS) // _BLOCK

        def is_too_long() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        database.set_progress_handler(is_too_long, _BLOCK)


def _line(error: Exception) -> str:
    """Return an error in one line: SQLite quotes the file, which may contain anything."""
    return " ".join(str(error).split())[:_MAX_REASON] or type(error).__name__
