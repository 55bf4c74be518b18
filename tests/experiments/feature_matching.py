"""SIFT and Harris corners matched between the panoramas of a pair, to compare enhanced SAD with (section III.B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array
from omnid.messages import Panoramas

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
RATIO = 0.8  # Lowe 2004: the nearest descriptor must be this much nearer than the second nearest
COLUMN_PX = 2.0  # largest column difference of a match: epipolar lines are columns
MIN_DISPARITY_PX = 0.5
SIFT_CONTRAST = 0.01  # OpenCV's 0.04 finds hardly any feature on bricks of little contrast
HARRIS_BLOCK_PX, HARRIS_K = 5, 0.04
HARRIS_QUALITY = 1e-3  # smallest response, as a share of the strongest
HARRIS_SPACING_PX = 3
HARRIS_FEATURES = 4000
SUBPIXEL_WINDOW_PX = 3  # half the side of the window that refines a corner
SUBPIXEL_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
PATCH_PX = 15  # side of the patch that describes a Harris corner
FLAT_GREY = 1e-6  # keeps a patch of one grey level from dividing by zero


@dataclass(frozen=True, slots=True)
class FeatureSet:
    """Keypoints of one panorama and their descriptors."""

    pixels: Array  # (N, 2) column, row
    descriptors: NDArray[np.float32]  # (N, D)


Detector = Callable[[Image, Flags], FeatureSet]


def sift(image: Image, usable: Flags, features: int = 0) -> FeatureSet:
    """Detect and describe SIFT features (Lowe 2004) where usable; features 0: no limit, else the strongest."""
    detector = cv2.SIFT.create(nfeatures=features, contrastThreshold=SIFT_CONTRAST)
    keypoints, descriptors = detector.detectAndCompute(image, usable.astype(np.uint8))
    if descriptors is None:
        return FeatureSet(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    return FeatureSet(np.array([k.pt for k in keypoints], float), np.asarray(descriptors, np.float32))


def harris(image: Image, usable: Flags) -> FeatureSet:
    """Detect Harris corners where usable and describe each by its patch, with mean 0 and norm 1.

    The distance d of two such patches and their normalised cross-correlation c satisfy d^2 = 2 - 2 c.
    """
    found = cv2.goodFeaturesToTrack(
        image,
        HARRIS_FEATURES,
        HARRIS_QUALITY,
        HARRIS_SPACING_PX,
        mask=usable.astype(np.uint8),
        blockSize=HARRIS_BLOCK_PX,
        useHarrisDetector=True,
        k=HARRIS_K,
    )
    if found is None:
        return FeatureSet(np.zeros((0, 2)), np.zeros((0, PATCH_PX**2), np.float32))
    window = (SUBPIXEL_WINDOW_PX, SUBPIXEL_WINDOW_PX)
    pixels = cv2.cornerSubPix(image, found, window, (-1, -1), SUBPIXEL_STOP).reshape(-1, 2).astype(float)
    half = PATCH_PX // 2
    rows, columns = np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)
    inside = (rows >= half) & (rows < image.shape[0] - half) & (columns >= half) & (columns < image.shape[1] - half)
    rows, columns = rows[inside], columns[inside]
    offsets = np.arange(-half, half + 1)
    patches = image[rows[:, None, None] + offsets[:, None], columns[:, None, None] + offsets].astype(np.float32)
    flat = patches.reshape(len(rows), PATCH_PX**2)
    flat = flat - flat.mean(axis=1, keepdims=True)
    norm = np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), FLAT_GREY)
    return FeatureSet(pixels[inside], (flat / norm).astype(np.float32))


def match_pair(panoramas: Panoramas, detect: Detector, *, along_column: bool) -> Array:
    """Return the views (N, 3) = (column, row in lower, row in upper) of the features matched in a pair.

    A match needs two features each of which is the other one's nearest. along_column: only features of the same
    column and with a positive disparity are compared, as SAD does. Else all are compared with Lowe's ratio test, and
    the matches that contradict the epipolar geometry are removed afterwards.
    """
    lower = detect(panoramas.lower.panorama, panoramas.visible)
    upper = detect(panoramas.upper.panorama, np.ones_like(panoramas.visible))
    distance = descriptor_distance(lower, upper)
    possible = _epipolar(lower.pixels, upper.pixels)
    if along_column:
        a, b = mutual_matches(np.where(possible, distance, np.inf), ratio=1.0)
    else:
        a, b = mutual_matches(distance)
    kept = possible[a, b]
    a, b = a[kept], b[kept]
    return np.column_stack([lower.pixels[a], upper.pixels[b, 1]])


def descriptor_distance(a: FeatureSet, b: FeatureSet) -> NDArray[np.float32]:
    """Return the Euclidean distances (N, M) between the descriptors of two sets."""
    squared = (
        (a.descriptors**2).sum(axis=1)[:, None] + (b.descriptors**2).sum(axis=1) - 2 * a.descriptors @ b.descriptors.T
    )
    return np.asarray(np.sqrt(np.maximum(squared, 0)), np.float32)


def _epipolar(lower: Array, upper: Array) -> Flags:
    """Return which pixels (N, 2) and (M, 2) may show the same point: same column, upper row below the lower one."""
    same_column = np.abs(lower[:, None, 0] - upper[None, :, 0]) <= COLUMN_PX
    return np.asarray(same_column & (upper[None, :, 1] - lower[:, None, 1] > MIN_DISPARITY_PX))


def mutual_matches(distance: NDArray[np.float32], ratio: float = RATIO) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices (K,) and (K,) of matches by distances (N, M): mutually nearest, and passing the ratio test.

    ratio 1: without the ratio test.
    """
    if min(distance.shape) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(distance))
    best = distance[rows, nearest]
    others = distance.copy()
    others[rows, nearest] = np.inf
    mutual = distance.argmin(axis=0)[nearest] == rows
    kept = np.isfinite(best) & mutual & (best <= ratio * others.min(axis=1))
    return np.flatnonzero(kept), nearest[kept]
