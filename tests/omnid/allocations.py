"""Memory that a piece of work allocates, in Python and numpy."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import NamedTuple


class Taken(NamedTuple):
    """Bytes at the most while it went on, and bytes that were still held when it was done."""

    most: int
    held: int


def taken(work: Callable[[], object]) -> Taken:
    """By the work; what it gives counts as held."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        result = work()
        after, most = tracemalloc.get_traced_memory()
        del result
    finally:
        tracemalloc.stop()
    return Taken(most - before, after - before)
