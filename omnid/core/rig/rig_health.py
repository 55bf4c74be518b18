"""State of the rig of a run: one state machine, driven by the first pairs and by views of the drive.

The stage that computes depth shows it the first pairs (`begin`), before a pose moves wheels; a sink shows it views of a
live run (`drive`). Each of the two threads sets its own finding in one assignment, and any thread may read the state.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.column_finding import (
    BROKEN_DEG,
    Matches,
    PanoramaPair,
    RigFinding,
    RigState,
    is_motion_unknown,
    judge,
    match,
    together,
)
from omnid.core.rig.first_pairs import FirstPairs, StartFinding
from omnid.errors import OmnidError

Array = NDArray[np.float64]

# Views that are kept, and new views after which the rig is checked again, because at the default period they take 80 s
# of driving.
VIEWS: Final = 16
# Different places for a check, because walls in fewer directions may all bias it to the same side.
MIN_PLACES: Final = 6
# Newest views that show alone that the rig is broken, because a mirror was knocked, and the wheels must not wait for
# VIEWS.
RECENT_VIEWS: Final = 3
# Least correlation of the thumbnails of two views of one place, because those 15 cm apart in a corridor are so alike.
SAME_VIEW_CORRELATION: Final = 0.8
# Columns and rows of a thumbnail: three degrees a column, so that noise and small parts do not make a place new.
THUMBNAIL: Final = (128, 24)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    thumbnail: Array  # (N,) of mean 0 and length 1
    matches: Matches


class DrivingViews:
    """Uses one pair every every_s, by their stamps.

    A view of a new place takes 10 to 20 ms, a check after VIEWS of them 20 to 50 ms more, all other pairs almost
    nothing.
    """

    def __init__(self, cylinder: Cylinder, every_s: float) -> None:
        self._cylinder, self._every_ns = cylinder, every_s * 1e9
        self._views: deque[_View] = deque(maxlen=VIEWS)
        self._used_ns: float = math.inf
        self.new = 0  # views since the last check

    def add(self, pair: PanoramaPair, exposure: Exposure | None = None) -> RigFinding | None:
        """Use a pair if it is due; return a finding where it completes a check, or shows a broken rig.

        exposure: the motion between the exposures of a pair that is not synchronised, which is used only with it.
        """
        # 1. A pair that is due, and whose motion is known.
        if is_motion_unknown(pair, exposure) or self._used_ns <= pair.stamp_ns < self._used_ns + self._every_ns:
            return None
        self._used_ns = pair.stamp_ns
        # 2. The newest views alone may show a broken rig.
        recent = None
        if self._add_view(pair, exposure):
            self.new += 1
            recent = self._recent_break()
        # 3. A whole check, after enough new views of enough places.
        if self.new >= VIEWS and len(self._views) >= MIN_PLACES:
            self.new = 0
            return judge(together(view.matches for view in self._views), self._cylinder)
        return recent

    def _add_view(self, pair: PanoramaPair, exposure: Exposure | None) -> bool:
        """Keep a view unless the last one is from the same place; return True if it was kept."""
        thumbnail = _thumbnail(pair)
        same_place = [float(thumbnail @ view.thumbnail) > SAME_VIEW_CORRELATION for view in self._views]
        if any(same_place[-1:]) or not thumbnail.any():
            return False
        if any(same_place):  # an older view of this place
            del self._views[same_place.index(True)]
        self._views.append(_View(thumbnail, match(pair.lower, pair.upper, pair.visible, exposure)))
        return True

    def _recent_break(self) -> RigFinding | None:
        """Return the finding of the newest views if they show a broken rig."""
        if len(self._views) < RECENT_VIEWS:
            return None
        finding = judge(together(view.matches for view in islice(reversed(self._views), RECENT_VIEWS)), self._cylinder)
        return finding if finding.misfit_deg > BROKEN_DEG else None


def _thumbnail(pair: PanoramaPair) -> Array:
    """Return the common view of both cameras in the lower panorama as a vector (N,) of mean 0 and norm 1, or all 0."""
    small = cv2.resize(pair.lower.panorama, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(float)
    seen = cv2.resize(pair.visible.astype(np.uint8), THUMBNAIL, interpolation=cv2.INTER_AREA) > 0
    grey = small[seen] - small[seen].mean() if seen.any() else np.zeros(0)
    length = float(np.linalg.norm(grey))
    return np.asarray(grey / length if length > 0 else grey)


EXCHANGE: Final = (
    "exchange --lower and --upper, or the cameras in the configuration; if that does not help, the rig "
    "is that of other cameras"
)
CALIBRATE: Final = (
    "give the rig of these cameras, or calibrate it: `omnid calibrate drive --only check` shows by how much it is off"
)
LATE_OR_MOVED: Final = "; if the rig was right before, one of the cameras is late now, or was moved"


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
        self._first = FirstPairs(cylinder)
        self._again: FirstPairs | None = None  # the pairs of a later check, until it has decided or ended
        self._since = ""  # when the state was found, as a line begins
        self._views = DrivingViews(cylinder, every_s) if every_s else None
        self._later = RigState.UNCHECKED  # state by the views of the drive
        self._newest_ns = 0
        self._found: tuple[RigFinding, int] | None = None  # finding by the views of the drive, with its stamp

    @property
    def state(self) -> RigState:
        """The state, by all that was seen."""
        first = self._first.state
        if first is RigState.EXCHANGED or self._later is RigState.UNCHECKED:
            return first
        return self._later

    @property
    def is_checking(self) -> bool:
        """True while first pairs, or those of a later check, are needed."""
        return self._mode != "off" and (self._again is not None or not self._first.ended)

    @property
    def uses_views(self) -> bool:
        """True if views of the drive are used."""
        return self._views is not None

    @property
    def start_finding(self) -> StartFinding | None:
        """The newest finding of the first pairs; None before the first."""
        return self._first.finding

    @property
    def finding(self) -> RigFinding | None:
        """The newest finding of the drive; None before the first."""
        return self._found[0] if self._found else None

    @property
    def finding_age_s(self) -> float:
        """Time since then, by the stamps; NaN before the first."""
        return (self._newest_ns - self._found[1]) * 1e-9 if self._found else float("nan")

    @property
    def new_views(self) -> int:
        """Views of the drive since the last whole check."""
        return self._views.new if self._views else 0

    @property
    def warning(self) -> str:
        """One line about a rig that the first pairs do not fit, or could not check; empty for a good one."""
        finding = self._first.finding
        if self._mode == "off" or finding is None:
            return ""
        if self._first.state.is_contradicted:
            is_exchanged = finding.state is RigState.EXCHANGED
            return self._since + contradiction(finding) + (LATE_OR_MOVED if self._since and not is_exchanged else "")
        if self._first.state is RigState.UNCHECKED:
            return (
                "the rig could not be checked by the images: too few points are seen by both cameras; are they "
                "dark, covered or unsharp?"
            )
        if finding.state is RigState.DRIFTED and self._first.used_unknown_motion:
            return (
                "the rig could only be checked to 2 deg: the cameras are not synchronised, and the motion between "
                "their exposures is not known: check it by a recording of slow driving, `omnid calibrate drive --only "
                "check`"
            )
        if finding.state is RigState.DRIFTED:
            return (
                f"{self._since}the images do not quite fit the rig, {finding.straight.summary}: run `omnid calibrate "
                "check` on a recording" + (LATE_OR_MOVED if self._since else "")
            )
        return ""

    def begin(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use one of the first pairs, some 30 ms of work; RigContradictedError where the mode is to refuse the rig.

        exposure: the motion between the exposures of a pair that is not synchronised.
        """
        if not self.is_checking:
            return
        if self._again is not None:
            self._add_again(self._again, pair, exposure)
            return
        self._first.add(pair, exposure)
        if self._first.state.is_contradicted and self._mode == "refuse":
            raise RigContradictedError(self.warning)

    def check_again(self) -> None:
        """Check the next pairs as the first ones, as the pose was lost: cables may have been exchanged meanwhile.

        A contradiction ends no run that has had poses, and is checked again until the rig fits, as a hand before a
        mirror passes. The state stays as it is while the pairs show too little.
        """
        if not self.is_checking:
            self._again = FirstPairs(self._cylinder)

    def _add_again(self, again: FirstPairs, pair: PanoramaPair, exposure: Exposure | None) -> None:
        again.add(pair, exposure)
        if not again.ended:
            return
        if again.state is not RigState.UNCHECKED:
            self._first, self._since = again, "after the pose was lost, "
        is_wrong = again.state.is_contradicted
        self._again = FirstPairs(self._cylinder, pair.stamp_ns) if is_wrong else None

    def drive(self, pair: PanoramaPair, exposure: Exposure | None = None) -> None:
        """Use a pair of the drive if it is due; a finding changes the state unless it saw too little."""
        self._newest_ns = pair.stamp_ns
        finding = self._views.add(pair, exposure) if self._views else None
        if finding is None:
            return
        self._found = finding, pair.stamp_ns
        if finding.state is not RigState.UNCHECKED:
            self._later = finding.state


def contradiction(finding: StartFinding) -> str:
    """Return what the first pairs show against the rig, and what to do."""
    straight = finding.straight
    if finding.state is RigState.EXCHANGED:
        return (
            f"the images match better the other way round: {finding.exchanged_matches} points are seen as if the "
            f"lower camera were the upper one, {straight.matches} as the rig says: {EXCHANGE}"
        )
    return (
        f"the images contradict the rig: the upper camera seems turned by {straight.turn_deg:.1f} deg by "
        f"{straight.matches} points: {CALIBRATE}"
    )
