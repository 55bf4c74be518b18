"""Depths of the first keyframe where nearly everything repeats: the first motion decides among them.

Courses of bricks of the height c fit the upper panorama at every disparity d (1 - k c / B), B the baseline, whatever
their distance: a world that is larger by 1 / (1 - k c / B) explains the pair as well. Where a landmark repeats, dense
stereo may have taken any of its disparities d_k, and landmarks of an earlier keyframe, which would decide, there are
none. The lower panorama alone, followed from the keyframe on, decides:

1. Motion without depths: of directions t at right angles to the baseline and turns R about it, those that most pairs
   of bearings (a_i, b_i) fit,

       e_i = f (t x R a_i) b_i / |t x R a_i|.

2. The distance |t|: the bearings of a landmark give its range r_i in units of |t|, and each of its disparities a
   distance |t| = f B / (d_k r_i). Each landmark votes once,

       S(|t|) = sum_i max_k exp(-(log |t| - log f B / (d_k r_i))^2 / (2 sigma_ik^2)).

   The true distance has the votes of all landmarks, that of a larger world not those of landmarks that do not repeat.
3. Of the distances that a vehicle can have made, the one with most votes decides the depths. While another one has
   nearly as many, or too few landmarks have moved far enough to vote, the pose is in doubt by the difference of both.

Pairs that are not synchronised are left as they are (keyframes.py).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import SAME_M
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.odometry.wrong_periods import matching_disparities
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

if TYPE_CHECKING:
    from omnid.core.odometry.local_map import Keyframe, LocalMap

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Pair = tuple[PaddedPanorama, PaddedPanorama]

# Landmarks that do not repeat, as a share of all, below which the others decide the scale of the map: rendered rooms
# with a wall of bricks have 0.42 and more, so that only worlds which repeat nearly everywhere are in doubt.
LEAST_SURE = 0.4
# Directions of the motion and turns that are tried first, rad: such a step moves an epipolar line by TOLERANCE_PX, so
# that none is missed. The last turn is as far as the tracker reaches, because it searches 30 px at scale 1.
DIRECTION_STEP, TURN_STEP, MOST_TURN = math.radians(2.5), math.radians(0.5), math.radians(10.0)
ROUNDS, FINER = 3, 3  # rounds, each so many times as fine, because a tenth of a degree then remains
# Share of the bearings that the motion explains, because a wrong one, where the turn is too large, explains 0.6.
FIT_SHARE = 2 / 3
# Share of the bearings that fit the best turn from which another turn fits as well, and how far apart both are, rad:
# with a view of 30 degrees on a wall all of 10 degrees do, with a full turn those of 1.5 degrees, as measured.
ALIKE_SHARE, ALIKE_TURN = 0.9, math.radians(2.5)
TOLERANCE_PX = 1.5  # distance of a track from its epipolar line, because vehicles roll and pitch by half a degree
# Parallax from which a landmark votes: with errors of SIGMA_PX, as measured for tracks without warped patches, its
# range errs by an eighth, so that neighbouring courses differ by two sigmas.
PARALLAX_PX, SIGMA_PX = 6.0, 0.7
DISPARITY_SIGMA_PX = 0.5  # because peaks of the correlation are found among whole pixels
LOG_STEP = 0.01  # between two distances whose votes are counted, so that it is half of the least sigma
LEAST_SIGMA = 0.02  # of a vote, because the motion is only known to a tenth of a degree
LEAST_VOTES = 30.0  # that decide, because fewer are as many as scattered votes of a hundred landmarks give
# Share of the landmarks with a vote that must agree, because without repetition no two distances can have so many.
DECIDING_SHARE = 0.5
# Votes by which a runner-up has fewer, so that it is less likely by a million to one: an outlier costs 1.1, see `_cost`
# in `frame_to_map.py`.
LEAD_VOTES = math.log(1e6) / 1.1
# Of the distance that wheels report, because theirs errs by less also before its scale is learned, and periods by more.
WHEELS_RATIO = 1.2
OTHER_RATIO = 1.1  # Distances whose ratio is less are one, because the votes for one distance are spread so far.
# Covariance [px^2] of a view whose upper row was moved to another peak, because only that is known less well.
VIEW_NOISE = np.diag([0.0, 0.0, DISPARITY_SIGMA_PX**2])
# Share of the disparities decided on that were those of dense stereo, above which the others are kept as well, because
# RANSAC leaves out so few wrong ones.
RIGHT_SHARE = 0.9
VOTED_SIGMAS = 3.0  # within which a disparity is the voted one, because three in a thousand of the right ones are not


class Votes(NamedTuple):
    """Distances [m] with most votes."""

    moved_m: float
    runner_up_m: float | None  # another distance that has nearly as many


class FirstDepths:
    """Disparities that the landmarks of the first keyframe may have, until the motion has decided among them."""

    def __init__(self, pair: Pair, keyframe: Keyframe, ids: Indices, views: Array, model: StereoModel) -> None:
        """pair: lower and upper panorama of the keyframe; ids (N,) and views (N, 3) [px] of its landmarks."""
        self._model, self._T_odom_rect, self._ids, self._views = model, keyframe.T_odom_rect, ids, views
        self._disparities = _disparities(pair, views, model)
        self._taken = np.zeros(len(ids), np.intp)  # which of its disparities a landmark has
        self._last, self._pixels = pair[0], views[:, :2]
        # The largest distance from the keyframe that is possible, and the one by wheels; NaN: not known.
        self._most_m, self._sensed_m = 0.0, 0.0
        self._larger_share = self._largest_share()

    @classmethod
    def of(cls, pair: Pair, keyframe: Keyframe, ids: Indices, views: Array, model: StereoModel) -> FirstDepths | None:
        """Return the disparities of a keyframe, None where enough landmarks do not repeat."""
        found = cls(pair, keyframe, ids, views, model) if len(views) else None
        return found if found is not None and found.is_open else None

    @property
    def is_open(self) -> bool:
        """True while the motion may be larger or smaller than the depths of the map give it."""
        return self._larger_share != 0.0

    def doubt_m(self, T_odom_rect: Array) -> float:
        """Return the distance [m] from a pose to the runner-up."""
        return abs(self._larger_share) * float(np.linalg.norm(T_odom_rect[:3, 3] - self._T_odom_rect[:3, 3]))

    def decide(self, lower: PaddedPanorama, klt: KltSettings, local_map: LocalMap, step_m: tuple[float, float]) -> None:
        """Follow the landmarks into the next panorama, and correct their depths where it shows how far it is.

        step_m: the most that a vehicle can move since the last panorama, and the step by wheels, NaN: not known.
        """
        # 1. Follow them from the keyframe on.
        self._most_m, self._sensed_m = self._most_m + step_m[0], self._sensed_m + step_m[1]
        self._follow(lower, klt)
        if len(self._ids) < LEAST_VOTES:
            return
        # 2. Vote for the distance.
        ranges, parallax_px = self._ranges()
        distances = self._model.cylinder.focal_px * self._model.baseline_m / (self._disparities * ranges[:, None])
        sigmas = np.hypot(SIGMA_PX / parallax_px[:, None], DISPARITY_SIGMA_PX / self._disparities) + LEAST_SIGMA
        votes = voted(np.log(distances), sigmas, reach_m(self._most_m, self._sensed_m))
        if votes is None:
            return
        self._larger_share = 0.0 if votes.runner_up_m is None else votes.runner_up_m / votes.moved_m - 1.0
        # 3. Landmarks take the disparity of that distance. Those without one are wrong, and so may be those without a
        #    vote, unless nearly all that were decided on had been right.
        off = np.abs(np.log(distances / votes.moved_m)) / sigmas
        off[~np.isfinite(off)] = np.inf
        chosen, each = off.argmin(axis=1), np.arange(len(off))
        is_decided = off[each, chosen] < VOTED_SIGMAS
        repeats = _repeats(self._disparities)
        own = chosen[is_decided & repeats] == 0
        were_right = own.sum() > RIGHT_SHARE * len(own)
        is_right = is_decided | (~np.isfinite(ranges) & (~repeats | were_right))
        moved = is_decided & (chosen != self._taken)
        self._taken = np.where(is_decided, chosen, self._taken)
        views = self._views[moved]
        views[:, 2] = views[:, 1] + self._disparities[each, chosen][moved]
        local_map.set_views(self._ids[moved], views, np.tile(VIEW_NOISE, (len(views), 1, 1)))
        local_map.keep(self._ids[is_right])

    def _largest_share(self) -> float:
        """Return by which share of a motion it may be larger or smaller; 0: enough landmarks do not repeat."""
        repeats = _repeats(self._disparities)
        if 1.0 - repeats.mean() >= LEAST_SURE:
            return 0.0
        own, others = self._disparities[repeats, 0], self._disparities[repeats]
        larger, smaller = (np.median(own / edge(others, axis=1)) - 1.0 for edge in (np.nanmin, np.nanmax))
        return float(max(larger, smaller, key=abs))

    def _follow(self, lower: PaddedPanorama, klt: KltSettings) -> None:
        """Track the landmarks from the last panorama into the next one; others are no longer followed."""
        pixels, found = track(self._last, lower, self._pixels, self._pixels, klt)
        self._last, self._pixels = lower, pixels[found]
        self._ids, self._views, self._disparities = self._ids[found], self._views[found], self._disparities[found]
        self._taken = self._taken[found]

    def _ranges(self) -> tuple[Array, Array]:
        """Return ranges (N,) of the landmarks from the keyframe, in units of the distance, and parallaxes (N,) [px].

        A landmark off its epipolar line, behind the camera, or with too little parallax has none: NaN.
        """
        cylinder = self._model.cylinder
        before, now = cylinder.rays(self._views[:, :2]), cylinder.rays(self._pixels)
        now /= np.linalg.norm(now, axis=1, keepdims=True)
        motion = most_likely_motion(before, now, cylinder.focal_px)
        if motion is None:
            return np.full(len(now), np.nan), np.ones(len(now))
        direction, turn = motion
        t, turned = (
            np.array([math.cos(direction), math.sin(direction), 0.0]),
            before @ se3.rotation_exp([0.0, 0.0, turn]).T,
        )
        error_px = cylinder.focal_px * epipolar_errors(turned, now, direction)
        # r R a + t = q b in the least-squares sense; t points forwards or backwards, whichever leaves most in front.
        a2, ab = (turned**2).sum(axis=1), (turned * now).sum(axis=1)
        sine2 = a2 - ab**2
        ranges = (ab * (now @ t) - turned @ t) / np.maximum(sine2, 1e-12)
        ranges *= np.sign(np.median(ranges[sine2 >= np.median(sine2)]))
        parallax_px = cylinder.focal_px * np.sqrt(np.maximum(sine2, 1e-12) / a2)
        known = (np.abs(error_px) < TOLERANCE_PX) & (parallax_px > PARALLAX_PX) & (ranges > 0)
        return np.where(known, ranges, np.nan), parallax_px


def reach_m(most_m: float, sensed_m: float) -> tuple[float, float]:
    """Return the least and the largest distance that are possible, by the speed limit and by wheels (NaN: none).

    Wheels that report hardly any motion may not have begun to turn.
    """
    return (sensed_m / WHEELS_RATIO, sensed_m * WHEELS_RATIO) if sensed_m > SAME_M else (0.0, most_m)


def _disparities(pair: Pair, views: Array, model: StereoModel) -> Array:
    """Return the disparities (N, K) [px] at which views (N, 3) match, up to that of the baseline's distance."""
    return matching_disparities(pair, views, round(model.cylinder.focal_px))


def _repeats(disparities: Array) -> Flags:
    """Return the landmarks (N,) of several disparities (N, K)."""
    return np.asarray(np.isfinite(disparities[:, 1:]).any(axis=1))


def most_likely_motion(before: Array, now: Array, focal_px: float) -> tuple[float, float] | None:
    """Return direction and turn [rad] of the horizontal motion that most bearings (N, 3) fit, before and after it.

    None: other turns fit as well, because what fills a narrow view turns as it moves aside, or may do so beyond
    MOST_TURN; or too few bearings fit.
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
        as_good = scores.max(axis=1) >= ALIKE_SHARE * scores.max()
        is_shown = scores.max() > FIT_SHARE * len(now) and abs(at[1]) < MOST_TURN - ALIKE_TURN
        if not is_shown or np.abs(turn[as_good] - at[1]).max() > ALIKE_TURN:
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


def voted(distances: Array, sigmas: Array, reach_m: tuple[float, float]) -> Votes | None:
    """Return the distance within reach that has most votes; None: too few agree.

    distances (N, K): logarithms, NaN: no vote; sigmas (N, K) of them; reach_m: least and largest distance.
    """
    voting = np.isfinite(distances).any(axis=1)
    distances, sigmas = distances[voting], sigmas[voting]
    if len(distances) < LEAST_VOTES:
        return None
    least, most = max(math.exp(np.nanmin(distances)), reach_m[0]), min(math.exp(np.nanmax(distances)), reach_m[1])
    if least >= most:
        return None
    grid = np.arange(math.log(least), math.log(most), LOG_STEP)
    each = np.exp(-0.5 * ((grid[:, None, None] - distances) / sigmas) ** 2)
    votes = np.nan_to_num(each).max(axis=2).sum(axis=1)
    best = int(votes.argmax())
    if votes[best] < max(LEAST_VOTES, DECIDING_SHARE * len(distances)):
        return None
    others = np.where(np.abs(grid - grid[best]) > math.log(OTHER_RATIO), votes, 0.0)
    other = int(others.argmax())
    is_near = others[other] > votes[best] - LEAD_VOTES
    return Votes(math.exp(grid[best]), math.exp(grid[other]) if is_near else None)
