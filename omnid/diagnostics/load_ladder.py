"""Load shedding of a live run: what is given up, and in which order, while the computer is too slow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from omnid.engine.telemetry import StageStats
from omnid.transport.codec import OK, WARN, DiagnosticStatus
from omnid.transport.status_names import LOAD, Key

PERIOD_S: Final = 1.0  # between two observations
TOO_SLOW: Final = 0.1  # share of the images dropped in front of the pairing from which the computer is too slow
KEEPS_UP: Final = 0.02  # share below which it keeps up
OBSERVATIONS_UP: Final = 2  # consecutive ones, too slow, before more is given up
OBSERVATIONS_DOWN: Final = 10  # consecutive ones, keeping up, before something is taken up again
# Where more load is given up soon after some was taken up again, the next attempt comes later, up to this time.
MAX_OBSERVATIONS_DOWN: Final = 320


@dataclass(frozen=True, slots=True)
class LoadLevel:
    """Level of load shedding."""

    name: str
    map_period_s: float  # least time between two pairs that enter the map
    features: float  # share of the landmarks wanted in a keyframe
    ring_period_s: float  # least time between two obstacle rings; the collision monitor slows down by their age


# The map gives way first: it changes slowly, and its dense stereo costs half as much as a pose.
LEVELS: Final = (
    LoadLevel("all is computed", 0.0, 1.0, 0.0),
    LoadLevel("too slow: a pair a second enters the map", 1.0, 1.0, 0.0),
    LoadLevel("too slow: nothing enters the map, no place is recognised", math.inf, 1.0, 0.3),
    LoadLevel("too slow: no map, no places, half the landmarks, few rings of obstacles", math.inf, 0.5, 0.45),
)


class LoadLadder:
    """Chooses the level from the images that the pairing has to drop; a ticker calls it every PERIOD_S.

    Stages read `level` from other threads.
    """

    def __init__(self) -> None:
        self._number = 0
        self._seen = 0, 0  # processed and dropped at the last observation
        self._slow = self._calm = 0  # consecutive observations
        self._patience = OBSERVATIONS_DOWN
        self._descended = False  # the last change took something up again
        self._changes = 0

    @property
    def level(self) -> LoadLevel:
        """The level now."""
        return LEVELS[self._number]

    def observe(self, pairing: StageStats) -> None:
        """Choose the level from the counters of the stage that takes the images."""
        seen = pairing.processed, pairing.dropped
        taken, dropped = (now - before for now, before in zip(seen, self._seen, strict=True))
        self._seen = seen
        share = dropped / max(1, taken + dropped)
        self._slow = self._slow + 1 if share > TOO_SLOW else 0
        self._calm = self._calm + 1 if share < KEEPS_UP else 0
        if self._slow >= OBSERVATIONS_UP and self._number < len(LEVELS) - 1:
            if self._descended:
                self._patience = min(2 * self._patience, MAX_OBSERVATIONS_DOWN)
            self._descended = False
            self._change(self._number + 1)
        elif self._calm >= self._patience and self._number > 0:
            self._descended = True
            self._change(self._number - 1)

    def _change(self, number: int) -> None:
        self._number, self._slow, self._calm = number, 0, 0
        self._changes += 1

    def status(self) -> DiagnosticStatus:
        """Return the level as a status."""
        values = {str(Key.LEVEL): str(self._number), "changes": str(self._changes)}
        return DiagnosticStatus(LOAD, WARN if self._number else OK, self.level.name, values)
