"""Growing waits between tries: for a port, a camera or a disk that is gone for a moment, or for a day."""

from __future__ import annotations


class Backoff:
    """Waits that double from 0.1 s up to `longest_s`; reads no clock and does not wait itself."""

    def __init__(self, longest_s: float) -> None:
        self._first_s, self._longest_s = min(0.1, longest_s), longest_s
        self._next_s = self._first_s

    def next_s(self) -> float:
        """Return the wait before the next try [s]."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return wait_s

    def reset(self) -> None:
        """Begin again with the first wait, after a success."""
        self._next_s = self._first_s
