"""Panoramas on a cylinder about the line through both viewpoints, in which every epipolar line is a column.

column: azimuth falls from left to right, as seen from inside; azimuth 0 (the rig's x) is in the middle.
row = row0 - focal * z / r, r the distance from the axis, so row_upper - row_lower = focal * baseline / r.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array, inside_image
from calib.rig import MountedCamera, Rig

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]
# Grid on which the common field of view is measured, and the least share of azimuths at which a slope is visible.
SLOPES, AZIMUTH_STEP_DEG, MIN_VISIBLE = 400, 15, 0.5
# Least length of the horizon of a camera that sees it.
MIN_HORIZON_PX = 64
# Columns: more than cv2.remap's 32767 with padding cannot be used. Pixels: tables and images must fit the memory.
MAX_WIDTH_PX, MAX_PIXELS = 16384, 16 * 2**20
# Rows of a table that are computed at once: the projection takes some 200 bytes a pixel.
BLOCK_ROWS = 64
# Guards against division by zero on the cylinder's axis.
MIN_RADIUS = 1e-9


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Size and scale of a panorama [px]; pixels are (column, row), columns are periodic in width."""

    width: int
    height: int
    row0: float

    @property
    def focal_px(self) -> float:
        """Return the pixels per radian of azimuth, and per unit of z/r: square pixels on the horizon."""
        return self.width / (2 * math.pi)

    def rays(self, pixels: Array) -> Array:
        """Return rays (N, 3) with r = 1 in the rectified frame of pixels (N, 2)."""
        azimuth = math.pi - (pixels[:, 0] + 0.5) / self.focal_px
        return np.column_stack([np.cos(azimuth), np.sin(azimuth), (self.row0 - pixels[:, 1]) / self.focal_px])

    def pixels(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) relative to the viewpoint, in the rectified frame."""
        r = np.hypot(points[:, 0], points[:, 1])
        column = (math.pi - np.arctan2(points[:, 1], points[:, 0])) * self.focal_px - 0.5
        return np.column_stack([column, self.row0 - self.focal_px * points[:, 2] / np.maximum(r, MIN_RADIUS)])

    def wrap(self, columns: Array) -> Array:
        """Return column differences, mapped to [-width/2, width/2)."""
        return np.asarray((columns + self.width / 2) % self.width - self.width / 2)


def fit_cylinder(rig: Rig, width_px: int = 0, elevation_deg: tuple[float, float] = (-50.0, 40.0), scale: float = 1.0
                 ) -> Cylinder:
    """Return the panorama of the elevations that both cameras see; width 0: the resolution of the images, scaled."""
    width = width_px or 8 * round(scale * _horizon_px(rig) / 8)
    if width > MAX_WIDTH_PX:
        raise _too_large(f"{width} columns")
    focal = width / (2 * math.pi)
    low, high = (np.tan(np.deg2rad(elevation_deg)))
    seen = [_seen_slopes(rig, mounted, np.linspace(low, high, SLOPES)) for mounted in (rig.lower, rig.upper)]
    both = seen[0] & seen[1]
    if not both.any():
        raise CalibError(f"rig: the cameras share no view between {elevation_deg[0]} and {elevation_deg[1]} degrees "
                         "of elevation; check the transforms and the masks")
    slopes = np.linspace(low, high, SLOPES)[both]
    row0 = float(focal * slopes.max())
    height = math.ceil(row0 - focal * slopes.min()) + 1
    if width * height > MAX_PIXELS:
        raise _too_large(f"{width} x {height} pixels")
    return Cylinder(width, height, row0)


def _too_large(found: str) -> CalibError:
    return CalibError(f"rig: a panorama with the resolution of its images would have {found}, expected at most "
                      f"{MAX_WIDTH_PX} columns and {MAX_PIXELS} pixels; check the intrinsics and the transforms, or "
                      "set panorama.width_px")


def _seen_slopes(rig: Rig, mounted: MountedCamera, slopes: Array) -> NDArray[np.bool_]:
    """Return the mask of slopes z/r that a camera sees at half of all azimuths at least."""
    azimuth = np.deg2rad(np.arange(0, 360, AZIMUTH_STEP_DEG))
    grid = np.column_stack([np.tile(np.cos(azimuth), len(slopes)), np.tile(np.sin(azimuth), len(slopes)),
                            np.repeat(slopes, len(azimuth))])
    pixels = _project(rig, mounted, grid)
    seen = inside_image(mounted.camera, pixels) & mounted.visible.contains(pixels)
    return np.asarray(seen.reshape(len(slopes), -1).mean(axis=1) >= MIN_VISIBLE)


def _horizon_px(rig: Rig) -> float:
    """Return the length of the horizon [px] in the camera with the lower resolution."""
    azimuth = np.linspace(0, 2 * math.pi, 361)
    ring = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
    with np.errstate(over="ignore", invalid="ignore"):
        around = [np.linalg.norm(np.diff(_project(rig, m, ring), axis=0), axis=1).sum() for m in (rig.lower, rig.upper)]
    if not np.isfinite(around).all() or min(around) < MIN_HORIZON_PX:
        raise CalibError("rig: a camera does not see the horizon; set panorama.width_px and check the transforms")
    return float(min(around))


def _project(rig: Rig, mounted: MountedCamera, rays: Array) -> Array:
    """Return the pixels of rays (N, 3) in the rectified frame that start at the camera's own viewpoint."""
    R_cam_rect = mounted.T_cam_rig[:3, :3] @ se3.inverse(rig.T_rect_rig)[:3, :3]
    return mounted.camera.project(rays @ R_cam_rect.T)


def remap_tables(rig: Rig, mounted: MountedCamera, cylinder: Cylinder, pad_px: int = 0) -> Maps:
    """Return image coordinates (H, W + 2 pad) float32 of every panorama pixel, for cv2.remap; -1 outside the image.

    pad_px columns are repeated on either side, so that windows and pyramids are continuous across the seam.
    """
    shape = cylinder.height, cylinder.width + 2 * pad_px
    u, v = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for top in range(0, cylinder.height, BLOCK_ROWS):
        rows = np.arange(top, min(top + BLOCK_ROWS, cylinder.height))
        u[rows], v[rows] = _block_tables(rig, mounted, cylinder, (rows, pad_px))
    return u, v


def _block_tables(rig: Rig, mounted: MountedCamera, cylinder: Cylinder, block: tuple[NDArray[np.int_], int]) -> Maps:
    """Return the tables of some rows; block: the rows and the padding [px]."""
    columns, rows = np.meshgrid(np.arange(-block[1], cylinder.width + block[1]), block[0])
    pixels = _project(rig, mounted, cylinder.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float)))
    pixels[~inside_image(mounted.camera, pixels)] = -1
    u, v = pixels.astype(np.float32).T.reshape(2, *columns.shape)
    return u, v


def visible(mounted: MountedCamera, maps: Maps, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Return the mask (H, W) of panorama pixels (of remap tables) on the image and inside the camera's mask."""
    pixels = np.stack(maps, axis=-1).reshape(-1, 2).astype(float)
    seen = (pixels[:, 0] >= 0) & mounted.visible.contains(pixels, margin_px)
    return seen.reshape(maps[0].shape)
