"""Check of the rig's calibration: a point seen in both panoramas must lie on the same column in both."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.rig_drift import RigDrift, estimate_rig_drift
from calib.panorama import Cylinder
from omnid.core.odometry.corners import corners
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama, track

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]
RigCondition = Literal["good", "drifted", "broken", "unknown"]

POINTS = 160  # corners per pair
COARSE = 4  # the coarse search uses images reduced by this factor
PATCH_PX = 4  # half the side of its patches, in the reduced image
ASIDE_PX = 5  # searched to either side there: about five degrees of a panorama of 1300 columns
DOWN_PX = 30  # searched downwards there: down to a distance of one and a half baselines
MIN_CORRELATION = 0.8  # of a coarse match
MAX_STEP_PX = 2 * COARSE  # from the coarse match to the tracked point
MIN_DISPARITY_PX = 0.5
KLT = KltSettings(window_px=15, levels=2, max_error_px=0.3)
MAX_PAIRS = 64
MIN_MATCHES = 120  # for a condition
DRIFTED_DEG = 0.2  # rotation of the upper camera; rendered and real rigs as calibrated stay below
BROKEN_DEG = 2.0
SHIFT_WEIGHT = 0.2  # of the shift's angle against the rotation's: a shifted viewpoint affects near points only
SIGMAS = 4.0  # standard deviations subtracted from rotation and shift before the condition
# With a rig that is wrong by many degrees, points match by chance only. Corners in noise match nowhere either, so only
# points with contrast are counted.
MIN_MATCHED_PART = 0.08  # of the points with contrast: fewer matches mean a broken rig
MIN_CONTRAST_POINTS = 400  # for this condition
CONTRAST_GREY = 6.0  # standard deviation of a coarse patch with contrast, grey levels
SECTORS = 12  # of azimuth
MIN_IN_SECTOR = 20  # matches
# A camera whose intrinsics have changed bends the columns all around; the matches of one wall alone may be misled.
DRIFTED_PX = 0.3  # median residual of the sectors
MAD_TO_SIGMA = 1.4826  # of a normal distribution


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
    """Result of the check."""

    condition: RigCondition
    matches: int
    tried: int
    offset_px: float  # median of upper minus lower columns
    spread_px: float  # 1.48 times the median absolute deviation
    by_azimuth: tuple[tuple[float, float, int], ...]  # degrees, median offset [px] or NaN, matches
    left_px: float  # median residual of the sectors after the drift: no rotation of a camera explains it
    drift: RigDrift | None

    @property
    def turn_deg(self) -> float:
        """Rotation of the upper camera against the rig's file, degrees; NaN without a condition."""
        return float(np.rad2deg(np.linalg.norm(self.drift.turn))) if self.drift else float("nan")

    @property
    def misfit_deg(self) -> float:
        """Rotation, or part of the shift, less SIGMAS standard deviations, in degrees; 0 where it is unknown."""
        return 0.0 if self.drift is None else _misfit_deg(self.drift)

    @property
    def summary(self) -> str:
        """Summary in one line."""
        if self.drift is None:
            return f"{self.condition}: {self.matches} of {self.tried} points found in both panoramas"
        x, y, z = np.rad2deg(self.drift.turn)
        return (f"{self.condition}: columns off by {self.offset_px:+.2f} px (spread {self.spread_px:.2f}), upper "
                f"camera turned by {self.turn_deg:.3f} deg ({x:+.3f} {y:+.3f} {z:+.3f}) by {self.matches} points")


class RigCheck:
    """Collects the matches of the newest pairs, at most MAX_PAIRS, and checks the rig by them."""

    def __init__(self, cylinder: Cylinder, pairs: int = 16) -> None:
        self._cylinder = cylinder
        self._found: deque[Matches] = deque(maxlen=min(pairs, MAX_PAIRS))

    def add(self, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags, exposure: Exposure | None = None
            ) -> None:
        """Add a pair of panoramas; visible (H, W): where both show the world; exposure: the motion during a pair."""
        self._found.append(match(lower, upper, visible, exposure))

    def finding(self) -> RigFinding:
        """Return the result of all pairs collected."""
        return judge(together(self._found), self._cylinder)


def together(found: Iterable[Matches]) -> Matches:
    """Return the matches of several pairs as one."""
    parts = [Matches(np.zeros((0, 2)), np.zeros((0, 2)), 0, 0), *found]
    lower, upper = (np.concatenate([getattr(part, side) for part in parts]) for side in ("lower", "upper"))
    return Matches(lower, upper, sum(part.tried for part in parts), sum(part.clear for part in parts))


def match(lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags, exposure: Exposure | None = None) -> Matches:
    """Return the corners of the lower panorama found in the upper one, by coarse search and tracking.

    exposure: the motion between the exposures of the pair, for which the pixels are corrected; None: none.
    """
    points = corners(lower, visible, POINTS)
    guess, likely, clear = _coarse(lower, upper, points)
    there, good = track(lower, upper, points, guess, KLT)
    step = there - guess
    step[:, 0] = (step[:, 0] + lower.width / 2) % lower.width - lower.width / 2
    good &= likely & (np.abs(step).max(axis=1) < MAX_STEP_PX) & (there[:, 1] > points[:, 1] + MIN_DISPARITY_PX)
    found = Matches(points[good], there[good], len(points), clear)
    return found if exposure is None else _at_stamp(found, exposure)


def _at_stamp(found: Matches, exposure: Exposure) -> Matches:
    """Return matches as they would be seen if both images were exposed at the stamp of the pair."""
    views, _ = exposure.corrected(found.lower, found.upper[:, 1])
    columns, _ = exposure.upper_columns(found.lower, found.upper[:, 1])
    known = np.isfinite(columns)
    upper = found.upper[known]
    aside = exposure.model.cylinder.wrap(views[known, 0] - columns[known])
    return Matches(views[known, :2], np.column_stack([upper[:, 0] + aside, views[known, 2]]), found.tried, found.clear)


def _coarse(lower: PaddedPanorama, upper: PaddedPanorama, points: Array) -> tuple[Array, Flags, int]:
    """Return the best positions (N, 2) of points in the upper panorama, to COARSE pixels, and flags of good ones (N,).

    Also the number of points with contrast.
    """
    small_lower, small_upper = (_reduced(wrapped.image) for wrapped in (lower, upper))
    height, width = small_upper.shape
    guess, likely, clear = points.copy(), np.zeros(len(points), bool), 0
    padded = points + np.array([lower.pad_px, 0])
    for index, (column, row) in enumerate((padded / COARSE).round().astype(int).tolist()):
        left, right, top = column - PATCH_PX, column + PATCH_PX + 1, row - PATCH_PX
        low, high = max(0, left - ASIDE_PX), min(width, right + ASIDE_PX)
        strip = small_upper[max(0, top):min(height, row + PATCH_PX + 1 + DOWN_PX), low:high]
        patch = small_lower[max(0, top):row + PATCH_PX + 1, max(0, left):right]
        if left < 0 or top < 0 or right > width or patch.shape[0] != 2 * PATCH_PX + 1 or strip.shape[0] < len(patch):
            continue
        _, best, _, (aside, down) = cv2.minMaxLoc(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED))
        guess[index] += COARSE * (low + aside - left), COARSE * down
        likely[index] = best >= MIN_CORRELATION
        clear += bool(patch.std() > CONTRAST_GREY)
    return guess, likely, clear


def _reduced(image: Image) -> Image:
    width, height = image.shape[1] // COARSE, image.shape[0] // COARSE
    whole = image[:height * COARSE, :width * COARSE]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def judge(found: Matches, cylinder: Cylinder) -> RigFinding:
    """Return the result for a rig by matches of some pairs."""
    aside = cylinder.wrap(found.upper[:, 0] - found.lower[:, 0])
    offset = float(np.median(aside)) if len(aside) else float("nan")
    spread = MAD_TO_SIGMA * float(np.median(np.abs(aside - offset))) if len(aside) else float("nan")
    enough = len(aside) >= MIN_MATCHES
    drift = estimate_rig_drift(cylinder.rays(found.lower), cylinder.rays(found.upper)) if enough else None
    residuals = _by_azimuth(found.lower, drift.residuals * cylinder.focal_px, cylinder) if drift else ()
    offsets = [abs(median) for _, median, count in residuals if count >= MIN_IN_SECTOR]
    left_px = float(np.median(offsets)) if offsets else float("nan")
    return RigFinding(_condition(drift, left_px, (len(aside), found.clear)), len(aside), found.tried, offset, spread,
                      _by_azimuth(found.lower, aside, cylinder), left_px, drift)


def _condition(drift: RigDrift | None, left_px: float, counts: tuple[int, int]) -> RigCondition:
    matches, clear = counts
    if clear >= MIN_CONTRAST_POINTS and matches < MIN_MATCHED_PART * clear:
        return "broken"
    if drift is None:
        return "unknown"
    worst = _misfit_deg(drift)
    if worst > BROKEN_DEG:
        return "broken"
    return "drifted" if worst > DRIFTED_DEG or left_px > DRIFTED_PX else "good"


def _misfit_deg(drift: RigDrift) -> float:
    turn, shift = np.rad2deg(np.linalg.norm(drift.turn)), np.rad2deg(np.linalg.norm(drift.shift))
    unsure = np.rad2deg(SIGMAS * np.array([np.linalg.norm(drift.turn_sigma), np.linalg.norm(drift.shift_sigma)]))
    return float(max(max(0.0, turn - unsure[0]), SHIFT_WEIGHT * max(0.0, shift - unsure[1])))


def _by_azimuth(lower: Array, aside: Array, cylinder: Cylinder) -> tuple[tuple[float, float, int], ...]:
    """Return azimuth of the middle [deg], median offset [px], NaN without matches, and matches of each sector."""
    azimuth = np.pi - (lower[:, 0] + 0.5) / cylinder.focal_px
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    middle = -180 + (np.arange(SECTORS) + 0.5) * 360 / SECTORS
    chosen = [aside[sector == k] for k in range(SECTORS)]
    return tuple((float(middle[k]), float(np.median(part)) if len(part) else float("nan"), len(part))
                 for k, part in enumerate(chosen))
