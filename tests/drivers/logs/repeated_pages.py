"""An SQLite bag whose interior pages name one leaf again and again: a small file with more rows than a disk holds."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

PAGE_BYTES, LEVELS = 4096, 6
CHILDREN = 500  # of an interior page: cells of 6 bytes and pointers of 2


def repeat_pages(path: Path) -> None:
    """Replace the root of the messages by a tower of interior pages (SQLite file format, section 1.6) over it."""
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("VACUUM")
        (root,) = bag.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
        (size,) = bag.execute("PRAGMA page_size").fetchone()
    assert size == PAGE_BYTES
    data = bytearray(path.read_bytes())
    pages = len(data) // PAGE_BYTES
    data += data[(root - 1) * PAGE_BYTES : root * PAGE_BYTES]  # the old root
    child = pages + 1
    for _ in range(LEVELS - 1):
        data += interior(child)
        child += 1
    data[(root - 1) * PAGE_BYTES : root * PAGE_BYTES] = interior(child)
    data[28:32] = (len(data) // PAGE_BYTES).to_bytes(4, "big")  # pages in the header
    path.write_bytes(data)


def interior(child: int) -> bytes:
    """Return an interior page of a table, all of whose cells name one child."""
    cell = struct.pack(">IB", child, 1)
    cells = cell * CHILDREN
    start = PAGE_BYTES - len(cells)
    pointers = b"".join(struct.pack(">H", start + len(cell) * number) for number in range(CHILDREN))
    head = struct.pack(">BHHHBI", 5, 0, CHILDREN, start, 0, child) + pointers
    return head + bytes(start - len(head)) + cells
