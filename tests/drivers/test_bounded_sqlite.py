"""SQLite files are opened for reading, with bounds of values and of work."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from drivers.bounded_sqlite import bound_work, open_bounded


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "a b?.db"  # characters that a URI would take for its own
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE rows (value)")
        database.executemany("INSERT INTO rows VALUES (?)", [(bytes(10),), (bytes(1000),)])
        database.commit()
    return path


@pytest.mark.parametrize("unchanging", [True, False])
def test_values_are_bounded_and_nothing_is_written(path: Path, unchanging: bool) -> None:
    with closing(open_bounded(path, 500, unchanging=unchanging)) as database:
        assert database.execute("SELECT length(value) FROM rows WHERE rowid = 1").fetchone() == (10,)
        with pytest.raises(sqlite3.Error):
            database.execute("SELECT value FROM rows WHERE rowid = 2").fetchone()
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            database.execute("DELETE FROM rows")


def test_endless_queries_end(path: Path) -> None:
    endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT count(*) FROM n"
    with closing(open_bounded(path, 500)) as database:
        bound_work(database, 1_000_000)
        with pytest.raises(sqlite3.OperationalError, match="interrupted"):
            database.execute(endless).fetchone()


def test_a_missing_file_is_an_error_and_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.Error):
        open_bounded(tmp_path / "missing.db", 500).execute("SELECT 1 FROM rows")
    assert not (tmp_path / "missing.db").exists()
