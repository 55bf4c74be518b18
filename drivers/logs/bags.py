"""Bags of ROS 1 (.bag, format 2.0), read by rosbags, and of ROS 2 in SQLite (.db3), read by Python's sqlite3.

Layout of the latter, as `ros2 bag record -s sqlite3` writes it: rosbag2_storage_sqlite3, versions 1 to 4: table topics
(id, name, type, serialization_format, ...) and table messages (id, topic_id, timestamp [ns], data). A write-ahead log
beside the file counts, as a recorder that was killed leaves it. rosbags reads neither that, nor a bag without
metadata.yaml, nor messages that are compressed one by one.

Each row has bytes of its own in a file that is whole. So a file of N bytes, with its write-ahead log, has at most N / 8
rows with N bytes of data, and what has more is damaged: its pages are named more than once.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from rosbags.rosbag1 import Reader

from drivers.errors import DriverError
from drivers.logs.log import MAX_RECORD_BYTES, LogDamage, LoggedMessage, widened

SQLITE_MAGIC: Final = b"SQLite format 3\0"
_MAX_TOPICS: Final = 4096
_MAX_REASON: Final = 120  # characters
_LEAST_ROW_BYTES: Final = 8  # pointer, sizes, number, and the types of four columns
_ROW_INSTRUCTIONS: Final = 100  # Instructions of SQLite that a row may take; it needs 10 to 20, sorted twice as many.
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
_TIMES: Final = "SELECT topic_id, timestamp FROM messages NOT INDEXED ORDER BY rowid"
_AS_WRITTEN: Final = (
    "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({ids}) THEN data END FROM messages NOT INDEXED ORDER BY rowid"
)
_BY_TIME: Final = (  # sorted on the disk where it does not fit the memory
    "SELECT topic_id, timestamp, rowid FROM messages NOT INDEXED WHERE topic_id IN ({ids}) ORDER BY timestamp, rowid"
)
_DATA: Final = "SELECT data FROM messages WHERE rowid = ?"
_TOO_MANY: Final = "it has more rows than its size allows"


@dataclass(slots=True)
class _Times:
    """What a look at the times of all messages has found."""

    counts: Counter[object] = field(default_factory=Counter)  # by topic
    span_ns: tuple[int, int] | None = None
    in_order: bool = True
    complete: bool = False  # False: the file is damaged


class _Bag:
    """State that the bags of both kinds share."""

    def __init__(self, path: Path) -> None:
        self.name, self._path = str(path), path
        self._damage, self._closed = LogDamage(), False

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage


class SqliteBag(_Bag):
    """A Log of one .db3 file; raises DriverError where it is no bag."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._found: _Times | None = None
        try:
            self._bag = _opened(path)
            self._bound_work()
            is_bag = (
                self._bag.execute(_TABLES).fetchone()[0] == 2
                and [name for (name,) in self._bag.execute(_COLUMNS)] == _EXPECTED
            )
            rows = self._bag.execute(_TOPICS).fetchall() if is_bag else []
        except (sqlite3.Error, OSError, OverflowError, ValueError) as error:
            log = Path(f"{path}-wal").exists()
            advice = "copy it with its -wal file to a folder that can be written" if log else "`sqlite3 FILE .recover`"
            raise DriverError(
                f"cannot read the bag {self.name!r}: {_line(error)}; if the recording was cut, try: {advice}"
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
        return {name: found.counts[key] for key, (name, _) in self._topics.items()} if found.complete else None

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time; None without messages, and where the file is damaged."""
        found = self._times()
        return found.span_ns if found.complete else None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time."""
        wanted = {key: topic for key, topic in self._topics.items() if topics is None or topic[0] in topics}
        in_order = self._times().in_order
        query = (_AS_WRITTEN if in_order else _BY_TIME).format(ids=", ".join(map(str, wanted)))
        broken, count = 0, 0
        try:
            for key, time_ns, found in self._rows(query):
                if self._closed:
                    return
                if key not in wanted:
                    continue
                count += 1
                data = found if in_order else self._bag.execute(_DATA, (found,)).fetchone()[0]
                if isinstance(data, bytes) and isinstance(time_ns, int):
                    yield LoggedMessage(*wanted[key], time_ns, partial(bytes, data))
                else:
                    broken += 1
            self._damage = LogDamage(broken)
        except (sqlite3.Error, OverflowError) as error:
            if not self._closed:
                line = f"is cut or corrupt after {count} messages ({_line(error)}): used those before"
                self._damage = LogDamage(broken, f"the bag {self.name!r} {line}")

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._closed = True
        self._bag.close()

    def _times(self) -> _Times:
        """Return counts, span and order of the messages, as far as they can be read."""
        if self._found is None:
            found = self._found = _Times()
            try:
                for key, time_ns in self._rows(_TIMES):
                    found.counts[key] += 1
                    if isinstance(time_ns, int):
                        found.in_order = found.in_order and (not found.span_ns or time_ns >= found.span_ns[1])
                        found.span_ns = widened(found.span_ns, time_ns)
                found.complete = True
            except (sqlite3.Error, OverflowError):
                # A sorted reading would end at the damage, before its first message.
                found.in_order = True
        return self._found

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, as many and as large as the file can hold; then raise sqlite3.DatabaseError."""
        self._bound_work()
        rows = total_bytes = 0
        for row in self._bag.execute(query):
            rows, total_bytes = rows + 1, total_bytes + sum(len(value) for value in row if isinstance(value, bytes))
            if max(rows * _LEAST_ROW_BYTES, total_bytes) > self._bytes and (
                max(rows * _LEAST_ROW_BYTES, total_bytes) > self._measured_bytes()
            ):
                raise sqlite3.DatabaseError(_TOO_MANY)
            yield row

    def _measured_bytes(self) -> int:
        """Return the size of the file and of its write-ahead log; both grow while it is recorded."""
        log = Path(f"{self._path}-wal")
        self._bytes = self._path.stat().st_size + (log.stat().st_size if log.exists() else 0)
        return self._bytes

    def _bound_work(self) -> None:
        """Bound the instructions of the next queries by the number of rows that fit; beyond it sqlite3.Error.

        In a hostile file many pages refer to the same one, so that a query over a small file may never end.
        """
        rows = self._measured_bytes() // _LEAST_ROW_BYTES
        left = max(_FEWEST_INSTRUCTIONS, rows * _ROW_INSTRUCTIONS) // _BLOCK

        def is_too_long() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        self._bag.set_progress_handler(is_too_long, _BLOCK)


def _opened(path: Path) -> sqlite3.Connection:
    """Open a file, which may be damaged or hostile, for reading from any thread. Raise sqlite3.Error."""
    uri = f"file:{quote(str(path.resolve()))}?mode=ro"
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD_BYTES)
        for pragma in _PRAGMAS:
            database.execute(f"PRAGMA {pragma}")
    except BaseException:
        database.close()
        raise
    database.text_factory = partial(str, encoding="utf-8", errors="replace")
    return database


def _line(error: Exception) -> str:
    """Return an error in one line: SQLite quotes the file, which may contain anything."""
    return " ".join(str(error).split())[:_MAX_REASON] or type(error).__name__


ROS1_MAGIC: Final = b"#ROSBAG V2.0\n"


class Ros1Bag(_Bag):
    """A Log of one .bag file; raises DriverError where it cannot be opened.

    rosbags trusts the lengths in a file and raises errors of any kind for a damaged one: all count as damage.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._reader = Reader(path)
        try:
            self._reader.open()
            self._topics = {name: found.msgtype or "" for name, found in self._reader.topics.items()}
            self._counts = {name: found.msgcount for name, found in self._reader.topics.items()}
        except Exception as error:
            raise DriverError(
                f"cannot read the bag {self.name!r}: {_line(error)}; if it was cut, `rosbag reindex` mends it"
            ) from error

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of all topics."""
        return self._topics

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic by the index."""
        return self._counts

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time by the index; None without messages."""
        return (self._reader.start_time, self._reader.end_time - 1) if any(self._counts.values()) else None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time."""
        wanted = [connection for connection in self._reader.connections if topics is None or connection.topic in topics]
        self._damage = LogDamage()
        count = 0
        try:
            for connection, time_ns, data in self._reader.messages(wanted) if wanted else ():
                count += 1
                yield LoggedMessage(connection.topic, connection.msgtype, time_ns, partial(bytes, data), aligned=False)
                if self._closed:
                    return
        except Exception as error:
            line = f"the bag {self.name!r} is corrupt after {count} messages ({_line(error)}): used those before"
            self._damage = LogDamage(cut=line)

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._closed = True
        with suppress(Exception):  # it is closed already
            self._reader.close()
