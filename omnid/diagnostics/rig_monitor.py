"""The daemon's own look at its rig: now and then, from the panoramas that it makes anyway, without a board.

Who stands still sees the same wall again and again, and one wall alone may mislead all its points: only views that
differ count, and of a place that is seen again only the newest view is kept.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.rig.rig_check import Matches, RigFinding, Verdict, judge, match, together
from omnid.messages import Panoramas
from omnid.transport.codec import ERROR, OK, WARN, DiagnosticStatus
from omnid.transport.status_names import RIG

Array = NDArray[np.float64]

PAIRS = 16  # views that are remembered, and how many new ones make a new finding
# Fewer different views are no verdict. Two thumbnails that are so alike show one place: some 15 cm of a corridor.
MIN_PLACES, ALIKE = 6, 0.8
THUMBNAIL = (128, 24)  # columns, rows
LEVELS: dict[Verdict, int] = {"good": OK, "unknown": OK, "drifted": WARN, "broken": ERROR}
ADVICE: dict[Verdict, str] = {
    "good": "good", "unknown": "cannot tell: too few points are found in both panoramas",
    "drifted": "drifted: run omnid calibrate check on a recording; --refine turns the upper camera back",
    "broken": "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: run omnid "
              "calibrate check on a recording",
}


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    thumbnail: Array  # (N,) of mean 0 and length 1
    matches: Matches


class RigMonitor:
    """A sink of panoramas that takes one every every_s of their stamps; give it an inbox that forgets.

    10 to 20 ms for a view that is new, 20 to 50 ms more once in PAIRS of them; next to nothing for all others.
    """

    def __init__(self, cylinder: Cylinder, every_s: float) -> None:
        self._cylinder, self._every_ns = cylinder, every_s * 1e9
        self._views: deque[_View] = deque(maxlen=PAIRS)
        self._looked_ns: float = math.inf
        self._new = 0
        self._newest_ns = 0
        self._found: tuple[RigFinding, int] | None = None  # with the stamp; put in one go: status() has another thread

    @property
    def finding(self) -> RigFinding | None:
        """The newest finding; None before the first."""
        return self._found[0] if self._found else None

    def process(self, panoramas: Panoramas) -> None:
        """Looks at a pair when it is time, and at all that is remembered when there is enough that is new."""
        self._newest_ns = panoramas.stamp_ns
        if self._looked_ns <= panoramas.stamp_ns < self._looked_ns + self._every_ns:
            return
        self._looked_ns = panoramas.stamp_ns
        if self._remembered(panoramas):
            self._new += 1
        if self._new >= PAIRS and len(self._views) >= MIN_PLACES:
            self._found = judge(together(view.matches for view in self._views), self._cylinder), panoramas.stamp_ns
            self._new = 0

    def _remembered(self, panoramas: Panoramas) -> bool:
        """Whether the pair shows another place than the last one; then it replaces an older look at that place."""
        thumbnail = _thumbnail(panoramas)
        alike = [float(thumbnail @ view.thumbnail) > ALIKE for view in self._views]
        if any(alike[-1:]) or not thumbnail.any():
            return False
        if any(alike):
            del self._views[alike.index(True)]
        self._views.append(_View(thumbnail, match(panoramas.lower, panoramas.upper, panoramas.visible)))
        return True

    def status(self) -> DiagnosticStatus:
        """What the newest finding says of the rig; age_s is the time in stamps since then."""
        values = {"new_views": str(self._new), "needed_views": str(PAIRS)}
        if self._found is None:
            return DiagnosticStatus(RIG, OK, "not looked yet: that takes some driving", values)
        finding, stamp_ns = self._found
        values |= {"verdict": finding.verdict, "turn_deg": f"{finding.turn_deg:.3f}",
                   "offset_px": f"{finding.offset_px:+.2f}", "left_px": f"{finding.left_px:.2f}",
                   "matches": str(finding.matches), "tried": str(finding.tried),
                   "age_s": f"{(self._newest_ns - stamp_ns) * 1e-9:.0f}"}
        return DiagnosticStatus(RIG, LEVELS[finding.verdict], ADVICE[finding.verdict], values)


def _thumbnail(panoramas: Panoramas) -> Array:
    """What both cameras see of the lower panorama, shrunk to THUMBNAIL: (N,) of mean 0 and length 1, or all 0."""
    small = cv2.resize(panoramas.lower.panorama, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(float)
    seen = cv2.resize(panoramas.visible.astype(np.uint8), THUMBNAIL, interpolation=cv2.INTER_AREA) > 0
    grey = small[seen] - small[seen].mean() if seen.any() else np.zeros(0)
    length = float(np.linalg.norm(grey))
    return np.asarray(grey / length if length > 0 else grey)
