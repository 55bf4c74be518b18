"""Panoramas on a cylinder about the line through both viewpoints, in which every epipolar line is a column.

column: azimuth falls from left to right, as seen from inside; in that of a full turn azimuth 0 (the rig's x) is in the
middle. Cameras that share less than a full turn have a panorama of their sector: some columns of the full turn, with
first as column 0.
row = row0 - focal * z / r, r the distance from the axis, so row_upper - row_lower = focal * baseline / r.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array, inside_image
from calib.rig import MountedCamera, Rig

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
# Numbers of slopes and azimuths by which the common field of view is measured, and the least share of these azimuths at
# which a slope is visible.
SLOPES, AZIMUTHS, MIN_VISIBLE = 400, 24, 0.5
# A sector begins and ends at one of SECTOR_STEPS steps of a full turn, each of a whole number of columns. Steps of 3.75
# degrees are five directions of the obstacles, so that both share their borders, and a sector is at most two of them
# wider than what is seen.
SECTOR_STEPS = 96
# Azimuths at which a sector is measured, 0.375 degrees, so that no pole hides between them.
SECTOR_GRID = 10 * SECTOR_STEPS
# A panorama is a sector if the cameras do not share an azimuth of at least this width, because a strut or a mast hides
# less.
MIN_UNSEEN_RAD = math.radians(45)
# Least elevations that both cameras see, because 15 degrees have 60 rows at scale 1, four windows of the tracker.
MIN_SHARED_DEG = 15.0
# Columns: more than cv2.remap's 32767 with padding cannot be used. Pixels: tables and images must fit the memory.
MAX_WIDTH_PX, MAX_PIXELS = 16384, 16 * 2**20
# Guards against division by zero on the cylinder's axis.
MIN_RADIUS = 1e-9


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Size and scale of a panorama [px]; pixels are (column, row). Columns of a full turn are periodic."""

    width: int
    height: int
    row0: float
    period_px: int = 0  # columns of a full turn, of which the panorama has `width`; 0: all of them
    first: int = 0  # column of the full turn that is column 0
    scale: float = field(default=1.0, compare=False)  # columns by those of the images' own resolution

    def __post_init__(self) -> None:
        if not self.period_px:
            object.__setattr__(self, "period_px", self.width)

    @property
    def focal_px(self) -> float:
        """Return the pixels per radian of azimuth, and per unit of z/r: square pixels on the horizon."""
        return self.period_px / (2 * math.pi)

    @property
    def left_rad(self) -> float:
        """Return the azimuth of the left edge of column 0."""
        return math.pi - self.first / self.focal_px

    def resized(self, width: int) -> Cylinder:
        """Return the panorama of about the same view in other columns."""
        scale = width / self.width
        period_px, first = round(self.period_px * scale), round(self.first * scale)
        height = max(1, round(self.height * scale))
        return Cylinder(width, height, self.row0 * scale, period_px, first, self.scale * scale)

    @property
    def full_turn(self) -> Cylinder:
        """Return the panorama of the full turn of which this is a sector."""
        return Cylinder(self.period_px, self.height, self.row0, scale=self.scale)

    def azimuth(self, columns: Array) -> Array:
        """Return the azimuths (N,) of columns (N,)."""
        return np.asarray(self.left_rad - (columns + 0.5) / self.focal_px)

    def rays(self, pixels: Array) -> Array:
        """Return rays (N, 3) with r = 1 in the rectified frame of pixels (N, 2)."""
        azimuth = self.azimuth(pixels[:, 0])
        return np.column_stack([np.cos(azimuth), np.sin(azimuth), (self.row0 - pixels[:, 1]) / self.focal_px])

    def pixels(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) relative to the viewpoint, in the rectified frame.

        What a sector does not show has columns outside of it: each point is at most half a turn from the middle.
        """
        r = np.hypot(points[:, 0], points[:, 1])
        column = (self.left_rad - np.arctan2(points[:, 1], points[:, 0])) * self.focal_px - 0.5
        if self.width < self.period_px:
            column = self.width / 2 + self.wrap(column - self.width / 2)
        return np.column_stack([column, self.row0 - self.focal_px * points[:, 2] / np.maximum(r, MIN_RADIUS)])

    def wrap(self, columns: Array) -> Array:
        """Return column differences, mapped to [-turn/2, turn/2)."""
        return np.asarray((columns + self.period_px / 2) % self.period_px - self.period_px / 2)

    def shows(self, columns: Array) -> NDArray[np.bool_]:
        """True (N,) for columns, as `pixels` returns them, that the panorama has."""
        return np.asarray((self.width == self.period_px) | ((columns >= 0) & (columns <= self.width - 1)))


def fit_cylinder(
    rig: Rig, width_px: int = 0, elevation_deg: tuple[float, float] = (-50.0, 40.0), scale: float = 1.0
) -> Cylinder:
    """Return the panorama of what both cameras see: a full turn or a sector of it, within elevations.

    width_px: columns of a full turn; 0: the resolution of the images, scaled.
    """
    # 1. The sector of azimuth, and the slopes, that both cameras see.
    right_rad, span_rad, slopes = _shared_view(rig, elevation_deg)
    # 2. Columns.
    own_px, turn = _period_px(rig, right_rad, span_rad, float(np.clip(0.0, slopes.min(), slopes.max()))), width_px
    if turn:
        scale = turn / own_px if math.isfinite(own_px) else 1.0
    elif math.isfinite(own_px):
        turn = 8 * round(scale * own_px / 8)
    if not turn:
        raise CalibError(
            "rig: a camera does not see the horizon, or as a point; check intrinsics and transforms, or set "
            "panorama.width_px"
        )
    width, first = turn, 0
    if span_rad < math.tau:
        step = max(1, round(turn / SECTOR_STEPS))
        turn, step_rad = step * SECTOR_STEPS, 2 * math.pi / SECTOR_STEPS
        left = math.floor((math.pi - right_rad - span_rad) / step_rad)
        right = math.ceil((math.pi - right_rad) / step_rad)
        width, first = step * min(right - left, SECTOR_STEPS), step * (left % SECTOR_STEPS)
    if width > MAX_WIDTH_PX:
        raise _too_large(f"{width} columns")
    # 3. Rows.
    focal = turn / (2 * math.pi)
    row0 = float(focal * slopes.max())
    height = math.ceil(row0 - focal * slopes.min()) + 1
    if width * height > MAX_PIXELS:
        raise _too_large(f"{width} x {height} pixels")
    return Cylinder(width, height, row0, turn, first, scale)


def at_pixels(table: NDArray[Any], pixels: Array) -> NDArray[Any]:
    """Return the values (...) of a panorama's table (H, W) at the nearest of pixels (..., 2): columns wrap around.

    Rows beyond the table are its first and last one; NaN is pixel 0.
    """
    height, width = table.shape
    nearest = np.rint(np.nan_to_num(pixels))
    rows = np.clip(nearest[..., 1], 0, height - 1).astype(np.intp)
    return np.asarray(table[rows, nearest[..., 0].astype(np.intp) % width])


def at_scale(px: float, scale: float) -> int:
    """Return an angle in pixels of a panorama of a scale, at least one; px: in one of the images' own resolution."""
    return max(1, round(px * scale))


def _too_large(found: str) -> CalibError:
    return CalibError(
        f"rig: a panorama with the resolution of its images would have {found}, expected at most {MAX_WIDTH_PX} "
        f"columns and {MAX_PIXELS} pixels; check the intrinsics and the transforms, or set panorama.width_px"
    )


def _shared_view(rig: Rig, elevation_deg: tuple[float, float]) -> tuple[float, float, Array]:
    """Return the sector that both cameras share, and the slopes z/r (S,) that both see over most of it.

    The sector begins at an azimuth and turns left by its span [rad]; that of the whole circle is 2 pi. Raise CalibError
    where the cameras share too little.
    """
    low, high = np.tan(np.deg2rad(elevation_deg))
    slopes: Array = np.linspace(low, high, SLOPES)
    sector = _shared_sector(rig, slopes)
    if sector is None:
        raise CalibError(
            f"rig: the cameras share no view between {elevation_deg[0]} and {elevation_deg[1]} degrees "
            "of elevation; check the intrinsics, the transforms and the masks"
        )
    right_rad, span_rad = sector
    azimuths = right_rad + (np.arange(AZIMUTHS) + (0.5 if span_rad < math.tau else 0.0)) * span_rad / AZIMUTHS
    lower, upper = (
        _seen(rig, mounted, slopes, azimuths).mean(axis=1) >= MIN_VISIBLE for mounted in (rig.lower, rig.upper)
    )
    slopes = slopes[lower & upper]
    if not len(slopes):
        raise CalibError(
            f"rig: the cameras share {math.degrees(span_rad):.0f} degrees of azimuth, but no elevation between "
            f"{elevation_deg[0]} and {elevation_deg[1]} degrees in half of them; check the transforms and the masks"
        )
    shared_deg = math.degrees(math.atan(slopes.max()) - math.atan(slopes.min()))
    if shared_deg < MIN_SHARED_DEG:
        raise CalibError(
            f"rig: the cameras share {shared_deg:.1f} degrees of elevation about the line through both "
            f"viewpoints, expected {MIN_SHARED_DEG:g} or more: lenses back to back share too little; "
            "check the transforms and the masks"
        )
    return right_rad, span_rad, slopes


def _shared_sector(rig: Rig, slopes: Array) -> tuple[float, float] | None:
    """Return begin and span of the azimuths at which both cameras see a slope; None where there is none.

    It is the complement of the widest gap, or the whole circle if no gap is as wide as MIN_UNSEEN_RAD.
    """
    step_rad = 2 * math.pi / SECTOR_GRID
    azimuths = np.asarray((np.arange(SECTOR_GRID) + 0.5) * step_rad - math.pi, float)
    few = slopes[:: SLOPES // 40]
    shared = _seen(rig, rig.lower, few, azimuths) & _seen(rig, rig.upper, few, azimuths)
    seen = np.flatnonzero(shared.any(axis=0))
    if not len(seen):
        return None
    gaps = np.diff(np.append(seen, seen[0] + SECTOR_GRID)) - 1
    widest = int(gaps.argmax())
    if gaps[widest] * step_rad < MIN_UNSEEN_RAD:
        return -math.pi, math.tau
    right = int(seen[(widest + 1) % len(seen)])
    return right * step_rad - math.pi, (SECTOR_GRID - int(gaps[widest])) * step_rad


def _seen(rig: Rig, mounted: MountedCamera, slopes: Array, azimuth: Array) -> NDArray[np.bool_]:
    """Return flags (S, A) of slopes z/r (S,) that a camera sees at azimuths (A,)."""
    grid = np.column_stack(
        [np.tile(np.cos(azimuth), len(slopes)), np.tile(np.sin(azimuth), len(slopes)), np.repeat(slopes, len(azimuth))]
    )
    pixels = _project(rig, mounted, grid)
    seen = inside_image(mounted.camera, pixels) & mounted.visible.contains(pixels)
    return np.asarray(seen.reshape(len(slopes), -1))


def _period_px(rig: Rig, right_rad: float, span_rad: float, slope: float) -> float:
    """Return the length [px] of a full turn in the images, from that of the sector at a slope, in the coarser camera.

    That of a full circle is the length of the horizon; NaN where a camera does not see it.
    """
    azimuth = right_rad + np.linspace(0, span_rad, 361)
    level = np.full_like(azimuth, slope if span_rad < math.tau else 0.0)
    ring = np.column_stack([np.cos(azimuth), np.sin(azimuth), level])
    with np.errstate(over="ignore", invalid="ignore"):
        around = [np.linalg.norm(np.diff(_project(rig, m, ring), axis=0), axis=1) for m in (rig.lower, rig.upper)]
    # At the ends of a sector one of the cameras may have no image, and a stitched image has its ends somewhere on the
    # horizon, where a step leads from one end of the image to the other: the median step stands for those.
    usual = [float(np.nanmedian(steps)) if np.isfinite(steps).any() else math.nan for steps in around]
    lengths = [
        np.where(steps < 2 * step, steps, step).sum() * math.tau / span_rad
        for steps, step in zip(around, usual, strict=True)
    ]
    return float(min(lengths)) if np.isfinite(lengths).all() and min(lengths) > 0 else math.nan


def _project(rig: Rig, mounted: MountedCamera, rays: Array) -> Array:
    """Return the pixels of rays (N, 3) in the rectified frame that start at the camera's own viewpoint."""
    R_cam_rect = se3.R_of(mounted.T_cam_rig) @ se3.R_of(se3.inverse(rig.T_rect_rig))
    return mounted.camera.project(rays @ R_cam_rect.T)


def remap_tables(rig: Rig, mounted: MountedCamera, cylinder: Cylinder, pad_px: int = 0) -> Maps:
    """Return image coordinates (H, W + 2 pad) float32 of every panorama pixel, for cv2.remap; -1 outside the image.

    pad_px columns more lie on either side, those of a full turn repeated, so that windows and pyramids are continuous
    across the seam.
    """
    columns = np.arange(-pad_px, cylinder.width + pad_px)
    u, v = (np.empty((cylinder.height, len(columns)), np.float32) for _ in range(2))
    for row in range(cylinder.height):
        pixels = _project(rig, mounted, cylinder.rays(np.column_stack([columns, np.full(len(columns), float(row))])))
        pixels[~inside_image(mounted.camera, pixels)] = -1
        u[row], v[row] = pixels.T
    return u, v


def visible(mounted: MountedCamera, maps: Maps, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Return the mask (H, W) of panorama pixels (of remap tables) on the image and inside the camera's mask."""
    pixels = np.stack(maps, axis=-1).reshape(-1, 2).astype(float)
    seen = (pixels[:, 0] >= 0) & mounted.visible.contains(pixels, margin_px)
    return seen.reshape(maps[0].shape)
