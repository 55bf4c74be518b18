"""Comparison of a frame with keyframes: votes choose those that RANSAC and Gauss-Newton verify; what then counts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.hypotheses import angle_rad, length_m
from omnid.core.places.place_map import PlaceFeatures
from omnid.core.places.recognition import RATIO, Recognition, distances, recognise
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]


# Least inliers, and sectors of azimuth that hold them, where odometry agrees; by trial on development seeds.
NEAR_INLIERS, NEAR_SECTORS = 20, 4
# The same where it gives no pose, because other worlds gave 10 inliers in 600 queries.
FAR_INLIERS, FAR_SECTORS = 24, 5
# At most PER_PLACE of the compared keyframes lie within SAME_PLACE_M of each other; by trial on development seeds.
PER_PLACE, SAME_PLACE_M = 3, 1.5
# Share of the inliers with which another place makes a recognition ambiguous; by trial on development seeds.
RUNNER_UP: Final = 0.6
# Poses farther apart are different places.
RUNNER_UP_M, RUNNER_UP_RAD = 0.5, math.radians(10)
# Features of a frame that vote, evenly spread, the strongest ones first.
VOTERS: Final = 64
BINS: Final = 24  # Bins of the yaw angle; three neighbours count together.


def compare(
    here: PlaceFeatures,
    known: Mapping[int, PlaceFeatures],
    poses: Mapping[int, Array],
    most: int,
    enough: int,
    model: StereoModel,
) -> dict[int, Recognition | None]:
    """Compare a frame with the keyframes that most of its features vote for; return the recognition or None of each.

    known: features of each keyframe; poses: (4, 4) of each. At most `most` are compared, best first, until one is
    recognised with `enough` inliers.
    """
    ids = list(known)
    voted = [votes(here, known[id], model.cylinder.width) for id in ids]
    ranked = np.argsort([-count for count, _ in voted], kind="stable")
    found: dict[int, Recognition | None] = {}
    for n in spread(ranked, np.array([poses[id][:3, 3] for id in ids]), most):
        place = found[ids[n]] = recognise(here, known[ids[n]], ids[n], voted[n][1], model)
        if place is not None and place.inliers >= enough:
            break
    return found


def supported(found: Iterable[Recognition | None], *, near: bool = False) -> list[Recognition]:
    """Return the recognitions with enough support; near: odometry agrees with them."""
    inliers, sectors = (NEAR_INLIERS, NEAR_SECTORS) if near else (FAR_INLIERS, FAR_SECTORS)
    return [place for place in found if place and place.inliers >= inliers and place.sectors >= sectors]


def unambiguous(found: list[Recognition], poses: Mapping[int, Array]) -> Recognition | None:
    """Return the recognition with most inliers, None where another place has nearly as many, or none was found."""
    best = max(found, key=lambda place: place.inliers, default=None)
    if best is None:
        return None
    T = poses[best.id] @ best.T_place_rect
    rivals = (place for place in found if is_elsewhere(T, poses[place.id] @ place.T_place_rect))
    return None if any(place.inliers > RUNNER_UP * best.inliers for place in rivals) else best


def is_elsewhere(a: Array, b: Array) -> bool:
    """True if two poses (4, 4) are different places."""
    between = se3.inverse(a) @ b
    return length_m(between) > RUNNER_UP_M or angle_rad(between) > RUNNER_UP_RAD


def spread(ranked: NDArray[np.intp], at: Array, most: int) -> list[int]:
    """Return the first `most` of ranked places (N,) at positions (N, 3), at most PER_PLACE near another.

    So a second, similar place is compared as well, although all neighbours of the first are more similar.
    """
    chosen: list[int] = []
    for n in ranked.tolist():
        beside = np.linalg.norm(at[chosen] - at[n], axis=1) < SAME_PLACE_M
        if beside.sum() < PER_PLACE:
            chosen.append(n)
        if len(chosen) == most:
            break
    return chosen


def votes(here: PlaceFeatures, there: PlaceFeatures, width: int) -> tuple[int, float]:
    """Return how many features of a frame have a match in a keyframe at one turn, and that turn [rad].

    The turn is the yaw from the keyframe to the frame; width: columns of the panorama. Of places that are not the same,
    the matches are few, and their turns differ.
    """
    if len(there.views) < 2 or not len(here.views):
        return 0, 0.0
    here = here.first(VOTERS)
    squared = distances(here, there)
    best = squared.argmin(axis=1)
    nearest, second = np.partition(squared, 1, axis=1)[:, :2].T
    voting = np.flatnonzero(nearest < RATIO**2 * second)
    # A turn to the left moves the world to the right.
    turned = (here.views[voting, 0] - there.views[best[voting], 0]) % width
    counts = np.bincount((turned * (BINS / width)).astype(np.intp) % BINS, minlength=BINS)
    together = counts + np.roll(counts, 1) + np.roll(counts, -1)
    bin = int(together.argmax())
    return int(together[bin]), (bin + 0.5) * 2 * math.pi / BINS
