"""State of a rig by matches between both panoramas of some pairs: of the start of a run, of its drive, or of a log.

A point that both cameras see lies on the same column of both panoramas, and lower in the upper one. With the cameras
exchanged it lies higher, so the matches downwards from the lower panorama are then fewer than those downwards from the
upper one. A rotation of a camera, or another mirror, moves the columns. In rendered rooms, corridors and bare walls, a
right rig gives 0.00 to 0.41 matches with the cameras exchanged for each match, exchanged ones give 2.0 or more, and one
that is turned by 3 deg is measured within 0.3 deg (four standard deviations subtracted).

A mirror whose scale alone is larger than the rig's moves points along the columns only, which a wrong distance explains
as well: that cannot be seen here.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.rig_drift import RigDrift, estimate_rig_drift
from calib.panorama import Cylinder, at_scale
from omnid.core.odometry.corners import corners
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.pose_estimation import OUTLIER_SQUARED
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.photometry import block_means
from omnid.core.stereo.semiglobal import MIN_DISPARITY_PX
from omnid.core.stereo.tiles import TEXTURE_GREY
from omnid.core.types.panorama import PaddedPanorama, Panoramas
from omnid.errors import OmnidError

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Corners per pair: two pairs have MIN_MATCHES if four corners in ten are found.
POINTS: Final = 160
# The coarse search works on images reduced by this factor, because its cost falls with the fourth power, and the
# tracker that follows converges from two reduced pixels away.
COARSE: Final = 4
# Half the side of a patch, in the reduced image: 36 px of the panorama, some ten degrees at 1300 columns. At all
# scales, because fewer pixels match by chance.
PATCH_PX: Final = COARSE
# Search range to either side and downwards, in the reduced image at scale 1: five degrees of 1300 columns, because a
# rig that is wrong by more finds chance matches only; and a point at one and a half baselines.
ACROSS_PX, DOWN_PX = 5, 30
# Least correlation of a coarse match, because the search is wide, and a lower one lets more chance matches pass.
MIN_CORRELATION: Final = 0.8
# Two levels are enough: half a window reaches 7 px, and 28 px on the second level, farther than the coarse search errs.
KLT: Final = KltSettings(window_px=15, levels=2, max_error_px=0.3)

# Matches for a finding: ten in each sector of azimuth, so that a tilt and a shift can be distinguished.
MIN_MATCHES: Final = 120
# Rotation of the upper camera from which a rig has drifted: calibrated rigs, rendered and real, show less than 0.1 deg.
# From the other one it is broken: two degrees are seven columns of a panorama of 1300, so that stereo, which searches
# one column, matches by chance.
DRIFTED_DEG, BROKEN_DEG = 0.2, 2.0
# Weight of the shift's angle against the rotation's, because a shifted viewpoint affects near points only.
SHIFT_WEIGHT: Final = 0.2
# Standard deviations subtracted from rotation and shift: an uncertain finding accuses no rig.
SIGMAS: Final = math.sqrt(OUTLIER_SQUARED)
# Least part of the points with contrast that match: with a rig that is wrong by many degrees they match by chance only.
# Corners without contrast are noise, which matches with no rig.
MIN_MATCHED_PART: Final = 0.08
# Median residual of the sectors of azimuth, each about as wide as a wall in a room, from which a rig has drifted:
# changed intrinsics bend the columns all around, while wrong matches on one wall change one sector.
SECTORS, DRIFTED_PX = 12, 0.3

# Views of a drive that are kept, some 80 s of driving at the default period. So many of the first pairs are a round
# where matches are few, and so many pass before pairs are used whose motion is not known: with a rig that is wrong by
# degrees, no odometry starts that could find the motion.
VIEWS: Final = 16
# Newest views that show alone that the rig is broken, because a mirror was knocked, and the wheels must not wait.
RECENT_VIEWS: Final = 3
VIEW_M: Final = 0.3  # between two views, because one place shows the same points again


class RigState(StrEnum):
    """State of a rig by the images; ARCHITECTURE.md has a figure of the transitions."""

    UNCHECKED = "unchecked"  # The images show too little, or nothing was checked yet.
    FITS = "fits"
    DRIFTED = "drifted"  # The rig is off by some tenths of a degree: poses are less accurate.
    EXCHANGED = "exchanged"  # The lower and the upper camera are exchanged.
    BROKEN = "broken"  # The rig is off by degrees: a mirror was knocked, a camera covered, or it is of other cameras.

    @property
    def is_contradicted(self) -> bool:
        """True if the images cannot be of this rig, so that their poses are not reliable."""
        return self in (RigState.EXCHANGED, RigState.BROKEN)


class RigContradictedError(OmnidError):
    """The images cannot be of this rig."""


@dataclass(frozen=True, slots=True)
class Matches:
    """Points of the lower panorama found in the upper one: (column, row) (N, 2) each.

    tried: number of points searched; clear: number of these with contrast.
    """

    lower: Array
    upper: Array
    tried: int
    clear: int


@dataclass(frozen=True, slots=True)
class RigFinding:
    """The rig by the matches of some pairs."""

    state: RigState
    matches: int
    tried: int  # points that were searched
    drift: RigDrift | None  # of the upper camera; None: there are fewer than MIN_MATCHES

    @property
    def turn_deg(self) -> float:
        """Rotation of the upper camera against the rig's file, degrees; NaN where it is unknown."""
        return float(np.rad2deg(np.linalg.norm(self.drift.turn))) if self.drift else math.nan

    @property
    def summary(self) -> str:
        """Summary in one line."""
        if self.drift is None:
            return f"{self.state}: {self.matches} of {self.tried} points found in both panoramas"
        x, y, z = np.rad2deg(self.drift.turn)
        return (
            f"{self.state}: upper camera turned by {self.turn_deg:.3f} deg, sigma "
            f"{np.rad2deg(self.drift.angle_sigma):.3f} ({x:+.3f} {y:+.3f} {z:+.3f}), by {self.matches} points"
        )


def match(lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags, exposure: Exposure | None = None) -> Matches:
    """Return the corners of the lower panorama found in the upper one, by coarse search and tracking.

    exposure: the motion between the exposures of the pair, for which the pixels are corrected; None: none.
    """
    # 1. Corners of the lower panorama, and the best place of each in the upper one, both reduced.
    points = corners(lower, visible, POINTS)
    small_lower, small_upper = (block_means(padded.image, COARSE) for padded in (lower, upper))
    across, down_most = at_scale(ACROSS_PX, lower.scale), at_scale(DOWN_PX, lower.scale)
    guess, good, clear = points.copy(), np.zeros(len(points), bool), 0
    reduced = ((points + np.array([lower.pad_px, 0])) / COARSE).round().astype(int)
    for index, (left, top) in enumerate((reduced - PATCH_PX).tolist()):
        right, bottom, low = left + 2 * PATCH_PX + 1, top + 2 * PATCH_PX + 1, max(0, left - across)
        if left < 0 or top < 0 or right > small_lower.shape[1] or bottom > small_lower.shape[0]:
            continue
        patch, strip = small_lower[top:bottom, left:right], small_upper[top : bottom + down_most, low : right + across]
        _, best, _, (shift, down) = cv2.minMaxLoc(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED))
        guess[index] += COARSE * (low + shift - left), COARSE * down
        good[index] = best >= MIN_CORRELATION
        clear += bool(patch.std() > TEXTURE_GREY)  # noise alone, averaged over COARSE^2 pixels, has less
    # 2. Track from there, to parts of a pixel.
    tracked, is_tracked = track(lower, upper, points, guess, KLT)
    # 3. Keep those that stay near the coarse place and lie lower in the upper panorama than in the lower one.
    step = tracked - guess
    step[:, 0] = lower.wrap(step[:, 0])
    good &= is_tracked & (np.abs(step).max(axis=1) < 2 * COARSE) & (tracked[:, 1] > points[:, 1] + MIN_DISPARITY_PX)
    below, above = points[good], tracked[good]
    if exposure is not None:
        # 4. Views at the stamp of the pair, where its images were exposed at several times.
        views, of_motion = exposure.corrected(below, above[:, 1])
        known = np.isfinite(views).all(axis=1)
        columns = above[:, 0] + of_motion.px[:, 3]
        below, above = views[known, :2], np.column_stack([columns, views[:, 2]])[known]
    return Matches(below, above, len(points), clear)


def judge(found: Sequence[Matches], cylinder: Cylinder, exchanged: int = 0) -> RigFinding:
    """Return what the matches of some pairs say about their rig.

    exchanged: number of the matches with the cameras exchanged; 0 if that was not tried.
    """
    lower, upper = np.concatenate([one.lower for one in found]), np.concatenate([one.upper for one in found])
    drift, misfit_deg, residual_px = None, 0.0, math.nan
    if len(lower) >= MIN_MATCHES:
        # 1. The rotation and shift of the upper camera that explain the columns; the rotation, or a part of the shift,
        #    less SIGMAS standard deviations counts.
        drift = estimate_rig_drift(cylinder.rays(lower), cylinder.rays(upper))
        angles = zip((drift.turn, drift.shift), np.split(drift.sigmas, [len(drift.turn)]), strict=True)
        turn, shift = (float(np.linalg.norm(angle) - SIGMAS * np.linalg.norm(sigma)) for angle, sigma in angles)
        misfit_deg = math.degrees(max(turn, SHIFT_WEIGHT * shift, 0.0))
        # 2. Residuals in each direction, which no rotation of a camera explains, show changed intrinsics.
        sector = np.floor(cylinder.azimuth(lower[:, 0]) * (SECTORS / math.tau))
        offsets = [abs(np.median(drift.residuals[sector == number])) for number in np.unique(sector)]
        residual_px = float(np.median(offsets)) * cylinder.focal_px
    # 3. The state by this finding alone.
    state = RigState.FITS
    if max(len(lower), exchanged) >= MIN_MATCHES and exchanged > len(lower):
        state = RigState.EXCHANGED
    elif len(lower) < MIN_MATCHES <= MIN_MATCHED_PART * sum(one.clear for one in found) or misfit_deg > BROKEN_DEG:
        state = RigState.BROKEN
    elif drift is None:
        state = RigState.UNCHECKED
    elif misfit_deg > DRIFTED_DEG or residual_px > DRIFTED_PX:
        state = RigState.DRIFTED
    return RigFinding(state, len(lower), sum(one.tried for one in found), drift)


class RigHealth:
    """State of the rig: `check_first` takes pairs before a pose moves wheels, `check_drive` views of the drive.

    mode: what a contradiction by the first pairs does: "refuse" raises RigContradictedError, "warn" keeps the reason in
    `warning`, "off" checks no first pairs. Where these show too little, as in darkness, later ones are used, and until
    then the rig counts as fitting. Views of the drive overrule the first pairs unless the cameras are exchanged. Two
    threads may call the two; each sets its finding in one assignment, and any thread may read the state.
    """

    def __init__(self, cylinder: Cylinder, mode: str, every_s: float = 0.0) -> None:
        """every_s: time between two rounds of first pairs that show too little, and between two views of the drive."""
        self._cylinder, self._mode, self._every_ns = cylinder, mode, round(every_s * 1e9)
        self.state = RigState.UNCHECKED
        self.finding: RigFinding | None = None  # the newest one
        # The round of first pairs under way: matches as the rig says, and with the cameras exchanged.
        self._round: list[tuple[Matches, Matches]] = []
        self._next_ns, self._is_contradicted, self._unknown_pairs = -math.inf, False, 0
        self.views: deque[Matches] = deque(maxlen=VIEWS)
        self._next_view_ns, self._view_at = -math.inf, np.full(3, math.inf)  # m

    @property
    def is_checking(self) -> bool:
        """True while first pairs are needed."""
        return self._mode != "off" and self.state is RigState.UNCHECKED

    @property
    def is_undecided(self) -> bool:
        """True until the first pairs were judged, at most four rounds of VIEWS of them, though they showed nothing."""
        return self.is_checking and self.finding is None

    @property
    def warning(self) -> str:
        """One line about a rig that the images contradict, or could not check, and what to do; else empty."""
        if (finding := self.finding) is None:
            return ""
        words = {
            RigState.EXCHANGED: "the images match better the other way round: exchange --lower and --upper, or the "
            "cameras in the configuration; if that does not help, the rig is that of other cameras",
            RigState.BROKEN: "the images contradict the rig: a camera is covered, or the upper one is turned by "
            f"{finding.turn_deg:.1f} deg by {finding.matches} points: give its own rig, or "
            "calibrate it: `omnid calibrate drive --only check` shows by how much it is off",
            RigState.UNCHECKED: "the rig could not be checked by the images: too few points are seen by both cameras; "
            "are they dark, covered or unsharp?",
            RigState.DRIFTED: f"the images do not quite fit the rig, {finding.summary}: run `omnid calibrate "
            "drive` on a recording of driving",
        }
        return words.get(self.state, "")

    def check_first(self, pair: Panoramas, exposure: Exposure | None = None) -> None:
        """Use one of the first pairs, some 30 ms of work; RigContradictedError where the mode is to refuse the rig.

        A right rig is decided in one round, a contradiction needs two in a row, because a hand before a mirror passes.
        A round with too few matches decides nothing. exposure: the motion between the exposures of a pair that is not
        synchronised.
        """
        # 1. A new round begins some time after one that confirmed nothing.
        if not self.is_checking or (not self._round and pair.stamp_ns < self._next_ns):
            return
        # 2. Wait for pairs whose motion is known, if not for long.
        if _is_motion_unknown(pair, exposure):
            self._unknown_pairs, exposure = self._unknown_pairs + 1, None
            if self._unknown_pairs <= VIEWS:
                return
        # 3. Match it as the rig says, and with the cameras exchanged, until the round has matches enough.
        own = match(pair.lower, pair.upper, pair.visible, exposure)
        self._round.append((own, match(pair.upper, pair.lower, pair.visible)))
        found, exchanged = zip(*self._round, strict=True)
        count = sum(len(one.lower) for one in exchanged)
        is_enough = count + sum(len(one.lower) for one in found) >= MIN_MATCHES
        if len(found) < 2 or (len(found) < VIEWS and not is_enough):
            return
        finding = judge(found, self._cylinder, count)
        was_contradicted, self._is_contradicted = self._is_contradicted, finding.state.is_contradicted
        self._round = []
        # 4. The second of two contradictions, or any other result, counts.
        if self._is_contradicted and not was_contradicted:
            return
        self._next_ns = pair.stamp_ns + self._every_ns
        self.finding, self.state = finding, finding.state
        if self._is_contradicted and self._mode == "refuse":
            raise RigContradictedError(self.warning)

    def check_drive(self, pair: Panoramas, position: Array, exposure: Exposure | None = None) -> None:
        """Use a pair of the drive if it is due; a finding changes the state unless it saw too little.

        position (3,) [m] of the rig in odom; exposure: as in `check_first`. The newest views count, so that older
        ones are forgotten with the path. Only first pairs show that cameras are exchanged. A view of a new place takes
        10 to 20 ms, and 20 to 50 ms more from VIEWS of them on, all other pairs almost nothing.
        """
        # 1. A pair that is due, of another place, and whose motion is known.
        is_new = not np.linalg.norm(position - self._view_at) < VIEW_M
        if pair.stamp_ns < self._next_view_ns or not is_new or _is_motion_unknown(pair, exposure):
            return
        self._next_view_ns, self._view_at = pair.stamp_ns + self._every_ns, position
        self.views.append(match(pair.lower, pair.upper, pair.visible, exposure))
        # 2. The newest views alone may show a broken rig, all of them any other state.
        if len(self.views) < RECENT_VIEWS or self.state is RigState.EXCHANGED:
            return
        finding = judge(list(self.views)[-RECENT_VIEWS:], self._cylinder)
        if finding.state is not RigState.BROKEN:
            if len(self.views) < VIEWS:
                return
            finding = judge(list(self.views), self._cylinder)
        if finding.state is not RigState.UNCHECKED:
            self.finding, self.state = finding, finding.state


def _is_motion_unknown(pair: Panoramas, exposure: Exposure | None) -> bool:
    """True if a pair has several times of exposure and the motion in between, which looks like drift, is unknown."""
    return not pair.times.is_synchronised and (exposure is None or not exposure.is_known)
