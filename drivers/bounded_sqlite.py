"""SQLite files that may be damaged or hostile: opened read-only, with bounds of values and of work.

In such a file many pages may refer to the same one, so that a small file has any number of rows, and a query over it
ends by a bound only.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Final
from urllib.parse import quote

_BLOCK: Final = 10_000  # instructions of SQLite's virtual machine between two calls of the progress handler
_PRAGMAS: Final = ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0")


def open_bounded(path: Path, most_value_bytes: int, *, unchanging: bool = False) -> sqlite3.Connection:
    """Open a file for reading, from any thread; no value of more bytes is read from it.

    unchanging: no program writes the file meanwhile, so that it needs no lock. Raises sqlite3.Error.
    """
    options = "mode=ro&immutable=1" if unchanging else "mode=ro"
    database = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{options}", uri=True, check_same_thread=False)
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, most_value_bytes)
        for pragma in _PRAGMAS:
            database.execute(f"PRAGMA {pragma}")
    except BaseException:
        database.close()
        raise
    return database


def bound_work(database: sqlite3.Connection, most_instructions: int) -> None:
    """Bound the instructions of all later queries together, to a multiple of _BLOCK; beyond it sqlite3.Error."""
    left = most_instructions // _BLOCK + 1

    def is_too_long() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    database.set_progress_handler(is_too_long, _BLOCK)
