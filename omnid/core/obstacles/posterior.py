"""Posterior of the first obstacle on each ray, from one pair.

In each direction of the panoramas the world is floor up to some bin, then the first obstacle: upright, a step up or
down, a low one over whose top the floor behind is seen, one that hangs over floor in view, or none up to the last
bin. Bins are half a disparity wide.

    log p(k, c | z) = sum_{j<k} l_j(floor) + l_k(c) + sum_{j>k} l_j(behind) + log prior(k, c)

1. Steps of grey e across the bins of the floor, and its greys. Floor: (1 - m) N(e; s_r) + m Laplace(e; b g),
   with its sigma s_r at that range and its rate of marks m; what is behind an obstacle: the same with a rate m_h, with
   texture or without; where an obstacle begins: Laplace(e; b g). So a plain bin speaks against a beginning.
2. Ratios of floor, surfaces and planes beside the floor, from stereo (plane_view.py).
3. Look of the floor: contrast, grey and outline of a bin, by those of floor that is known. Beyond the
   border of a patch of sun, or of another covering, it may look otherwise.
4. The posterior (ray_kernels.posterior): sums along the ray. The end of the floor beyond the last bin shows a foot,
   too; and an obstacle may begin nearer than the view: then it hides all, shows no foot, and may show its surface.

All are log-likelihood ratios to "hidden behind an obstacle".
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import ray_kernels as kernels
from omnid.core.obstacles.plane_view import AZIMUTHS, DIRECTIONS, Bins, ShownBins, pooled, turned
from omnid.core.obstacles.ray_kernels import PARAMETERS as P
from omnid.core.stereo.tiles import SATURATED_GREY

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

RISK: Final = 0.1  # probability of an obstacle on a way that is free
MAD: Final = 1.48  # sigma of a normal distribution by the median of its magnitudes
LEAST_STEP: Final = 0.35  # sigma of a step by the rounding of greys
TYPICAL_M: Final = 1.3  # range at which the near floor is seen
SIDE: Final = 3  # directions on either side with which a bin is compared
LEAST_OTHERS: Final = 0.1  # least share of the floor that looks otherwise in one feature
LEAST: Final = 1e-30  # density, so that logarithms are finite
ALONG_RAD: Final = math.radians(35.0)  # about ahead and behind: floor there is assumed before any is known


class RayBelief(NamedTuple):
    """What one pair says of each direction of the rectified frame, about the viewpoint."""

    first: Floats  # (DIRECTIONS, N + 1) probability that the first obstacle begins in a bin; last: nowhere
    ratios: Floats  # (DIRECTIONS, N) log-ratio of an obstacle in the bin to its prior, weighted by the view of it
    view: Floats  # (DIRECTIONS, N) probability that the bin's floor is in view, 0 where it is out of sight
    surface: Floats  # (DIRECTIONS, N) log-likelihood ratio of surfaces
    ends_m: Array  # (N + 1,) range at which the bins begin, from near to far, and the end of the last


def ray_belief(shown: ShownBins, bins: Bins, sensor_grey: float, known: Flags) -> RayBelief:
    """Return the belief by what a pair shows of the bins; sensor_grey: noise of the difference of two pixels.

    known (N, DIRECTIONS): bins that are known to be floor.
    """
    ranges_m = bins.ranges_m[:, None]
    # 1. The floor by which its look is learned: of the cells that are known, or the nearest ahead and behind where
    #    these are few.
    known = known & shown.seen
    near = known & (ranges_m < P.look_m)
    if near.sum() < P.look_bins:
        known = near = shown.seen & (ranges_m < P.look_m) & (np.abs(np.sin(AZIMUTHS)) < math.sin(ALONG_RAD))
    first = np.zeros((DIRECTIONS, len(ranges_m) + 1), np.float32)
    ratios, view = np.zeros((2, DIRECTIONS, len(ranges_m)), np.float32)
    if near.sum() < P.look_bins:  # The pair shows no floor.
        first[:, -1] = 1.0
        return RayBelief(first, ratios, view, view, bins.ends_m)
    # 2. Stereo, by bins. Noise without texture fits other disparities a little better: the ratio of known floor says by
    #    how much.
    floor = shown.floor - np.float32(min(max(float(np.median(shown.floor[near])), -1.0), 0.0))
    floor = P.w_floor * np.clip(floor, -P.floor_most, P.floor_most)
    # A bin without texture fits a plane beside the floor by noise, of which known floor says how much: a ratio L for
    # such a plane counts by the odds that it is more than that.
    levels = np.stack([shown.levels[0], _along_edges(shown.levels[1], ranges_m)])
    beside = np.minimum(levels, 0)
    noise2 = np.square(beside[:, near]).mean(axis=1, keepdims=True)[..., None] + np.float32(LEAST)
    levels = levels - beside * np.exp(-np.square(beside) / (2 * noise2))
    levels = floor - P.w_level * np.clip(levels, -P.level_most, P.level_most)
    fits = np.minimum(shown.fits, P.surface_most) - P.surface_noise
    # 3. Edges and look, by those of the floor.
    steps, greys = pooled(shown.steps), shown.greys
    sigmas = _step_sigmas(steps, near, known)
    marks = float((np.abs(steps) > 5 * sigmas)[near].mean())
    plain = max(P.noise_share * sensor_grey, LEAST_STEP)
    edges = _edges(np.abs(steps), greys, sigmas, min((P.marks + 2 * marks) / 3, 0.5), plain)
    look = _look(shown.steps, greys, near, np.maximum(ranges_m / TYPICAL_M, 1.0).astype(np.float32))
    far = (shown.far / max(float(sigmas[-1, 0]), float(sigmas.min()))).astype(np.float32)
    # 4. The posterior.
    seen = shown.seen & (greys < SATURATED_GREY)
    terms = np.where(seen, np.stack([floor, *levels, look, *edges, fits]).astype(np.float32), 0)
    terms[kernels.FITS] = fits
    lengths_m = np.diff(bins.ends_m).astype(np.float32)
    kernels.posterior(terms, lengths_m, far, shown.near, float(bins.ends_m[0]), first, ratios, view)
    surfaces = np.ascontiguousarray(shown.surface.T)
    return RayBelief(first, ratios, np.where(seen.T, view, np.float32(0)), surfaces, bins.ends_m)


def _along_edges(ratios: Floats, ranges_m: Array) -> Floats:
    """Return the means of ratios (N, D) over the directions in which an edge lies at ranges (N, 1)."""
    half = np.rint(0.5 * P.edge_m / ranges_m * (DIRECTIONS / math.tau)).astype(int)
    beside = int(half.max(initial=0)) + 1
    sums = np.cumsum(turned(ratios, beside), axis=1, dtype=float)
    at = np.arange(DIRECTIONS) + beside
    ends = (np.take_along_axis(sums, at + shift, axis=1) for shift in (half, -half - 1))
    return np.asarray(np.subtract(*ends) / (2 * half + 1), np.float32)


def _step_sigmas(steps: Floats, near: Flags, known: Flags) -> Floats:
    """Return the sigmas (N, 1) of steps (N, D) of the floor at each range, within twice that of near ones."""
    last = least = max(_sigma_of(steps[near]), LEAST_STEP)
    followed = np.full((len(steps), 1), least, np.float32)
    for n, (sigma, count) in enumerate(zip(MAD * _row_medians(np.abs(steps), known), known.sum(axis=1), strict=True)):
        if count >= P.look_bins:
            last = (last + sigma) / 2
        followed[n] = last
    return np.clip(followed, np.float32(max(least / 2, LEAST_STEP)), np.float32(2 * least))


def _edges(steps: Floats, greys: Floats, sigmas: Floats, marks: float, plain: float) -> tuple[Floats, ...]:
    """Return log-ratios (N, D) to a hidden bin, by steps: of floor, of a plain obstacle, and of its beginning.

    sigmas (N, 1) of steps of the floor; marks: its rate of edges; plain: sigma of steps without any texture.
    """
    scale = np.asarray(P.contrast * np.maximum(greys, 20.0), np.float32)

    def behind(step: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the densities of steps of texture, of texture or none, of what is hidden, and of edges."""
        textured, other = _noise(step, sigmas, P.tail), _laplace(step, scale)
        even = (1 - P.plain_behind) * textured + P.plain_behind * _noise(step, np.float32(plain), P.tail)
        return textured, even, (1 - P.marks_behind) * even + P.marks_behind * other, other

    *_, hidden, begins = behind(steps)
    # Windows of neighbouring bins overlap: an edge is one event, where it is largest.
    largest = cv2.dilate(steps, np.ones((5, 1), np.uint8), borderType=cv2.BORDER_REPLICATE)
    once = np.asarray(np.where((steps < largest) & (steps > 2 * sigmas), 2 * sigmas, steps), np.float32)
    textured, even, other_hidden, other = behind(once)
    floor = P.w_edge * np.log(((1 - marks) * textured + marks * other) / other_hidden)
    bare = P.w_edge * np.log(((1 - P.marks_plain) * even + P.marks_plain * other) / other_hidden)
    return np.asarray(floor, np.float32), np.asarray(bare, np.float32), np.log(begins / hidden)


def _look(steps: Floats, greys: Floats, near: Flags, far: Floats) -> Floats:
    """Return the log-ratios (N, D) that a bin looks like known floor near to the base, to anything: by contrast, by the
    difference of its grey to both sides, and by its grey.

    near (N, D): bins that are known to be floor. far (N, 1): by so much farther the same floor shows less contrast, in
    other light.
    """
    grey = float(np.median(greys[near]))
    scale = np.float32(P.contrast * max(grey, 20.0))
    # 1. The size of steps around.
    size2 = np.asarray(cv2.blur(turned(steps * steps, 1), (3, 5))[:, 1:-1], np.float32)
    contrast = np.asarray(np.log(np.sqrt(size2) + np.float32(0.3)), np.float32)
    z = np.asarray(contrast - np.median(contrast[near]), np.float32)
    sigma = np.float32(max(_sigma_of(z[near]), 0.25))
    anything = _noise(contrast - 1, np.float32(1.3), 0.0)
    by_contrast = _ratio_of_look(_noise(z, np.where(z < 0, sigma + np.log(far), sigma), 0.0) / anything, near)
    # 2. The difference to both sides, of a bin or of five, whichever is less. An obstacle shows an outline in half of
    #    its directions.
    side = turned(greys, SIDE)
    one = greys - (side[:, : -2 * SIDE] + side[:, 2 * SIDE :]) / 2
    five = cv2.blur(one, (1, 5))
    outline = np.asarray(np.where(np.abs(one) < np.abs(five), one, five), np.float32)
    core = _noise(outline, np.float32(max(_sigma_of(outline[near]), 0.8)) * np.sqrt(far), P.tail)
    by_outline = _ratio_of_look(2 * core / (core + _laplace(np.abs(outline), scale)), near)
    # 3. The grey, by that of the floor at the same range where it is known.
    middles = np.full((len(greys), 1), grey, np.float32)
    sigmas = np.full_like(middles, max(_sigma_of(greys[near] - grey), P.grey_share * grey))
    known = near.sum(axis=1) > P.look_bins
    middles[known, 0] = _row_medians(greys[known], near[known])
    of_rows = MAD * _row_medians(np.abs(greys[known] - middles[known]), near[known])
    sigmas[known, 0] = np.clip(of_rows, P.near_grey_share * grey, sigmas[known, 0])
    z = greys - middles
    by_grey = _ratio_of_look(_noise(z, sigmas, 0.0) / _laplace(np.abs(z), 1.5 * scale), near)
    # Far away the light of the near floor is all that is known.
    lowest = P.look_low * (1 + known[:, None])
    total = np.clip(by_contrast, P.look_low, P.look_high) + np.clip(by_outline, P.look_low, P.look_high)
    return np.asarray(P.w_look * (total + np.clip(by_grey, lowest, P.look_high)), np.float32)


def _noise(values: Floats, sigma: Floats | np.float32, tail: float) -> Floats:
    """Return the density of values within one material: normal, a share `tail` of them with 2.5 times the sigma."""
    z2 = np.square(values / sigma)
    density = np.exp(-0.5 * z2)
    if tail:
        density = (1 - tail) * density + 0.4 * tail * np.exp(-0.08 * z2)
    return np.asarray(density / (math.sqrt(math.tau) * sigma), np.float32)


def _laplace(magnitudes: Floats, scale: Floats | np.float32) -> Floats:
    """Return the density of differences between two materials."""
    return np.asarray(np.exp(-magnitudes / scale) / (2 * scale) + LEAST, np.float32)


def _ratio_of_look(ratios: Floats, near: Flags) -> Floats:
    """Return the log-ratios (N, D) of a feature of the floor, of which a share shows anything, to that of anything.

    ratios (N, D) of the rest of the floor; near (N, D): bins that are floor, which show that share, such as boards of
    other tones: a tenth at least.
    """
    share = LEAST_OTHERS
    for _ in range(3):  # expectation and maximisation
        share = max(float((share / (share + (1 - share) * ratios[near])).mean()), LEAST_OTHERS)
    return np.asarray(np.log((1 - share) * ratios + share), np.float32)


def _sigma_of(values: Floats) -> float:
    """Return the robust standard deviation of differences that are 0 in the mean."""
    return MAD * float(np.median(np.abs(values)))


def _row_medians(values: Floats, chosen: Flags) -> Floats:
    """Return the medians (N,) of the chosen values of each row of (N, D), inf where none is chosen."""
    ordered = np.sort(np.where(chosen, values, np.float32(np.inf)), axis=1)
    counts = chosen.sum(axis=1)
    return np.asarray(ordered[np.arange(len(values)), counts // 2 - (counts == values.shape[1])])
