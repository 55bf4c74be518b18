"""Features of a place: corners of known depth, described upright and at one metric size.

A robot that drives stays upright, and the depth of a corner gives the size at which it is seen: so neither orientation
nor scale has to be searched for.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.descriptors import describe_patches
from omnid.core.places.place_map import PlaceFeatures

FEATURES: Final = 200  # kept of a frame; so that 1,000 keyframes have 34 MB; by trial on development seeds
CORNERS: Final = 450  # detected, as the depth of some is not known; by trial on development seeds
# Side of a feature, in baselines of the rig: disparity times this is its side in px.
PATCH_BASELINES: Final = 2.0
LEAST_SIDE_PX: Final = 16.0  # at all scales, because it has one sample a pixel
LARGEST_SIDE_PX: Final = 240.0  # at scale 1; by trial on development seeds


def describe(frame: StereoFrame) -> PlaceFeatures:
    """Return the features of a frame, at most FEATURES, evenly spread, with views in columns of the full turn."""
    pixels = corners(frame.lower, frame.usable, CORNERS)
    disparity = nearby_disparity(frame.disparity, pixels)
    located = np.flatnonzero(np.isfinite(disparity))[:FEATURES]
    pixels, disparity = pixels[located], disparity[located]
    sides = np.minimum(PATCH_BASELINES * disparity, frame.lower.scale * LARGEST_SIDE_PX)
    descriptors = describe_patches(frame.lower, pixels, np.maximum(sides, LEAST_SIDE_PX))
    views = np.column_stack([frame.lower.in_turn(pixels[:, 0]), pixels[:, 1], pixels[:, 1] + disparity])
    return PlaceFeatures(descriptors, views.astype(np.float32))
