"""State of a rig by matches of some pairs.

A point that both cameras see lies on the same column of both panoramas, and lower in the upper one. With the cameras
exchanged it lies higher, so the matches downwards from the lower panorama are then fewer than those downwards from the
upper one. A rotation of a camera, or another mirror, moves the columns. In rendered rooms, corridors and bare walls, a
right rig gives 0.00 to 0.41 matches with the cameras exchanged for each match, exchanged ones give 2.0 or more, and one
that is turned by 3 deg is measured within 0.3 deg (four standard deviations subtracted).

A mirror whose scale alone is larger than the rig's moves points along the columns only, which a wrong distance explains
as well: that cannot be seen here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.fit.rig_drift import RigDrift, estimate_rig_drift
from calib.panorama import Cylinder, at_scale
from omnid.core.odometry.corners import corners
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.semiglobal import MIN_DISPARITY_PX
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.pixel_times import PixelTimes


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


Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]

# Corners per pair: two pairs have the matches of a finding (120) if four corners in ten are found.
POINTS: Final = 160
# The coarse search works on images reduced by this factor, because its cost falls with the fourth power, and the
# tracker that follows converges from two reduced pixels away.
COARSE: Final = 4
# Half the side of a patch, in the reduced image: 36 px of the panorama, some ten degrees at 1300 columns. At all
# scales, because fewer pixels match by chance.
PATCH_PX: Final = 4
# Search range to either side, in the reduced image at scale 1: five degrees of a panorama of 1300 columns, because a
# rig that is wrong by more finds chance matches only, which `column_finding` recognises by their number.
ASIDE_PX: Final = 5
# Search range downwards, in the reduced image at scale 1, because a point at one and a half baselines is so far below.
DOWN_PX: Final = 30
# Least correlation of a coarse match, because the search is wide, and a lower one lets more chance matches pass.
MIN_CORRELATION: Final = 0.8
# Two levels are enough: half a window reaches 7 px, and 28 px on the second level, farther than the coarse search errs.
KLT: Final = KltSettings(window_px=15, levels=2, max_error_px=0.3)
# Standard deviation of a coarse patch with contrast, grey levels, because noise alone, averaged over COARSE^2 pixels,
# has less.
CONTRAST_GREY: Final = 6.0


class PanoramaPair(Protocol):
    """Both panoramas of a pair, as the messages between the stages have them."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the pair."""

    @property
    def lower(self) -> PaddedPanorama:
        """Panorama of the lower camera."""

    @property
    def upper(self) -> PaddedPanorama:
        """Panorama of the upper camera."""

    @property
    def visible(self) -> Flags:
        """Flags (H, W) of the pixels where both cameras see the world."""

    @property
    def times(self) -> PixelTimes:
        """Times of exposure of the pixels."""


@dataclass(frozen=True, slots=True)
class Matches:
    """Points of the lower panorama found in the upper one: (column, row) (N, 2) each.

    tried: number of points searched; clear: number of these with contrast.
    """

    lower: Array
    upper: Array
    tried: int
    clear: int


def is_motion_unknown(pair: PanoramaPair, exposure: Exposure | None) -> bool:
    """True if a pair has several times of exposure and the motion in between, which looks like drift, is unknown."""
    return not pair.times.is_at_once and (exposure is None or not exposure.is_known)


def together(found: Iterable[Matches]) -> Matches:
    """Return the matches of several pairs as one."""
    parts = [Matches(np.zeros((0, 2)), np.zeros((0, 2)), 0, 0), *found]
    lower, upper = (np.concatenate([getattr(part, side) for part in parts]) for side in ("lower", "upper"))
    return Matches(lower, upper, sum(part.tried for part in parts), sum(part.clear for part in parts))


def match(lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags, exposure: Exposure | None = None) -> Matches:
    """Return the corners of the lower panorama found in the upper one, by coarse search and tracking.

    exposure: the motion between the exposures of the pair, for which the pixels are corrected; None: none.
    """
    # 1. Corners of the lower panorama, and the best place of each in the reduced upper one.
    points = corners(lower, visible, POINTS)
    guess, likely, clear = _coarse(lower, upper, points)
    # 2. Track from there, to parts of a pixel.
    there, good = track(lower, upper, points, guess, KLT)
    # 3. Keep those that stay near the coarse place and lie lower in the upper panorama than in the lower one.
    step = there - guess
    step[:, 0] = lower.apart(step[:, 0])
    good &= likely & (np.abs(step).max(axis=1) < 2 * COARSE) & (there[:, 1] > points[:, 1] + MIN_DISPARITY_PX)
    found = Matches(points[good], there[good], len(points), clear)
    # 4. Views at the stamp of the pair, where its images were exposed at several times.
    return found if exposure is None else _at_stamp(found, exposure)


def _at_stamp(found: Matches, exposure: Exposure) -> Matches:
    """Return matches as they would be seen if both images were exposed at the stamp of the pair."""
    views, _ = exposure.corrected(found.lower, found.upper[:, 1])
    columns, _ = exposure.upper_columns(found.lower, found.upper[:, 1])
    known = np.isfinite(columns)
    upper = found.upper[known]
    shift = exposure.model.cylinder.wrap(views[known, 0] - columns[known])
    return Matches(views[known, :2], np.column_stack([upper[:, 0] + shift, views[known, 2]]), found.tried, found.clear)


def _coarse(lower: PaddedPanorama, upper: PaddedPanorama, points: Array) -> tuple[Array, Flags, int]:
    """Return the best positions (N, 2) of points in the upper panorama, to COARSE pixels, and flags of good ones (N,).

    Also the number of points with contrast.
    """
    small_lower, small_upper = (_reduced(wrapped.image) for wrapped in (lower, upper))
    (height, width), scale = small_upper.shape, lower.scale
    aside, down_most = at_scale(ASIDE_PX, scale), at_scale(DOWN_PX, scale)
    guess, likely, clear = points.copy(), np.zeros(len(points), bool), 0
    padded = points + np.array([lower.pad_px, 0])
    for index, (column, row) in enumerate((padded / COARSE).round().astype(int).tolist()):
        left, right, top = column - PATCH_PX, column + PATCH_PX + 1, row - PATCH_PX
        low, high = max(0, left - aside), min(width, right + aside)
        strip = small_upper[max(0, top) : min(height, row + PATCH_PX + 1 + down_most), low:high]
        patch = small_lower[max(0, top) : row + PATCH_PX + 1, max(0, left) : right]
        if left < 0 or top < 0 or right > width or patch.shape[0] != 2 * PATCH_PX + 1 or strip.shape[0] < len(patch):
            continue
        _, best, _, (right, down) = cv2.minMaxLoc(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED))
        guess[index] += COARSE * (low + right - left), COARSE * down
        likely[index] = best >= MIN_CORRELATION
        clear += bool(patch.std() > CONTRAST_GREY)
    return guess, likely, clear


def _reduced(image: Image) -> Image:
    width, height = image.shape[1] // COARSE, image.shape[0] // COARSE
    whole = image[: height * COARSE, : width * COARSE]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


# Matches for a finding: ten in each sector of azimuth, so that a tilt and a shift can be distinguished.
MIN_MATCHES: Final = 120
# Rotation of the upper camera from which a rig has drifted: calibrated rigs, rendered and real, show less than 0.1 deg.
DRIFTED_DEG: Final = 0.2
# Rotation from which a rig is broken: two degrees are seven columns of a panorama of 1300, so that stereo, which
# searches one column, matches by chance.
BROKEN_DEG: Final = 2.0
# Weight of the shift's angle against the rotation's, because a shifted viewpoint affects near points only.
SHIFT_WEIGHT: Final = 0.2
# Standard deviations subtracted from rotation and shift, so that an uncertain finding accuses no rig.
SIGMAS: Final = 4.0
# Least part of the points with contrast that match: with a rig that is wrong by many degrees they match by chance only.
# Corners without contrast are noise, which matches with no rig.
MIN_MATCHED_PART: Final = 0.08
SECTORS: Final = 12  # Sectors of azimuth, 30 deg each, because that is about the width of a wall in a room.
# Median residual of the sectors from which a rig has drifted: changed intrinsics bend the columns all around, while
# wrong matches on one wall change one sector.
DRIFTED_PX: Final = 0.3


@dataclass(frozen=True, slots=True)
class RigFinding:
    """Result of the check."""

    found: Matches
    exchanged_matches: int  # matches with the cameras exchanged; 0 if that was not tried
    offset_px: float  # median of upper minus lower columns
    left_px: float  # median residual of the sectors after the drift: no rotation of a camera explains it
    drift: RigDrift | None

    @property
    def matches(self) -> int:
        """Number of the matches."""
        return len(self.found.lower)

    @property
    def tried(self) -> int:
        """Number of the points that were searched."""
        return self.found.tried

    @property
    def state(self) -> RigState:
        """The state of the rig by this finding alone."""
        matches, exchanged, enough = self.matches, self.exchanged_matches, MIN_MATCHED_PART * self.found.clear
        if max(matches, exchanged) >= MIN_MATCHES and exchanged > matches:
            return RigState.EXCHANGED
        if matches < MIN_MATCHES <= enough or self.misfit_deg > BROKEN_DEG:
            return RigState.BROKEN
        if self.drift is None:
            return RigState.UNCHECKED
        return RigState.DRIFTED if self.misfit_deg > DRIFTED_DEG or self.left_px > DRIFTED_PX else RigState.FITS

    @property
    def turn_deg(self) -> float:
        """Rotation of the upper camera against the rig's file, degrees; NaN where it is unknown."""
        return float(np.rad2deg(np.linalg.norm(self.drift.turn))) if self.drift else float("nan")

    @property
    def misfit_deg(self) -> float:
        """Rotation, or part of the shift, less SIGMAS standard deviations, in degrees; 0 where it is unknown."""
        if self.drift is None:
            return 0.0
        angles = (self.drift.turn, self.drift.turn_sigma), (self.drift.shift, self.drift.shift_sigma)
        turn, shift = (float(np.linalg.norm(angle) - SIGMAS * np.linalg.norm(sigma)) for angle, sigma in angles)
        return float(np.rad2deg(max(turn, SHIFT_WEIGHT * shift, 0.0)))

    @property
    def summary(self) -> str:
        """Summary in one line."""
        if self.drift is None:
            return f"{self.state}: {self.matches} of {self.tried} points found in both panoramas"
        x, y, z = np.rad2deg(self.drift.turn)
        return (
            f"{self.state}: columns off by {self.offset_px:+.2f} px, upper camera "
            f"turned by {self.turn_deg:.3f} deg, sigma {np.rad2deg(self.drift.angle_sigma):.3f} "
            f"({x:+.3f} {y:+.3f} {z:+.3f}), by {self.matches} points"
        )


def judge(found: Matches, cylinder: Cylinder, exchanged_matches: int = 0) -> RigFinding:
    """Return what the matches of some pairs say about their rig.

    exchanged_matches: number of the matches with the cameras exchanged; 0 if that was not tried.
    """
    # 1. Offsets of the columns, as they are.
    shifts = cylinder.wrap(found.upper[:, 0] - found.lower[:, 0])
    offset = float(np.median(shifts)) if len(shifts) else float("nan")
    # 2. The rotation and shift of the upper camera that explain them.
    drift = None
    if len(shifts) >= MIN_MATCHES:
        drift = estimate_rig_drift(cylinder.rays(found.lower), cylinder.rays(found.upper))
    # 3. Residuals in each direction show changed intrinsics.
    offsets = _sector_offsets(found.lower, drift.residuals * cylinder.focal_px, cylinder) if drift else []
    left_px = float(np.median(offsets)) if offsets else float("nan")
    return RigFinding(found, exchanged_matches, offset, left_px, drift)


def _sector_offsets(lower: Array, shifts: Array, cylinder: Cylinder) -> list[float]:
    """Return the size of the median shift [px] in each sector of azimuth with enough matches."""
    azimuth = cylinder.azimuth(lower[:, 0])
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    parts = [shifts[sector == k] for k in range(SECTORS)]
    return [abs(float(np.median(part))) for part in parts if len(part) * SECTORS >= MIN_MATCHES]
