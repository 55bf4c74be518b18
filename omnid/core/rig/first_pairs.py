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
from typing import Final

from calib.panorama import Cylinder
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.column_finding import (
    BROKEN_DEG,
    DRIFTED_DEG,
    MIN_MATCHES,
    Matches,
    PanoramaPair,
    RigFinding,
    RigState,
    is_motion_unknown,
    judge,
    match,
    together,
)

# Pairs of a round, and the most where matches are few, so that a start is checked within a second.
ROUND_PAIRS: Final = 2
MOST_ROUND_PAIRS: Final = 8
# Rounds that must agree before the rig counts as contradicted, because a hand before a mirror passes.
CONTRADICTIONS: Final = 2
# Rounds without a decision, after which the check ends, because at RETRY_S between two of them the first minute of a
# run is over.
MOST_ROUNDS: Final = 40
# Between two rounds while the images show too little, s, because light changes slower than that.
RETRY_S: Final = 1.0
# Pairs whose motion is not known, before such pairs are used as if the rig stood, because with a rig that is wrong by
# degrees, no odometry starts that could find the motion.
PATIENT_PAIRS: Final = 5
# Scatter of the columns, because right rigs stay below 0.45 px, other mirrors have 0.3 to 7 px. At all scales, because
# most of the scatter of a right rig is of the matches, which err by parts of a pixel at each.
SCATTERED_PX: Final = 0.6
# Matches with the cameras exchanged, per match, because right rigs have up to 0.41, exchanged ones 2.0 or more.
EXCHANGED_RATIO: Final = 1.2


@dataclass(frozen=True, slots=True)
class StartFinding:
    """Result of a round."""

    state: RigState
    straight: RigFinding
    exchanged_matches: int


class FirstPairs:
    """Decides by the first pairs; where they show too little, by later ones.

    A right rig is decided in one round, a contradiction needs CONTRADICTIONS rounds in a row. A round with too few
    matches, as in darkness, decides nothing.
    """

    def __init__(self, cylinder: Cylinder, last_ns: float = -float("inf")) -> None:
        """last_ns: stamp of the last pair of an earlier check, RETRY_S after which this one begins."""
        self._cylinder = cylinder
        self._straight: list[Matches] = []
        self._exchanged: list[Matches] = []
        self._contradictions = self._rounds = 0
        self._next_ns = last_ns + RETRY_S / S_PER_NS
        self._unknown_pairs = 0
        self.finding: StartFinding | None = None  # finding of the last round
        self.state = RigState.UNCHECKED  # state that was decided

    @property
    def ended(self) -> bool:
        """True if no more pairs are needed."""
        return self.state is not RigState.UNCHECKED or self._rounds >= MOST_ROUNDS

    @property
    def used_unknown_motion(self) -> bool:
        """True if pairs were used whose motion between the exposures is not known."""
        return self._unknown_pairs > PATIENT_PAIRS

    def add(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use a pair if it is needed and due, by its stamp; exposure: the motion between the exposures."""
        # 1. A new round that confirms nothing begins some time after the last one.
        begins = not self._straight and not self._contradictions
        if self.ended or (begins and pair.stamp_ns < self._next_ns):
            return
        # 2. Wait for pairs whose motion is known, if not for long.
        if is_motion_unknown(pair, exposure):
            self._unknown_pairs, exposure = self._unknown_pairs + 1, None
            if not self.used_unknown_motion:
                return
        # 3. Match it as the rig says, and with the cameras exchanged.
        self._straight.append(match(pair.lower, pair.upper, pair.visible, exposure))
        self._exchanged.append(match(pair.upper, pair.lower, pair.visible))
        self._next_ns = pair.stamp_ns + RETRY_S / S_PER_NS
        # 4. End the round once it has matches enough.
        pairs = len(self._straight)
        matches = sum(len(found.lower) for found in (*self._straight, *self._exchanged))
        if pairs >= MOST_ROUND_PAIRS or (pairs >= ROUND_PAIRS and matches >= MIN_MATCHES):
            self._end_round()

    def _end_round(self) -> None:
        exchanged = len(together(self._exchanged).lower)
        finding = self.finding = start_finding(judge(together(self._straight), self._cylinder), exchanged)
        self._straight.clear()
        self._exchanged.clear()
        self._rounds += 1
        self._contradictions = self._contradictions + 1 if finding.state.is_contradicted else 0
        if not finding.state.is_contradicted or self._contradictions >= CONTRADICTIONS:
            self.state = finding.state


def start_finding(straight: RigFinding, exchanged_matches: int) -> StartFinding:
    """Return the state by the matches of one round."""
    state = RigState.UNCHECKED
    if max(straight.matches, exchanged_matches) < MIN_MATCHES:
        return StartFinding(state, straight, exchanged_matches)
    if exchanged_matches > EXCHANGED_RATIO * straight.matches:
        state = RigState.EXCHANGED
    elif straight.misfit_deg > BROKEN_DEG:
        state = RigState.BROKEN
    elif straight.misfit_deg > DRIFTED_DEG or straight.spread_px > SCATTERED_PX:
        state = RigState.DRIFTED
    elif straight.drift is not None:
        state = RigState.FITS
    return StartFinding(state, straight, exchanged_matches)
