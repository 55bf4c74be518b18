"""Whether the rig is still as it was calibrated: points that both panoramas show must lie on one column in both."""

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
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama, track

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]
Verdict = Literal["good", "drifted", "broken", "unknown"]

POINTS = 160
COARSE = 4  # points are first looked for in images so many times smaller,
PATCH_PX = 4  # by patches that reach so far about them there,
ASIDE_PX = 5  # so far aside (some five degrees of a panorama of 1300 columns), and
DOWN_PX = 30  # so far down: nearer than a baseline and a half is nothing
MIN_LIKENESS = 0.8
KLT = KltSettings(window_px=15, levels=2, max_error_px=0.3)
MAX_PAIRS = 64
# Less is no verdict. Verdicts are by the turn: a rig as good as new, rendered or real, stays below the first.
MIN_MATCHES = 120
DRIFTED_DEG, BROKEN_DEG = 0.2, 2.0
# A viewpoint aside moves near points only, by a tenth of its angle: it matters that much later.
SHIFT_PART = 0.2
SIGMAS = 4.0
# Of a rig that is wrong by many degrees no more match than by accident. Only points that stand out so far [grey levels]
# in the coarse image tell so: what noise makes in the dark matches nowhere either.
MIN_SHARE, MIN_CLEAR, CLEAR_GREY = 0.08, 400, 6.0
SECTORS, MIN_IN_SECTOR = 12, 20
# A camera that is no more what it was bends the columns all around; one wall alone may mislead all its matches.
DRIFTED_PX = 0.3


@dataclass(frozen=True, slots=True)
class Matches:
    """Points of the lower panorama found in the upper one: (column, row) (N, 2) each.

    tried is how many were sought, clear how many of these are no noise.
    """

    lower: Array
    upper: Array
    tried: int
    clear: int


@dataclass(frozen=True, slots=True)
class RigFinding:
    """What the columns say of the rig."""

    verdict: Verdict
    matches: int
    tried: int
    offset_px: float  # median of the upper columns less the lower ones
    spread_px: float  # 1.48 times the median distance from it
    by_azimuth: tuple[tuple[float, float, int], ...]  # degrees, median offset [px] or NaN, matches
    left_px: float  # what half of these exceed once the drift is taken away: no turn of a camera explains it
    drift: RigDrift | None

    @property
    def turn_deg(self) -> float:
        """By how much the upper camera has turned from where the rig's file has it; NaN where nobody can tell."""
        return float(np.rad2deg(np.linalg.norm(self.drift.turn))) if self.drift else float("nan")

    @property
    def summary(self) -> str:
        """One line."""
        if self.drift is None:
            return f"{self.verdict}: {self.matches} of {self.tried} points found in both panoramas"
        x, y, z = np.rad2deg(self.drift.turn)
        return (f"{self.verdict}: columns off by {self.offset_px:+.2f} px (spread {self.spread_px:.2f}), upper camera "
                f"turned by {self.turn_deg:.3f} deg ({x:+.3f} {y:+.3f} {z:+.3f}) by {self.matches} points")


class RigCheck:
    """Gathers matches of some pairs and judges the rig by them; remembers MAX_PAIRS pairs at most."""

    def __init__(self, cylinder: Cylinder, pairs: int = 16) -> None:
        self._cylinder = cylinder
        self._found: deque[Matches] = deque(maxlen=min(pairs, MAX_PAIRS))

    def add(self, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> None:
        """Looks at one pair of panoramas; visible (H, W) is where both show the world."""
        self._found.append(match(lower, upper, visible))

    def finding(self) -> RigFinding:
        """What all pairs that are remembered say."""
        return judge(together(self._found), self._cylinder)


def together(found: Iterable[Matches]) -> Matches:
    """The matches of several pairs as one."""
    parts = [Matches(np.zeros((0, 2)), np.zeros((0, 2)), 0, 0), *found]
    lower, upper = (np.concatenate([getattr(part, side) for part in parts]) for side in ("lower", "upper"))
    return Matches(lower, upper, sum(part.tried for part in parts), sum(part.clear for part in parts))


def match(lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> Matches:
    """Corners of the lower panorama found in the upper one, wherever they are, to a fraction of a pixel."""
    points = corners(lower, visible, POINTS)
    guess, likely, clear = _coarse(lower, upper, points)
    there, good = track(lower, upper, points, guess, KLT)
    step = there - guess
    step[:, 0] = (step[:, 0] + lower.width / 2) % lower.width - lower.width / 2
    good &= likely & (np.abs(step).max(axis=1) < 2 * COARSE) & (there[:, 1] > points[:, 1] + 0.5)
    return Matches(points[good], there[good], len(points), clear)


def _coarse(lower: PaddedPanorama, upper: PaddedPanorama, points: Array) -> tuple[Array, Flags, int]:
    """Where points (N, 2) are most likely in the upper panorama, to COARSE pixels, and whether that is like enough.

    Also how many of the points stand out clearly.
    """
    small_lower, small_upper = (_smaller(wrapped.image) for wrapped in (lower, upper))
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
        likely[index] = best >= MIN_LIKENESS
        clear += bool(patch.std() > CLEAR_GREY)
    return guess, likely, clear


def _smaller(image: Image) -> Image:
    width, height = image.shape[1] // COARSE, image.shape[0] // COARSE
    whole = image[:height * COARSE, :width * COARSE]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def judge(found: Matches, cylinder: Cylinder) -> RigFinding:
    """The verdict on a rig by matches of some pairs."""
    aside = cylinder.wrap(found.upper[:, 0] - found.lower[:, 0])
    offset = float(np.median(aside)) if len(aside) else float("nan")
    spread = 1.4826 * float(np.median(np.abs(aside - offset))) if len(aside) else float("nan")
    enough = len(aside) >= MIN_MATCHES
    drift = estimate_rig_drift(cylinder.rays(found.lower), cylinder.rays(found.upper)) if enough else None
    left = _by_azimuth(found.lower, drift.residuals * cylinder.focal_px, cylinder) if drift else ()
    offsets = [abs(median) for _, median, count in left if count >= MIN_IN_SECTOR]
    left_px = float(np.median(offsets)) if offsets else float("nan")
    return RigFinding(_verdict(drift, left_px, (len(aside), found.clear)), len(aside), found.tried, offset, spread,
                      _by_azimuth(found.lower, aside, cylinder), left_px, drift)


def _verdict(drift: RigDrift | None, left_px: float, counts: tuple[int, int]) -> Verdict:
    matches, clear = counts
    if clear >= MIN_CLEAR and matches < MIN_SHARE * clear:
        return "broken"
    if drift is None:
        return "unknown"
    turn, shift = np.rad2deg(np.linalg.norm(drift.turn)), np.rad2deg(np.linalg.norm(drift.shift))
    unsure = np.rad2deg(SIGMAS * np.array([np.linalg.norm(drift.turn_sigma), np.linalg.norm(drift.shift_sigma)]))
    worst = max(max(0.0, turn - unsure[0]), SHIFT_PART * max(0.0, shift - unsure[1]))
    if worst > BROKEN_DEG:
        return "broken"
    return "drifted" if worst > DRIFTED_DEG or left_px > DRIFTED_PX else "good"


def _by_azimuth(lower: Array, aside: Array, cylinder: Cylinder) -> tuple[tuple[float, float, int], ...]:
    """Azimuth of a sector's middle [deg], median offset [px], matches, all around; sectors without matches are NaN."""
    azimuth = np.pi - (lower[:, 0] + 0.5) / cylinder.focal_px
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    middle = -180 + (np.arange(SECTORS) + 0.5) * 360 / SECTORS
    chosen = [aside[sector == k] for k in range(SECTORS)]
    return tuple((float(middle[k]), float(np.median(part)) if len(part) else float("nan"), len(part))
                 for k, part in enumerate(chosen))
