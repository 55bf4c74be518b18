"""Growing waits between tries: for a port, a camera or a disk that is gone for a moment, or for a day."""

from __future__ import annotations


class Backoff:
    """Waits that double from 0.1 s up to 2 s; reads no clock and does not wait itself."""

    _next_s: float

    def __init__(self) -> None:
        self.reset()

    def next_s(self) -> float:
        """Return the wait before the next try [s]."""
        wait_s, self._next_s = self._next_s, min(2 * self._next_s, 2.0)
        return wait_s

    def reset(self) -> None:
        """Begin again with the first wait, after a success."""
        self._next_s = 0.1
