"""Posterior of the first thing on each ray, from one pair.

Along a direction of the panoramas the world is floor up to some bin, then the first thing: upright, a step up, a step
down, something that hangs over floor in view, or nothing up to the last bin. Bins are half a disparity wide.

    log p(k, c | z) = sum_{j<k} l_j(floor) + l_k(c) + sum_{j>k} l_j(behind) + log prior(k, c)

1. Steps of grey e across the bins of the floor, and its greys. Floor: (1 - m) N(e; s_r) + m Laplace(e; b g),
   with its sigma s_r at that range and its rate of marks m; what is behind something: the same with a rate m_h, with
   texture or without; where something begins: Laplace(e; b g). So a plain bin speaks against a beginning.
2. Ratios of floor, surfaces and planes beside the floor, from stereo (column.py).
3. Look of the floor: contrast, grey and outline of a bin, by those of floor that is known (floor_look.py). Beyond the
   border of a patch of sun, or of another covering, it may look otherwise.
4. The posterior (ray_kernels.posterior): sums along the ray. The end of the floor beyond the last bin shows a foot,
   too; and something may begin nearer than the view: then it hides all, and shows no foot.

All are log-likelihood ratios to "hidden behind something".
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.obstacles import ray_kernels as kernels
from omnid.core.obstacles.column import ColumnEvidence, Columns
from omnid.core.obstacles.floor_look import LEAST_STEP, floor_look, floor_steps
from omnid.core.obstacles.pair_views import DIRECTIONS, WorkingPair
from omnid.core.obstacles.ray_kernels import RayParameters

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

BINS_PER_PX: Final = 2
STEP_ROWS: Final = 4.0  # of a step below its bin, which must be in view
ROOT: Final = math.sqrt(math.tau)
LEAST: Final = 1e-30  # density, so that logarithms are finite
SATURATED: Final = 250.0  # grey from which a pixel shows nothing
ALONG_RAD: Final = math.radians(35.0)  # about ahead and behind: floor there is assumed before any is known


class RayBelief(NamedTuple):
    """What one pair says of each direction of the rectified frame, about the viewpoint."""

    first: Floats  # (DIRECTIONS, N + 1) probability that the first thing begins in a bin; last: nowhere
    ratios: Floats  # (DIRECTIONS, N) log-ratio of a thing in the bin to its prior, weighted by the view of it
    view: Floats  # (DIRECTIONS, N) probability that the bin's floor is in view, 0 where it is out of sight
    surface: Floats  # (DIRECTIONS, N) log-likelihood ratio of surfaces
    ends_m: Array  # (N + 1,) range at which the bins begin, from near to far, and the end of the last


class RayPosterior:
    """Posterior of pairs over one plane of the floor."""

    def __init__(self, columns: Columns, height_m: float, baseline_m: float, parameters: RayParameters) -> None:
        """height_m: of the viewpoint over the floor."""
        self._columns, self._p = columns, parameters
        # Bins from near to far: the nearest whose step is in view, to the last that stereo compares.
        numbers = np.arange(BINS_PER_PX * columns.bins)
        middle = (numbers + 0.5) / BINS_PER_PX
        rows = columns.panoramas.row0 + 0.5 + middle * height_m / baseline_m
        in_view = (rows + middle + STEP_ROWS < columns.last_row) & (numbers >= BINS_PER_PX * columns.first_bin)
        self._bins = np.flatnonzero(in_view)[::-1]
        # What lies beyond them shows the foot of what ends the floor.
        every = np.concatenate([self._bins, np.arange(1, BINS_PER_PX * columns.first_bin)[::-1]])
        self._rows = np.stack([rows[every], rows[every] + middle[every]])  # (2, N + far ones) in both views
        self._step_weights, self._grey_weights = _step_weights(self._rows, columns.panoramas.height)
        self.ranges_m = columns.at_1m / middle[self._bins]  # (N,) of the bins
        begins = (self._bins + 1) / BINS_PER_PX
        self.ends_m = columns.at_1m / np.append(begins, begins[-1:] - 1 / BINS_PER_PX)
        self._lengths_m = np.diff(self.ends_m).astype(np.float32)
        azimuth = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)
        along = np.abs(np.sin(azimuth)) < math.sin(ALONG_RAD)
        self._assumed = (self.ranges_m < parameters.look_m)[:, None] & along
        self.shows_floor = bool(self._of_bins(columns.visible).any())  # whether any floor is in view

    def belief(self, pair: WorkingPair, evidence: ColumnEvidence, known: Flags | None = None) -> RayBelief:
        """Return the belief by a pair and its stereo evidence.

        known (N, DIRECTIONS): bins that are known to be floor, None: the nearest ahead and behind are taken for it.
        """
        p, count, seen = self._p, len(self._bins), self._of_bins(pair.seen)
        known, near = self._known(known, seen)
        if near.sum() < p.look_bins:
            return self._nothing()
        # 1. Steps of grey, pooled over three directions.
        steps, greys = np.zeros((2, self._rows.shape[1], DIRECTIONS), np.float32)
        for weights, into in ((self._step_weights, steps), (self._grey_weights, greys)):
            for of_view, image in zip(weights, (pair.lower, pair.upper), strict=True):
                kernels.add_weighted_rows(of_view, image, into)
        pooled = np.asarray((np.roll(steps, 1, axis=1) + 2 * steps + np.roll(steps, -1, axis=1)) / 4, np.float32)
        sigmas, marks = floor_steps(pooled[:count], near, known, p)
        plain = max(p.noise_share * pair.sensor_grey, LEAST_STEP)
        far = np.abs(pooled[count:]).max(axis=0, initial=0.0) / max(float(sigmas[-1]), float(sigmas.min()))
        # 2. Stereo, by bins. Noise without texture fits other disparities a little better: the ratio of known floor
        #    says by how much.
        of_bin = self._bins // BINS_PER_PX
        floor = evidence.floor[of_bin]
        bias = float(np.median(np.nan_to_num(floor[near])))
        floor = p.w_floor * np.clip(
            np.nan_to_num(floor - np.float32(min(max(bias, -1.0), 0.0))), p.floor_low, p.floor_high
        )
        levels = floor - p.w_level * np.clip(evidence.level[:, of_bin], -p.level_most, p.level_most)
        fits = np.minimum(self._surfaces(evidence.surface)[of_bin], p.surface_most) - p.surface_noise
        # 3. The look of floor, and the edges.
        look = floor_look(steps[:count], greys[:count], self.ranges_m, near & (self.ranges_m < 1.6)[:, None], p)
        edges = self._edges(np.abs(pooled[:count]), greys[:count], sigmas[:, None], marks, plain)
        # 4. The posterior.
        seen = seen & (greys[:count].T < SATURATED)
        terms = np.where(seen.T, np.stack([floor, *levels, look, *edges, fits]).astype(np.float32), 0)
        terms[kernels.FITS] = fits
        first = np.empty((DIRECTIONS, count + 1), np.float32)
        ratios = np.empty((DIRECTIONS, count), np.float32)
        view = np.empty((DIRECTIONS, count), np.float32)
        kernels.posterior(terms, self._lengths_m, far.astype(np.float32), float(self.ends_m[0]), p, first, ratios, view)
        surfaces = np.ascontiguousarray(evidence.surface[of_bin].T)
        return RayBelief(first, ratios, np.where(seen, view, np.float32(0)), surfaces, self.ends_m)

    def _edges(self, steps: Floats, greys: Floats, sigmas: Floats, marks: float, plain: float) -> tuple[Floats, ...]:
        """Return log-ratios (N, D) to something hidden, by steps: of floor, of something plain, and of what begins.

        sigmas (N, 1) of steps of the floor; marks: its rate of edges; plain: sigma of steps without any texture.
        """
        p, scale = self._p, np.asarray(self._p.contrast * np.maximum(greys, 20.0), np.float32)

        def noise(step: Floats, sigma: Floats | float) -> Floats:
            """Return the density of steps within one material: normal, a share with 2.5 times the sigma."""
            z2 = np.square(step / sigma)
            density = (1 - p.tail) * np.exp(-0.5 * z2) + 0.4 * p.tail * np.exp(-0.08 * z2)
            return np.asarray(density / (ROOT * sigma), np.float32)

        def laplace(step: Floats) -> Floats:
            """Return the density of steps between two materials."""
            return np.asarray(np.exp(-step / scale) / (2 * scale) + LEAST, np.float32)

        def behind(step: Floats, other: Floats) -> tuple[Floats, Floats, Floats]:
            """Return the densities of steps of the floor, and of what is behind something, by texture and marks."""
            textured = noise(step, sigmas)
            even = (1 - p.plain_behind) * textured + p.plain_behind * noise(step, plain)
            return textured, even, (1 - p.marks_behind) * even + p.marks_behind * other

        begins = laplace(steps)
        hidden = behind(steps, begins)[2]
        # Windows of neighbouring bins overlap: an edge is one event, where it is largest.
        largest = cv2.dilate(steps, np.ones((5, 1), np.uint8), borderType=cv2.BORDER_REPLICATE)
        once = np.asarray(np.where((steps < largest) & (steps > 2 * sigmas), 2 * sigmas, steps), np.float32)
        other = laplace(once)
        textured, even, other_hidden = behind(once, other)
        floor = np.log(((1 - marks) * textured + marks * other) / other_hidden)
        bare = np.log(((1 - p.marks_plain) * even + p.marks_plain * other) / other_hidden)
        ratios = p.w_edge * floor, p.w_edge * bare, np.log(begins / hidden)
        return tuple(np.asarray(ratio, np.float32) for ratio in ratios)

    def _known(self, known: Flags | None, seen: Flags) -> tuple[Flags, Flags]:
        """Return the bins (N, DIRECTIONS) in view that are known to be floor, and those that show its look."""
        if known is not None:
            near = known & seen.T & (self.ranges_m < self._p.look_m)[:, None]
            if near.sum() >= self._p.look_bins:
                return known & seen.T, near
        assumed = self._assumed & seen.T
        return assumed, assumed

    def _nothing(self) -> RayBelief:
        """Return the belief by a pair that shows no floor."""
        count = len(self._bins)
        first, zero = np.zeros((DIRECTIONS, count + 1), np.float32), np.zeros((DIRECTIONS, count), np.float32)
        first[:, -1] = 1.0
        return RayBelief(first, zero, zero, zero, self.ends_m)

    def _of_bins(self, pixels: Flags) -> Flags:
        """Return the bins (DIRECTIONS, N) whose pixels (H, DIRECTIONS) of both views are set."""
        rows = np.clip(np.rint(self._rows[:, : len(self._bins)]).astype(int), 0, len(pixels) - 1)
        return np.ascontiguousarray((pixels[rows[0]] & pixels[rows[1]]).T)

    def _surfaces(self, surface: Floats) -> Floats:
        """Return ratios (K, DIRECTIONS) of surfaces, where one fits best at least the weighted mean of neighbours."""
        p = self._p
        most = np.minimum(surface, p.surface_most)
        three = np.maximum(most, np.maximum(np.roll(most, 1, 0), np.roll(most, -1, 0)))
        half = int(p.wide_columns) // 2
        turned = np.concatenate([three[:, -half:], three, three[:, :half]], axis=1)
        wide = cv2.blur(turned, (2 * half + 1, 1), borderType=cv2.BORDER_REPLICATE)[:, half:-half]
        is_best = wide >= np.maximum(np.roll(wide, 1, 0), np.roll(wide, -1, 0))
        return np.asarray(np.where(is_best, np.maximum(most, p.wide_weight * wide), most))


def _step_weights(rows: Array, height: int) -> tuple[Floats, Floats]:
    """Return the weights (2, N, H) of the rows of both views for steps of grey at rows (2, N), and for greys there.

    A step is the difference of the means of 2.6 rows on either side, less the trend of the rows beyond: a shading is no
    edge.
    """
    edges = np.arange(height)

    def mean(first: float, end: float) -> Array:
        low, high = (np.clip(rows[..., None] + at, 0, height - 1) for at in (first, end))
        part = np.clip(np.minimum(high, edges + 1) - np.maximum(low, edges), 0, None)
        return np.asarray(part / np.maximum(part.sum(axis=-1, keepdims=True), 1e-6))

    above, below, before, beyond = mean(-3.6, -1.0), mean(1.0, 3.6), mean(-8.0, -3.6), mean(3.6, 8.0)
    step = above - below - 0.575 * (before - above + below - beyond)
    return (step / 2).astype(np.float32), (mean(-1.1, 1.1) / 2).astype(np.float32)
