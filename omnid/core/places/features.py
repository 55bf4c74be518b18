"""Features of a place: corners of known depth, described by SIFT (Lowe 2004) at one metric size, upright.

A robot that drives stays upright, and the depth of a corner tells the size at which it is seen: so neither orientation
nor scale has to be searched for, which is most of the cost of SIFT.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.place_map import PlaceFeatures

FEATURES: Final = 200  # kept of a frame
CORNERS: Final = 450  # detected, as the depth of some is not known
PATCH_BASELINES: Final = 0.5  # diameter of a feature, in baselines of the rig: disparity times this is its size in px
SIZES_PX: Final = (4.0, 40.0)  # smallest and largest diameter
SIFT_SIGMA_PX, SIFT_LAYERS = 1.6, 3  # of OpenCV's SIFT: blur of the first image, and images in an octave
LARGEST_OCTAVE: Final = 4
SCALE: Final = 512.0  # of the square roots of a descriptor's shares, so that they fill a byte


def describe(frame: StereoFrame) -> PlaceFeatures:
    """Return the features of a frame, at most FEATURES, evenly spread.

    Descriptors are the square roots of SIFT's shares (RootSIFT: Arandjelovic and Zisserman 2012), in bytes.
    """
    pixels = corners(frame.lower, frame.usable, CORNERS)
    disparity = nearby_disparity(frame.disparity, pixels)
    located = np.flatnonzero(np.isfinite(disparity))[:FEATURES]
    pixels, disparity = pixels[located], disparity[located]
    if not len(pixels):
        return PlaceFeatures(np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.float32))
    sizes_px = np.clip(PATCH_BASELINES * disparity, *SIZES_PX)
    keypoints = [_keypoint(*row) for row in np.column_stack([pixels, sizes_px]).tolist()]
    image = np.ascontiguousarray(frame.lower.panorama)
    # SIFT keeps the order and the number of keypoints that are given to it.
    _, found = cv2.SIFT.create().compute(image, keypoints)
    shares = found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6)
    descriptors = np.clip(np.rint(SCALE * np.sqrt(shares)), 0, 255).astype(np.uint8)
    views = np.column_stack([pixels, pixels[:, 1] + disparity]).astype(np.float32)
    return PlaceFeatures(descriptors, views)


def _keypoint(column: float, row: float, size_px: float) -> cv2.KeyPoint:
    """Return an upright keypoint, with the octave and the layer of SIFT's pyramid in which it is described."""
    octaves = np.log2(max(size_px / 2, SIFT_SIGMA_PX) / SIFT_SIGMA_PX)
    octave = min(int(octaves), LARGEST_OCTAVE)
    layer = min(SIFT_LAYERS, max(1, round(SIFT_LAYERS * (octaves - octave))))
    return cv2.KeyPoint(column, row, size_px, 0.0, 1.0, octave | layer << 8)

