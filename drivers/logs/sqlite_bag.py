"""The images of a bag of ROS 2 in SQLite (.db3), as `ros2 bag record -s sqlite3` writes it.

Layout: rosbag2_storage_sqlite3, versions 1 to 4: table topics (id, name, type, serialization_format, ...) and table
messages (id, topic_id, timestamp [ns], data). A message may be compressed by zstd.

Each row has bytes of its own in a file that is whole. So a file of N bytes has at most N / 8 rows with N bytes of data,
and what has more is damaged: its pages are named more than once.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

import zstandard

from drivers.bounded_sqlite import bound_work, open_bounded
from drivers.errors import DriverError
from drivers.logs.image_log import LogDamage, LoggedImage, LoggedMotion, logged_message
from drivers.logs.mcap_records import MAX_RECORD_BYTES, RecordError
from drivers.logs.ros_image import IMAGE_TYPES
from drivers.logs.ros_motion import MOTION_TYPES

MAGIC: Final = b"SQLite format 3\0"
_MAX_TOPICS: Final = 4096
_MAX_REASON: Final = 120  # characters
_LEAST_LIMIT: Final = 2**16  # bytes of a value or a query
_ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame, RFC 8878
_TABLES: Final = (
    "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages') "
    "AND sql LIKE 'CREATE TABLE%'"
)
# The pragma lists no computed columns. The small columns come first, so that reading them never reads a whole row.
_COLUMNS: Final = "SELECT name FROM pragma_table_info('messages') LIMIT 4"
_EXPECTED: Final = ["id", "topic_id", "timestamp", "data"]
_LEAST_ROW_BYTES: Final = 8  # pointer, sizes, number, and the types of four columns
_ROW_INSTRUCTIONS: Final = 100  # Instructions of SQLite that a row may take; it needs 10 to 20.
_FEWEST_INSTRUCTIONS: Final = 1_000_000
_TOPICS: Final = (
    f"SELECT id, substr(name, 1, 256), substr(type, 1, 256), serialization_format FROM topics LIMIT {_MAX_TOPICS}"
)
# In the order of writing, which needs neither index nor sorting: that of the time is by the stamps of the images.
_MESSAGES: Final = (
    "SELECT topic_id, timestamp, data FROM messages WHERE typeof(topic_id) = 'integer' "
    "AND topic_id IN ({}) ORDER BY rowid"
)
_TOPIC_OF_EACH: Final = "SELECT topic_id FROM messages WHERE typeof(topic_id) = 'integer' ORDER BY rowid"
_TOO_MANY: Final = "it has more rows than its size allows"


class SqliteBag:
    """An ImageLog of one .db3 file; raises DriverError where it is no bag."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._damage = LogDamage()
        self._closed = False
        try:
            self._bytes = path.stat().st_size
            self._bag = open_bounded(path, max(_LEAST_LIMIT, min(MAX_RECORD_BYTES, self._bytes)))
            self._bag.text_factory = _text
            self._bound_work()
            is_bag = (
                self._bag.execute(_TABLES).fetchone()[0] == 2
                and [name for (name,) in self._bag.execute(_COLUMNS)] == _EXPECTED
            )
            self._topics = (
                {}
                if not is_bag
                else {
                    _integer(key): (str(name), str(kind) if encoding == "cdr" else "")
                    for key, name, kind, encoding in self._bag.execute(_TOPICS)
                }
            )
        except (sqlite3.Error, OSError, OverflowError, ValueError) as error:
            raise DriverError(
                f"cannot read the bag {self.name!r}: {_line(error)}; if the recording was cut, try "
                "`sqlite3 FILE .recover`"
            ) from error
        if not is_bag:
            self.close()
            raise DriverError(
                f"{self.name!r} is an SQLite file, but no bag of ROS 2: it has no tables topics and "
                "messages as one has; give the .db3 file that `ros2 bag record` wrote"
            )

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of all topics."""
        return dict(self._topics.values())

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where the file is damaged."""
        try:
            with closing(self._rows(_TOPIC_OF_EACH)) as rows:
                found = Counter(key for (key,) in rows)
        except sqlite3.Error:
            return None
        return {name: found[key] for key, (name, _) in self._topics.items()}

    def messages(self) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the messages in the order in which they were written."""
        wanted = {key: topic for key, topic in self._topics.items() if topic[1] in (*IMAGE_TYPES, *MOTION_TYPES)}
        broken, count = 0, 0
        try:
            with closing(self._rows(_MESSAGES.format(", ".join(map(str, wanted))))) as rows:
                for key, time_ns, data in rows:
                    count += 1
                    logged = None
                    if isinstance(data, bytes) and isinstance(time_ns, int):
                        logged = logged_message(*wanted[key], time_ns, partial(_unpacked, data))
                    if logged is not None:
                        yield logged
                    else:
                        broken += 1
                    if self._closed:
                        return
            self._damage = LogDamage(broken)
        except sqlite3.Error as error:
            if not self._closed:
                self._damage = LogDamage(
                    broken,
                    f"the bag {self.name!r} is cut or corrupt after {count} messages "
                    f"({_line(error)}): used those before",
                )

    def _rows(self, query: str) -> Generator[tuple[Any, ...], None, None]:
        """Yield the rows of a query, as many and as large as the file can hold; then raise sqlite3.DatabaseError."""
        self._bound_work()
        rows_left, bytes_left = self._bytes // _LEAST_ROW_BYTES, self._bytes
        for row in self._bag.execute(query):
            rows_left, bytes_left = rows_left - 1, bytes_left - sum(len(v) for v in row if isinstance(v, bytes))
            if rows_left < 0 or bytes_left < 0:
                raise sqlite3.DatabaseError(_TOO_MANY)
            yield row

    def _bound_work(self) -> None:
        bound_work(self._bag, max(_FEWEST_INSTRUCTIONS, self._bytes // _LEAST_ROW_BYTES * _ROW_INSTRUCTIONS))

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        self._bag.close()


def _unpacked(data: bytes) -> memoryview:
    """Return a message that may be compressed; raise RecordError where it does not unpack."""
    if not data.startswith(_ZSTD):
        return memoryview(data)
    try:
        return memoryview(zstandard.ZstdDecompressor().stream_reader(data).read(MAX_RECORD_BYTES))
    except (zstandard.ZstdError, MemoryError) as error:
        raise RecordError(f"a compressed message does not unpack: {error}") from error


def _line(error: Exception) -> str:
    """Return an error in one line: SQLite quotes the file, which may contain anything."""
    return " ".join(str(error).split())[:_MAX_REASON]


def _text(value: bytes) -> str:
    return value.decode("utf-8", "replace")


def _integer(value: object) -> int:
    if not isinstance(value, int):
        raise ValueError(f"a topic has the id {value!r}")
    return value
