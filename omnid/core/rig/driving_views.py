"""Views of different places of a drive, and what they say about the rig, without a board.

A robot at rest views the same wall again and again, and a single wall may give biased points. So only views
of different places count, and of every place the newest view is kept.
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
from omnid.core.rig.column_finding import BROKEN_DEG, RigFinding, judge
from omnid.core.rig.column_matches import Matches, PanoramaPair, is_motion_unknown, match, together

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
