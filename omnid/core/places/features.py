"""Features of a place: corners of known depth, described upright and at one metric size.

A robot that drives stays upright, and the depth of a corner gives the size at which it is seen: so neither orientation
nor scale has to be searched for. Descriptors are histograms of gradients like SIFT's (Lowe 2004). OpenCV's SIFT blurs
the whole image 6 times for each octave, which is most of its cost. Here patches of 16x16 samples are cut from a pyramid
of halved images, and all of them are handled at once.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.descriptor_kernels import BINS, CELLS, SAMPLES
from omnid.core.places.descriptor_kernels import describe as write_histograms
from omnid.core.places.place_map import PlaceFeatures
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

FEATURES: Final = 200  # kept of a frame; so that 1,000 keyframes have 34 MB; by trial on development seeds
CORNERS: Final = 450  # detected, as the depth of some is not known; by trial on development seeds
# Side of a feature, in baselines of the rig: disparity times this is its side in px.
PATCH_BASELINES: Final = 2.0
LEAST_SIDE_PX: Final = 16.0  # at all scales, because it has one sample a pixel
LARGEST_SIDE_PX: Final = 240.0  # at scale 1; by trial on development seeds
LEVELS: Final = 4  # Levels of the pyramid; because sides are 16 to 240 px, log2(240 / 16) = 3.9.
# Standard deviation of the weights of a patch, as a share of its side; half of it, as in SIFT (Lowe 2004).
WINDOW: Final = 0.5


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


def describe_patches(panorama: PaddedPanorama, pixels: Array, sides_px: Array) -> NDArray[np.uint8]:
    """Return descriptors (N, 128) of square patches at pixels (N, 2) with sides (N,) [px].

    They are the square roots of the histograms' shares (RootSIFT: Arandjelovic and Zisserman 2012), in bytes.
    """
    descriptors = np.zeros((len(pixels), CELLS**2 * BINS), np.uint8)
    write_histograms(_patches(panorama, pixels, sides_px), _cell_weights(), descriptors)
    return descriptors


def _patches(panorama: PaddedPanorama, pixels: Array, sides_px: Array) -> Floats:
    """Return patches (N, SAMPLES + 2, SAMPLES + 2), with one sample more on each side for the gradients."""
    steps = sides_px / SAMPLES
    levels = np.clip(np.floor(np.log2(np.maximum(steps, 1.0))), 0, LEVELS - 1).astype(int)
    side = SAMPLES + 2
    offsets = np.arange(side) - (side - 1) / 2
    patches = np.zeros((len(pixels), side, side), np.float32)
    image: cv2.typing.MatLike = panorama.image
    for level in range(int(levels.max(initial=0)) + 1):
        own = np.flatnonzero(levels == level)
        # The pixel x of a level is that at 2^level x of the panorama.
        scale = 0.5**level
        columns = scale * (pixels[own, :1] + panorama.pad_px + steps[own, None] * offsets)
        rows = scale * (pixels[own, 1:] + steps[own, None] * offsets)
        shape = len(own) * side, side
        x = np.broadcast_to(columns[:, None, :], (len(own), side, side)).reshape(shape).astype(np.float32)
        y = np.broadcast_to(rows[:, :, None], (len(own), side, side)).reshape(shape).astype(np.float32)
        if len(own):
            cut = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            patches[own] = cut.reshape(-1, side, side)
        image = cv2.pyrDown(image)
    return patches


@cache
def _cell_weights() -> Floats:
    """Return the weights (CELLS, SAMPLES) of the samples of a row in each cell: linear between middles, Gaussian."""
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    middles = (np.arange(CELLS) + 0.5) / CELLS
    linear = np.maximum(0.0, 1 - CELLS * np.abs(at[None] - middles[:, None]))
    return np.asarray(linear * np.exp(-0.5 * ((at - 0.5) / WINDOW) ** 2)[None], np.float32)
