"""Stamps as text."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

UNIX_TIMES_S: Final = (10**9, 2**33)  # 2001 to 2242; the clock of a simulation or of a camera is outside
OTHER_CLOCK_NS: Final = 3_600 * 10**9  # Stamps that differ by more are of two clocks.


def utc(stamp_ns: int) -> str:
    """Return date and time of a stamp (ns) to the millisecond, in ISO 8601; seconds where it is no Unix time."""
    seconds, rest_ns = divmod(stamp_ns, 10**9)
    rest = f"{rest_ns // 10**6:03}"
    if not UNIX_TIMES_S[0] <= seconds < UNIX_TIMES_S[1]:
        return f"{seconds}.{rest} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest}Z"
