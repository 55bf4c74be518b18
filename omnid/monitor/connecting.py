"""A connection to a robot or a router that may not be there yet."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from omnid.transport.session import Unreachable

T = TypeVar("T")
_RETRY_S: Final = 0.5


def connected_until(end_s: float, connect: Callable[[], T], signals: Sequence[int] = ()) -> T | None:
    """Try to connect until it succeeds; return None after end_s or a signal.

    end_s: by time.monotonic(). connect: raises Unreachable without a connection; each new reason is printed once.
    signals: numbers of the signals that came; a handler of the caller adds to it.
    """
    reason = ""
    while not signals and time.monotonic() < end_s:
        try:
            return connect()
        except Unreachable as error:
            if str(error) != reason:
                print(f"omnid: waiting: {error}", file=sys.stderr, flush=True)
            reason = str(error)
        time.sleep(_RETRY_S)
    return None
