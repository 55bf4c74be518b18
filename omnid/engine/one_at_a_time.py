"""A lock for code outside of omnid.engine, where no module imports `threading`."""

from __future__ import annotations

import threading
from types import TracebackType


class OneAtATime:
    """A context manager that one thread at a time enters; others wait. It is not reentrant."""

    __slots__ = ("_lock",)

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()
