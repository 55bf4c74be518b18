"""The grid of a run: what is known of cells of floor around the base, by the rays of all pairs.

Cells of 5 cm, in the axes of odom and around the cell of the base, hold the log-odds L of an obstacle there (upright,
hanging, or a step), and whether they are known.
1. Evidence of a pair: e = r log [q / (1 - q)] / [q_0 / (1 - q_0)] of each bin, q the probability that the first
   obstacle is there where the ray comes with the probability r; q_0 its prior. So the prior of the rays counts once.
2. Errors of pairs from one place are correlated, by rho, which falls to 0 over 5 cm of way. Of a pair
   counts what is new: L += e - rho e', e' that of the pair before. L forgets by (1 - rho) / n, as more than n views of
   a place are no more. What hangs over floor in view shows a surface in half of the pairs: the mean of what single
   pairs show, over 25 cm, has log-odds of its own.
3. Hidden Markov prediction: an obstacle comes into a cell with a small probability in each pair, so L has a lower
   bound; and unobserved cells may be entered from unknown ones, at 1.6 m/s by a person, 25 cm wide.
4. Too near to be seen: known by what is seen past a cell. What hides the nearest floor in view may be anywhere
   before it, unless an obstacle is known there. It has left when a base at rest sees that floor again.
5. Arrivals: the first obstacle of a direction, where the floor was free a short while ago.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles import ray_kernels as kernels
from omnid.core.obstacles.moving_tracker import Arrivals, runs
from omnid.core.obstacles.plane_view import AZIMUTHS
from omnid.core.obstacles.posterior import RISK, RayBelief

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Rays = Indices  # (REACH_CELLS, SECTORS) of cells along the sectors in a flat grid


@dataclass(frozen=True, slots=True)
class GridParameters:
    """The grid of cells; log-odds in nats."""

    prior: float = -4.6  # of an obstacle in a cell
    floor: float = -7.0  # of a cell by whose look floor is known
    least: float = -9.0  # least log-odds, as an obstacle may come into each cell in each pair
    most: float = 6.0
    views: float = 3.0  # n: views of a place that count
    same_place: float = 0.9  # rho: correlation of the errors of pairs from one place, 0 after the way of a cell
    walk_mps: float = 1.6  # of who may come where nobody sees
    person_cells: int = 5  # width of who may
    rest_m: float = 0.01  # by which a base at rest seems to move; half and twice as much change nothing
    outline_cells: int = 2  # around what has left, by which rays are wider than its outline
    strut_rad: float = 0.26  # widest part of the view that a strut or a mast hides
    person_rad: float = 0.65  # angle of a person nearer than the floor in view: 0.4 m at 0.6 m
    wall_rad: float = 0.5  # least half of the angle that a wall hides which is too near to be seen
    wall_gap: int = 27  # directions of it in which floor seems to be in view,
    wall_end: int = 16  # and beside its ends, where it is in view
    wall_m: float = 0.2  # by which its foot is farther there than expected, at most
    wall_nats: float = 2.0  # log-odds of a wall that is assumed
    arrival_nats: float = 2.0  # by which one pair shows an obstacle that has come [nats]
    lately_s: float = 3.0  # for how long it counts that a cell was free
    arrival_m: float = 0.2  # least width of what has come,
    behind_m: float = 0.15  # and of floor that was free behind its front, beside three sigmas of a disparity
    near_sigma: float = 0.3  # of the range of what hides the nearest floor in view, as a share
    surface_rate: float = 0.15  # of the mean of what single pairs show of something that hangs
    hanging_most: float = 0.3  # most of it, by which it is an obstacle; more would only be forgotten later
    hanging_least: float = 0.08  # mean from which something hangs there,
    hanging_weight: float = 30.0  # and its log-odds by this mean
    arrival_surface: float = 0.07  # mean from which something that hangs has come onto floor that was free


CELL_M: Final = kernels.CELL_M
REACH_CELLS: Final = 90  # of the grid, on either side of the cell of the base
SIDE: Final = 2 * REACH_CELLS + 1
STEPS_M: Final = CELL_M * (np.arange(REACH_CELLS) + 0.5)  # ranges of cells along a ray
OWN: Final = slice(REACH_CELLS - 3, REACH_CELLS + 4)  # cells that nothing but the base can be in
CROSS: Final = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SQUARE: Final = np.ones((3, 3), np.uint8)
SPECK_CELLS: Final = 4
OPEN_SHARE: Final = 0.9  # of the longest range, from which on a direction is open: few pairs show the last cells


UNKNOWN, FREE, OCCUPIED = 0, 1, 2  # states of a cell


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """What is known of the floor around the base, in cells in the axes of odom; row 0 has the lowest y.

    The base is in the cell (REACH_CELLS, REACH_CELLS). Cells move with it, and what comes into the grid is unknown.
    """

    corner_m: Array  # (2,) outer corner of the first cell in odom, x and y
    occupied: Floats  # (SIDE, SIDE) probability of an obstacle (upright, hanging, a step); NaN: unknown

    @property
    def states(self) -> Bytes:
        """State of each cell (SIDE, SIDE): OCCUPIED, FREE up to the risk of a free way, else UNKNOWN."""
        states = np.full(self.occupied.shape, UNKNOWN, np.uint8)
        states[self.occupied <= RISK] = FREE
        states[self.occupied > 0.5] = OCCUPIED
        return states

    def at(self, points_m: Array) -> tuple[Indices, Indices]:
        """Return rows and columns (N,) of the cells of points (N, 2) in odom; outside of 0 to SIDE: not in the grid."""
        column, row = np.floor((points_m - self.corner_m) / CELL_M).astype(np.intp).T
        return row, column


class GridScan(NamedTuple):
    """Nearest obstacles and free floor around the base, by sectors about its origin from -pi on."""

    ranges_m: Floats  # (SECTORS,) first obstacle; inf: floor up to the longest range; NaN: unknown
    sigma_m: Floats  # (SECTORS,) of the ranges
    free_m: Floats  # (SECTORS,) up to which the way is free
    arrivals: Arrivals  # of this pair, about the viewpoint
    grid: FloorGrid


class ObstacleGrid:
    """Cells (SIDE, SIDE) around that of the base, with which they move; row 0 at the lowest y."""

    def __init__(self, at_1m: float, max_range_m: float) -> None:
        self._p, self._at_1m = GridParameters(), at_1m
        self._max_range_m = min(max_range_m, REACH_CELLS * CELL_M)
        self._eye_base, self._turn_rad = np.zeros(2), 0.0  # viewpoint in base axes, and angle of these to the columns'
        self._cell: NDArray[np.int64] | None = None  # of the base, in odom
        # Viewpoint in cells of the grid, the nearest floor in view, and ranges (SIDE, SIDE) of cells.
        self._eye, self._near_m, self._ranges_m = np.zeros(2), 0.0, np.zeros((SIDE, SIDE), np.float32)
        self._forget()

    def viewpoint(self, pose: Array) -> Array:
        """Return the viewpoint (x, y) with the heading of the base, by the pose (3,) of the base in odom."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        return np.append(pose[:2] + np.array([[c, -s], [s, c]]) @ self._eye_base, pose[2])

    def set_floor(self, T_rect_base: Array) -> None:
        """Set the floor by T_rect_base (4, 4), from the base level on the floor to the columns."""
        self._eye_base = se3.inverse(T_rect_base)[:2, 3]
        self._turn_rad = math.atan2(T_rect_base[1, 0], T_rect_base[0, 0])

    def begin_again(self) -> None:
        """Forget what is known, as the way since then is not, but for obstacles nearer than the floor in view.

        No pair would show these again, and a base whose odometry is lost stops, so that they are still about there.
        """
        if self._cell is None:
            return
        cell, odds = self._cell, self.odds
        kept = (self._ranges_m < self._near_m) & (odds > 0)
        self._forget()
        self.odds[kept], self._known[kept], self._cell = odds[kept], 1, cell

    def forget_beyond(self, way_rad: float, offset_m: float) -> None:
        """Forget the cells beyond a line across a way: azimuth of the way in odom, and offset of the line along it."""
        if self._cell is None:
            return
        y, x = CELL_M * (np.indices((SIDE, SIDE)) + 0.5 + (self._cell - REACH_CELLS)[::-1, None, None])
        self._layers[:, x * math.cos(way_rad) + y * math.sin(way_rad) > offset_m] = self._empty[:, None]

    def _forget(self) -> None:
        """Forget everything."""
        self._empty = np.array([self._p.prior, 0, 0, 0, 0, 0, np.inf, 0], np.float32)
        self._layers = np.tile(self._empty[:, None, None], (1, SIDE, SIDE))
        # Log-odds of an obstacle; evidence of the pair before; mean of what single pairs show; whether a cell is known;
        # views past it; whether the last pair saw floor behind it; time [s] since it was free; views in which
        # it hid the nearest floor from this place, less those past it.
        self.odds, self._before, self._surface, self._known, *others = self._layers
        self._past_views, self._was_past, self._free_s, self._hiding = others
        self._cell = None
        self._last: tuple[int, Array] | None = None  # stamp and place [m] of the pair before
        self._carry, self._rest_m = 0.0, np.full(2, np.inf)

    def update(self, stamp_ns: int, pose: Array, belief: RayBelief) -> GridScan:
        """Add a pair, whose base has the pose (3,) in odom; return what is known."""
        p, place_m, yaw = self._p, pose[:2].copy(), float(pose[2])
        passed_s, way_m = 0.0, math.inf
        if self._last is not None:
            passed_s, way_m = max(stamp_ns - self._last[0], 0) * 1e-9, math.dist(place_m, self._last[1])
        is_first, self._last = self._last is None, (stamp_ns, place_m)
        rho = p.same_place * max(1.0 - way_m / CELL_M, 0.0)
        self._follow(place_m)
        self._eye, self._near_m = self._in_cells(self.viewpoint(pose)[:2]), float(belief.ends_m[0])
        # 1. Evidence and state of each cell, by its range and direction from the viewpoint.
        x, y = np.arange(SIDE, dtype=np.float32) + np.float32(0.5) - self._eye[:, None].astype(np.float32)
        count, self._ranges_m = len(belief.first), np.hypot(x, y[:, None]) * np.float32(CELL_M)
        columns = ((math.pi - self._turn_rad + yaw) - np.arctan2(y[:, None], x)) * (count / math.tau) - 0.5
        found, states = np.empty((3, SIDE, SIDE), np.float32), np.empty((SIDE, SIDE), np.uint8)
        hides = self._hides(belief)
        near = np.where(belief.view[:, 0] > 0, np.where(hides, 2, 1), 0).astype(np.uint8)
        of_belief = belief.ratios, belief.view, belief.surface, near, belief.ends_m
        reach_m = min(float(belief.ends_m[-2]), self._max_range_m)
        kernels.gather(*of_belief, self._ranges_m, columns, reach_m, found, states)
        in_view, past, hidden = (states == one for one in (kernels.IN_VIEW, kernels.SEEN_PAST, kernels.HIDDEN))
        observed = in_view & (found[kernels.VIEW] > 0.5)
        # 2. What is new of it.
        keep, change = 1 - (1 - rho) / p.views, found[kernels.RATIO] - np.float32(rho) * self._before
        updated = np.clip(p.prior + np.float32(keep) * (self.odds - p.prior) + change, p.least, p.most)
        self.odds[:] = np.where(in_view, updated, self.odds)
        self._before[:] = np.where(in_view, found[kernels.RATIO], 0)
        surface = np.float32(p.surface_rate * (1 - rho)) * (found[kernels.SURFACE] - self._surface)
        self._surface[:] = np.minimum(self._surface + np.where(in_view, surface, 0), np.float32(p.hanging_most))
        # 3. What is known: seen, or seen past. What was hidden from the start may look like floor in some pairs: it is
        #    known after so many more views past it.
        self._past_views[past] += np.float32(1 - rho)
        self._past_views[observed] = p.views
        is_doubted = hidden & (self._past_views < p.views)
        self._past_views[is_doubted] = np.maximum(self._past_views[is_doubted] - p.views * (1 - rho), 0)
        self._known[observed | (past & (self._past_views >= p.views))] = 1
        if is_first:
            self._assume_free(columns, hides, belief)
            self._assume_walls(yaw, hides, belief)
        self._release(place_m, hidden, past, np.float32(1 - rho))
        # 4. What hides the nearest floor in view, behind which floor was seen before, may be anywhere before it. What
        #    hides it from the start may be where it was. And somebody may come where no pair shows the floor.
        rays, things = _along(self._eye, yaw), self._things()
        possible = self._hidden_before(hidden, rays, things)
        if not is_first:
            visible = observed | past | (states == kernels.MOSTLY_PAST) | (hidden & (self._known > 0))
            self._spread_unknown(passed_s, visible)
        self._was_past[:] = past
        self._known[possible > 0] = 0
        # 5. What has come, and the scan.
        occupied = np.where((self._known > 0) | (self.odds > 0), things, np.float32(2))
        arrivals = self._arrivals(passed_s, rays, occupied, in_view & (found[kernels.RATIO] > p.arrival_nats), possible)
        self.odds[OWN, OWN], self._known[OWN, OWN], self._surface[OWN, OWN], occupied[OWN, OWN] = p.least, 1, 0, 0
        assert self._cell is not None
        cells = np.where(occupied > 1, np.float32(np.nan), occupied)
        grid = FloorGrid(np.asarray(CELL_M * (self._cell - REACH_CELLS), float), cells)
        return GridScan(*self._ways(occupied, self._in_cells(place_m), yaw), arrivals, grid)

    def is_floor(self, pose: Array, ranges_m: Array) -> Flags:
        """Return the bins (N, DIRECTIONS) about the viewpoint, at ranges (N,), whose cells are floor by all pairs.

        pose (3,): of the base in odom.
        """
        if self._cell is None or not len(ranges_m):
            return np.zeros((len(ranges_m), len(AZIMUTHS)), bool)
        azimuths_rad = AZIMUTHS - self._turn_rad + pose[2]
        unit = np.stack([np.cos(azimuths_rad), np.sin(azimuths_rad)]) / CELL_M
        # OpenCV has integers at the middles of cells.
        at = (self._in_cells(self.viewpoint(pose)[:2]) - 0.5)[:, None, None] + ranges_m[:, None] * unit[:, None]
        x, y = np.asarray(at, np.float32)
        floor = ((self._known > 0) & (self.odds < self._p.floor)).view(np.uint8)
        return np.asarray(cv2.remap(floor, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0)

    def _ways(self, cells: Floats, place: Array, yaw_rad: float) -> tuple[Floats, Floats, Floats]:
        """Return the range of the first obstacle from a place [cells] in each sector, its sigma, and the free way [m].

        cells (SIDE, SIDE): probability of an obstacle, 2 where nothing is known.
        """
        count = round(self._max_range_m / CELL_M)
        ranges_m, steps = STEPS_M[:count], np.arange(count)[:, None]
        occupied = cells.take(_along(place, yaw_rad)[:count]).astype(float)
        # 1. Free is up to where the probability of an obstacle on the way is at most the risk.
        has_ended = 1 - np.cumprod(1 - np.minimum(occupied, 1), axis=0) > RISK
        free_m = np.where(has_ended.any(axis=0), has_ended.argmax(axis=0) * CELL_M, self._max_range_m)
        # 2. The first cells in a row in which an obstacle is more likely than not.
        is_thing = (occupied > 0.5) & (occupied <= 1)
        is_beyond = ~is_thing & (steps >= is_thing.argmax(axis=0))
        end = np.where(is_beyond.any(axis=0), is_beyond.argmax(axis=0), count)
        weight = np.where(is_thing & (steps < end), occupied, 0.0)
        total = weight.sum(axis=0)
        with np.errstate(invalid="ignore"):
            hit_m = ranges_m @ weight / total
            variance = (weight * (ranges_m[:, None] - hit_m) ** 2).sum(axis=0) / total
        free_m = np.minimum(free_m, np.nan_to_num(hit_m, nan=np.inf))
        hit_m[np.isnan(hit_m) & (free_m >= OPEN_SHARE * self._max_range_m)] = np.inf
        sigma_m = np.sqrt(variance + CELL_M**2 / 12)
        return hit_m.astype(np.float32), sigma_m.astype(np.float32), free_m.astype(np.float32)

    def _hidden_before(self, hidden: Flags, rays: Rays, things: Floats) -> Bytes:
        """Return the cells (1) before the nearest floor in view, hidden (SIDE, SIDE) where it was seen, of ways on
        which nothing is known that hides it; rays: of the viewpoint, things (SIDE, SIDE): their probability."""
        possible = np.zeros((SIDE, SIDE), np.uint8)
        candidates = hidden & (self._was_past > 0)
        if not candidates.any():
            return possible
        hides = (things > 0.3) & ((self._known > 0) | (self.odds > 0))
        explained = hides.take(rays[self._near_m + 3 * CELL_M > STEPS_M]).any(axis=0)
        explained = np.any([np.roll(explained, shift) for shift in range(-2, 3)], axis=0)
        before = rays[self._near_m > STEPS_M][:, ~explained]
        possible.flat[before] = candidates.take(before)
        return _without_specks(possible)

    def _release(self, place_m: Array, hidden: Flags, past: Flags, views: np.float32) -> None:
        """Release cells (SIDE, SIDE) that hid the nearest floor in view, where a base at rest sees that floor again.

        So a person or a trolley that was too near to be seen has left. A base that drives learns nothing of it: a low
        box hides that floor on the way, and no longer when the base is near. place_m (2,): of the base. views: by which
        the pair counts.
        """
        p, hiding = self._p, self._hiding
        # 1. Views from this place: hidden ones count twice, and after p.views of them as many past it are needed.
        if math.dist(place_m, self._rest_m) > p.rest_m:
            self._rest_m, hiding[:] = place_m, 0
        hiding += np.where(hidden, 2 * views, np.where(past, -views, 0))
        has_left = past & (hiding < p.views) & (hiding + views >= p.views)
        # 2. What has left takes the cells around its outline along.
        if has_left.any():
            around = cv2.dilate(has_left.view(np.uint8), SQUARE, iterations=p.outline_cells) > 0
            released = around & past & (self._things() > 1 / (1 + math.exp(-p.prior)))
            self.odds[released], self._surface[released], hiding[released] = p.floor, 0, 0
        hiding[hidden & (hiding >= p.views)] = 2 * p.views
        np.maximum(hiding, -p.views, out=hiding)

    def _arrivals(self, passed_s: float, rays: Rays, occupied: Floats, shows: Flags, possible: Bytes) -> Arrivals:
        """Return what has come onto floor that was free a short while ago.

        rays: of the viewpoint; occupied (SIDE, SIDE): of an obstacle; shows: this pair shows one; possible: 1
        where one may that hides the nearest floor.
        """
        p = self._p
        self._free_s += np.float32(passed_s)
        lately = self._free_s < p.lately_s
        self._free_s[occupied < 1 / (1 + math.exp(-p.prior))] = 0
        # What has come is wider than a speck of noise.
        around, is_most = self._hanging()
        arrived = ((occupied > 0.5) & (occupied <= 1)) | (possible > 0) | ((around > p.arrival_surface) & is_most)
        arrived |= cv2.morphologyEx(shows.view(np.uint8), cv2.MORPH_OPEN, SQUARE) > 0
        # The first one of each direction, before floor that was free, by the noise of stereo and more.
        found, ranges_m = arrived.take(rays), np.full(SECTORS, np.nan)
        sectors = np.flatnonzero(found.any(axis=0))
        first = found[:, sectors].argmax(axis=0)
        end = first + np.ceil((p.behind_m + 1.5 * STEPS_M[first] ** 2 / self._at_1m) / CELL_M).astype(np.intp)
        steps, was_free = np.arange(REACH_CELLS)[:, None], lately.take(rays[:, sectors])
        is_behind_free = (was_free | (steps < first) | (steps >= end)).all(axis=0) & (end <= REACH_CELLS)
        ranges_m[sectors[is_behind_free]] = STEPS_M[first[is_behind_free]]
        for run in runs(np.isfinite(ranges_m)):
            # Who hides the nearest floor in view stands next to the base.
            range_m = float(ranges_m[run].mean())
            least_rad = p.arrival_m / range_m if range_m > self._near_m else p.person_rad
            if len(run) * math.tau / SECTORS < least_rad:
                ranges_m[run] = np.nan
        is_nearer = ranges_m < self._near_m
        sigma_m = np.where(is_nearer, p.near_sigma * self._near_m, 0.5 * ranges_m**2 / self._at_1m)
        ranges_m[is_nearer] = self._near_m
        return Arrivals(ranges_m.astype(np.float32), sigma_m.astype(np.float32), is_nearer)

    def _assume_free(self, columns: Floats, hides: Flags, belief: RayBelief) -> None:
        """Assume at the start that floor too near to be seen is free, except where something hides the nearest in view.

        That may be anywhere before the floor that it hides. Nothing is assumed where no floor is in view, in wider
        directions than a strut or a mast hides. columns (SIDE, SIDE): directions of cells; hides (D,).
        """
        p, count = self._p, len(hides)
        reach_m = np.where(hides, 0.0, self._near_m + 2 * CELL_M)
        for run in runs(belief.view[:, 0] <= 0):
            if len(run) * math.tau / count >= p.strut_rad:
                reach_m[run] = 0.0
        reach_m = np.min([np.roll(reach_m, shift) for shift in range(-3, 4)], axis=0)
        free = self._ranges_m < reach_m[np.floor(columns + 0.5).astype(np.intp) % count]
        self._known[free], self._past_views[free] = 1, p.views
        self.odds[free & (self.odds < 0)] = p.least

    def _assume_walls(self, yaw_rad: float, hides: Flags, belief: RayBelief) -> None:
        """Assume walls: what hides the nearest floor in view at the start, where a straight wall goes on at both ends.

        So a base may begin between walls that are nearer than the floor in view. Beside what stands alone the floor
        goes on, and what ends it there is too far away to hide any. hides (D,).
        """
        p, count = self._p, len(hides)
        ranges_m = belief.ends_m[belief.first[:, :-1].argmax(axis=1)]
        ranges_m[belief.first[:, -1] > 0.5] = np.inf
        for run in runs(hides, p.wall_gap):
            # 1. The wall that hides just these directions, and the range of its foot beside them.
            half_rad = 0.5 * ((run[-1] - run[0]) % count + 1) * (math.tau / count)
            beside_rad = half_rad + 0.5 * p.wall_end * (math.tau / count)
            if half_rad < p.wall_rad or beside_rad >= math.pi / 2:
                continue
            foot_m = self._near_m * math.cos(half_rad) / math.cos(beside_rad)
            # 2. What is seen there: the lower quartile, as plain walls look like floor in some directions.
            beside = np.array([run[0] - 1 - np.arange(p.wall_end), run[-1] + 1 + np.arange(p.wall_end)])
            ends_m = np.quantile(ranges_m[beside % count], 0.25, axis=1, method="lower")
            if ends_m.max() > foot_m + p.wall_m:
                continue
            azimuths = math.pi - self._turn_rad + yaw_rad - (beside.mean(axis=1) + 0.5) * (math.tau / count)
            ends = foot_m * np.column_stack([np.cos(azimuths), np.sin(azimuths)])
            corners = np.floor(self._eye + np.vstack([np.zeros(2), ends / CELL_M])).astype(np.int32)
            before, wall = np.zeros((2, SIDE, SIDE), np.uint8)
            cv2.fillConvexPoly(before, corners, 1)
            cv2.line(wall, corners[1].tolist(), corners[2].tolist(), 1)
            is_free, is_wall = (before > 0) & (self.odds < 0), wall > 0
            self._known[is_free | is_wall], self._past_views[is_free] = 1, p.views
            self.odds[is_free], self.odds[is_wall] = p.least, np.maximum(self.odds[is_wall], p.wall_nats)

    def _hides(self, belief: RayBelief) -> Flags:
        """Return the directions (D,) in which the nearest floor in view is hidden."""
        bins = int(np.searchsorted(belief.ends_m, belief.ends_m[0] + CELL_M))
        hidden = belief.first[:, :bins].sum(axis=1)
        three = (np.roll(hidden, 1) + hidden + np.roll(hidden, -1)) / 3
        return np.asarray((three > 0.5) & (belief.view[:, 0] > 0))

    def _things(self) -> Floats:
        """Return the probability of an obstacle in cells (SIDE, SIDE), also where nothing is known."""
        p, (around, is_most) = self._p, self._hanging()
        hanging = np.clip(p.hanging_weight * (around - p.hanging_least), -9.0, 6.0) + np.float32(p.prior)
        hanging[~is_most] = p.least
        return np.asarray(1 / (1 + np.exp(-np.maximum(self.odds, hanging))), np.float32)

    def _hanging(self) -> tuple[Floats, Flags]:
        """Return the mean surface (SIDE, SIDE) that pairs show around cells, and the cells that show at least as much:
        what hangs is there."""
        around = np.asarray(cv2.blur(self._surface, (5, 5)), np.float32)
        return around, self._surface >= around

    def _spread_unknown(self, passed_s: float, visible: Flags) -> None:
        """Spread what is not known through cells that nobody sees."""
        p = self._p
        self._carry += p.walk_mps * passed_s / CELL_M
        steps = int(self._carry)
        self._carry -= steps
        person = np.ones((p.person_cells, p.person_cells), np.uint8)
        wide = np.asarray(
            cv2.morphologyEx((~visible & (self.odds <= 0)).view(np.uint8), cv2.MORPH_OPEN, person), np.uint8
        )
        source = wide & (self._known == 0)
        for step in range(min(steps, SIDE)):
            source = np.asarray(cv2.dilate(source, CROSS if step % 2 else SQUARE), np.uint8) & wide
        self._known[source > 0] = 0

    def _follow(self, place_m: Array) -> None:
        """Move the cells along with the base; those that come into the grid are unknown."""
        cell = np.floor(place_m / CELL_M).astype(np.int64)
        x, y = np.clip(cell - cell if self._cell is None else cell - self._cell, -SIDE, SIDE).tolist()
        self._cell = cell
        if x or y:
            self._layers[:] = np.roll(self._layers, (-y, -x), axis=(1, 2))
            new = np.ones((SIDE, SIDE), bool)
            new[max(-y, 0) : SIDE - max(y, 0), max(-x, 0) : SIDE - max(x, 0)] = False
            self._layers[:, new] = self._empty[:, None]

    def _in_cells(self, place_m: Array) -> Array:
        """Return a place (2,) in odom in cells of the grid."""
        assert self._cell is not None
        return np.asarray(place_m / CELL_M - self._cell + REACH_CELLS)


def _along(place: Array, yaw_rad: float) -> Rays:
    """Return the cells along the sectors, from a place [cells], a cell apart."""
    angle, steps = azimuths() + yaw_rad, STEPS_M / CELL_M
    x, y = (np.floor(at + np.outer(steps, of(angle))) for at, of in zip(place, (np.cos, np.sin), strict=True))
    return np.asarray(np.clip(y, 0, SIDE - 1) * SIDE + np.clip(x, 0, SIDE - 1), np.intp)


def _without_specks(flags: Bytes) -> Bytes:
    """Return flags (H, W) without patches of few cells, as what hides floor from the viewpoint hides a long way."""
    if not flags.any():
        return flags
    _, labels, of_patch, _ = cv2.connectedComponentsWithStats(flags)
    is_kept = of_patch[:, cv2.CC_STAT_AREA] > SPECK_CELLS
    is_kept[0] = False
    return np.asarray(is_kept[labels], np.uint8)
