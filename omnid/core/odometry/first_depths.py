"""Depths of the first keyframe where nearly everything repeats: the first motion decides among them.

Courses of bricks of the height c fit the upper panorama at every disparity d (1 - k c / B), B the baseline, whatever
their distance: a world that is larger by 1 / (1 - k c / B) explains the pair as well. Where a landmark repeats, dense
stereo may have chosen any of its disparities d_k, and there is no earlier keyframe whose landmarks would decide. So
they are tracked in the lower panorama, from the keyframe on:

1. Motion without depths: of directions t at right angles to the baseline and turns R about it, those that most pairs
   of bearings (a_i, b_i) fit,

       e_i = f (t x R a_i) b_i / |t x R a_i|.

2. The distance |t|: the bearings of a landmark give its range r_i in units of |t|, and each of its disparities a
   distance |t| = f B / (d_k r_i). Each landmark votes once,

       S(|t|) = sum_i max_k exp(-(log |t| - log f B / (d_k r_i))^2 / (2 sigma_ik^2)).

   The true distance has the votes of all landmarks; that of a larger world lacks those of landmarks that do not
   repeat.
3. Of the distances that a vehicle can have moved, the one with most votes decides the depths. While another distance
   has nearly as many, or too few landmarks have enough parallax to vote, the pose is uncertain by the difference of the
   two.

Depths of pairs that are not synchronised are not corrected (keyframes.py).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.correlation import matching_disparities
from omnid.core.odometry.estimates import SAME_M
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

if TYPE_CHECKING:
    from omnid.core.odometry.local_map import Keyframe, LocalMap

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Pair = tuple[PaddedPanorama, PaddedPanorama]

# The scale of the map is certain if at least this share of the landmarks does not repeat: rendered rooms with a wall of
# bricks have 0.42 and more, so that it is uncertain only in worlds that repeat nearly everywhere.
LEAST_UNIQUE_SHARE = 0.4
# Steps of the direction of the motion and of its turn in the first round of the search [rad]: a step moves an epipolar
# line by TOLERANCE_PX. The steps of each round are smaller by FINER. The largest turn is the reach of the tracker.
DIRECTION_STEP, TURN_STEP, MOST_TURN = math.radians(2.5), math.radians(0.5), math.radians(10.0)
ROUNDS, FINER = 3, 3
# Least share of the bearings that the motion must explain: a wrong one, where the turn is too large, explains 0.6.
FIT_SHARE = 2 / 3
# A turn fits as well as the best one if it has this share of its score. The motion is unknown if such a turn differs by
# more than EQUAL_FIT_TURN [rad]. Measured: turns up to 10 degrees away fit as well for a view of 30 degrees on a wall,
# up to 1.5 degrees for a full turn.
EQUAL_FIT_SHARE, EQUAL_FIT_TURN = 0.9, math.radians(2.5)
TOLERANCE_PX = 1.5  # distance of a track from its epipolar line: vehicles roll and pitch by half a degree
# Parallax from which a landmark votes: with errors of SIGMA_PX, as measured for tracks without warped patches, its
# range errs by an eighth, so that neighbouring courses differ by two sigmas.
PARALLAX_PX, SIGMA_PX = 6.0, 0.7
DISPARITY_SIGMA_PX = 0.5  # Peaks of the correlation are found at whole pixels.
LEAST_SIGMA = 0.02  # of the logarithm of a voted distance: the motion is only known to a tenth of a degree
LEAST_VOTES = 30.0  # of a distance that decides: more than the scattered votes of a hundred landmarks give
# Share of the voting landmarks that a distance must have to decide: without repetition no two distances have so many.
DECIDING_SHARE = 0.5
# Lead in votes that makes every other distance less likely by a million to one: an outlier costs 1.1 (`_cost` in
# pose_search.py).
LEAD_VOTES = math.log(1e6) / 1.1
# Largest ratio of the true distance to that of the wheels: their scale errs by less also before it is learned, while
# distances by neighbouring courses differ by more.
WHEELS_RATIO = 1.2
OTHER_RATIO = 1.1  # Distances with a smaller ratio are one: the votes for one distance spread so far.
VOTED_SIGMAS = 3.0  # A disparity within so many sigmas of the distance is the voted one: 99.7 % of the right ones.


class FirstDepths:
    """Disparities that the landmarks of the first keyframe may have, until the motion has decided among them."""

    def __init__(self, pair: Pair, keyframe: Keyframe, ids: Indices, views: Array, model: StereoModel) -> None:
        """pair: lower and upper panorama of the keyframe; ids (N,) and views (N, 3) [px] of its landmarks."""
        self._model, self._T_odom_rect, self._ids, self._views = model, keyframe.T_odom_rect, ids, views
        # Disparities (N, K) [px] at which a landmark matches, up to that of a point at the distance of the baseline;
        # and the column (N,) of the one that the map has now.
        self._disparities = matching_disparities(pair, views, round(model.cylinder.focal_px))
        self._chosen = np.zeros(len(ids), np.intp)
        # Rows (M,) of the landmarks that are tracked, the last panorama, and their pixels (M, 2) in it.
        self._rows, self._last, self._pixels = np.arange(len(ids)), pair[0], views[:, :2]
        # The largest possible distance from the keyframe, and the one that wheels report, NaN: unknown [m].
        self._reached_m = np.zeros(2)
        # Fraction by which the motion may be larger (positive) or smaller; 0: it is certain.
        self._larger_share = 0.0
        self._repeats = np.asarray(np.isfinite(self._disparities[:, 1:]).any(axis=1))
        if self._repeats.sum() > (1.0 - LEAST_UNIQUE_SHARE) * len(ids):
            ratios = self._disparities[self._repeats, :1] / self._disparities[self._repeats] - 1.0
            edges = [float(np.median(edge(ratios, axis=1))) for edge in (np.nanmin, np.nanmax)]
            self._larger_share = max(edges, key=abs)

    @property
    def is_open(self) -> bool:
        """True while the motion may be larger or smaller than the depths of the map give it."""
        return self._larger_share != 0.0

    def doubt_m(self, T_odom_rect: Array) -> float:
        """Return the distance [m] between a pose and the one by the other depths."""
        return abs(self._larger_share) * float(np.linalg.norm(T_odom_rect[:3, 3] - self._T_odom_rect[:3, 3]))

    def decide(self, lower: PaddedPanorama, klt: KltSettings, local_map: LocalMap, step_m: tuple[float, float]) -> None:
        """Track the landmarks into the next panorama, and correct their depths in the map if the motion decides them.

        step_m: the largest possible distance since the last panorama, and the one that wheels report, NaN: unknown.
        """
        # 1. Track them from panorama to panorama.
        self._reached_m += step_m
        pixels, found = track(self._last, lower, self._pixels, self._pixels, klt)
        self._last, self._pixels, self._rows = lower, pixels[found], self._rows[found]
        if len(self._rows) < LEAST_VOTES:
            return
        # 2. Each of their disparities gives a distance; its logarithm is voted for. The wheels limit the distances,
        #    unless they have hardly moved: they may report the start late.
        ranges, parallax_px = self._ranges()
        disparities = self._disparities[self._rows]
        distances = np.log(self._model.cylinder.focal_px * self._model.baseline_m / (disparities * ranges[:, None]))
        sigmas = np.hypot(SIGMA_PX / parallax_px[:, None], DISPARITY_SIGMA_PX / disparities) + LEAST_SIGMA
        votes = np.isfinite(distances).any(axis=1)
        if votes.sum() < LEAST_VOTES:
            return
        most_m, sensed_m = self._reached_m
        reach_m = (sensed_m / WHEELS_RATIO, sensed_m * WHEELS_RATIO) if sensed_m > SAME_M else (0.0, most_m)
        least = max(float(np.nanmin(distances)), math.log(max(reach_m[0], SAME_M / 2)))
        grid = np.arange(least, min(float(np.nanmax(distances)), math.log(max(reach_m[1], SAME_M))), LEAST_SIGMA / 2)
        if not len(grid):
            return
        # 3. Count the votes of each distance, and of the best one of clearly different distances.
        each = np.exp(-0.5 * ((grid[:, None, None] - distances[votes]) / sigmas[votes]) ** 2)
        scores = np.nan_to_num(each).max(axis=2).sum(axis=1)
        best = int(scores.argmax())
        if scores[best] < max(LEAST_VOTES, DECIDING_SHARE * votes.sum()):
            return
        others = np.where(np.abs(grid - grid[best]) > math.log(OTHER_RATIO), scores, 0.0)
        is_near = others.max() > scores[best] - LEAD_VOTES
        self._larger_share = math.expm1(grid[others.argmax()] - grid[best]) if is_near else 0.0
        # 4. Landmarks get the disparity of that distance. Voting landmarks without such a disparity are false; those
        #    that repeat and have no vote may be. Both are removed.
        off = np.where(np.isfinite(distances), np.abs(distances - grid[best]) / sigmas, np.inf)
        chosen, is_decided = off.argmin(axis=1), off.min(axis=1) < VOTED_SIGMAS
        moved = np.flatnonzero(is_decided & (chosen != self._chosen[self._rows]))
        rows = self._rows[moved]
        self._chosen[rows], views = chosen[moved], self._views[rows]
        views[:, 2] = views[:, 1] + disparities[moved, chosen[moved]]
        noise = np.tile(np.diag([0.0, 0.0, DISPARITY_SIGMA_PX**2]), (len(rows), 1, 1))
        local_map.set_views(self._ids[rows], views, noise)
        local_map.keep(self._ids[self._rows[is_decided | ~(votes | self._repeats[self._rows])]])

    def _ranges(self) -> tuple[Array, Array]:
        """Return ranges (M,) of the landmarks from the keyframe, in units of the distance, and parallaxes (M,) [px].

        A landmark off its epipolar line, behind the camera, or with too little parallax has none: NaN.
        """
        cylinder = self._model.cylinder
        before, now = cylinder.rays(self._views[self._rows, :2]), cylinder.rays(self._pixels)
        now /= np.linalg.norm(now, axis=1, keepdims=True)
        motion = most_likely_motion(before, now, cylinder.focal_px)
        if motion is None:
            return np.full(len(now), np.nan), np.ones(len(now))
        direction, turn = motion
        t, turned = np.array([math.cos(direction), math.sin(direction), 0.0]), _turned(before, turn)
        error_px = cylinder.focal_px * epipolar_errors(turned, now, direction)
        # r R a + t = q b in the least-squares sense. The sign of t is the one with which most landmarks lie in front.
        a2, ab = (turned**2).sum(axis=1), (turned * now).sum(axis=1)
        sine2 = np.maximum(a2 - ab**2, 1e-12)
        ranges = (ab * (now @ t) - turned @ t) / sine2
        ranges *= np.sign(np.median(ranges[sine2 >= np.median(sine2)]))
        parallax_px = cylinder.focal_px * np.sqrt(sine2 / a2)
        known = (np.abs(error_px) < TOLERANCE_PX) & (parallax_px > PARALLAX_PX) & (ranges > 0)
        return np.where(known, ranges, np.nan), parallax_px


def most_likely_motion(before: Array, now: Array, focal_px: float) -> tuple[float, float] | None:
    """Return direction and turn [rad] of the horizontal motion that most bearings (N, 3) fit, before and after it.

    None: too few bearings fit; or other turns fit as well, or may do so beyond MOST_TURN: in a narrow view a turn looks
    like a motion to the side.
    """
    direction, turn = np.arange(0.0, math.pi, DIRECTION_STEP), np.arange(-MOST_TURN, MOST_TURN + TURN_STEP, TURN_STEP)
    steps = DIRECTION_STEP, TURN_STEP
    for _ in range(ROUNDS):
        scores = np.empty((len(turn), len(direction)))
        for row, angle in zip(scores, turn, strict=True):
            errors_px = focal_px * epipolar_errors(_turned(before, angle), now, direction[:, None])
            row[:] = np.exp(-0.5 * (errors_px / TOLERANCE_PX) ** 2).sum(axis=1)
        best = np.unravel_index(int(scores.argmax()), scores.shape)
        at = float(direction[best[1]]), float(turn[best[0]])
        as_good = scores.max(axis=1) >= EQUAL_FIT_SHARE * scores.max()
        is_shown = scores.max() > FIT_SHARE * len(now) and abs(at[1]) < MOST_TURN - EQUAL_FIT_TURN
        if not is_shown or np.abs(turn[as_good] - at[1]).max() > EQUAL_FIT_TURN:
            return None
        steps = steps[0] / FINER, steps[1] / FINER
        direction, turn = (middle + step * np.arange(-FINER, FINER + 1) for middle, step in zip(at, steps, strict=True))
    return at


def _turned(bearings: Array, angle: float) -> Array:
    """Return bearings (N, 3) turned about the vertical by an angle [rad]."""
    return np.asarray(bearings @ se3.rotation_exp([0.0, 0.0, angle]).T)


def epipolar_errors(turned: Array, now: Array, direction: Array | float) -> Array:
    """Return the angles (..., N) [rad] of bearings now (N, 3), of unit length, to the planes through turned (N, 3).

    direction (...,) [rad]: that of the horizontal motion, which all planes contain.
    """
    c, s = np.cos(direction), np.sin(direction)
    x, y, z = turned.T
    across = c * y - s * x
    return np.asarray(
        (z * (s * now[:, 0] - c * now[:, 1]) + across * now[:, 2]) / np.maximum(np.hypot(z, across), 1e-12)
    )
