"""Load shedding of a live run: what is given up, and in which order, while the computer is too slow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from omnid.engine.telemetry import StageStats
from omnid.load_level import LoadLevel
from omnid.transport.codec import OK, WARN
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import LOAD, Key

PERIOD_S: Final = 1.0  # between two observations
TOO_SLOW: Final = 0.1  # share of the images dropped in front of the pairing from which the computer is too slow
KEEPS_UP: Final = 0.02  # share below which it keeps up
OBSERVATIONS_UP: Final = 2  # consecutive ones, too slow, before more is given up
OBSERVATIONS_DOWN: Final = 10  # consecutive ones, keeping up, before something is taken up again
# Where more load is given up soon after some was taken up again, the next attempt comes later, up to this time.
MAX_OBSERVATIONS_DOWN: Final = 320


TEXTS: Final[Mapping[LoadLevel, str]] = {
    LoadLevel.FULL: "all is computed",
    LoadLevel.SPARSE_MAP: "too slow: a pair a second enters the map",
    LoadLevel.NO_MAP: "too slow: nothing enters the map, no place is recognised, few rings of obstacles",
    LoadLevel.REDUCED: "too slow: no map, no places, half the landmarks, few rings of obstacles",
}


class LoadLadder:
    """Chooses the level from the images that the pairing has to drop; a ticker calls it every PERIOD_S.

    Stages read `level` from other threads.
    """

    def __init__(self) -> None:
        self.level = LoadLevel.FULL
        self._seen = 0, 0  # processed and dropped at the last observation
        self._slow = self._calm = 0  # consecutive observations
        self._patience = OBSERVATIONS_DOWN
        self._descended = False  # the last change took something up again
        self._changes = 0

    def observe(self, pairing: StageStats) -> None:
        """Choose the level from the counters of the stage that takes the images."""
        seen = pairing.processed, pairing.dropped
        taken, dropped = (now - before for now, before in zip(seen, self._seen, strict=True))
        self._seen = seen
        share = dropped / max(1, taken + dropped)
        self._slow = self._slow + 1 if share > TOO_SLOW else 0
        self._calm = self._calm + 1 if share < KEEPS_UP else 0
        if self._slow >= OBSERVATIONS_UP and self.level < max(LoadLevel):
            if self._descended:
                self._patience = min(2 * self._patience, MAX_OBSERVATIONS_DOWN)
            self._descended = False
            self._change(LoadLevel(self.level + 1))
        elif self._calm >= self._patience and self.level > LoadLevel.FULL:
            self._descended = True
            self._change(LoadLevel(self.level - 1))

    def _change(self, level: LoadLevel) -> None:
        self.level, self._slow, self._calm = level, 0, 0
        self._changes += 1

    def status(self) -> DiagnosticStatus:
        """Return the level as a status."""
        values = {str(Key.LEVEL): str(int(self.level)), "changes": str(self._changes)}
        return DiagnosticStatus(LOAD, WARN if self.level else OK, TEXTS[self.level], values)
