"""State of the rig of a run: one filter of matches between both panoramas, of first pairs and of views of the drive.

The stage that computes depth shows it the first pairs (`begin`), before a pose moves wheels; a sink shows it views of a
live run (`drive`), which overrule the first pairs unless the cameras are exchanged. Each of the two threads sets its
finding in one assignment, and any thread may read the state.
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

# Views that are kept, and new views after which the rig is checked again, because at the default period they take 80 s
# of driving. So many of the first pairs are a round where matches are few, and so many pairs may pass before pairs are
# used whose motion is not known: with a rig that is wrong by degrees, no odometry starts that could find the motion.
VIEWS: Final = 16
# Between two rounds while the images show too little, because light changes slower than that.
RETRY_NS: Final = 1_000_000_000
VIEW_M: Final = 0.3  # between two views, because one place shows the same points again
# Newest views that show alone that the rig is broken, because a mirror was knocked, and the wheels must not wait for
# VIEWS.
RECENT_VIEWS: Final = 3

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
        self._cylinder, self._mode = cylinder, mode
        self.state = RigState.UNCHECKED
        self.finding: RigFinding | None = None  # the newest one
        self.is_checking = mode != "off"  # True while first pairs, or those of a later check, are needed
        # The round under way: matches as the rig says, and with the cameras exchanged.
        self._round: list[tuple[Matches, Matches]] = []
        self._next_ns, self._is_contradicted, self._unknown_pairs = -math.inf, False, 0
        self.uses_views = every_s > 0  # True if views of the drive are used
        self._every_ns, self._used_ns = every_s * 1e9, math.inf
        self._views: deque[Matches] = deque(maxlen=VIEWS)
        self._view_at: Array | None = None  # (3,) m: where the newest of them was seen
        self.new_views = 0  # views of the drive since the last whole check
        self._has_views = False  # True after a finding by views of the drive

    @property
    def warning(self) -> str:
        """One line about a rig that the images contradict, or could not check, and what to do; else empty."""
        state, finding = self.state, self.finding
        if finding is None or state is RigState.FITS:
            return ""
        if state is RigState.EXCHANGED:
            return (
                "the images match better the other way round: exchange --lower and --upper, or the cameras in the "
                "configuration; if that does not help, the rig is that of other cameras"
            )
        if state is RigState.BROKEN:
            return (
                "the images contradict the rig: a camera is covered, or the upper one is turned by "
                f"{finding.turn_deg:.1f} deg by {finding.matches} points: {CALIBRATE}"
            )
        if state is RigState.UNCHECKED:
            return (
                "the rig could not be checked by the images: too few points are seen by both cameras; are they "
                "dark, covered or unsharp?"
            )
        rough = ""
        if self._unknown_pairs > VIEWS:
            rough = " (to 2 deg, as the cameras are not synchronised, and the motion between them is not known)"
        return (
            f"the images do not quite fit the rig{rough}, {finding.summary}: run `omnid calibrate drive --only check` "
            "on a recording of slow driving; -o corrects the rotation of the upper camera"
        )

    def begin(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use one of the first pairs, some 30 ms of work; RigContradictedError where the mode is to refuse the rig.

        A right rig is decided in one round, a contradiction needs two in a row, because a hand before a mirror passes.
        A round with too few matches decides nothing. exposure: the motion between the exposures of a pair that is not
        synchronised. A later check, after a loss, ends no run: it is repeated until the rig fits.
        """
        # 1. A new round that confirms nothing begins some time after the last one.
        if not self.is_checking or (not self._round and pair.stamp_ns < self._next_ns):
            return
        # 2. Wait for pairs whose motion is known, if not for long.
        if is_motion_unknown(pair, exposure):
            self._unknown_pairs, exposure = self._unknown_pairs + 1, None
            if self._unknown_pairs <= VIEWS:
                return
        # 3. Match it as the rig says, and with the cameras exchanged, until the round has matches enough.
        own = match(pair.lower, pair.upper, pair.visible, exposure)
        self._round.append((own, match(pair.upper, pair.lower, pair.visible)))
        found, exchanged = (together(matches) for matches in zip(*self._round, strict=True))
        pairs, is_enough = len(self._round), len(found.lower) + len(exchanged.lower) >= MIN_MATCHES
        if pairs < 2 or (pairs < VIEWS and not is_enough):
            return
        finding = judge(found, self._cylinder, len(exchanged.lower))
        state, was_contradicted = finding.state, self._is_contradicted
        self._round, self._is_contradicted = [], state.is_contradicted
        # 4. The second of two contradictions, or any other result, counts.
        if state.is_contradicted and not was_contradicted:
            return
        self._next_ns = pair.stamp_ns + RETRY_NS
        is_first = self.state is RigState.UNCHECKED
        is_newer = not self._has_views or RigState.EXCHANGED in (state, self.state)
        if is_first or (is_newer and state is not RigState.UNCHECKED):
            self.finding, self.state = finding, state
        if is_first and state.is_contradicted and self._mode == "refuse":
            raise RigContradictedError(self.warning)
        self.is_checking = state is RigState.UNCHECKED or (state.is_contradicted and not is_first)

    def check_again(self) -> None:
        """Check the next pairs as the first ones, as the pose was lost: cables may have been exchanged meanwhile.

        The state stays as it is while the pairs show too little.
        """
        if self._mode != "off" and not self.is_checking:
            self.is_checking, self._is_contradicted, self._next_ns = True, False, -math.inf

    def drive(self, pair: PanoramaPair, position: Array, exposure: Exposure | None = None) -> None:
        """Use a pair of the drive if it is due; a finding changes the state unless it saw too little.

        position (3,) [m] of the rig in odom; exposure: as in `begin`. The newest views count, so that older ones are
        forgotten with the path. Only pairs of `begin` show that cameras are exchanged, and no longer. A view of a new
        place takes 10 to 20 ms, a check after VIEWS of them 20 to 50 ms more, all other pairs almost nothing.
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
        if finding.state is not RigState.UNCHECKED and self.state is not RigState.EXCHANGED:
            self.finding, self.state, self._has_views = finding, finding.state, True
