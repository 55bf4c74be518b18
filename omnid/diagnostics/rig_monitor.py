"""Monitoring of the rig's calibration on the panoramas of a live run, without a board.

A robot that stands still views the same wall again and again, and a single wall may give biased points. So only views
of different places count, and of every place the newest view is kept.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.rig_check import BROKEN_DEG, Matches, RigCondition, RigFinding, judge, match, together
from omnid.messages import OdometryUpdate, Panoramas
from omnid.stages.rig_gate import RigGate
from omnid.transport.codec import ERROR, OK, WARN, DiagnosticStatus
from omnid.transport.status_names import RIG, RIG_AT_START

Array = NDArray[np.float64]

VIEWS = 16  # views that are kept, and new views after which the rig is checked again
MIN_PLACES = 6  # fewer different views are not enough for a check
RECENT_VIEWS = 3  # views that show alone that the rig is broken: a mirror was knocked
MIN_CORRELATION = 0.8  # of the thumbnails of two views of one place: some 15 cm of a corridor
THUMBNAIL = (128, 24)  # columns, rows
LEVELS: dict[RigCondition, int] = {"good": OK, "unknown": OK, "drifted": WARN, "broken": ERROR}
ADVICE: dict[RigCondition, str] = {
    "good": "good", "unknown": "unknown: too few points are matched in both panoramas",
    "drifted": "drifted: run omnid calibrate check on a recording; --refine corrects the upper camera's rotation",
    "broken": "broken: a camera is covered or has moved by degrees, or the rig's file is of other cameras: run omnid "
              "calibrate check on a recording",
}


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    thumbnail: Array  # (N,) of mean 0 and length 1
    matches: Matches


class RigMonitor:
    """A sink of panoramas that uses one every every_s, by their stamps; its inbox drops the oldest (policy NEWEST).

    A view of a new place takes 10 to 20 ms, a check after VIEWS of them 20 to 50 ms more, all other panoramas almost
    nothing.
    """

    def __init__(self, cylinder: Cylinder, every_s: float) -> None:
        self._cylinder, self._every_ns = cylinder, every_s * 1e9
        self._views: deque[_View] = deque(maxlen=VIEWS)
        self._used_ns: float = math.inf
        self._new = self._version = 0
        self._newest_ns = 0
        # With its stamp, set in one assignment: status() runs in another thread.
        self._found: tuple[RigFinding, int] | None = None

    @property
    def finding(self) -> RigFinding | None:
        """The newest finding; None before the first."""
        return self._found[0] if self._found else None

    @property
    def contradicted(self) -> bool:
        """True if the newest finding is that the rig is broken."""
        return self.finding is not None and self.finding.condition == "broken"

    def process(self, panoramas: Panoramas, exposure: Exposure | None = None) -> None:
        """Use a pair if it is due, and check the rig when there are enough new views.

        exposure: the motion between the exposures of a pair that is not synchronised, which is used only with it.
        """
        self._newest_ns = panoramas.stamp_ns
        if panoramas.rig_version != self._version:  # views by the rig of before tell nothing about this one
            self._version, self._new, self._found = panoramas.rig_version, 0, None
            self._views.clear()
        if panoramas.times is not None and (exposure is None or not exposure.is_known):
            return
        if self._used_ns <= panoramas.stamp_ns < self._used_ns + self._every_ns:
            return
        self._used_ns = panoramas.stamp_ns
        if self._add_view(panoramas, exposure):
            self._new += 1
            self._look_at_recent(panoramas.stamp_ns)
        if self._new >= VIEWS and len(self._views) >= MIN_PLACES:
            self._found = judge(together(view.matches for view in self._views), self._cylinder), panoramas.stamp_ns
            self._new = 0

    def _add_view(self, panoramas: Panoramas, exposure: Exposure | None) -> bool:
        """Keep the view unless it is of the same place as the last one; return True if it was kept."""
        thumbnail = _thumbnail(panoramas)
        same_place = [float(thumbnail @ view.thumbnail) > MIN_CORRELATION for view in self._views]
        if any(same_place[-1:]) or not thumbnail.any():
            return False
        if any(same_place):  # an older view of this place
            del self._views[same_place.index(True)]
        self._views.append(_View(thumbnail, match(panoramas.lower, panoramas.upper, panoramas.visible,
                                              exposure)))
        return True

    def _look_at_recent(self, stamp_ns: int) -> None:
        """Report a rig that the newest views contradict at once, without waiting for all VIEWS."""
        if len(self._views) < RECENT_VIEWS:
            return
        finding = judge(together(view.matches for view in islice(reversed(self._views), RECENT_VIEWS)), self._cylinder)
        if finding.misfit_deg > BROKEN_DEG:
            self._found = finding, stamp_ns

    def status(self) -> DiagnosticStatus:
        """Return the newest finding as a status; age_s is the time since then, by the stamps."""
        values = {"new_views": str(self._new), "needed_views": str(VIEWS)}
        if self._found is None:
            return DiagnosticStatus(RIG, OK, "not checked yet: the robot must drive past different places", values)
        finding, stamp_ns = self._found
        values |= {"condition": finding.condition, "turn_deg": f"{finding.turn_deg:.3f}",
                   "offset_px": f"{finding.offset_px:+.2f}", "left_px": f"{finding.left_px:.2f}",
                   "matches": str(finding.matches), "tried": str(finding.tried),
                   "age_s": f"{(self._newest_ns - stamp_ns) * 1e-9:.0f}"}
        return DiagnosticStatus(RIG, LEVELS[finding.condition], ADVICE[finding.condition], values)


class RigMonitorSink:
    """Passes the pairs of the odometry on to a monitor, with the motion during their exposures."""

    def __init__(self, monitor: RigMonitor) -> None:
        self._monitor = monitor

    def process(self, odometry: OdometryUpdate) -> None:
        """Pass a pair on."""
        self._monitor.process(odometry.depth.panoramas, odometry.depth.exposure)


def start_status(gate: RigGate) -> DiagnosticStatus:
    """Return what the first images say about the rig."""
    finding = gate.finding
    if finding is None:
        return DiagnosticStatus(RIG_AT_START, OK, "not checked yet", {})
    values = {"condition": finding.condition, "turn_deg": f"{finding.straight.turn_deg:.3f}",
              "matches": str(finding.straight.matches), "exchanged_matches": str(finding.exchanged_matches)}
    level = ERROR if gate.contradicted else WARN if gate.warning else OK
    return DiagnosticStatus(RIG_AT_START, level, gate.warning or "good", values)


def _thumbnail(panoramas: Panoramas) -> Array:
    """Return the common view of both cameras in the lower panorama as a vector (N,) of mean 0 and norm 1, or all 0."""
    small = cv2.resize(panoramas.lower.panorama, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(float)
    seen = cv2.resize(panoramas.visible.astype(np.uint8), THUMBNAIL, interpolation=cv2.INTER_AREA) > 0
    grey = small[seen] - small[seen].mean() if seen.any() else np.zeros(0)
    length = float(np.linalg.norm(grey))
    return np.asarray(grey / length if length > 0 else grey)
