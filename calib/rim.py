"""Detection of the mirror's rim, the circle beyond which the image is dark, and of a dark hub in its middle."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array, Mask

AZIMUTHS = 720  # steps of half a degree, which is INLIER_PX on a rim of 230 px
# Least difference of grey levels between the middle and the corners; half of it across the edge at one azimuth.
MIN_CONTRAST = 25.0
# Threshold between the dark (0) and the light level (1), nearer the dark one, because the world at the rim is often
# dark too.
EDGE_FRACTION = 0.25
# Number of pixels on either side over which the edge is measured, and beyond it that must be dark.
EDGE_PX = 4
# An azimuth is an inlier if its edge is this near the circle; least share of inliers on the visible circle.
INLIER_PX, MIN_SUPPORT = 2.0, 0.6
# Margin inside the rim and outside the hub, for blur and the last reflections at the edge.
SAFETY_PX = 1.5
# A hub ends within MAX_HUB of the rim's radius, at a ring that is dark (HUB_EDGE_DARK), after rings that are mostly
# dark (HUB_INSIDE_DARK; a lens glints). Within HUB_RING_PX the dark share drops by HUB_DROP: the world begins.
MAX_HUB, HUB_RING_PX, HUB_EDGE_DARK, HUB_INSIDE_DARK, HUB_DROP = 0.4, 5, 0.9, 0.65, 0.2


def find_rim(image: NDArray[np.uint8], center_guess: tuple[float, float]) -> Mask | None:
    """Find the ring that shows the world in an image (H, W) uint8; None if no rim is found with certainty.

    center_guess (u, v) [px] may be off by a tenth of the radius. An image that is bright on all sides (or the maximum
    of several) gives the best rim. None for dark or full-frame images, noise, soft vignettes.
    """
    levels = _levels(image)
    if levels is None:
        return None
    edges = _edges(image, center_guess, levels)
    circle = _fit(edges)
    if circle is None or not _supported(circle, edges, image.shape):
        return None
    u, v, radius = (float(value) for value in circle)
    hub = _hub(image, (u, v), radius, levels[0] + EDGE_FRACTION * (levels[1] - levels[0]))
    return Mask((u, v), hub + SAFETY_PX if hub > 0 else 0.0, radius - SAFETY_PX)


def _levels(image: NDArray[np.uint8]) -> tuple[float, float] | None:
    """Return the dark level, of the corners, and the light level, of the middle; None if they are too close."""
    side = max(1, min(image.shape) // 16)
    corners = [image[:side, :side], image[:side, -side:], image[-side:, :side], image[-side:, -side:]]
    middle = image[tuple(slice(size // 4, -size // 4) for size in image.shape)]
    dark, light = float(np.median([np.median(corner) for corner in corners])), float(np.median(middle))
    return (dark, light) if light - dark >= MIN_CONTRAST else None


def _polar(image: NDArray[np.uint8], center: tuple[float, float], radius_px: int) -> Array:
    """Return the polar image (AZIMUTHS, radius) about a centre, radii 1 px apart; NaN outside the image."""
    azimuth = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False)[:, None]
    radii = np.arange(radius_px)
    u, v = center[0] + radii * np.cos(azimuth), center[1] + radii * np.sin(azimuth)
    sampled = cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    inside = (u >= 0) & (v >= 0) & (u <= image.shape[1] - 1) & (v <= image.shape[0] - 1)
    return np.where(inside, sampled, np.nan)


def _edges(image: NDArray[np.uint8], center: tuple[float, float], levels: tuple[float, float]) -> Array:
    """Return the pixels (N, 2), at most one per azimuth, beyond which the image is dark, with subpixel accuracy."""
    polar = _polar(image, center, int(np.hypot(*image.shape)))
    # 1. The last light pixel, with enough pixels of the image on either side: an image is convex, so each profile is
    #    inside it from one radius to another.
    known, light = np.isfinite(polar), polar >= levels[0] + EDGE_FRACTION * (levels[1] - levels[0])
    first, count = known.argmax(axis=1), known.sum(axis=1)
    last = polar.shape[1] - 1 - light[:, ::-1].argmax(axis=1)
    rows = np.flatnonzero(light.any(axis=1) & (last - first >= EDGE_PX) & (last - first + 2 * EDGE_PX < count))
    # 2. Levels on either side of the fall, which is steep.
    near = polar[rows[:, None], last[rows, None] + np.arange(1 - EDGE_PX, 2 * EDGE_PX)]
    inside, outside = near[:, :EDGE_PX].mean(axis=1), near[:, 2 * EDGE_PX - 1 :].mean(axis=1)
    steep = inside - outside >= MIN_CONTRAST / 2
    rows, near, half = rows[steep], near[steep], (inside + outside)[steep] / 2
    # 3. The radius at which the profile has the level between them.
    at = EDGE_PX - 1 - (near[:, EDGE_PX - 1 :: -1] >= half[:, None]).argmax(axis=1)
    level, beyond = near[np.arange(len(at)), at], near[np.arange(len(at)), at + 1]
    radius_px, azimuth = last[rows] + 1 - EDGE_PX + at + (level - half) / (level - beyond), 2 * np.pi * rows / AZIMUTHS
    return np.column_stack([center[0] + radius_px * np.cos(azimuth), center[1] + radius_px * np.sin(azimuth)])


def _fit(edges: Array) -> Array | None:
    """Fit a circle (u, v, radius) to edges (N, 2) in order of azimuth; None if they are too few.

    The best of the circles through three edges a third of all apart (as RANSAC, without chance), then least squares
    over its inliers as long as they become more.
    """
    if len(edges) < AZIMUTHS / 2 * MIN_SUPPORT:
        return None
    numbers = np.arange(len(edges))
    triples = np.stack([numbers, numbers + len(edges) // 3, numbers + 2 * len(edges) // 3], axis=1) % len(edges)
    circles = circles_through(edges[triples])
    best = circles[(_distance(edges, circles.T[:, :, None]) < INLIER_PX).sum(axis=1).argmax()]
    inliers = np.zeros(len(edges), bool)
    while (found := _distance(edges, best) < INLIER_PX).sum() > inliers.sum():
        inliers, best = found, _circle(edges[found])
    return np.asarray(best)


def circles_through(points: Array) -> Array:
    """Return centres and radii (N, 3) of the circles through three points each (N, 3, 2); not finite for three in line.

    The centre c, seen from the first point, is as far from it as from the others, p: 2 p c = p^2.
    """
    p, q = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    p2, q2 = (p**2).sum(axis=1), (q**2).sum(axis=1)
    twice_area = 2 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (q[:, 1] * p2 - p[:, 1] * q2) / twice_area
        v = (p[:, 0] * q2 - q[:, 0] * p2) / twice_area
    return np.column_stack([points[:, 0, 0] + u, points[:, 0, 1] + v, np.hypot(u, v)])


def _circle(points: Array) -> Array:
    """Return centre and radius (3,) of the circle through points (N, 2), by least squares (Kasa 1976)."""
    middle = points.mean(axis=0)
    local = points - middle
    A = np.column_stack([2 * local, np.ones(len(local))])
    a, b, c = np.linalg.lstsq(A, (local**2).sum(axis=1), rcond=None)[0]
    return np.array([a + middle[0], b + middle[1], np.sqrt(max(0.0, c + a * a + b * b))])


def _distance(points: Array, circle: Array) -> Array:
    """Return distances (N,) of points (N, 2) from a circle (3,), or (M, N) from circles (3, M, 1)."""
    return np.asarray(np.abs(np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]))


def _supported(circle: Array, edges: Array, shape: tuple[int, ...]) -> bool:
    """True if half of the circle lies in the image, as less does not determine its centre, and has an edge there."""
    azimuth = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False)
    reach = circle[2] + 2 * EDGE_PX
    u, v = circle[0] + reach * np.cos(azimuth), circle[1] + reach * np.sin(azimuth)
    possible = int(((u >= 0) & (v >= 0) & (u <= shape[1] - 1) & (v <= shape[0] - 1)).sum())
    inliers = int((_distance(edges, circle) < INLIER_PX).sum())
    return possible >= AZIMUTHS / 2 and inliers >= MIN_SUPPORT * possible


def _hub(image: NDArray[np.uint8], center: tuple[float, float], rim_px: float, threshold: float) -> float:
    """Return the radius [px] of a dark disc or ring about the centre, the camera's own reflection; 0: none."""
    polar = _polar(image, center, int(MAX_HUB * rim_px))
    dark = np.mean(polar < threshold, axis=0)
    inside = np.convolve(dark, np.ones(HUB_RING_PX) / HUB_RING_PX, "valid")[:-HUB_RING_PX]
    edge, beyond = dark[HUB_RING_PX - 1 : -HUB_RING_PX], dark[2 * HUB_RING_PX - 1 :]
    ends = np.flatnonzero((edge >= HUB_EDGE_DARK) & (inside >= HUB_INSIDE_DARK) & (beyond <= edge - HUB_DROP))
    return float(ends[-1] + HUB_RING_PX) if ends.size else 0.0
