"""State of a rig by matches of some pairs: a point lies on one column of both panoramas if the rig fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.fit.rig_drift import RigDrift, estimate_rig_drift
from calib.fit.robust_scale import SIGMA_PER_MAD
from calib.panorama import Cylinder
from omnid.core.rig.column_matches import Matches
from omnid.core.rig.rig_state import RigState

Array = NDArray[np.float64]

# Matches for a finding: ten in each sector of azimuth, so that a tilt and a shift can be distinguished.
MIN_MATCHES: Final = 120
# Rotation of the upper camera, because rigs as calibrated, rendered and real, are measured below 0.1 deg.
DRIFTED_DEG: Final = 0.2
# So many because two degrees are seven columns of a panorama of 1300, where stereo, which searches one column, matches
# by chance.
BROKEN_DEG: Final = 2.0
# Weight of the shift's angle against the rotation's, because a shifted viewpoint affects near points only.
SHIFT_WEIGHT: Final = 0.2
# Standard deviations subtracted from rotation and shift, so that an uncertain finding accuses no rig.
SIGMAS: Final = 4.0
# With a rig that is wrong by many degrees, points match by chance only. Corners in noise match nowhere either, so only
# points with contrast are counted, because a smaller part of them that match means a broken rig.
MIN_MATCHED_PART: Final = 0.08
MIN_CONTRAST_POINTS: Final = 400
SECTORS: Final = 12  # Sectors of azimuth, 30 deg each, because that is about the width of a wall in a room.
# Matches for the median of a sector, so that it is known to 1.25 / sqrt(20), about a quarter of the spread.
MIN_IN_SECTOR: Final = 20
# Median residual of the sectors, because a camera whose intrinsics have changed bends the columns all around; the
# matches of one wall alone may be misled.
DRIFTED_PX: Final = 0.3


@dataclass(frozen=True, slots=True)
class RigFinding:
    """Result of the check."""

    state: RigState
    matches: int
    tried: int
    offset_px: float  # median of upper minus lower columns
    spread_px: float  # 1.48 times the median absolute deviation
    by_azimuth: tuple[tuple[float, float, int], ...]  # degrees, median offset [px] or NaN, matches
    left_px: float  # median residual of the sectors after the drift: no rotation of a camera explains it
    drift: RigDrift | None

    @property
    def turn_deg(self) -> float:
        """Rotation of the upper camera against the rig's file, degrees; NaN where it is unknown."""
        return float(np.rad2deg(np.linalg.norm(self.drift.turn))) if self.drift else float("nan")

    @property
    def misfit_deg(self) -> float:
        """Rotation, or part of the shift, less SIGMAS standard deviations, in degrees; 0 where it is unknown."""
        return 0.0 if self.drift is None else _misfit_deg(self.drift)

    @property
    def summary(self) -> str:
        """Summary in one line."""
        if self.drift is None:
            return f"{self.state}: {self.matches} of {self.tried} points found in both panoramas"
        x, y, z = np.rad2deg(self.drift.turn)
        return (
            f"{self.state}: columns off by {self.offset_px:+.2f} px (spread {self.spread_px:.2f}), upper "
            f"camera turned by {self.turn_deg:.3f} deg, sigma {np.rad2deg(self.drift.angle_sigma):.3f} "
            f"({x:+.3f} {y:+.3f} {z:+.3f}), by {self.matches} points"
        )


def judge(found: Matches, cylinder: Cylinder) -> RigFinding:
    """Return what the matches of some pairs say about their rig."""
    # 1. Offsets of the columns, as they are.
    shifts = cylinder.wrap(found.upper[:, 0] - found.lower[:, 0])
    offset = float(np.median(shifts)) if len(shifts) else float("nan")
    spread = SIGMA_PER_MAD * float(np.median(np.abs(shifts - offset))) if len(shifts) else float("nan")
    enough = len(shifts) >= MIN_MATCHES
    # 2. The rotation and shift of the upper camera that explain them.
    drift = estimate_rig_drift(cylinder.rays(found.lower), cylinder.rays(found.upper)) if enough else None
    # 3. What is left in each direction shows a camera whose intrinsics have changed.
    residuals = _by_azimuth(found.lower, drift.residuals * cylinder.focal_px, cylinder) if drift else ()
    offsets = [abs(median) for _, median, count in residuals if count >= MIN_IN_SECTOR]
    left_px = float(np.median(offsets)) if offsets else float("nan")
    return RigFinding(
        _state(drift, left_px, len(shifts), found.clear),
        len(shifts),
        found.tried,
        offset,
        spread,
        _by_azimuth(found.lower, shifts, cylinder),
        left_px,
        drift,
    )


def _state(drift: RigDrift | None, left_px: float, matches: int, clear: int) -> RigState:
    """Return the state by the drift, the residuals that it leaves, and the matches of points with clear contrast."""
    if clear >= MIN_CONTRAST_POINTS and matches < MIN_MATCHED_PART * clear:
        return RigState.BROKEN
    if drift is None:
        return RigState.UNCHECKED
    worst = _misfit_deg(drift)
    if worst > BROKEN_DEG:
        return RigState.BROKEN
    return RigState.DRIFTED if worst > DRIFTED_DEG or left_px > DRIFTED_PX else RigState.FITS


def _misfit_deg(drift: RigDrift) -> float:
    turn, shift = np.rad2deg(np.linalg.norm(drift.turn)), np.rad2deg(np.linalg.norm(drift.shift))
    unsure = np.rad2deg(SIGMAS * np.array([np.linalg.norm(drift.turn_sigma), np.linalg.norm(drift.shift_sigma)]))
    return float(max(max(0.0, turn - unsure[0]), SHIFT_WEIGHT * max(0.0, shift - unsure[1])))


def _by_azimuth(lower: Array, shifts: Array, cylinder: Cylinder) -> tuple[tuple[float, float, int], ...]:
    """Return azimuth of the middle [deg], median offset [px], NaN without matches, and matches of each sector."""
    azimuth = cylinder.azimuth(lower[:, 0])
    sector = np.floor((azimuth + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    middle = -180 + (np.arange(SECTORS) + 0.5) * 360 / SECTORS
    chosen = [shifts[sector == k] for k in range(SECTORS)]
    return tuple(
        (float(middle[k]), float(np.median(part)) if len(part) else float("nan"), len(part))
        for k, part in enumerate(chosen)
    )
