"""Descriptors of corners: histograms of gradients like SIFT's (Lowe 2004), upright, of a size that is given.

OpenCV's SIFT blurs the whole image 6 times for each octave, which is most of its cost. Here patches of 16x16 samples
are cut from a pyramid of halved images, and all of them are handled at once.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.tracking import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

SAMPLES: Final = 16  # along a side of a patch
CELLS, BINS = 4, 8  # cells along a side of a patch, and directions of the gradient in each cell
LEVELS: Final = 4  # of the pyramid
WINDOW: Final = 0.5  # standard deviation of the weights of a patch, as a share of its side
LARGEST: Final = 0.2  # of a histogram's entries in one of length 1 (Lowe 2004)
SCALE: Final = 512.0  # of the square roots of a descriptor's shares, so that they fill a byte
LEAST_LENGTH: Final = 1e-3  # grey levels: of a patch without contrast


def describe_patches(panorama: PaddedPanorama, pixels: Array, sides_px: Array) -> NDArray[np.uint8]:
    """Return descriptors (N, 128) of square patches at pixels (N, 2) with sides (N,) [px].

    They are the square roots of the histograms' shares (RootSIFT: Arandjelovic and Zisserman 2012), in bytes.
    """
    patches = _patches(panorama, pixels, sides_px)
    across = patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]
    down = patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]
    length = np.sqrt(across * across + down * down).reshape(-1)
    direction = (np.arctan2(down, across).reshape(-1) * np.float32(BINS / (2 * math.pi))) % BINS
    low = direction.astype(np.intp)
    share = direction - low
    # A gradient counts in the two directions beside its own.
    of_bins = np.zeros((len(length), BINS), np.float32)
    rows = np.arange(len(length))
    of_bins[rows, low % BINS] = length * (1 - share)
    of_bins[rows, (low + 1) % BINS] += length * share
    histograms = _cell_weights() @ of_bins.reshape(len(pixels), SAMPLES**2, BINS)
    found = histograms.reshape(len(pixels), CELLS**2 * BINS)
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), LEAST_LENGTH)
    found = np.minimum(found, LARGEST)
    found /= np.maximum(found.sum(axis=1, keepdims=True), LEAST_LENGTH)
    return np.asarray(np.clip(np.rint(SCALE * np.sqrt(found)), 0, 255), np.uint8)


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
    """Return the weights (CELLS^2, SAMPLES^2) of samples in cells: linear between their middles, Gaussian in all."""
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    middles = (np.arange(CELLS) + 0.5) / CELLS
    linear = np.maximum(0.0, 1 - CELLS * np.abs(at[None] - middles[:, None]))
    along = linear * np.exp(-0.5 * ((at - 0.5) / WINDOW) ** 2)[None]
    return np.asarray(np.einsum("ay,bx->abyx", along, along).reshape(CELLS**2, SAMPLES**2), np.float32)
