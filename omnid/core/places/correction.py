"""Correction of a map by its loops: the pose graph, weighted by the drift that the loops themselves show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.drift import drift_factor, relative_covariance
from omnid.core.places.place_map import Link, PlaceMap
from omnid.core.places.pose_graph import PoseEdges, optimise

Array = NDArray[np.float64]

LEAST_ODOMETRY: Final = np.diag([2e-4] * 3 + [2e-5] * 3) ** 2  # m, rad: of an edge, so that none is infinitely stiff
FITS_M, FITS_RAD = 0.01, 0.003  # A loop that the map fits within this needs no optimisation.
LOOPS_THAT_FIT: Final = 3  # wait for the next optimisation, more of them in a large map; by trial on development seeds
KEYFRAMES_PER_LOOP: Final = 50  # one more loop waits per this number of keyframes; by trial on development seeds
ACCEPTED: Final = 0.5  # least weight of a loop that counts; the middle is enough, because weights end at 0 or 1
RECENT: Final = 8  # Newest loops, because they show the present drift; a refused loop may be accepted while among them.


@dataclass(frozen=True, slots=True, eq=False)
class _Anchor:
    """A keyframe whose covariance in the map is known."""

    T_odom_rect: Array
    of_odom: Array  # (6, 6) covariance in odom
    of_map: Array  # (6, 6) covariance in the map


class MapCorrection:
    """Optimises the poses of a map when loops are closed."""

    def __init__(self, places: PlaceMap) -> None:
        self._places = places
        self._anchor: _Anchor | None = None
        self._is_due = False  # the next loop says how well the place of odom in the map is known
        self._waiting = 0  # loops since the last optimisation
        self.rejected = 0  # loops that the graph refused
        self.factor = 1.0  # factor on odometry's covariance that the loops show
        self.optimisations = 0

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
        self._places.links += loops
        self._waiting += len(loops)
        may_wait = self._waiting <= LOOPS_THAT_FIT + len(part) // KEYFRAMES_PER_LOOP
        if may_wait and not self._is_due and all(map(self._fits, loops)):
            return
        self._waiting, self._is_due = 0, False
        self.optimisations += 1
        # 2. The drift that the loops show, which weighs odometry in the graph.
        among = set(part)
        links = [link for link in self._places.links if link.a in among]
        self.factor = self._drift_factor(links)
        # 3. The poses by all links but those between keyframes that stay, which say nothing of the others.
        links = [link for link in links if link.a not in fixed or link.b not in fixed]
        joined = {id for link in links for id in (link.a, link.b)}
        part = [id for id in part if id not in fixed or id in joined]
        stays = np.array([id in fixed for id in part])
        poses = np.array([self._places.poses[id] for id in part])
        result = optimise(poses, self._edges(part, links), stays if stays.any() else None)
        self._places.move(dict(zip(part, result.poses, strict=True)))
        # 4. Loops that the graph refuses go.
        self._refuse([links[n] for n in np.flatnonzero(result.weights < ACCEPTED)], links)
        # 5. The covariance of later poses in the map.
        newest = self._places.keyframes[part[-1]]
        if np.isfinite(result.covariance).all():
            self._anchor = _Anchor(newest.T_odom_rect, newest.covariance, result.covariance)

    def _edges(self, part: list[int], links: list[Link]) -> PoseEdges:
        """Return the edges of the graph of a part (ids of keyframes) by its links."""
        row = {id: n for n, id in enumerate(part)}
        return PoseEdges(
            np.array([(row[link.a], row[link.b]) for link in links]),
            np.array([link.T_a_b for link in links]),
            np.array([self._covariance(link) for link in links]),
            np.array([link.is_loop for link in links]),
        )

    def _refuse(self, refused: list[Link], links: list[Link]) -> None:
        """Remove refused links of some from the map, but the newest loops."""
        bad = {id(link) for link in refused} - {id(link) for link in _recent_loops(links)}
        self._places.links = [link for link in self._places.links if id(link) not in bad]
        self.rejected += len(bad)

    def _fits(self, loop: Link) -> bool:
        """True if the poses of a map agree with a loop."""
        poses = self._places.poses
        error = se3.log(se3.inverse(poses[loop.a] @ loop.T_a_b) @ poses[loop.b])
        return bool(np.linalg.norm(error[:3]) < FITS_M and np.linalg.norm(error[3:]) < FITS_RAD)

    def covariance_at(self, T_odom_rect: Array, covariance: Array) -> Array:
        """Return the covariance (6, 6) in the map of a pose whose covariance in odom is given."""
        if self._anchor is None:
            return covariance
        T_anchor_rect = se3.inverse(self._anchor.T_odom_rect) @ T_odom_rect
        A = se3.adjoint(se3.inverse(T_anchor_rect))
        since = relative_covariance(T_anchor_rect, self._anchor.of_odom, covariance)
        return np.asarray(A @ self._anchor.of_map @ A.T + self.factor * since)

    def _covariance(self, link: Link) -> Array:
        return link.covariance if link.is_loop else self.factor * link.covariance + LEAST_ODOMETRY

    def _drift_factor(self, links: list[Link]) -> float:
        """Return the factor on odometry's covariance that explains the loops within one run."""
        pairs = [
            (link, self._places.keyframes[link.a], self._places.keyframes[link.b]) for link in links if link.is_loop
        ]
        pairs = [(link, a, b) for link, a, b in pairs if a.session == b.session]
        if not pairs:
            return self.factor
        T_a_b = np.array([se3.inverse(a.T_odom_rect) @ b.T_odom_rect for _, a, b in pairs])
        by_loop = np.array([link.T_a_b for link, _, _ in pairs])
        by_odometry = relative_covariance(
            T_a_b, np.array([a.covariance for _, a, _ in pairs]), np.array([b.covariance for _, _, b in pairs])
        )
        errors, spread = se3.log(se3.inverse(by_loop) @ T_a_b), np.array([link.covariance for link, _, _ in pairs])
        by_odometry = by_odometry + LEAST_ODOMETRY
        errors, by_odometry, spread = _per_pair([(link.a, link.b) for link, _, _ in pairs], errors, by_odometry, spread)
        # The drift of the whole path, or of its newest part where that is larger: a rig may have been bent meanwhile.
        return max(
            drift_factor(errors[-count:], by_odometry[-count:], spread[-count:]) for count in (len(errors), RECENT)
        )


def _per_pair(pairs: Sequence[tuple[int, int]], *values: Array) -> list[Array]:
    """Return the means (K, ...) of values (N, ...) over loops between the same keyframes, in the order of the last one.

    Such loops match the same features: what is wrong with one of them is wrong with the others.
    """
    rows: dict[tuple[int, int], list[int]] = {}
    for n, pair in enumerate(pairs):
        rows[pair] = [*rows.pop(pair, []), n]
    return [np.array([value[same].mean(axis=0) for same in rows.values()]) for value in values]


def _recent_loops(links: list[Link]) -> list[Link]:
    """Return the newest loops."""
    return [link for link in links if link.is_loop][-RECENT:]
