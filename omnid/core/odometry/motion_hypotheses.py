"""Motions that explain the images about as well: at most three hypotheses (multiple hypothesis tracking, Reid 1979).

Along identical bricks a step and that step plus a period look the same. A hypothesis j holds its displacement d_j from
the published pose, its velocity w_j relative to the published one, and the logarithm l_j of its weight. A new frame has
pose candidates m, which lie x_m [m] off the predicted pose. A pair of both has

    l_jm = l_j - |x_m - w_j dt|^2 / (2 s_j^2),    d_jm = d_j + x_m - x_m*,    w_jm = (x_m - x_m*) / dt,

s_j what is known of the predicted step, m* the candidate of the likeliest pair, which is published. Landmarks on a
pattern have correlated errors, so the images only show which candidates there are: those less than a million to one
less likely than the best. Now and then noise hides a peak: then a hypothesis continues at its velocity, at the cost of
the logarithm of that probability. Pairs whose steps agree within SAME_M are merged, with the larger displacement, since
no later frame distinguishes them; those that are less likely by a million to one are dropped, and the likeliest three
remain.

Candidates are peaks of the mean correlation of the landmarks' patches A_i of the last panorama with the new one, B,
over horizontal displacements d of the pose T:

    C(d) = 1/N sum_i NCC(A_i, B at pi((T exp d)^-1 p_i)).

On a texture that does not repeat C has one peak; on one that repeats with the period L others at multiples of L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.correlation import normalised_patches
from omnid.core.odometry.estimates import SAME_M, PoseEstimate
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_filter import START_ACCELERATION_VARIANCE
from omnid.core.stereo.triangulation import view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

MOST = 3
DECIDING_COST = math.log(1e6)  # logarithm of the odds at which the likeliest hypothesis replaces another one
MISSED = math.log(1 / 29)  # logarithm of the probability that noise hides the peak of a hypothesis
# Sigmas within which a predicted motion is to be expected, so that a single step decides at a million to one at most.
REACH_SIGMAS = math.sqrt(2 * DECIDING_COST)
DISPLACEMENT_ERROR = 0.02  # of a displacement as a share of it, to all sides: few millimetres of some decimetres
# Two poses contradict each other if their shares of the landmarks in view differ by less than the chance of which are
# in view, and fewer than half of the landmarks support both: then the depths of one half are wrong.
EQUAL_SHARE, COMMON_SHARE = 2 / 3, 0.5

LANDMARKS = 120  # whose patches are compared: the mean of so many correlations errs by less than 0.1
# Side of a patch in samples and their distance, px: as wide as the tracker's window, and blurred by as much as a step
# of the grid moves it.
SAMPLES, SAMPLE_PX, BLUR_PX = 7, 2, 2.0
STEP_PX = 5.0  # between two displacements at the median distance: half of it is what a tracker without pyramid reaches
MOST_STEPS = 12  # to each side; a wider reach is searched in wider steps
# Share of the mean correlation at the pose that another peak must reach: textures that do not repeat stay below 0.37 of
# it on rendered logs, identical bricks reach 0.62 and more.
PEAK_SHARE = 0.5
MIN_PATCH_GREY = 1.0  # standard deviation of a patch with texture; noise has less


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One motion, relative to the published one."""

    displacement: Array  # (6,) [t; r] of the pose, as a twist in odom
    velocity: Array  # (3,) m/s in odom
    log_weight: float = 0.0


class MotionHypotheses:
    """The hypotheses that are left, the likeliest first."""

    def __init__(self) -> None:
        self._left = [Hypothesis(np.zeros(6), np.zeros(3))]

    @property
    def is_single(self) -> bool:
        """True if it is known which motion was made."""
        return len(self._left) == 1

    @property
    def fastest(self) -> Array:
        """Velocity (3,) [m/s] in odom, relative to the published one, of that which differs most from it."""
        return max((each.velocity for each in self._left), key=lambda velocity: float(np.linalg.norm(velocity)))

    def covariance(self, T_odom_rect: Array) -> Array:
        """Return the covariance (6, 6) of the published pose that covers all of them.

        It does not follow the weights: the errors of landmarks on a pattern are not independent.
        """
        steps = [se3.adjoint(se3.inverse(T_odom_rect)) @ each.displacement for each in self._left]
        farthest = max(steps, key=lambda step: float(np.linalg.norm(step[:3])))
        sigma_m = DISPLACEMENT_ERROR * float(np.linalg.norm(farthest[:3]))
        return np.outer(farthest, farthest) + np.diag(np.repeat([sigma_m**2, 0.0], 3))

    def choose(
        self, candidates: list[PoseEstimate], T_predicted: Array, dt_s: float, sigma_mps: float
    ) -> tuple[PoseEstimate, NDArray[np.intp]]:
        """Return the likeliest candidate, and the landmarks (rows of the map) of those that contradict it.

        The first candidate is the pose that was found first, the others are of peaks. sigma_mps: standard deviation of
        the predicted velocity.
        """
        if self.is_single and len(candidates) == 1:
            self._left = [Hypothesis(self._left[0].displacement, np.zeros(3))]
            return candidates[0], np.zeros(0, np.intp)
        # 1. Costs of the images. Those of poses by wrong and by right depths do not decide: the motion does.
        cheapest = min(candidates, key=lambda each: each.cost)
        costs = np.array([_cost(each, cheapest) for each in candidates])
        # 2. The weights of all pairs. Another velocity is known by one step, in which the acceleration is not known.
        moved_m = [each.T_odom_rect[:3, 3] - T_predicted[:3, 3] for each in candidates]
        weights = np.empty((len(self._left), len(candidates)))
        for row, before in zip(weights, self._left, strict=True):
            is_other = before.velocity.any()
            variance_m2 = START_ACCELERATION_VARIANCE * dt_s**4 if is_other else (sigma_mps * dt_s) ** 2
            squared = np.array([np.sum((step_m - before.velocity * dt_s) ** 2) for step_m in moved_m]) / variance_m2
            row[:] = before.log_weight - np.minimum(squared / 2, DECIDING_COST)
        likely = np.flatnonzero(costs < DECIDING_COST)
        best = int(likely[weights[:, likely].max(axis=0).argmax()])
        # 3. The pairs, and the hypotheses that no candidate continues, relative to the new published pose.
        A, chosen, after = se3.adjoint(T_predicted), candidates[best], list[Hypothesis]()
        for m in likely:
            each = candidates[m]
            step = A @ se3.log(se3.inverse(chosen.T_odom_rect) @ each.T_odom_rect)
            velocity = (moved_m[m] - moved_m[best]) / dt_s
            if each.distance_m(chosen.T_odom_rect) <= SAME_M:
                step, velocity = np.zeros(6), np.zeros(3)
            after += [
                Hypothesis(before.displacement + step, velocity, float(weight))
                for before, weight in zip(self._left, weights[:, m], strict=True)
            ]
        if not self.is_single:
            after += [
                _moved(before, moved_m[best], dt_s, MISSED)
                for before, row in zip(self._left, weights, strict=True)
                if row[likely].max() < before.log_weight + MISSED
            ]
        self._keep(after, chosen.T_odom_rect, dt_s)
        # 4. Of estimates of the same pose the one with most inliers.
        wrong = [each.landmarks for each in candidates if contradict(each, chosen)]
        same = [each for each in candidates if each.distance_m(chosen.T_odom_rect) <= SAME_M]
        chosen = max(same, key=lambda each: each.inliers)
        return chosen, np.setdiff1d(np.concatenate(wrong or [np.zeros(0, np.intp)]), chosen.landmarks)

    def predict(self, dt_s: float) -> None:
        """Move all by their velocities, at a frame without a pose."""
        self._left = [_moved(each, np.zeros(3), dt_s) for each in self._left]

    def agree(self) -> None:
        """Give all the published velocity: wheels measure the step, whatever was made before."""
        self._left = [replace(each, velocity=np.zeros(3)) for each in self._left]

    def add(self, T_published: Array, T_other: Array, velocity: Array) -> None:
        """Add a motion that is not published, with its velocity (3,) [m/s] in odom relative to that which is."""
        step = se3.adjoint(T_published) @ se3.log(se3.inverse(T_published) @ T_other)
        self._keep([*self._left, Hypothesis(step, velocity)], T_published, 1.0)

    def _keep(self, hypotheses: list[Hypothesis], T_published: Array, dt_s: float) -> None:
        """Merge, prune and keep the likeliest, which gets the weight 1."""
        to_body, left = se3.adjoint(se3.inverse(T_published)), list[Hypothesis]()
        best = max(each.log_weight for each in hypotheses)
        for each in sorted(hypotheses, key=lambda each: -each.log_weight):
            if each.log_weight <= best - DECIDING_COST:
                break
            same = (n for n, one in enumerate(left) if np.linalg.norm(each.velocity - one.velocity) * dt_s <= SAME_M)
            number = next(same, None)
            if number is None:
                left.append(replace(each, log_weight=each.log_weight - best))
                continue
            twists = left[number].displacement, each.displacement
            farther = max(twists, key=lambda twist: float(np.linalg.norm((to_body @ twist)[:3])))
            left[number] = replace(left[number], displacement=farther)
        self._left = left[:MOST]


def _moved(each: Hypothesis, published_m: Array, dt_s: float, price: float = 0.0) -> Hypothesis:
    """Return a hypothesis that has gone on at its velocity; published_m (3,): by how far another pose was published."""
    step_m = each.velocity * dt_s - published_m
    displacement, velocity = each.displacement + np.pad(step_m, (0, 3)), step_m / dt_s if dt_s else each.velocity
    return Hypothesis(displacement, velocity, each.log_weight + price)


def _cost(each: PoseEstimate, cheapest: PoseEstimate) -> float:
    """Return by how much the images of an estimate cost more than those of the cheapest one."""
    in_view = min(each.in_view, cheapest.in_view)
    return 0.0 if contradict(each, cheapest) else (each.cost - cheapest.cost) * in_view


def contradict(a: PoseEstimate, b: PoseEstimate) -> bool:
    """True if about as many landmarks support one pose as the other, and they are not the same landmarks."""
    if a is b:
        return False
    shares = [len(each.landmarks) / max(1, each.in_view) for each in (a, b)]
    common = len(np.intersect1d(a.landmarks, b.landmarks, assume_unique=True))
    fewest = min(len(a.landmarks), len(b.landmarks))
    return min(shares) >= EQUAL_SHARE * max(shares) and common <= COMMON_SHARE * fewest


def displacements(
    local_map: LocalMap, model: StereoModel, current: PaddedPanorama, T_odom_rect: Array, reach_m: float
) -> list[Array]:
    """Return displacements (x, y) [m] of a pose, in its own axes, at which the last panorama's patches are seen too.

    At most MOST, best first; the pose itself may be among them, as (0, 0). None if reach_m, the largest one that is
    searched, is less than a step of the grid.
    """
    # 1. The grid, and the patches in the last panorama.
    before, rows = local_map.last_seen(LANDMARKS)
    if before is None or not len(rows):
        return []
    table = local_map.table
    points = se3.apply(se3.inverse(T_odom_rect), table.points[rows])
    step_m = STEP_PX / model.cylinder.focal_px * float(np.median(np.hypot(points[:, 0], points[:, 1])))
    step_m = max(step_m, reach_m / MOST_STEPS)
    if reach_m < step_m:
        return []
    steps = math.ceil(reach_m / step_m)
    offsets: Array = np.arange(-steps, steps + 1, dtype=float) * step_m
    patches, contrast = normalised_patches(before, np.rint(table.pixels[rows]), SAMPLES, SAMPLE_PX, _blurred(before))
    textured = contrast > MIN_PATCH_GREY
    if not textured.any():
        return []
    # 2. Their mean correlation with the current one.
    blurred, scores = _blurred(current), np.empty((len(offsets), len(offsets)))
    for a, x in enumerate(offsets):
        moved = np.concatenate([points - (x, y, 0.0) for y in offsets])
        pixels = view(moved, model.cylinder, model.baseline_m)[:, :2]
        seen, _ = normalised_patches(current, np.rint(pixels), SAMPLES, SAMPLE_PX, blurred)
        each = np.einsum("gns,ns->gn", seen.reshape(len(offsets), *patches.shape), patches)
        scores[a] = each[:, textured].mean(axis=1)
    # 3. Its peaks.
    is_peak = (scores == cv2.dilate(scores, np.ones((3, 3)))) & (scores > PEAK_SHARE * scores[steps, steps])
    return [offsets[at] for at in sorted(np.argwhere(is_peak), key=lambda at: -scores[tuple(at)])[:MOST]]


def _blurred(panorama: PaddedPanorama) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(panorama.image.astype(np.float32), (0, 0), BLUR_PX), np.float32)
