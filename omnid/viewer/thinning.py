"""Which of many to keep, so that a long run stays small."""

from __future__ import annotations


class Thinning:
    """Says of each that comes whether to keep it: every one for as long as there are few, then every 2nd, 4th, 8th.

    Each rate serves for `most` of them, so n become some most * log2(n / most). expected: how many there will be, if
    that is known; they are then thinned evenly.
    """

    def __init__(self, most: int, expected: int = 0) -> None:
        self._most = most
        self._step = max(1, -(-expected // most))
        self._seen = self._kept = 0

    def __call__(self) -> bool:
        """Whether to keep the next one."""
        kept = self._seen % self._step == 0
        self._seen += 1
        self._kept += kept
        if kept and self._kept % self._most == 0:
            self._step *= 2
        return kept
