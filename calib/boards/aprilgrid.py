"""Detection of AprilTag grids in mirror images: any visible part of a grid counts.

The tags' borders are two bits wide, and black squares between the tags turn the tags' corners into corners of a
checkerboard. The tags that can be read predict the corners around them, to second order; these are found as saddle
points of grey, also those of tags that could not be read.
"""

from __future__ import annotations

import cv2
import numpy as np

from calib.boards.board import TAG_BORDER_BITS, AprilGrid
from calib.boards.corner_candidates import Grey, Image, smoothed
from calib.boards.corner_grid import shown_corners
from calib.boards.local_mapping import REACH, local_mapping, refined_corners, without_outliers
from calib.models.camera import Array

# Corners (4, 2) [px] of tags by number, in the order of cv2.aruco.
Tags = dict[int, Array]


# Least perimeter of a tag as a fraction of the image's larger side, and pixels per bit when it is read: half and 1.5 of
# OpenCV's defaults, because tags are small in a mirror image.
MIN_PERIMETER_PART, PIXELS_PER_BIT = 0.015, 6
# Least number of corners, because fewer determine no pose well.
MIN_CORNERS = 8


def find_april_grid(image: Image, board: AprilGrid) -> Array | None:
    """Return pixels (N, 2) of board.points in an image (H, W) uint8, NaN for hidden ones; None if too few are seen."""
    corners = board.tag_corners / board.tag_m
    tags = _read_tags(image, len(corners))
    if not tags:
        return None
    points = board.points[:, :2] / board.tag_m
    places, outlines = corners[list(tags)].reshape(-1, 2), np.concatenate(list(tags.values()))
    pixels = _grown(smoothed(image), points, places, outlines, board.window)
    # Corners in one line have no mapping, and those of tags that are misread, or of another grid, do not fit to it.
    pixels = without_outliers(points, refined_corners(image, points, pixels, board.window))
    return pixels if np.isfinite(pixels[:, 0]).sum() >= MIN_CORNERS else None


def _read_tags(image: Image, count: int) -> Tags:
    """Read the tags of a grid of a number of tags in an image (H, W) uint8, seen directly or in a mirror."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = TAG_BORDER_BITS
    parameters.minMarkerPerimeterRate = MIN_PERIMETER_PART
    parameters.perspectiveRemovePixelPerCell = PIXELS_PER_BIT
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)
    # Tags are hardly misread: the view that shows more of them is the right one. Small ones are read when enlarged.
    sides = image, np.ascontiguousarray(image[:, ::-1])
    views = [_detected(detector, side, 1) for side in sides]
    most = max(map(len, views))
    views = [
        _detected(detector, side, 2) | found if len(found) == most < count else found
        for side, found in zip(sides, views, strict=True)
    ]
    direct, reflected = ({k: at for k, at in found.items() if k < count} for found in views)
    if len(direct) >= len(reflected):
        return direct
    return {k: np.array([image.shape[1] - 1, 0]) + np.array([-1, 1]) * at for k, at in reflected.items()}


def _detected(detector: cv2.aruco.ArucoDetector, image: Image, scale: int) -> Tags:
    """Return the tags that are read in an image enlarged by a factor, in pixels of the image itself."""
    enlarged = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    corners, ids, _ = detector.detectMarkers(enlarged)
    places = [(np.asarray(at, float).reshape(4, 2) + 0.5) / scale - 0.5 for at in corners]
    numbers = np.zeros(0, int) if ids is None else np.asarray(ids, int).ravel()
    return dict(zip(numbers.tolist(), places, strict=True))


def _grown(image: Grey, points: Array, places: Array, outlines: Array, window: float) -> Array:
    """Return the pixels (N, 2) of the board's points [squares] that the image shows, NaN for the others.

    places (M, 2) [squares] and outlines (M, 2) [px]: the tags' corners.
    """
    pixels = np.full(points.shape, np.nan)
    known_points, known_pixels = places, outlines
    while True:
        tried = np.flatnonzero(np.isnan(pixels[:, 0])).tolist()
        found = shown_corners(image, {k: local_mapping(points[k], known_points, known_pixels) for k in tried}, window)
        if not found:
            break
        pixels[list(found)] = np.array(list(found.values()))
        new = np.isfinite(pixels[:, 0])
        # Corners are more accurate than the outlines of tags, which remain where there are no corners yet.
        far = np.linalg.norm(places[:, None] - points[new], axis=2).min(axis=1) > REACH
        known_points = np.vstack([points[new], places[far]])
        known_pixels = np.vstack([pixels[new], outlines[far]])
    return pixels
