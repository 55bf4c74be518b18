"""Load shedding of a live run: work that is omitted, and in which order, while the computer is too slow."""

from __future__ import annotations

from typing import Final

from omnid.diagnostics.status import entry
from omnid.engine.telemetry import StageStats
from omnid.load_level import LoadLevel
from omnid.transport.codec import WARN, DiagnosticStatus
from omnid.transport.status_names import LOAD, Key

PERIOD_S: Final = 1.0  # A ticker observes the pairing with this period.
# The computer is too slow where the pairing drops more than this share of the images, twice in a row: dropped images
# cost accuracy. Work is resumed slowly, because it may overload the computer again: where the share was below a fifth
# of that for so many periods. After each attempt that failed the number doubles, up to the second one.
TOO_SLOW: Final = 0.1
PATIENCE: Final = 10, 320

TEXTS: Final = {
    LoadLevel.FULL: "all is computed",
    LoadLevel.SPARSE_MAP: "too slow: a pair a second enters the map",
    LoadLevel.NO_MAP: "too slow: nothing enters the map, no place is recognised, few rings of obstacles",
    LoadLevel.REDUCED: "too slow: no map, no places, half the landmarks, few rings of obstacles",
}


class LoadLadder:
    """Chooses the load level from the share of the images that the pairing drops.

    A ticker calls `observe` with the period PERIOD_S; the pairs of images carry the level to the stages.
    """

    def __init__(self) -> None:
        self.level = LoadLevel.FULL
        self._seen = 0, 0  # numbers of processed and dropped images at the last observation
        self._slow = self._calm = 0  # numbers of consecutive observations
        self._patience = PATIENCE[0]
        self._has_resumed = False  # True if the last change of the level resumed work
        self._changes = 0

    def observe(self, pairing: StageStats) -> LoadLevel:
        """Return the level that follows from the counters of the stage that takes the images."""
        # 1. The share of the images that were dropped since the last observation, and for how many in a row it is high.
        seen = pairing.processed, pairing.dropped
        taken, dropped = (now - before for now, before in zip(seen, self._seen, strict=True))
        share = dropped / max(1, taken + dropped)
        self._seen = seen
        self._slow = self._slow + 1 if share > TOO_SLOW else 0
        self._calm = self._calm + 1 if share < TOO_SLOW / 5 else 0
        # 2. One level more or less; an attempt to resume work that failed makes the next one wait longer.
        is_too_slow, is_calm = self._slow >= 2, self._calm >= self._patience
        if is_too_slow and self.level < max(LoadLevel):
            if self._has_resumed:
                self._patience = min(2 * self._patience, PATIENCE[1])
            self._change(LoadLevel(self.level + 1))
        elif is_calm and self.level > LoadLevel.FULL:
            self._change(LoadLevel(self.level - 1))
        return self.level

    def _change(self, level: LoadLevel) -> None:
        self._has_resumed = level < self.level
        self.level, self._slow, self._calm = level, 0, 0
        self._changes += 1

    def status(self) -> DiagnosticStatus:
        """Return the level as a status."""
        values = {Key.LEVEL: int(self.level), "changes": self._changes}
        return entry(LOAD, values, (self.level, WARN, TEXTS[self.level]), words=TEXTS[self.level])
