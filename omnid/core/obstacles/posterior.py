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
from omnid.core.obstacles.pair_views import DIRECTIONS
from omnid.core.obstacles.parameters import RayParameters
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

BINS_PER_PX: Final = 2
STEP_ROWS: Final = 4.0  # of a step below its bin, which must be in view
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
        self._values = np.array([getattr(parameters, name) for name in kernels.PARAMETERS], np.float64)
        # Bins from near to far: the nearest whose step is in view, to the last that stereo compares.
        numbers = np.arange(BINS_PER_PX * columns.bins)
        middle = (numbers + 0.5) / BINS_PER_PX
        rows = columns.panoramas.row0 + 0.5 + middle * height_m / baseline_m
        in_view = (rows + middle + STEP_ROWS < columns.last_row) & (numbers >= BINS_PER_PX * columns.first_bin)
        self._bins = np.flatnonzero(in_view)[::-1]
        # What lies beyond them shows the foot of what ends the floor.
        every = np.concatenate([self._bins, np.arange(1, BINS_PER_PX * columns.first_bin)[::-1]])
        self._rows, self._shifts = rows[every].astype(np.float32), middle[every].astype(np.float32)
        self.ranges_m = columns.at_1m / middle[self._bins]  # (N,) of the bins
        begins = (self._bins + 1) / BINS_PER_PX
        self.ends_m = columns.at_1m / np.append(begins, begins[-1:] - 1 / BINS_PER_PX)
        self._lengths_m = np.diff(self.ends_m).astype(np.float32)
        azimuth = math.pi - (np.arange(DIRECTIONS) + 0.5) * (math.tau / DIRECTIONS)
        along = np.abs(np.sin(azimuth)) < math.sin(ALONG_RAD)
        self._assumed = (self.ranges_m < parameters.look_m)[:, None] & along
        self._seen = self._of_bins(columns.visible, every=True)

    @property
    def shows_floor(self) -> bool:
        """Whether any floor is in view."""
        return bool(self._seen.any())

    def belief(
        self,
        lower: PaddedPanorama,
        upper: PaddedPanorama,
        evidence: ColumnEvidence,
        lost: Flags | None = None,
        known: Flags | None = None,
    ) -> RayBelief:
        """Return the belief by a pair and its stereo evidence.

        lost (H, W): pixels that are no evidence; known (N, DIRECTIONS): bins that are known to be floor, None: the
        nearest ahead and behind are taken for it.
        """
        p, count, panoramas = self._p, len(self._bins), self._columns.panoramas
        seen = self._seen
        if lost is not None:
            seen = seen & ~self._of_bins(panoramas.sized(lost * np.uint8(255)) > 0, every=False)
        known, near = self._known(known, seen)
        if near.sum() < p.look_bins:
            return self._nothing()
        # 1. Steps of grey, pooled over three directions.
        steps, greys = np.empty((2, len(self._rows), DIRECTIONS), np.float32)
        kernels.grey_steps(panoramas.grey(lower), panoramas.grey(upper), self._rows, self._shifts, steps, greys)
        pooled = np.asarray((np.roll(steps, 1, axis=1) + 2 * steps + np.roll(steps, -1, axis=1)) / 4, np.float32)
        sigmas, marks = floor_steps(pooled[:count], near, known, p)
        plain = max(p.noise_share * math.hypot(lower.noise_grey, upper.noise_grey), LEAST_STEP)
        far = np.abs(pooled[count:]).max(axis=0, initial=0.0) / max(float(sigmas[-1]), float(sigmas.min()))
        # 2. Stereo, by bins. Noise without texture fits other disparities a little better: the ratio of known floor
        #    says by how much.
        of_bin, surface = self._bins // BINS_PER_PX, self._surfaces(evidence.surface)
        ratios = evidence.floor[of_bin]
        bias = np.nan_to_num(ratios[near]).mean() if not np.isfinite(ratios[near]).any() else np.nanmedian(ratios[near])
        stereo = ratios - np.float32(min(max(float(bias), -1.0), 0.0)), *(a[of_bin] for a in (surface, *evidence.level))
        # 3. The look of floor.
        look = floor_look(steps[:count], greys[:count], self.ranges_m, near & (self.ranges_m < 1.6)[:, None], p)
        # 4. The posterior.
        seen = seen & (greys[:count].T < SATURATED)
        first = np.empty((DIRECTIONS, count + 1), np.float32)
        cells = np.empty((2, DIRECTIONS, count), np.float32)
        by_direction = [np.ascontiguousarray(a.T) for a in (*stereo, pooled[:count], greys[:count], look)]
        floor, surfaces, above, below, steps, greys, look = by_direction
        kernels.posterior(
            floor,
            surfaces,
            above,
            below,
            steps,
            greys,
            look,
            seen.view(np.uint8),
            sigmas,
            self._lengths_m,
            far.astype(np.float32),
            marks,
            float(self.ends_m[0]),
            plain,
            self._values,
            first,
            cells,
        )
        surfaces = np.ascontiguousarray(evidence.surface[of_bin].T)
        return RayBelief(first, cells[0], cells[1], surfaces, self.ends_m)

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

    def _of_bins(self, pixels: Flags, *, every: bool) -> Flags:
        """Return the bins (DIRECTIONS, N) whose pixels (H, DIRECTIONS) of both views are set; or any of them."""
        count = len(self._bins)
        lower = np.rint(self._rows[:count]).astype(int)
        upper = np.rint((self._rows + self._shifts)[:count]).astype(int)
        one, two = (pixels[np.clip(rows, 0, len(pixels) - 1)] for rows in (lower, upper))
        return np.ascontiguousarray((one & two if every else one | two).T)

    def _surfaces(self, surface: Floats) -> Floats:
        """Return ratios (K, DIRECTIONS) of surfaces, where one fits best at least the weighted mean of neighbours."""
        p = self._p
        most = np.minimum(surface, p.surface_most)
        three = np.maximum(most, np.maximum(np.roll(most, 1, 0), np.roll(most, -1, 0)))
        half = p.wide_columns // 2
        turned = np.concatenate([three[:, -half:], three, three[:, :half]], axis=1)
        wide = cv2.blur(turned, (p.wide_columns, 1), borderType=cv2.BORDER_REPLICATE)[:, half:-half]
        is_best = wide >= np.maximum(np.roll(wide, 1, 0), np.roll(wide, -1, 0))
        return np.asarray(np.where(is_best, np.maximum(most, p.wide_weight * wide), most))
