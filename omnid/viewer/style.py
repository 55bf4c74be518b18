"""Colours, sizes and shapes of the viewer, as arrays; they differ in grey, too.

Colours (r, g, b) are those of Okabe and Ito, which colour-blind people can distinguish.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

SIGMAS: Final = 3.0  # Radius of the ellipsoid in standard deviations.
VISIBLE_M: Final = 0.05  # a smaller ellipsoid is magnified
MOST_MAGNIFIED: Final = 1000
FARTHEST_MM: Final = 65535
SPOT_PX: Final = 3  # side of the square for a located pixel in the depth image


class Style(NamedTuple):
    """A colour and a size in pixels of the screen."""

    colour: Colour
    size_px: float


UNKNOWN: Final = Style((150, 150, 150), 1.5)
STATES: Final = {  # the worse, the thicker
    "tracking": Style((86, 180, 233), 1.5),
    "degraded": Style((230, 159, 0), 3.0),
    "lost": Style((213, 94, 0), 5.0),
}
OBSTACLE: Final = Style((213, 40, 40), 3.0)  # dots around the base
KEYFRAME: Final = Style((60, 60, 60), 2.5)  # dots, and the path through them
LOOP: Final = Style((170, 80, 200), 1.0)
INLIER: Final = Style((86, 180, 233), 2.5)  # dots
REJECTED: Final = Style((213, 94, 0), 5.0)  # crosses
NEW: Final = Style((240, 228, 66), 4.0)  # squares
AXES: Final[tuple[Colour, ...]] = ((213, 94, 0), (0, 158, 115), (0, 114, 178))  # x, y, z


def state_style(state: str) -> Style:
    """Return the style of the path in a state."""
    return STATES.get(state, UNKNOWN)


class Ellipsoid(NamedTuple):
    """Confidence ellipsoid of a position, magnified so that it is visible."""

    half_m: Array  # (3,) half axes as they are drawn
    R: Array  # (3, 3) whose columns are the axes; right-handed
    magnified: int

    @property
    def largest_m(self) -> float:
        """Longest half axis, without the magnification."""
        return float(self.half_m.max()) / self.magnified


def ellipsoid(covariance: Array) -> Ellipsoid | None:
    """Return the ellipsoid of SIGMAS standard deviations for a covariance (3, 3) [m^2]; None unless it is finite.

    Its axes are the eigenvectors. A small ellipsoid is drawn 10, 100 or 1000 times as large.
    """
    if not np.isfinite(covariance).all():
        return None
    variances, axes = np.linalg.eigh(covariance)
    half_m = SIGMAS * np.sqrt(np.maximum(0.0, variances))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    magnified = magnification(float(half_m.max()))
    return Ellipsoid(magnified * half_m, axes, magnified)


def magnification(size_m: float) -> int:
    """Return the power of ten by which an object of that size must be magnified to be visible."""
    if size_m <= 0:
        return 1
    wanted = 10 ** max(0, math.ceil(math.log10(VISIBLE_M / size_m)))
    return int(min(MOST_MAGNIFIED, wanted))


def crosses(pixels: Array, half_px: float) -> NDArray[np.float32]:
    """Return lines (2N, 2, 2) that cross at pixels (N, 2)."""
    corners = np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]], float) * half_px
    return (pixels[:, None, None, :] + corners).reshape(-1, 2, 2).astype(np.float32)


def squares(pixels: Array, half_px: float) -> NDArray[np.float32]:
    """Return closed lines (N, 5, 2) around pixels (N, 2)."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float) * half_px
    return (pixels[:, None, :] + corners).astype(np.float32)


def depth_image(disparity: NDArray[np.float32], focal_baseline: float) -> NDArray[np.uint16]:
    """Return distances [mm] from the rig's axis (H, W), 0 unknown; located pixels are squares, the nearest on top.

    disparity: (H, W) px, NaN unknown; focal_baseline: of the panorama, px times m.
    """
    known = np.nan_to_num(disparity, nan=0.0)
    spots = np.asarray(cv2.dilate(known, np.ones((SPOT_PX, SPOT_PX), np.uint8)), np.float32)
    mm = 1e3 * focal_baseline / np.maximum(spots, 1e-3)
    return np.where(spots > 0, np.minimum(mm, FARTHEST_MM), 0).astype(np.uint16)


def depth_range(distance_mm: NDArray[np.uint16]) -> tuple[float, float]:
    """Return 0 and the 95th percentile of the known distances [mm]: what is unknown, 0, is darker than the nearest."""
    known = distance_mm[distance_mm > 0]
    return (0.0, float(np.percentile(known, 95))) if known.size else (0.0, 1.0)


def evenly(most: int, *rows: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return rows of each array, evenly chosen, at most the given number, the same rows of all."""
    step = max(1, -(-len(rows[0]) // most))
    return tuple(each[::step] for each in rows)


def by_height(points: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours (N, 3) of points (N, 3), dark below and light above, between percentiles of the heights."""
    if not len(points):
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(points[:, 2], (2, 98))
    share = np.clip((points[:, 2] - low) / max(1e-3, high - low), 0, 1)
    colours = cv2.applyColorMap((255 * share).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(colours.reshape(-1, 3)[:, ::-1], np.uint8)
