"""Load shedding of a live run: work that is omitted, and in which order, while the computer is too slow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from omnid.engine.telemetry import StageStats
from omnid.load_level import LoadLevel
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import LOAD, Key

PERIOD_S: Final = 1.0  # A ticker observes the pairing with this period.
# The computer is too slow if the pairing drops more than this share of the images, and keeps up if the share is below
# the smaller limit. In between the level stays, so that it does not alternate.
TOO_SLOW: Final = 0.1
KEEPS_UP: Final = 0.02
# Consecutive observations that are needed to omit more work, or to resume some. Omitting is fast, because dropped
# images cost accuracy; resuming is slow, because it may overload the computer again.
OBSERVATIONS_UP: Final = 2
OBSERVATIONS_DOWN: Final = 10
# If the computer is too slow again after work was resumed, the wait for the next attempt is doubled, up to this number.
MAX_OBSERVATIONS_DOWN: Final = 320

TEXTS: Final[Mapping[LoadLevel, str]] = {
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
        self._patience = OBSERVATIONS_DOWN  # observations that are needed before the next attempt to resume work
        self._descended = False  # True if the last change of the level resumed work
        self._changes = 0

    def observe(self, pairing: StageStats) -> LoadLevel:
        """Return the level that follows from the counters of the stage that takes the images."""
        # 1. The share of the images that were dropped since the last observation.
        seen = pairing.processed, pairing.dropped
        taken, dropped = (now - before for now, before in zip(seen, self._seen, strict=True))
        self._seen = seen
        share = dropped / max(1, taken + dropped)
        # 2. For how many observations in a row it has been above or below the limits.
        self._slow = self._slow + 1 if share > TOO_SLOW else 0
        self._calm = self._calm + 1 if share < KEEPS_UP else 0
        # 3. One level more or less; an attempt to resume work that failed makes the next one wait longer.
        if self._slow >= OBSERVATIONS_UP and self.level < max(LoadLevel):
            if self._descended:
                self._patience = min(2 * self._patience, MAX_OBSERVATIONS_DOWN)
            self._descended = False
            self._change(LoadLevel(self.level + 1))
        elif self._calm >= self._patience and self.level > LoadLevel.FULL:
            self._descended = True
            self._change(LoadLevel(self.level - 1))
        return self.level

    def _change(self, level: LoadLevel) -> None:
        self.level, self._slow, self._calm = level, 0, 0
        self._changes += 1

    def status(self) -> DiagnosticStatus:
        """Return the level as a status."""
        values = {Key.LEVEL: int(self.level), "changes": self._changes}
        return DiagnosticStatus.of(LOAD, WARN if self.level else OK, TEXTS[self.level], values)
