"""Calls in threads of their own, which may take longer than their caller can wait now."""

from __future__ import annotations

import threading
from collections.abc import Callable


def returns_within(action: Callable[[], None], timeout_s: float, name: str) -> bool:
    """Call an action in a thread; return whether it has returned in time.

    Otherwise it continues in its thread, which does not keep the program from ending. For the end of a run: what the
    action uses must not be used afterwards.
    """
    thread = threading.Thread(target=action, name=name, daemon=True)
    thread.start()
    thread.join(timeout_s)
    return not thread.is_alive()


def started(action: Callable[[], None], name: str) -> Callable[[], None]:
    """Call an action in a thread; return a function that waits for its end.

    The thread does not keep the program from ending. What the action raises is lost.
    """
    thread = threading.Thread(target=action, name=name, daemon=True)
    thread.start()
    return thread.join
