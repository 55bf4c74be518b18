"""Stamps are whole nanoseconds, durations are seconds: from one to the other."""

from __future__ import annotations

from typing import Final

S_PER_NS: Final = 1e-9  # exact, by the definition of the prefix
NS_PER_S: Final = 10**9
STAMP_JITTER_NS: Final = 5_000_000  # What is early by less is due, because stamps of cameras jitter.


class SecondsSinceFirst:
    """Times since the first stamp, because seconds since 1970 have too few digits of a float."""

    def __init__(self) -> None:
        self._zero_ns: int | None = None

    def seconds(self, stamp_ns: int) -> float:
        """Return the time [s] since the first stamp that was asked for."""
        if self._zero_ns is None:
            self._zero_ns = stamp_ns
        return (stamp_ns - self._zero_ns) * S_PER_NS
