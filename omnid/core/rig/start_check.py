"""Check at the start of a run whether the images can be of this rig: cameras exchanged, another mirror, degrees off.

A point that both cameras see lies on the same column of both panoramas, and lower in the upper one. With the cameras
exchanged it lies higher, so the matches downwards from the lower panorama are then fewer than those downwards from the
upper one. A rotation of a camera, or another mirror, moves the columns. In rendered rooms, corridors and bare walls, a
right rig gives 0.00 to 0.41 matches with the cameras exchanged for each match, exchanged ones give 2.0 or more, and one
that is turned by 3 deg is measured within 0.3 deg (four standard deviations subtracted).

A mirror whose scale alone is larger than the rig's moves points along the columns only, which a wrong distance explains
as well: that cannot be seen here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.core.rig.rig_check import (
    BROKEN_DEG,
    DRIFTED_DEG,
    MIN_MATCHES,
    Flags,
    Matches,
    RigFinding,
    judge,
    match,
    together,
)

ROUND_PAIRS: Final = 2  # pairs of a round with enough matches
MOST_ROUND_PAIRS: Final = 8  # pairs of a round where matches are few
CONTRADICTIONS: Final = 2  # rounds that must agree before the rig is refused
MOST_ROUNDS: Final = 40  # rounds without a decision, after which the check ends
SCATTERED_PX: Final = 0.6  # of the columns: right rigs stay below 0.45, other mirrors have 0.3 to 7
EXCHANGED_RATIO: Final = 1.2  # matches with the cameras exchanged, per match, that show exchanged cameras

StartCondition = Literal["undecided", "fits", "drifted", "exchanged", "turned"]
CONTRADICTED: Final[tuple[StartCondition, ...]] = ("exchanged", "turned")


@dataclass(frozen=True, slots=True)
class StartFinding:
    """Result of a round."""

    condition: StartCondition
    straight: RigFinding
    exchanged_matches: int


class RigStartCheck:
    """Decides by the first pairs; where they show too little, by later ones.

    A right rig is decided in one round, a contradiction needs CONTRADICTIONS rounds in a row. A round with too few
    matches, as in darkness, decides nothing.
    """

    def __init__(self, cylinder: Cylinder) -> None:
        self._cylinder = cylinder
        self._straight: list[Matches] = []
        self._exchanged: list[Matches] = []
        self._contradictions = self._rounds = 0
        self.finding: StartFinding | None = None  # of the last round
        self.decided = False

    @property
    def between_rounds(self) -> bool:
        """True if the next pair begins a round that is no confirmation: it may be a later one."""
        return not self._straight and not self._contradictions

    @property
    def ended(self) -> bool:
        """True if no more pairs are needed."""
        return self.decided or self._rounds >= MOST_ROUNDS

    def add(self, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags, exposure: Exposure | None = None
            ) -> None:
        """Add a pair; visible (H, W): where both cameras see the world; exposure: see `match`."""
        self._straight.append(match(lower, upper, visible, exposure))
        self._exchanged.append(match(upper, lower, visible))
        pairs = len(self._straight)
        matches = sum(len(found.lower) for found in (*self._straight, *self._exchanged))
        if pairs >= MOST_ROUND_PAIRS or (pairs >= ROUND_PAIRS and matches >= MIN_MATCHES):
            self._end_round()

    def _end_round(self) -> None:
        exchanged = len(together(self._exchanged).lower)
        self.finding = start_finding(judge(together(self._straight), self._cylinder), exchanged)
        self._straight.clear()
        self._exchanged.clear()
        self._rounds += 1
        contradicted = self.finding.condition in CONTRADICTED
        self._contradictions = self._contradictions + 1 if contradicted else 0
        self.decided = self.finding.condition in ("fits", "drifted") or self._contradictions >= CONTRADICTIONS


def start_finding(straight: RigFinding, exchanged_matches: int) -> StartFinding:
    """Return the condition on the matches of one round."""
    condition: StartCondition = "undecided"
    if max(straight.matches, exchanged_matches) < MIN_MATCHES:
        return StartFinding(condition, straight, exchanged_matches)
    if exchanged_matches > EXCHANGED_RATIO * straight.matches:
        condition = "exchanged"
    elif straight.misfit_deg > BROKEN_DEG:
        condition = "turned"
    elif straight.misfit_deg > DRIFTED_DEG or straight.spread_px > SCATTERED_PX:
        condition = "drifted"
    elif straight.drift is not None:
        condition = "fits"
    return StartFinding(condition, straight, exchanged_matches)
