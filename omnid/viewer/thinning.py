"""Selection of messages to keep, so that the view of a long run stays small."""

from __future__ import annotations


class Thinning:
    """Keeps every message at first, then every 2nd, 4th, 8th ...

    Each rate serves for `most` kept messages, so that of n about most * log2(n / most) are kept. expected: number of
    messages, where it is known; they are thinned evenly then.
    """

    def __init__(self, most: int, expected: int = 0) -> None:
        self._most = most
        self._step = max(1, -(-expected // most))
        self._count = self._kept = 0

    def __call__(self) -> bool:
        """Return whether to keep the next message."""
        keep = self._count % self._step == 0
        self._count += 1
        self._kept += keep
        if keep and self._kept % self._most == 0:
            self._step *= 2
        return keep
