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
    """Return a connection as soon as there is one; None where the time is over first, or a signal came.

    end_s: by time.monotonic(). connect: raises Unreachable while there is none; each new reason is printed once.
    signals: those that came, to which the handler of the caller adds.
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
