"""Correction of a map by its loops: the pose graph, weighted by the drift that the loops themselves show."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.place_map import Link, PlaceKeyframe, PlaceMap
from omnid.core.places.pose_graph import PoseEdges, optimise

Array = NDArray[np.float64]

MIN_COVARIANCE: Final = np.diag([2e-4] * 3 + [2e-5] * 3) ** 2  # m, rad: of an edge, so that none is infinitely stiff
KEYFRAMES_PER_LOOP: Final = 50  # one loop that fits waits per this number of keyframes; by trial on development seeds
RECENT: Final = 8  # Newest loops, because they show the present drift; a refused loop may be accepted while among them.
# Share of the squared distances that the drift explains, because the others may be wrong loops, and that quantile of
# the chi-squared distribution of six dimensions.
QUANTILE, EXPECTED = 0.75, 7.841


class MapCorrection:
    """Optimises the poses of a map when loops are closed."""

    def __init__(self, places: PlaceMap) -> None:
        self._places = places
        self._anchor: tuple[PlaceKeyframe, Array] | None = None  # a keyframe, and its covariance (6, 6) in the map
        self._is_due = False  # the next loop says how well the place of odom in the map is known
        self._waiting = 0  # loops since the last optimisation
        self.factor = 1.0  # factor on odometry's covariance that the loops show

    def forget(self) -> None:
        """Forget the covariance in the map: odom has been continued after a gap, or its part has joined another one.

        The next loops say how well its place in the map is known, also where the map fits them, as they have put it
        there.
        """
        self._anchor, self._is_due = None, True

    def close(self, loops: list[Link], part: list[int], fixed: frozenset[int] = frozenset()) -> None:
        """Add loops and optimise the keyframes (ids) of a connected part, the oldest first, the newest last.

        fixed: keyframes (ids) that stay where they are; if there is none in the part, the oldest one stays.
        """
        # 1. Loops that the map fits already wait for others, so that its cost does not grow with the square of the map.
        places = self._places
        places.links += loops
        self._waiting += len(loops)
        may_wait = self._waiting <= len(part) // KEYFRAMES_PER_LOOP
        if may_wait and not self._is_due and all(map(self._fits, loops)):
            return
        self._waiting, self._is_due = 0, False
        # 2. The drift that the loops show, which weighs odometry in the graph.
        among = set(part)
        links = [link for link in places.links if link.a in among]
        self.factor = self._drift_factor(links)
        # 3. The poses by all links but those between keyframes that stay, which say nothing of the others.
        links = [link for link in links if link.a not in fixed or link.b not in fixed]
        joined = {id for link in links for id in (link.a, link.b)}
        part = [id for id in part if id not in fixed or id in joined]
        row = {id: n for n, id in enumerate(part)}
        by_odometry = [self.factor * link.covariance + MIN_COVARIANCE for link in links]
        edges = PoseEdges(
            np.array([(row[link.a], row[link.b]) for link in links]),
            np.array([link.T_a_b for link in links]),
            np.array([link.covariance if link.is_loop else S for link, S in zip(links, by_odometry, strict=True)]),
            np.array([link.is_loop for link in links]),
        )
        stays = np.array([id in fixed for id in part])
        result = optimise(np.array([places.poses[id] for id in part]), edges, stays if stays.any() else None)
        places.poses.update(zip(part, result.poses, strict=True))
        # 4. Loops that the graph refuses go, but the newest ones.
        recent = [id(link) for link in links if link.is_loop][-RECENT:]
        bad = {id(links[n]) for n in np.flatnonzero(~result.accepted)}.difference(recent)
        places.links = [link for link in places.links if id(link) not in bad]
        # 5. The covariance of later poses in the map.
        if np.isfinite(result.covariance).all():
            self._anchor = places.keyframes[part[-1]], result.covariance

    def _fits(self, loop: Link) -> bool:
        """True if the poses of a map agree with a loop within its own sigma."""
        poses = self._places.poses
        error = se3.log(se3.inverse(poses[loop.a] @ loop.T_a_b) @ poses[loop.b])
        return bool(error @ np.linalg.solve(loop.covariance, error) < len(error))

    def covariance_at(self, T_odom_rect: Array, covariance: Array) -> Array:
        """Return the covariance (6, 6) in the map of a pose whose covariance in odom is given."""
        if self._anchor is None:
            return covariance
        anchor, of_map = self._anchor
        T_anchor_rect, since = anchor.relative_pose(T_odom_rect, covariance)
        A = se3.adjoint(se3.inverse(T_anchor_rect))
        return np.asarray(A @ of_map @ A.T + self.factor * since)

    def _drift_factor(self, links: list[Link]) -> float:
        """Return the factor on odometry's covariance that explains the loops within one run."""
        # 1. Loops by their keyframes, in the order of the last one. Such loops match the same features: what is wrong
        #    with one of them is wrong with the others.
        same: dict[tuple[int, int], list[Link]] = {}
        for link in links:
            sessions = {self._places.keyframes[id].session for id in (link.a, link.b)}
            if link.is_loop and len(sessions) == 1:
                same[link.a, link.b] = [*same.pop((link.a, link.b), []), link]
        if not same:
            return self.factor
        # 2. Errors of odometry, and both covariances.
        errors, by_odometry, by_loop = [], [], []
        for (a, b), loops in same.items():
            odometry = Link.by_odometry(self._places.keyframes[a], self._places.keyframes[b])
            errors.append(np.mean([se3.log(se3.inverse(loop.T_a_b) @ odometry.T_a_b) for loop in loops], axis=0))
            by_odometry.append(odometry.covariance + MIN_COVARIANCE)
            by_loop.append(np.mean([loop.covariance for loop in loops], axis=0))
        # 3. The drift of the whole path, or of its newest part where that is larger: the rig may have been bent.
        return max(
            drift_factor(*(np.array(values[-count:]) for values in (errors, by_odometry, by_loop)))
            for count in (len(errors), RECENT)
        )


def drift_factor(errors: Array, by_odometry: Array, by_loop: Array) -> float:
    """Return the factor >= 1 on odometry's covariance that explains the errors (N, 6) of loops.

    errors: log of T_a_b by odometry in that by the loop; by_odometry, by_loop (N, 6, 6) their covariances, positive
    definite. The factor is the one at which a quantile of the squared Mahalanobis distances is that of the
    distribution: noise of the images is in odometry's covariance, an error of the rig is not.
    """

    def is_explained(factor: float) -> bool:
        S = factor * by_odometry + by_loop
        squared = (errors * np.linalg.solve(S, errors[:, :, None])[:, :, 0]).sum(axis=1)
        return bool(np.quantile(squared, QUANTILE) <= EXPECTED)

    low, high = 1.0, 1.0
    while not is_explained(high):
        low, high = high, 2 * high
    while low < (middle := math.sqrt(low * high)) < high:
        low, high = (low, middle) if is_explained(middle) else (middle, high)
    return high
