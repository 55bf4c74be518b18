"""Runner-up motions: displacements from which the images would be nearly the same, as along identical bricks.

With the landmarks' patches A_i of the last panorama and the view pi(T^-1 p_i) of landmark i from a pose T in the new
panorama B, the likelihood of a displacement d [m] of the pose follows

    C(d) = 1/N sum_i NCC(A_i, B at pi((T exp d)^-1 p_i)).

On a texture that does not repeat C has one peak; on one that repeats with the period L it has others at multiples of L.
Displacements are horizontal, as those of a vehicle on a floor, and within the reach that is known of the velocity. The
peaks are guesses of the pose that the odometry then estimates from and compares as it does those of the yaw.

Along a column a texture that repeats also gives wrong depths: half of a wall one period too far, in the first keyframe,
where no landmark is known yet. Then two motions are supported by about as many landmarks each, but by others, and their
steps differ by the ratio of the depths. The second one is estimated from the outliers of the first (pose_search.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import SAME_M, GapStep, PoseEstimate
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_filter import JERK_PSD, START_ACCELERATION_VARIANCE
from omnid.core.odometry.wrong_periods import normalised_patches
from omnid.core.stereo.triangulation import view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

LANDMARKS = 120  # whose patches are compared, evenly chosen, because the mean of 120 correlations errs by less than 0.1
# Side of a patch in samples, and their distance, px, so that it is as wide as the tracker's window, and blurred by as
# much as a step of the grid moves it.
SAMPLES, SAMPLE_PX = 7, 2
BLUR_PX = 2.0
# Displacement between two candidates at the median distance, px, because a tracker's window without a pyramid finds its
# place from half as far.
STEP_PX = 5.0
MOST_STEPS = 12  # Most steps to each side, so that the time is bounded: a wider reach is searched in wider steps.
PEAKS = 3  # that are estimated from.
# Share of the mean correlation at the pose that another peak must reach to be estimated from: textures that do not
# repeat stay below 0.37 of it on rendered logs, identical bricks reach 0.62 and more.
PEAK_SHARE = 0.5
# Standard deviation of a patch's grey levels, because with less, that of noise, it has no texture.
MIN_PATCH_GREY = 1.0
# Difference of the costs of two poses, the logarithm of the ratio of their likelihoods, up to which the less likely one
# is a runner-up, so that none is left out but at a million to one.
RUNNER_UP_COST = math.log(1e6)
# Share of the landmarks in view, because without repetition no two poses explain more than half of them each.
LEAST_SHARE = 0.5
# Error of a runner-up pose as a share of its displacement, because it is few millimetres of some decimetres.
RUNNER_UP_ERROR = 0.02
# Two poses contradict each other if their shares of the landmarks in view differ by less than the chance of which are
# in view, and fewer than half of the landmarks support both, because one of them is then wrong.
EQUAL_SHARE, COMMON_SHARE = 2 / 3, 0.5
# Consecutive steps without a runner-up that end a doubt, because in one of 29 the noise hid it.
CLEAR_STEPS = 3
# Sigmas of a predicted velocity, or of its change, within which a motion is to be expected: of the unknown velocity
# after a start they are 5 m/s, the limit of the speed, so that no motion of a vehicle is left out.
REACH_SIGMAS = 5.0
# What a vehicle's velocity changes by: standard deviation of an acceleration that is not known, and the jerk's density.
ACCELERATION_VARIANCE, JERK_DENSITY = START_ACCELERATION_VARIANCE, JERK_PSD[0]


@dataclass(frozen=True, slots=True)
class Peak:
    """Displacement (x, y) [m] of a pose in its own axes, and the mean correlation of the patches there."""

    displacement: Array  # (2,)
    score: float


@dataclass(frozen=True, slots=True)
class Doubt:
    """Motions that were chosen from several, and what the pose would be by the others.

    It is over after CLEAR_STEPS without a runner-up. Where the velocity of the first of them is that which was chosen,
    and a vehicle cannot have changed to it from the runner-up's, the choice was right; else it stays in the covariance.
    """

    T_odom_rect: Array  # (4, 4) the pose that was chosen last
    displacement: Array  # (6,) [t; r] from it to the one by the runners-up
    chosen_mps: Array  # (3,) velocities of the last step in odom, as chosen and by the runner-up
    runner_up_mps: Array
    is_right: bool = True  # False if the velocities that were chosen contradict each other
    clear_steps: int = 0  # consecutive ones without a runner-up

    @property
    def is_open(self) -> bool:
        """True while it is not known which motion was made."""
        return self.clear_steps < CLEAR_STEPS

    @property
    def runner_up_distance_mps(self) -> float:
        """By how much the runner-up's velocity differs from the one that was chosen."""
        return float(np.linalg.norm(self.runner_up_mps - self.chosen_mps))

    def covariance(self, T_odom_rect: Array) -> Array:
        """Return the covariance (6, 6) of a later pose by it."""
        moved = se3.adjoint(se3.inverse(T_odom_rect) @ self.T_odom_rect) @ self.displacement
        sigmas = np.repeat([RUNNER_UP_ERROR * float(np.linalg.norm(moved[:3])), 0.0], 3)
        return np.outer(moved, moved) + np.diag(sigmas**2)

    def after_clear_step(self, velocity_mps: Array, dt_s: float) -> Doubt | None:
        """Return the doubt after a step of dt_s without a runner-up, by its velocity (3,) in odom; None: settled."""
        is_right = self.is_right
        if self.clear_steps == 0:
            chosen, other = (np.linalg.norm(velocity_mps - each) for each in (self.chosen_mps, self.runner_up_mps))
            is_right = self.is_right and bool(chosen <= most_change_mps(dt_s) < other)
        after = replace(self, is_right=is_right, clear_steps=self.clear_steps + 1)
        return after if after.is_open or not is_right else None


def most_change_mps(dt_s: float) -> float:
    """Return by how much a vehicle's velocity changes in a time at most: the motion filter's model, REACH_SIGMAS."""
    return REACH_SIGMAS * math.sqrt(ACCELERATION_VARIANCE * dt_s**2 + JERK_DENSITY * dt_s**3 / 3)


def doubt_after(before: Doubt | None, T_odom_prev: Array, estimate: PoseEstimate, dt_s: float) -> Doubt | None:
    """Return the doubt after a step of dt_s to an estimate, which may have a runner-up."""
    velocity = (estimate.T_odom_rect[:3, 3] - T_odom_prev[:3, 3]) / dt_s
    if estimate.runner_up is None:
        return None if before is None else before.after_clear_step(velocity, dt_s)
    displacement, is_right = estimate.runner_up, not estimate.through_gap
    if before is not None:
        # The same mistake in each step adds up.
        earlier = se3.adjoint(se3.inverse(estimate.T_odom_rect) @ before.T_odom_rect) @ before.displacement
        displacement = earlier + displacement * (1.0 if earlier[:3] @ displacement[:3] >= 0 else -1.0)
        is_right = (
            is_right and before.is_right and bool(np.linalg.norm(velocity - before.chosen_mps) <= most_change_mps(dt_s))
        )
    runner_up_mps = velocity + estimate.T_odom_rect[:3, :3] @ estimate.runner_up[:3] / dt_s
    return Doubt(estimate.T_odom_rect, displacement, velocity, runner_up_mps, is_right)


def likeliest(found: PoseEstimate, others: list[PoseEstimate], T_predicted: Array, reach_m: float) -> PoseEstimate:
    """Return the most likely estimate, with the farthest of its runners-up.

    others: from displacements, or by outliers; one that is not within reach_m [m] of the pose T_predicted is no motion
    of a vehicle, and one that explains less than LEAST_SHARE of the landmarks in view no view of the scene. Of
    estimates of one pose the one with most inliers is taken.

    Where half of the landmarks contradict the others, one half has a wrong depth, all of it by the same period of the
    texture. The costs are sums over landmarks that err independently, so they do not decide; the motion does: the pose
    nearest to T_predicted is taken, and the other one is its runner-up.
    """
    if not others:
        return found
    # 1. The estimate with the lowest cost, and estimates that contradict it; among all these the motion decides.
    near = [each for each in others if each.distance_m(T_predicted) < reach_m]
    views = [found, *(each for each in near if len(each.landmarks) >= LEAST_SHARE * each.in_view)]
    cheapest = min(views, key=lambda each: each.cost)
    opposed = [each for each in (found, *near) if contradict(each, cheapest)]
    best = min([cheapest, *opposed], key=lambda each: each.distance_m(T_predicted))
    # 2. The others are at the same pose, or runners-up if they contradict the best one or cost little more.
    candidates = list({id(each): each for each in (*views, *opposed)}.values())
    steps = [(each, se3.log(se3.inverse(best.T_odom_rect) @ each.T_odom_rect)) for each in candidates]
    same = [each for each, step in steps if np.linalg.norm(step[:3]) <= SAME_M]
    runners_up = [
        step
        for each, step in steps
        if np.linalg.norm(step[:3]) > SAME_M and _rivals(each, best) and each.distance_m(T_predicted) < reach_m
    ]
    farthest = max(runners_up, key=lambda step: float(np.linalg.norm(step[:3])), default=None)
    # 3. Landmarks of contradicting poses that do not support the chosen one.
    wrong = [each.landmarks for each in candidates if contradict(each, best)]
    chosen = max(same, key=lambda estimate: estimate.inliers)
    contradicting = np.setdiff1d(np.concatenate(wrong), chosen.landmarks) if wrong else chosen.contradicting
    return replace(chosen, runner_up=farthest, contradicting=contradicting)


def _rivals(other: PoseEstimate, best: PoseEstimate) -> bool:
    """True if an estimate contradicts the best one or costs little more."""
    excess = (other.cost - best.cost) * min(best.in_view, other.in_view)
    return contradict(other, best) or excess < RUNNER_UP_COST


def contradict(a: PoseEstimate, b: PoseEstimate) -> bool:
    """True if about as many landmarks support one pose as the other, and they are not the same landmarks."""
    shares = [len(each.landmarks) / max(1, each.in_view) for each in (a, b)]
    common = len(np.intersect1d(a.landmarks, b.landmarks, assume_unique=True))
    fewest = min(len(a.landmarks), len(b.landmarks))
    return min(shares) >= EQUAL_SHARE * max(shares) and common <= COMMON_SHARE * fewest


def displacements(
    local_map: LocalMap, model: StereoModel, current: PaddedPanorama, T_odom_rect: Array, reach_m: float
) -> list[Array]:
    """Return displacements (x, y) [m] of a pose, in its own axes, at which the last panorama's patches are seen too.

    At most PEAKS, best first; the pose itself may be among them, as (0, 0). reach_m: the largest one that is searched;
    none if that is less than a step of the grid.
    """
    before, rows = local_map.last_seen(LANDMARKS)
    if before is None or not len(rows):
        return []
    table = local_map.table
    points = se3.apply(se3.inverse(T_odom_rect), table.points[rows])
    step_px = STEP_PX / model.cylinder.focal_px
    step_m = max(step_px * float(np.median(np.hypot(points[:, 0], points[:, 1]))), reach_m / MOST_STEPS)
    if reach_m < step_m:
        return []
    steps = math.ceil(reach_m / step_m)
    offsets: Array = np.arange(-steps, steps + 1, dtype=float) * step_m
    patches, contrast = normalised_patches(before, table.pixels[rows], SAMPLES, SAMPLE_PX, _blurred(before))
    textured = contrast > MIN_PATCH_GREY
    if not textured.any():
        return []
    blurred, scores = _blurred(current), np.empty((len(offsets), len(offsets)))
    for a, x in enumerate(offsets):
        moved = np.concatenate([points - (x, y, 0.0) for y in offsets])
        pixels = view(moved, model.cylinder, model.baseline_m)[:, :2]
        seen, _ = normalised_patches(current, pixels, SAMPLES, SAMPLE_PX, blurred)
        each = np.einsum("gns,ns->gn", seen.reshape(len(offsets), *patches.shape), patches)
        scores[a] = each[:, textured].mean(axis=1)
    return [peak.displacement for peak in _peaks(scores, offsets) if peak.score > PEAK_SHARE * scores[steps, steps]]


def _peaks(scores: Array, offsets: Array) -> list[Peak]:
    """Return the local maxima of scores (G, G) over displacements (G,) along x and y, best first."""
    highest = cv2.dilate(scores, np.ones((3, 3)))
    at = np.argwhere(scores == highest)
    found = [Peak(offsets[index], float(scores[tuple(index)])) for index in at]
    return sorted(found, key=lambda peak: -peak.score)[:PEAKS]


def _blurred(panorama: PaddedPanorama) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(panorama.image.astype(np.float32), (0, 0), BLUR_PX), np.float32)


# Sigma of the velocity while poses are refused [m/s, rad/s], because indoor vehicles are seldom faster than twice that.
UNTRACKED_SPEED_SIGMA = 0.5


@dataclass(frozen=True, slots=True)
class UntrackedMotion:
    """Motion since the last accepted pose."""

    T_at_fix: Array  # (4, 4) that pose
    too_fast: Array = field(default_factory=lambda: np.zeros(3))  # [m/s] in odom: that of the fastest refused pose

    @property
    def sigma(self) -> Array:
        """Standard deviation (6,) of the velocity [m/s, rad/s]."""
        return np.repeat([max(UNTRACKED_SPEED_SIGMA, float(np.linalg.norm(self.too_fast))), UNTRACKED_SPEED_SIGMA], 3)

    def keeps_view(self, T_odom_rect: Array) -> bool:
        """Return whether a pose (4, 4) has the same landmarks in view as the last accepted one."""
        return GapStep.between(self.T_at_fix, T_odom_rect).keeps_view

    def refused(self, T_odom_rect: Array, since_s: float) -> UntrackedMotion:
        """Return the motion after a pose that was refused for its speed, since_s after the last accepted one."""
        velocity = (T_odom_rect[:3, 3] - self.T_at_fix[:3, 3]) / since_s
        return replace(self, too_fast=max(self.too_fast, velocity, key=lambda v: float(np.linalg.norm(v))))

    def in_doubt(self, estimate: PoseEstimate, since_s: float) -> PoseEstimate:
        """Return an estimate with the motion at the refused speed as its runner-up, if there was one."""
        if not self.too_fast.any():
            return estimate
        aside = self.T_at_fix[:3, 3] + self.too_fast * since_s - estimate.T_odom_rect[:3, 3]
        other = np.concatenate([estimate.T_odom_rect[:3, :3].T @ aside, np.zeros(3)])
        return replace(estimate, runner_up=max((other, estimate.runner_up), key=_length), through_gap=True)


def _length(step: Array | None) -> float:
    return 0.0 if step is None else float(np.linalg.norm(step[:3]))
