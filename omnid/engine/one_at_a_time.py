"""A lock for work that several threads may ask for, of which one is to do it while the others wait."""

from __future__ import annotations

import threading
from types import TracebackType


class OneAtATime:
    """A context that one thread at a time is in."""

    __slots__ = ("_lock",)

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()
