"""Scan of free floor and obstacles by each pair: posterior of the rays, grid; a floor that leans, and ramps.

A tilt (a, b) of the floor beyond that which the rig states changes the disparity of all its rows by
f t / h (a cos u + b sin u), whatever their range. So the difference of both views on the plane, by the gradient along
columns, is a linear measurement of a and b, and a Kalman filter adds up pairs. Floor without texture has no gradient,
and changes nothing. Only floor nearer than where a step down looks like a tilt counts, and only where it is known.

A ramp of slope s that begins x_0 ahead lies on a plane of its own: z = -(h + s x_0) + r (a + s) cos(u), about the
viewpoint, over a floor z = -h + r a cos(u). So it has a disparity in each row, too, and both planes are compared, pixel
by pixel, in the rows beyond the line. Of all (x_0, s) the likeliest is chosen, where it explains those rows better than
the floor, and than anything upright, in most directions: what is narrower than the way, such as a box, is no ramp, and
neither is a wall.
A ramp goes up by at most what may be driven; and down by at most what the base has climbed: a landing. Any other fall
is an edge.
While a base drives over the line it is on neither plane: then its own pose says where both are.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from calib.se2_arrays import planar
from omnid.core.obstacles.evidence_kernels import UNITS, ramp_gains
from omnid.core.obstacles.grid import GridScan, ObstacleGrid
from omnid.core.obstacles.plane_view import (
    AROUND_ROWS,
    AZIMUTHS,
    FOCAL_PX,
    FloorPlane,
    PlaneView,
    ShownBins,
    WorkingPair,
    floor_plane,
)
from omnid.core.obstacles.posterior import MAD, ray_belief
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAN_M: Final = 1.7  # range up to which floor shows the tilt: farther away a step down looks like one
FOLLOWED_NS: Final = 500_000_000  # between two pairs by which a known tilt, and ramps, are followed
PRIOR_RAD: Final = math.radians(1.0)  # sigma of a rig that leans,
DRIFT_RAD: Final = math.radians(0.05)  # of its change from pair to pair,
SURE_RAD: Final = math.radians(0.3)  # and of a tilt that is used
LEAST_M: Final = 0.005  # change of the floor for which tables are made again,
LEAST_RAD: Final = LEAST_M / LEAN_M  # and of its tilt
CORRELATED: Final = 20.0  # pixels with one error: neighbours are smoothed, and share what is wrong
HALF_BASE_M: Final = 0.5  # From a line so far on, a base stands with all wheels on one side of it.
FOUND_M: Final = 1.0  # A ramp that begins nearer is known: too little floor is left before it to show a start.
STEEPEST: Final = math.tan(math.radians(10.0))  # ramp that may be driven,
TOO_STEEP: Final = np.tan(np.radians(np.arange(12.0, 21.0, 2.0)))  # and others, with which it must not be confused
GENTLEST: Final = math.tan(PRIOR_RAD)  # The filter of the tilt follows what is less.
STEP: Final = math.tan(math.radians(0.5))  # between slopes that are compared
STARTS_M: Final = np.arange(0.6, 3.3, 0.1)  # where ramps are looked for: nearer ones are known by their pairs before
SEEN_M: Final = 4.0  # range up to which they are seen
HALF_RAD: Final = math.radians(27.0)  # half of the angle in which a ramp is as wide as the way
PARTS: Final = 8  # of that angle: most of them must show a ramp
# Log-likelihood by a sigma of difference of a pixel: that of evidence_kernels.py with its weight in the posterior.
RATIO: Final = 0.075
LEAST_NATS: Final = 10.0  # Evidence of a ramp in one pair: without one it is below 4 in textured corridors.


class Ramp(NamedTuple):
    """The floor beyond a line across a way, in odom."""

    way_rad: float  # azimuth of the way
    offset_m: float  # of the line along the way
    slope: float  # along the way, against the floor before the line
    nats: float  # evidence of it in one pair

    def start_m(self, viewpoint: Array) -> float:
        """Return how far the line is from a viewpoint (x, y, heading) along the way; below 0: behind."""
        return self.offset_m - _along(viewpoint, self.way_rad)


def _along(viewpoint: Array, way_rad: float) -> float:
    """Return how far a place is along a way in odom [m]."""
    return float(viewpoint[0] * math.cos(way_rad) + viewpoint[1] * math.sin(way_rad))


def ramp_ahead(pair: WorkingPair, view: PlaneView, viewpoint: Array, turn_rad: float, climbed: float) -> Ramp | None:
    """Search for a ramp ahead in a pair on the floor before it.

    viewpoint: x, y, heading in odom; turn_rad: of odom in the rectified frame; climbed: slope of the base in odom.
    """
    # 1. Gains of all ramps in parts of the way.
    offset_rad = np.angle(np.exp(1j * (AZIMUTHS - viewpoint[2] - turn_rad)))
    order = np.argsort(offset_rad)
    ahead = order[np.abs(offset_rad[order]) < HALF_RAD]
    parts = ahead[: len(ahead) // PARTS * PARTS].reshape(PARTS, -1)[:, ::2].astype(np.int32)
    slopes = np.concatenate([np.arange(GENTLEST, STEEPEST + STEP / 2, STEP), TOO_STEEP])
    if climbed > GENTLEST:  # A landing is level.
        slopes = np.append(slopes, STEP * np.arange(-2, 3) - climbed)
    gains = np.empty((PARTS, len(STARTS_M), len(slopes)))
    upright = np.empty((PARTS, math.ceil(view.at_1m / STARTS_M[0]), view.height))
    live, height_m = pair.seen * np.uint8(255), view.plane.height_m
    images = *pair.bounded, live, view.plane_rows, np.ascontiguousarray(parts), np.cos(offset_rad)
    geometry = view.row0, FOCAL_PX, height_m, view.at_1m / FOCAL_PX, SEEN_M
    ramp_gains(*images, *geometry, STARTS_M, slopes, gains, upright)
    by_gain = 2 * RATIO / UNITS * PARTS  # nats. Every second direction was looked at.
    if by_gain * np.median(gains, axis=0).max() < LEAST_NATS:  # as nearly always
        return None
    # 2. Those of the best upright obstacle in the same rows of each part, from the farthest of a ramp to its start.
    sums = np.pad(np.cumsum(upright, axis=2), ((0, 0), (0, 0), (1, 0)))
    below_m = height_m + np.outer(STARTS_M, slopes)
    far = np.ceil(view.row0 + FOCAL_PX * (below_m / SEEN_M - slopes)).astype(int)
    near = np.floor(view.row0 + FOCAL_PX * height_m / STARTS_M).astype(int)[:, None]
    ends = (np.clip(rows, int(view.row0), view.height) for rows in (near + 1, far))
    things = np.subtract(*(sums[:, :, rows] for rows in ends)).max(axis=1)
    # 3. The likeliest, which most parts show.
    nats = by_gain * np.median(gains - np.maximum(things, 0), axis=0)
    x, s = np.unravel_index(nats.argmax(), nats.shape)
    if nats[x, s] < LEAST_NATS or slopes[s] >= TOO_STEEP[0]:
        return None
    way_rad = float(viewpoint[2])
    return Ramp(way_rad, float(STARTS_M[x]) + _along(viewpoint, way_rad), float(slopes[s]), float(nats[x, s]))


def _is_beyond(start_m: float, way_rad: float, ranges_m: Array) -> Flags:
    """Return whether places at ranges (N,) are beyond a line across a way (N, DIRECTIONS), in the rectified frame."""
    return np.asarray(np.outer(ranges_m, np.cos(AZIMUTHS - way_rad)) > start_m)


class RayScans:
    """Scans of a run by the rays of its pairs."""

    def __init__(self, cylinder: Cylinder, baseline_m: float, settings: ScanSettings) -> None:
        self._cylinder, self._baseline_m, self._settings = cylinder, baseline_m, settings
        self.grid = ObstacleGrid(FOCAL_PX * baseline_m, settings.max_range_m)
        # Tilt (2,) beyond what the rig states by all pairs, its covariance, and that of the tables.
        self._tilt, self._P, self._used = np.zeros(2), PRIOR_RAD**2 * np.eye(2), np.zeros(2)
        self._followed_ns: int | None = None  # stamp of the last pair by which tilt and ramps were followed
        self._ramp: Ramp | None = None
        self._way = np.column_stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS)])

    def set_floor(self, T_rect_base: Array, visible: Flags) -> None:
        """Set the floor by T_rect_base (4, 4), from the base level on it to the panoramas, and their pixels (H, W)."""
        self._T_rect_base, self._visible = T_rect_base, visible
        self._T_odom_floor = np.eye(4)  # pose of the base when it stood on the floor before a ramp
        self.grid.set_floor(T_rect_base)
        self._ramp = None
        self._floor = self._on_ramp = self._seen(floor_plane(T_rect_base), None)

    def begin_again(self) -> None:
        """Forget what is known in odom, as the way since then is not."""
        self.grid.begin_again()
        self._ramp = None

    def add(
        self, stamp_ns: int, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, lost: Flags | None
    ) -> GridScan | None:
        """Return the scan at a pair, whose base has the pose T_odom_base (4, 4); None: no floor is in view.

        lost (H, W): pixels that are no evidence, None: all in view are.
        """
        pose = planar(T_odom_base)
        viewpoint = self.grid.viewpoint(pose)
        turn_rad = math.atan2(self._T_rect_base[1, 0], self._T_rect_base[0, 0]) - viewpoint[2]
        # 1. The plane of the floor, and that of a ramp.
        start_m = math.inf if self._ramp is None else self._ramp.start_m(viewpoint)
        if start_m < -HALF_BASE_M:
            self._ramp, start_m = None, math.inf
        ramp, stands_level = self._ramp, start_m > HALF_BASE_M
        if stands_level:
            self._T_odom_floor = T_odom_base
        floor = floor_plane(self._T_rect_base @ se3.inverse(T_odom_base) @ self._T_odom_floor)
        floor = FloorPlane(floor.height_m, floor.a + float(self._used[0]), floor.b + float(self._used[1]))
        self._floor = self._seen(floor, self._floor)
        if not self._floor.shows_floor:
            return None
        # 2. What the pair shows on them.
        pair = self._floor.pair(lower, upper, lost)
        shown = self._floor.shown(pair)
        way_rad = 0.0
        if ramp is not None:
            way_rad = ramp.way_rad + turn_rad
            a, b = floor.a + ramp.slope * math.cos(way_rad), floor.b + ramp.slope * math.sin(way_rad)
            self._on_ramp = self._seen(FloorPlane(floor.height_m + ramp.slope * start_m, a, b), self._on_ramp)
            on_ramp = self._on_ramp.shown(self._on_ramp.pair(lower, upper, lost))
            where = _is_beyond(start_m, way_rad, self._floor.bins.ranges_m)
            near = np.where(where[0], on_ramp.near, shown.near)
            both = zip(shown, on_ramp, strict=True)
            shown = ShownBins(*(np.where(where if of.ndim > 1 else where[-1], theirs, of) for of, theirs in both))
            shown = shown._replace(near=near)  # what begins before the ramp stands on the floor
        # 3. The belief, with the look of floor that is known, and the grid.
        known = self.grid.is_floor(pose, self._floor.bins.ranges_m)
        belief = ray_belief(shown, self._floor.bins, pair.sensor_grey, known)
        scan = self.grid.update(stamp_ns, pose, belief)
        # 4. Tilt and ramps, for the next pair.
        is_due = self._followed_ns is None or not 0 <= stamp_ns - self._followed_ns < FOLLOWED_NS
        if stands_level and (is_due or np.diag(self._P).max() > SURE_RAD**2):
            self._observe_tilt(pose, pair, start_m, way_rad)
        if is_due:
            self._followed_ns = stamp_ns
        # A rig that leans along the way shows a slope everywhere on it.
        ahead = np.array([math.cos(viewpoint[2] + turn_rad), math.sin(viewpoint[2] + turn_rad)])
        if is_due and ahead @ self._P @ ahead < SURE_RAD**2 and start_m > FOUND_M:
            found = ramp_ahead(pair, self._floor, viewpoint, turn_rad, float(T_odom_base[2, 0]))
            # A nearer pair shows it better.
            if found is not None and (ramp is None or found.nats > ramp.nats):
                self._ramp = found
                if ramp is None:  # What was seen beyond its start was compared with another floor.
                    self.grid.forget_beyond(found.way_rad, found.offset_m)
        return scan

    def _observe_tilt(self, pose: Array, pair: WorkingPair, start_m: float, way_rad: float) -> None:
        """Take a pair into the filter of the tilt, by near floor that is known, before a ramp that begins along a way.

        pose (3,): of the base in odom.
        """
        self._P = self._P + DRIFT_RAD**2 * np.eye(2)
        view, height_m = self._floor, self._floor.plane.height_m
        ranges_m = FOCAL_PX * height_m / np.maximum(np.arange(view.height) - view.row0, 1e-6)
        rows = np.flatnonzero((ranges_m < LEAN_M) & (view.plane_rows < view.last_row - 2))
        known = self.grid.is_floor(pose, ranges_m[rows]) & pair.seen[rows]
        known &= ~_is_beyond(start_m, way_rad, ranges_m[rows])
        if not known.any():
            return
        # 1. Difference and gradient of both views on the plane.
        first = max(rows[0] - AROUND_ROWS, 0)
        parts = (image[first:] for image in (pair.lower, pair.upper))
        lower, upper = (part - cv2.blur(part, (1, AROUND_ROWS)) for part in parts)
        at = view.plane_rows[rows] - np.float32(first)
        above, share = np.floor(at).astype(int), (at % 1)[:, None]
        before, mine, after, beyond = (upper[above + row] for row in (-1, 0, 1, 2))
        gradient = (after - before) / 2 * (1 - share) + (beyond - mine) / 2 * share
        difference = lower[rows - first] - (mine * (1 - share) + after * share)
        # 2. Normal equations of the two slopes; single pixels that differ by much count little.
        sigma = max(MAD * float(np.median(np.abs(difference[known]))), 0.3)
        weight = known / (1.0 + (difference / (1.5 * sigma)) ** 2)
        squares, products = (weight * gradient * gradient).sum(0), (weight * gradient * difference).sum(0)
        # The gradient has noise of its own: without that share a plain floor would seem to measure something.
        textured = max(1.0 - float(weight.sum()) * sigma**2 / 4 / max(float(squares.sum()), 1e-6), 0.0)
        px_per_rad = FOCAL_PX * self._baseline_m / height_m
        scale = px_per_rad / (sigma * math.sqrt(CORRELATED))
        H = (scale * textured) ** 2 * np.einsum("u,ui,uj->ij", squares, self._way, self._way)
        y = scale**2 * textured / px_per_rad * (self._way.T @ products)
        # 3. The filter: information of the pair, about the tilt that its plane has.
        information = np.linalg.inv(self._P)
        self._P = np.linalg.inv(information + H)
        self._tilt = self._P @ (information @ self._tilt + H @ self._used + y)
        # 4. The tilt that is used.
        is_sure = np.diag(self._P) < SURE_RAD**2
        if np.abs((self._tilt - self._used)[is_sure]).max(initial=0.0) > LEAST_RAD:
            self._used = np.where(is_sure, self._tilt, self._used)

    def _seen(self, plane: FloorPlane, before: PlaneView | None) -> PlaneView:
        """Return the view of a plane, that of a plane before where it is about the same."""
        if before is not None:
            height_m, *slopes = np.abs(np.subtract(plane, before.plane))
            if height_m < LEAST_M and max(slopes) < LEAST_RAD:
                return before
        bins = None if before is None else before.bins
        return PlaneView(self._cylinder, self._baseline_m, plane, self._settings, self._visible, bins)
