"""State of the rig of a run: one state machine, driven by the first pairs and by views of the drive.

The stage that computes depth shows it the first pairs (`begin`), before a pose moves wheels; a sink shows it views of a
live run (`drive`). Each of the two threads sets its own finding in one assignment, and any thread may read the state.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.column_finding import (
    BROKEN_DEG,
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
from omnid.errors import OmnidError

Array = NDArray[np.float64]

# Pairs of a round, and the most where matches are few, so that a start is checked within a second.
ROUND_PAIRS, MOST_ROUND_PAIRS = 2, 8
# Rounds that must agree before the rig counts as contradicted, because a hand before a mirror passes.
CONTRADICTIONS: Final = 2
# Between two rounds while the images show too little, because light changes slower than that.
RETRY_NS: Final = 1_000_000_000
# Pairs whose motion is not known, before such pairs are used as if the rig stood, because with a rig that is wrong by
# degrees, no odometry starts that could find the motion.
PATIENT_PAIRS: Final = 5

# Views that are kept, and new views after which the rig is checked again, because at the default period they take 80 s
# of driving.
VIEWS: Final = 16
VIEW_M: Final = 0.3  # between two views, because one place shows the same points again
# Newest views that show alone that the rig is broken, because a mirror was knocked, and the wheels must not wait for
# VIEWS.
RECENT_VIEWS: Final = 3


class FirstPairs:
    """Decides by the first pairs; where they show too little, by later ones.

    A right rig is decided in one round, a contradiction needs CONTRADICTIONS rounds in a row. A round with too few
    matches, as in darkness, decides nothing.
    """

    def __init__(self, cylinder: Cylinder, last_ns: int | None = None) -> None:
        """last_ns: stamp of the last pair of an earlier check, RETRY_NS after which this one begins."""
        self._cylinder = cylinder
        self._straight: list[Matches] = []
        self._exchanged: list[Matches] = []
        self._contradictions = self._unknown_pairs = 0
        self._last_ns = last_ns  # stamp of the last pair that was used
        self.finding: RigFinding | None = None  # finding of the last round
        self.state = RigState.UNCHECKED  # state that was decided

    @property
    def ended(self) -> bool:
        """True if no more pairs are needed."""
        return self.state is not RigState.UNCHECKED

    @property
    def used_unknown_motion(self) -> bool:
        """True if pairs were used whose motion between the exposures is not known."""
        return self._unknown_pairs > PATIENT_PAIRS

    def add(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use a pair if it is needed and due, by its stamp; exposure: the motion between the exposures."""
        # 1. A new round that confirms nothing begins some time after the last one.
        begins = not self._straight and not self._contradictions and self._last_ns is not None
        if self.ended or (begins and pair.stamp_ns < (self._last_ns or 0) + RETRY_NS):
            return
        # 2. Wait for pairs whose motion is known, if not for long.
        if is_motion_unknown(pair, exposure):
            self._unknown_pairs, exposure = self._unknown_pairs + 1, None
            if not self.used_unknown_motion:
                return
        # 3. Match it as the rig says, and with the cameras exchanged.
        self._straight.append(match(pair.lower, pair.upper, pair.visible, exposure))
        self._exchanged.append(match(pair.upper, pair.lower, pair.visible))
        self._last_ns = pair.stamp_ns
        # 4. End the round once it has matches enough.
        pairs = len(self._straight)
        straight, exchanged = together(self._straight), len(together(self._exchanged).lower)
        if pairs < MOST_ROUND_PAIRS and (pairs < ROUND_PAIRS or len(straight.lower) + exchanged < MIN_MATCHES):
            return
        self._straight, self._exchanged = [], []
        self.finding = judge(straight, self._cylinder, exchanged)
        state = self.finding.state
        self._contradictions = self._contradictions + 1 if state.is_contradicted else 0
        if not state.is_contradicted or self._contradictions >= CONTRADICTIONS:
            self.state = state


EXCHANGE: Final = (
    "exchange --lower and --upper, or the cameras in the configuration; if that does not help, the rig "
    "is that of other cameras"
)
CALIBRATE: Final = (
    "give the rig of these cameras, or calibrate it: `omnid calibrate drive --only check` shows by how much it is off"
)


class RigContradictedError(OmnidError):
    """The images cannot be of this rig."""


class RigHealth:
    """State of the rig of a run.

    mode: what a contradiction by the first pairs does: "refuse" raises RigContradictedError, "warn" keeps the reason in
    `warning`, "off" checks no first pairs. Where these show too little, as in darkness, later ones are used, and until
    then the rig counts as fitting.
    """

    def __init__(self, cylinder: Cylinder, mode: str, every_s: float = 0.0) -> None:
        """every_s: time between two views of the drive; 0: none is used."""
        self._mode = mode
        self._cylinder = cylinder
        self._decided = FirstPairs(cylinder)  # the first check, or a later one that has decided
        self._running = None if mode == "off" else self._decided  # the check that needs pairs; None: none does
        self._since = ""  # when the state was found, as a line begins
        self.uses_views = every_s > 0  # True if views of the drive are used
        self._every_ns, self._used_ns = every_s * 1e9, math.inf
        self._views: deque[Matches] = deque(maxlen=VIEWS)
        self._view_at: Array | None = None  # (3,) m: where the newest of them was seen
        self.new_views = 0  # views of the drive since the last whole check
        self._later = RigState.UNCHECKED  # state by the views of the drive
        self.finding: RigFinding | None = None  # the newest finding of the drive; None before the first

    @property
    def state(self) -> RigState:
        """The state, by all that was seen."""
        first = self._decided.state
        if first is RigState.EXCHANGED or self._later is RigState.UNCHECKED:
            return first
        return self._later

    @property
    def is_checking(self) -> bool:
        """True while first pairs, or those of a later check, are needed."""
        return self._running is not None

    @property
    def start_finding(self) -> RigFinding | None:
        """The newest finding of the first pairs; None before the first."""
        return self._decided.finding

    @property
    def warning(self) -> str:
        """One line about a rig that the first pairs contradict, or could not check, and what to do; else empty."""
        check, finding = self._decided, self._decided.finding
        if finding is None or check.state is RigState.FITS:
            return ""
        if check.state is RigState.EXCHANGED:
            return (
                f"{self._since}the images match better the other way round: {finding.exchanged_matches} points are "
                f"seen as if the lower camera were the upper one, {finding.matches} as the rig says: {EXCHANGE}"
            )
        if check.state is RigState.BROKEN:
            return (
                f"{self._since}the images contradict the rig: the upper camera seems turned by {finding.turn_deg:.1f} "
                f"deg by {finding.matches} points: {CALIBRATE}"
            )
        if check.state is RigState.UNCHECKED:
            return (
                "the rig could not be checked by the images: too few points are seen by both cameras; are they "
                "dark, covered or unsharp?"
            )
        if check.used_unknown_motion:
            return (
                "the rig could only be checked to 2 deg: the cameras are not synchronised, and the motion between "
                "their exposures is not known: check it by a recording of slow driving, `omnid calibrate drive --only "
                "check`"
            )
        return (
            f"{self._since}the images do not quite fit the rig, {finding.summary}: run `omnid calibrate drive --only "
            "check` on a recording"
        )

    def begin(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use one of the first pairs, some 30 ms of work; RigContradictedError where the mode is to refuse the rig.

        exposure: the motion between the exposures of a pair that is not synchronised. A later check, after a loss, ends
        no run: it is repeated until the rig fits, as a hand before a mirror passes.
        """
        check = self._running
        if check is None:
            return
        check.add(pair, exposure)
        is_first = check is self._decided
        if is_first and check.state.is_contradicted and self._mode == "refuse":
            raise RigContradictedError(self.warning)
        if not check.ended:
            return
        self._running = None
        if not is_first:
            self._decided, self._since = check, "after the pose was lost, "
        if not is_first and check.state.is_contradicted:
            self._running = FirstPairs(self._cylinder, pair.stamp_ns)

    def check_again(self) -> None:
        """Check the next pairs as the first ones, as the pose was lost: cables may have been exchanged meanwhile.

        The state stays as it is while the pairs show too little.
        """
        if self._running is None and self._mode != "off":
            self._running = FirstPairs(self._cylinder)

    def drive(self, pair: PanoramaPair, position: Array, exposure: Exposure | None = None) -> None:
        """Use a pair of the drive if it is due; a finding changes the state unless it saw too little.

        position (3,) [m] of the rig in odom; exposure: as in `begin`. The newest views count, so that older ones are
        forgotten with the path. A view of a new place takes 10 to 20 ms, a check after VIEWS of them 20 to 50 ms more,
        all other pairs almost nothing.
        """
        # 1. A pair that is due, of another place, and whose motion is known.
        is_due = not self._used_ns <= pair.stamp_ns < self._used_ns + self._every_ns
        is_new = self._view_at is None or float(np.linalg.norm(position - self._view_at)) >= VIEW_M
        if not (self.uses_views and is_due and is_new) or is_motion_unknown(pair, exposure):
            return
        self._used_ns, self._view_at = pair.stamp_ns, position
        self._views.append(match(pair.lower, pair.upper, pair.visible, exposure))
        self.new_views += 1
        # 2. A whole check, after enough new views; the newest views alone may show a broken rig.
        is_whole = self.new_views >= VIEWS
        if not is_whole and len(self._views) < RECENT_VIEWS:
            return
        finding = judge(together(list(self._views)[0 if is_whole else -RECENT_VIEWS :]), self._cylinder)
        if is_whole:
            self.new_views = 0
        elif finding.misfit_deg <= BROKEN_DEG:
            return
        self.finding = finding
        if finding.state is not RigState.UNCHECKED:
            self._later = finding.state
