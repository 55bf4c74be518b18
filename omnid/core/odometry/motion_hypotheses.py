"""Another motion that explains the images about as well as the published one.

Along identical bricks a step and that step plus a period look the same. A new frame has pose candidates: the pose that
was found, and those at peaks of the mean correlation of the landmarks' patches A_i of the last panorama with the new
one, B, over horizontal displacements d of the pose T:

    C(d) = 1/N sum_i NCC(A_i, B at pi((T exp d)^-1 p_i)).

On a texture that does not repeat C has one peak; on one that repeats with the period L others at multiples of L.
Landmarks on a pattern have correlated errors, so the images only show which candidates there are: those less than a
million to one less likely than the best. The one nearest to the prediction is published. The other motion is that of
the candidate farthest from it: its displacements from the published pose add up, as the same mistake is made in each
step. Now and then noise hides a peak: the other motion goes on at its velocity, and ends once its peaks have been
missing so often that this is less likely than a million to one. It stays in the covariance where the published motion
was not the predicted one, or where wheels ended the doubt: then the past may have been the other.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import SAME_M, PoseEstimate
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.tracking import PEAKS, correlations, padded
from omnid.core.stereo.triangulation import view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

DECIDING_COST = math.log(1e6)  # logarithm of the odds that decide
# Frames without a peak that end the other motion: noise hides one in 29.
MOST_MISSED = math.ceil(DECIDING_COST / math.log(29))
# Sigmas within which a predicted motion is to be expected, so that a single step decides at a million to one at most.
REACH_SIGMAS = math.sqrt(2 * DECIDING_COST)
DISPLACEMENT_ERROR = 0.02  # of a displacement as a share of it, to all sides: few millimetres of some decimetres
LANDMARKS = 120  # whose patches are compared: the mean of so many correlations errs by less than 0.1
# Side of a patch in samples and their distance, px: as wide as the tracker's window, and blurred by as much.
SAMPLES, SAMPLE_PX = 7, 2
STEP_PX = 5.0  # between two displacements at the median distance: half of it is what a tracker without pyramid reaches
MOST_STEPS = 12  # to each side; a wider reach is searched in wider steps
# Share of the mean correlation at the pose that another peak must reach: textures that do not repeat stay below 0.37 of
# it on rendered logs, identical bricks reach 0.62 and more.
PEAK_SHARE = 0.5


class OtherMotion:
    """The motion that may have been made instead of the published one.

    velocity (3,) [m/s] in odom, relative to the published one; is_open: it is not known which of the two was made.
    """

    def __init__(self) -> None:
        self.is_open, self.velocity = False, np.zeros(3)
        # Displacements [t; r] of the pose as twists in odom: by the other motion, and those that are not ended by it.
        self._displacement, self._past, self._missed = np.zeros(6), np.zeros(6), 0

    def covariance(self, T_odom_rect: Array) -> Array:
        """Return the covariance (6, 6) of the published pose that covers the other one."""
        off = se3.adjoint(se3.inverse(T_odom_rect)) @ (self._displacement + self._past)
        sigma_m = DISPLACEMENT_ERROR * float(np.linalg.norm(off[:3]))
        return np.outer(off, off) + np.diag(np.repeat([sigma_m**2, 0.0], 3))

    def choose(self, candidates: list[PoseEstimate], T_predicted: Array, dt_s: float, sigma_mps: float) -> PoseEstimate:
        """Return the candidate nearest to the prediction.

        The first candidate is the pose that was found first, the others are of peaks. sigma_mps: standard deviation of
        the predicted velocity.
        """
        # 1. Candidates that the images allow.
        allowed = likely(candidates)
        chosen = min(allowed, key=lambda each: each.distance_m(T_predicted))
        # 2. The candidate farthest from it is the other motion. Where the images decide against what was predicted, the
        #    doubt goes on: that one is as far, and sought there.
        if self.is_open and chosen.distance_m(T_predicted) > REACH_SIGMAS * sigma_mps * dt_s:
            self.keep()
        others = [each for each in allowed if each.distance_m(chosen.T_odom_rect) > SAME_M]
        if others:
            off_m = self._displacement[:3] - chosen.T_odom_rect[:3, 3]
            farthest = max(others, key=lambda each: float(np.linalg.norm(off_m + each.T_odom_rect[:3, 3])))
            self.add(chosen.T_odom_rect, farthest.T_odom_rect, dt_s)
        else:
            self.predict(dt_s)
            self._missed += 1
            if self._missed >= MOST_MISSED:
                self._end()
        # 3. Of estimates of the same pose the one with most inliers.
        same = [each for each in candidates if each.distance_m(chosen.T_odom_rect) <= SAME_M]
        return max(same, key=lambda each: each.inliers)

    def predict(self, dt_s: float) -> None:
        """Move the other motion on by its velocity, at a frame that does not show it."""
        self._displacement = self._displacement + dt_s * np.pad(self.velocity, (0, 3))

    def keep(self) -> None:
        """Let the displacement stay in the covariance, whatever follows."""
        self._past, self._displacement = self._past + self._displacement, np.zeros(6)

    def agree(self) -> None:
        """End the doubt: wheels measure the step, whatever was made before."""
        self.keep()
        self._end()

    def _end(self) -> None:
        self.is_open, self._displacement, self.velocity = False, np.zeros(6), np.zeros(3)

    def add(self, T_published: Array, T_other: Array, dt_s: float) -> None:
        """Add a step to another pose than the published one, which was made in dt_s."""
        step = se3.adjoint(T_published) @ se3.log(se3.inverse(T_published) @ T_other)
        self.is_open, self._missed, self._displacement = True, 0, self._displacement + step
        self.velocity = (T_other[:3, 3] - T_published[:3, 3]) / dt_s

    def replace(self, T_published: Array, T_other: Array, dt_s: float) -> None:
        """Let the other motion be one that led to another pose in dt_s since both agreed."""
        self._displacement = np.zeros(6)
        self.add(T_published, T_other, dt_s)


def likely(candidates: list[PoseEstimate]) -> list[PoseEstimate]:
    """Return the candidates that are at most a million to one less likely than the best one."""
    best = min(candidates, key=lambda each: each.cost)
    return [each for each in candidates if (each.cost - best.cost) * min(each.in_view, best.in_view) < DECIDING_COST]


def displacements(
    local_map: LocalMap, model: StereoModel, current: PaddedPanorama, T_odom_rect: Array, reach_m: float
) -> list[Array]:
    """Return displacements (x, y) [m] of a pose, in its own axes, at which the last panorama's patches are seen too.

    At most PEAKS, best first; the pose itself may be among them, as (0, 0). None if reach_m, the largest one that is
    searched, is less than a step of the grid.
    """
    # 1. The grid, and the landmarks in the last panorama.
    table = local_map.table
    rows = np.flatnonzero(np.isfinite(table.pixels[:, 0]))
    rows = rows[:: max(1, -(-len(rows) // LANDMARKS))]
    if local_map.last is None or not len(rows):
        return []
    points = se3.apply(se3.inverse(T_odom_rect), table.points[rows])
    step_m = STEP_PX / model.cylinder.focal_px * float(np.median(np.hypot(points[:, 0], points[:, 1])))
    step_m = max(step_m, reach_m / MOST_STEPS)
    if reach_m < step_m:
        return []
    steps = math.ceil(reach_m / step_m)
    offsets: Array = np.arange(-steps, steps + 1, dtype=float) * step_m
    # 2. Their mean correlation with the current one; those without texture have none.
    images = _halved(local_map.last), _halved(current)
    at, scores = padded(local_map.last, table.pixels[rows]) / SAMPLE_PX, np.empty((len(offsets), len(offsets)))
    for a, x in enumerate(offsets):
        moved = np.concatenate([points - (x, y, 0.0) for y in offsets])
        there = padded(current, view(moved, model.cylinder, model.baseline_m)) / SAMPLE_PX
        scores[a] = correlations(images, at, there.reshape(len(offsets), -1, 2), SAMPLES).mean(axis=1)
    # 3. Its peaks.
    is_peak = (scores == cv2.dilate(scores, np.ones((3, 3)))) & (scores > PEAK_SHARE * scores[steps, steps])
    return [offsets[at] for at in sorted(np.argwhere(is_peak), key=lambda at: -scores[tuple(at)])[:PEAKS]]


def _halved(panorama: PaddedPanorama) -> NDArray[np.uint8]:
    """Return an image with a pixel for each sample."""
    blurred = np.asarray(cv2.GaussianBlur(panorama.image, (0, 0), SAMPLE_PX), np.uint8)
    return np.ascontiguousarray(blurred[::SAMPLE_PX, ::SAMPLE_PX])
