"""What a frame shows of its place: corners of known depth, described upright and at one metric size, and a thumbnail.

A robot that drives stays upright, and the depth of a corner gives the size at which it is seen: so neither orientation
nor scale has to be searched for. Descriptors are histograms of gradients like SIFT's (Lowe 2004). OpenCV's SIFT blurs
the whole image 6 times for each octave, which is most of its cost. Here patches of 16x16 samples are cut from a pyramid
of halved images, and all of them are handled at once.

Thumbnails are compared by their spectra, at all headings at once, in a fraction of a millisecond.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.place_map import PlaceFeatures
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Signature = NDArray[np.complex64]
Thumbnail = NDArray[np.int8]

FEATURES: Final = 200  # kept of a frame; so that 1,000 keyframes have 34 MB; by trial on development seeds
# Samples along a side of a patch, cells along a side, directions of the gradient in each cell; as in SIFT (Lowe 2004).
SAMPLES, CELLS, BINS = 16, 4, 8
DESCRIPTOR: Final = CELLS * CELLS * BINS  # bytes
LARGEST: Final = 0.2  # Limit of a histogram's entries, of one of length 1 (Lowe 2004).
SCALE: Final = 512.0  # Factor on the square roots of a descriptor's shares, so that they fill a byte.

ROWS, COLUMNS = 16, 128  # of a thumbnail: 2 kB a keyframe, 2.8 degrees a column; by trial on development seeds


def describe(frame: StereoFrame) -> PlaceFeatures:
    """Return the features of a frame, at most FEATURES, evenly spread, with views in columns of the full turn."""
    pixels = corners(frame.lower, frame.usable, 2 * FEATURES)  # as the depth of some is not known
    disparity = nearby_disparity(frame.disparity, pixels)
    located = np.flatnonzero(np.isfinite(disparity))[:FEATURES]
    pixels, disparity = pixels[located], disparity[located]
    sides = np.maximum(2 * disparity, SAMPLES)  # two baselines of the rig
    views = np.column_stack([frame.lower.in_turn(pixels[:, 0]), pixels[:, 1], pixels[:, 1] + disparity])
    return PlaceFeatures(describe_patches(frame.lower, pixels, sides), views.astype(np.float32))


def describe_patches(panorama: PaddedPanorama, pixels: Array, sides_px: Array) -> NDArray[np.uint8]:
    """Return descriptors (N, 128) of square patches at pixels (N, 2) with sides (N,) [px] of at least SAMPLES.

    They are the square roots of the histograms' shares (RootSIFT: Arandjelovic and Zisserman 2012), in bytes.
    """
    if not len(pixels):
        return np.zeros((0, DESCRIPTOR), np.uint8)
    # 1. Lengths and directions (0 to BINS) of the gradients of the samples (N, SAMPLES, SAMPLES).
    patches = _patches(panorama, pixels, sides_px)
    dx = patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]
    dy = patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]
    length, angle = (np.asarray(of, np.float32).ravel() for of in cv2.cartToPolar(dx.ravel(), dy.ravel()))
    direction = angle * np.float32(BINS / math.tau)
    low = direction.astype(np.intp)
    share = direction - low
    # 2. Histograms (N, CELLS, CELLS, BINS): a gradient counts in the two directions next to its own, and in the cells
    #    around it.
    by_direction = np.zeros((len(length), BINS), np.float32)
    each = np.arange(len(length)) * BINS
    by_direction.ravel()[each + low % BINS] = length * (1 - share)
    by_direction.ravel()[each + (low + 1) % BINS] = length * share
    weights = _cell_weights()
    by_rows = weights @ by_direction.reshape(len(patches), SAMPLES, SAMPLES * BINS)
    cells = by_rows.reshape(len(patches), CELLS, SAMPLES, BINS)
    histograms = (weights @ cells).reshape(len(patches), CELLS**2 * BINS)
    # 3. Square roots of the shares; a patch without contrast has none.
    tiny = np.finfo(np.float32).tiny
    histograms /= np.maximum(np.linalg.norm(histograms, axis=1, keepdims=True), tiny)
    histograms = np.minimum(histograms, np.float32(LARGEST))
    histograms /= np.maximum(histograms.sum(axis=1, keepdims=True), tiny)
    return np.minimum(np.rint(SCALE * np.sqrt(histograms)), np.iinfo(np.uint8).max).astype(np.uint8)


def _patches(panorama: PaddedPanorama, pixels: Array, sides_px: Array) -> Floats:
    """Return patches (N, SAMPLES + 2, SAMPLES + 2), with one sample more on each side for the gradients.

    Each is cut from the coarsest image of the pyramid in which it has a sample a pixel.
    """
    steps = sides_px / SAMPLES
    levels = np.floor(np.log2(steps)).astype(int)
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
    """Return the weights (CELLS, SAMPLES) of the samples of a row in each cell: linear between middles, Gaussian.

    The standard deviation of the Gaussian is half a side, as in SIFT (Lowe 2004).
    """
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    middles = (np.arange(CELLS) + 0.5) / CELLS
    linear = np.maximum(0.0, 1 - CELLS * np.abs(at[None] - middles[:, None]))
    return np.asarray(linear * np.exp(-0.5 * ((at - 0.5) / 0.5) ** 2)[None], np.float32)


def thumbnail(panorama: PaddedPanorama) -> Thumbnail:
    """Return the panorama (H, W) at (ROWS, COLUMNS) of a full turn without its slow changes of brightness.

    The root mean square is a quarter of the largest byte, so that hardly any is more; zeros outside of a sector.
    """
    # 1. The difference to the mean in a window, because brightness changes with the light.
    smooth, largest = (COLUMNS // 4 - 1, ROWS // 3), np.iinfo(np.int8).max
    columns = max(1, round(COLUMNS * panorama.width / panorama.period_px))
    small = cv2.resize(panorama.panorama, (columns, ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    pad = smooth[0] // 2
    border = cv2.BORDER_WRAP if columns == COLUMNS else cv2.BORDER_REPLICATE
    contrast = small - cv2.blur(cv2.copyMakeBorder(small, 0, 0, pad, pad, border), smooth)[:, pad:-pad]
    # 2. Its place in a full turn.
    whole, first = np.zeros((ROWS, COLUMNS), np.float32), round(COLUMNS * panorama.first / panorama.period_px)
    whole[:, (first + np.arange(columns)) % COLUMNS] = contrast / max(float(np.linalg.norm(contrast)), 1.0)
    return np.asarray(np.clip(np.rint(largest / 4 * math.sqrt(whole.size) * whole), -largest, largest), np.int8)


def signature_of(small: Thumbnail) -> Signature:
    """Return the signature of the panorama that has a thumbnail: its spectrum, row by row, of length 1."""
    size = float(np.linalg.norm(small.astype(np.float32)))
    return np.fft.rfft(small / max(size, 1.0), axis=1).astype(np.complex64)


def similarities(a: Signature, others: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the largest circular correlations (N,) over all headings with others (N, ROWS, COLUMNS / 2 + 1)."""
    correlation = np.fft.irfft(np.einsum("rk,nrk->nk", a, others.conj()), COLUMNS, axis=1)
    return np.asarray(correlation.max(axis=1), np.float32)
