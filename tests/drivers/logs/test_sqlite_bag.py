"""Bags of ROS 2 in SQLite: the frames of the same MCAP file; files that are no bag, or have no end."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.logs.log_formats import log_info
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_info import LogState
from drivers.logs.sqlite_bag import SqliteBag
from tests.drivers.logs.bags import write_db3
from tests.drivers.logs.foreign_logs import PAIRS, expected, read
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, Entry, jpeg, pairs
from tests.drivers.logs.repeated_pages import repeat_pages


@pytest.mark.parametrize("zstd", [False, True])
def test_an_sqlite_bag_has_the_frames_of_the_same_mcap(tmp_path: Path, zstd: bool) -> None:
    path = write_db3(tmp_path / "bag", pairs(PAIRS), zstd)
    found, reader = read(path)
    assert found == expected(tmp_path) and not reader.warnings and not reader.truncated
    assert reader.pair_estimate is not None
    assert read(tmp_path / "bag")[0] == found
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS and again.attachments() == {}


def test_an_sqlite_file_that_is_no_bag(tmp_path: Path) -> None:
    path = tmp_path / "notes.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE notes (text)")
        database.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


def test_a_view_in_place_of_the_messages_is_refused(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "bag", pairs(1))
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("DROP TABLE messages")
        bag.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, 0 AS timestamp, zeroblob(1000) AS data FROM n"
        )
        bag.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


def test_a_message_of_another_type_is_left_out(tmp_path: Path) -> None:
    entries = [Entry(LOWER, COMPRESSED, b"\0\1\0\0junk", START_NS), *pairs(2)]
    found, reader = read(write_db3(tmp_path / "bag", entries))
    assert len(found) == 4 and reader.counts["broken"] == 1 and jpeg(1)


def test_a_bag_whose_pages_are_named_again_and_again_ends(tmp_path: Path) -> None:
    """500**6 times the rows of one leaf: neither those that are wanted nor those of other topics are read for ever."""
    path = write_db3(tmp_path / "bag", [Entry(LOWER, COMPRESSED, b"\0\1\0\0", START_NS)] * 8)
    repeat_pages(path)
    assert path.stat().st_size < 100_000
    with closing(SqliteBag(path)) as bag:
        assert bag.counts() is None
        assert len(list(bag.messages())) <= path.stat().st_size // 8
        assert "more rows than its size allows" in bag.damage().cut
        bag._topics = {99: (LOWER, COMPRESSED)}
        assert list(bag.messages()) == [] and "interrupted" in bag.damage().cut
    assert log_info(path).state is LogState.BROKEN


@pytest.mark.parametrize(
    "columns",
    ["data, topic_id, timestamp, id INTEGER PRIMARY KEY", "id INTEGER PRIMARY KEY, topic_id AS (1), timestamp, data"],
)
def test_a_table_of_other_columns_is_no_bag(tmp_path: Path, columns: str) -> None:
    path = write_db3(tmp_path / "bag", pairs(1))
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("DROP TABLE messages")
        bag.execute(f"CREATE TABLE messages ({columns})")
        bag.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)
