"""The grid of a run: what is known of cells of floor around the base, by the rays of all pairs.

Cells of 5 cm in odom hold the log-odds L of a thing that stands, hangs or steps there, and whether they are known.
1. Evidence of a pair: e = r log [q / (1 - q)] / [q_0 / (1 - q_0)] of each bin, q the probability that the first thing
   is there where the ray comes with the probability r; q_0 its prior. So the prior of the rays does not count twice.
2. Errors of pairs from one place are alike: noise with the correlation rho, that falls to 0 over 5 cm of way. Of a pair
   counts what is new: L += e - rho e', e' that of the pair before. L forgets by (1 - rho) / n, as more than n views of
   a place are no more. What hangs over floor in view shows a surface in half of the pairs: the mean of what single
   pairs show, over 25 cm, has log-odds of its own.
3. Hidden Markov prediction: something comes into a cell with a small probability in each pair, so L has a lower bound;
   and what nobody sees may be entered from where nothing is known, at 1.6 m/s by a person, 25 cm wide.
4. Too near to be seen: known by what is seen past a cell. What hides the nearest floor in view may stand anywhere
   before it, unless something is known there.
5. Who comes: the first thing of a direction, where the floor was free a short while ago.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles import grid_kernels as kernels
from omnid.core.obstacles.moving_tracker import Arrivals
from omnid.core.obstacles.parameters import GridParameters
from omnid.core.obstacles.posterior import RayBelief

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

CELL_M: Final = 0.05
CELLS: Final = 256
REACH_CELLS: Final = 90  # on either side of the base: what a pair changes, and how far the ring goes
MARGIN_CELLS: Final = REACH_CELLS + 2  # nearer to the border than this, the square is moved
OWN_CELLS: Final = 3  # on either side of the base that nothing else can be in
CROSS: Final = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SQUARE: Final = np.ones((3, 3), np.uint8)
NEVER_NS: Final = -(1 << 62)
SPECK_CELLS: Final = 4
OPEN_SHARE: Final = 0.9  # of the longest range, from which on a direction is open: few pairs show the last cells


class GridRing(NamedTuple):
    """Nearest things and free floor around the base, by sectors about its origin from -pi on."""

    ranges_m: Floats  # (SECTORS,) first thing; inf: floor up to the longest range; NaN: unknown
    sigma_m: Floats  # (SECTORS,) of the ranges
    free_m: Floats  # (SECTORS,) up to which the way is free
    arrivals: Arrivals  # of this pair, about the viewpoint


def unknown_ring() -> GridRing:
    """Return the ring of a pair that shows no floor."""
    nan = np.full(SECTORS, np.nan, np.float32)
    return GridRing(nan, nan, np.zeros(SECTORS, np.float32), Arrivals(nan, nan, np.zeros(SECTORS, bool)))


class ObstacleGrid:
    """Log-odds of cells, in a square that follows the base."""

    def __init__(self, at_1m: float, max_range_m: float, parameters: GridParameters) -> None:
        self._p, self._at_1m = parameters, at_1m
        self._max_range_m = min(max_range_m, REACH_CELLS * CELL_M)
        self._azimuths = azimuths()
        self._T_rect_base = np.eye(4)
        self._corner: NDArray[np.int64] | None = None  # of the square, in cells of odom
        self._eye_m, self._near_m = np.zeros(2), 0.0  # viewpoint in odom, and the nearest floor in view
        self._forget()

    def viewpoint(self, T_odom_base: Array) -> Array:
        """Return the pose (4, 4) of axes parallel to the base's at the viewpoint."""
        T = np.eye(4)
        T[:2, 3] = self._T_base_rect[:2, 3]
        return np.asarray(T_odom_base @ T)

    def set_floor(self, T_rect_base: Array) -> None:
        """Take T_rect_base (4, 4), from the base level on the floor to the columns."""
        self._T_rect_base = T_rect_base

    def begin_again(self) -> None:
        """Forget what is known, as the way since then is not, but for things nearer than the floor in view.

        No pair would show these again, and a base whose odometry is lost stops, so that they are still about there.
        """
        if self._corner is None:
            return
        odds, corner, eye = self.odds, self._corner, self._eye_m / CELL_M
        y, x = np.indices((CELLS, CELLS)) + 0.5
        kept = (np.hypot(x + corner[0] - eye[0], y + corner[1] - eye[1]) * CELL_M < self._near_m) & (odds > 0)
        self._forget()
        self.odds[kept], self.known[kept], self._corner = odds[kept], 1, corner

    def _forget(self) -> None:
        """Forget everything."""
        self.odds = np.full((CELLS, CELLS), self._p.prior, np.float32)
        self._before = np.zeros((CELLS, CELLS), np.float32)
        self._shown = np.zeros((CELLS, CELLS), np.float32)
        self._free_ns = np.full((CELLS, CELLS), NEVER_NS, np.int64)
        self._past_views = np.zeros((CELLS, CELLS), np.float32)
        self.known = np.zeros((CELLS, CELLS), np.uint8)
        self._floor_was_behind = np.zeros((CELLS, CELLS), np.uint8)
        self._corner = None
        self._place_m: Array | None = None
        self._last_ns: int | None = None
        self._carry = 0.0

    def update(self, stamp_ns: int, T_odom_base: Array, belief: RayBelief) -> GridRing:
        """Add a pair, whose base has the planar pose T_odom_base (4, 4); return what is known."""
        p = self._p
        is_first = self._last_ns is None
        passed_s = 0.0 if self._last_ns is None else max(stamp_ns - self._last_ns, 0) * 1e-9
        self._last_ns = stamp_ns
        place = T_odom_base[:2, 3] / CELL_M
        corner = self._follow(place)
        at = np.floor(place).astype(np.int64) - corner
        rows, columns = (slice(int(n) - REACH_CELLS, int(n) + REACH_CELLS + 1) for n in (at[1], at[0]))
        way_m = math.inf if self._place_m is None else math.dist(T_odom_base[:2, 3], self._place_m)
        self._place_m = T_odom_base[:2, 3].copy()
        rho = p.same_place * max(1.0 - way_m / p.apart_m, 0.0)
        # 1. Evidence and state of each cell.
        first_m = np.asarray(CELL_M * (corner + (columns.start, rows.start) + 0.5), float)
        found, states = self._gathered(T_odom_base, first_m, belief)
        in_view, past = states == kernels.IN_VIEW, states == kernels.SEEN_PAST
        observed = in_view & (found[kernels.VIEW] > 0.5)
        # 2. What is new of it.
        odds, before = self.odds[rows, columns], self._before[rows, columns]
        change = found[kernels.RATIO] - np.float32(rho) * before
        keep = np.float32(1 - (1 - rho) / p.views)
        updated = np.clip(p.prior + keep * (odds - p.prior) + change, p.arrival, p.most)
        odds[in_view] = updated[in_view]
        self._before[:] = 0
        self._before[rows, columns] = np.where(in_view, found[kernels.RATIO], 0)
        shown = cv2.blur(found[kernels.SURFACE], (5, 5))
        self._shown[rows, columns] += np.where(
            in_view, np.float32(p.shown_rate * (1 - rho)) * (shown - self._shown[rows, columns]), 0
        )
        # 3. What is known: seen, or seen past; who comes where nobody sees.
        every = np.zeros((CELLS, CELLS), np.uint8)
        every[rows, columns] = states
        watched = np.zeros((CELLS, CELLS), np.uint8)
        watched[rows, columns] = observed | past | (states == kernels.MOSTLY_PAST)
        known = self.known[rows, columns]
        known[observed] = 1
        # What was hidden from the start may look like floor in some pairs: it is known after so many views past it.
        past_views = self._past_views[rows, columns]
        past_views[past] += np.float32(1 - rho)
        past_views[observed] = p.views
        past_views[(states == kernels.HIDDEN) & (past_views < p.views)] = 0.0
        known[past & (past_views >= p.views)] = 1
        self._eye_m, self._near_m = self.viewpoint(T_odom_base)[:2, 3], float(belief.ends_m[0])
        eye = self._eye_m / CELL_M - corner
        yaw = float(se3.yaw(T_odom_base))
        if is_first:
            self._assume_free(eye, yaw, belief)
        # 4. What hides the nearest floor in view, behind which floor was seen before, may stand anywhere before it.
        #    What hides it from the start may stand where it did.
        flooded = np.zeros((CELLS, CELLS), np.uint8)
        kernels.too_near(self._taken(), every, flooded, np.array([*eye, CELL_M]), self._azimuths + yaw, self._near_m)
        flooded = _without_specks(flooded & self._floor_was_behind)
        watched |= ((every == kernels.HIDDEN) & (self.known > 0)).view(np.uint8)
        if not is_first:
            self._who_comes(passed_s, watched)
        self._floor_was_behind[:] = every == kernels.SEEN_PAST
        self.known[flooded > 0] = 0
        # 5. Who has come, and the ring.
        shows = np.zeros((CELLS, CELLS), np.uint8)
        shows[rows, columns] = in_view & (found[kernels.RATIO] > p.comes)
        arrivals = self._arrivals(stamp_ns, eye, yaw, shows, flooded)
        own_rows, own_columns = (slice(int(n) - OWN_CELLS, int(n) + OWN_CELLS + 1) for n in (at[1], at[0]))
        for layer, value in ((self.odds, p.arrival), (self.known, 1), (self._shown, 0.0)):
            layer[own_rows, own_columns] = value
        hit, sigma, free = np.empty((3, len(self._azimuths)))
        view = np.array([*(place - corner), self._max_range_m, CELL_M])
        kernels.ways(self._taken(), view, self._azimuths + yaw, p.risk, hit, sigma, free)
        free = np.minimum(free, np.nan_to_num(hit, nan=np.inf))
        hit[np.isnan(hit) & (free >= OPEN_SHARE * self._max_range_m)] = np.inf
        return GridRing(hit.astype(np.float32), sigma.astype(np.float32), free.astype(np.float32), arrivals)

    def _arrivals(self, stamp_ns: int, eye: Array, yaw_rad: float, shows: Bytes, flooded: Bytes) -> Arrivals:
        """Return who has come onto floor that was free a short while ago.

        shows (CELLS, CELLS): 1 where this pair shows a thing; flooded: where one may that hides the nearest floor.
        """
        p, taken = self._p, self._taken()
        lately = (stamp_ns - self._free_ns < p.lately_s * 1e9).view(np.uint8)
        self._free_ns[taken < p.was_free] = stamp_ns
        # Who comes is wider than a speck of noise.
        came = ((taken > 0.5) & (taken <= 1.0)).view(np.uint8) | flooded
        came |= np.asarray(cv2.morphologyEx(shows, cv2.MORPH_OPEN, SQUARE), np.uint8)
        ranges_m, view = np.empty(SECTORS), np.array([*eye, self._max_range_m, CELL_M])
        kernels.first_changed(came, lately, view, self._azimuths + yaw_rad, p.behind_m, self._at_1m, ranges_m)
        for run in _runs(np.isfinite(ranges_m)):
            # Who hides the nearest floor in view stands next to the base.
            range_m = float(ranges_m[run].mean())
            least_rad = p.comes_m / range_m if range_m > self._near_m else p.person_rad
            if len(run) * math.tau / SECTORS < least_rad:
                ranges_m[run] = np.nan
        is_nearer = ranges_m < self._near_m
        sigma_m = np.where(is_nearer, p.near_sigma * self._near_m, 0.5 * ranges_m**2 / self._at_1m)
        ranges_m[is_nearer] = self._near_m
        return Arrivals(ranges_m.astype(np.float32), sigma_m.astype(np.float32), is_nearer)

    def _assume_free(self, eye: Array, yaw_rad: float, belief: RayBelief) -> None:
        """Take the floor too near to be seen for free at the start, but where something hides the nearest in view.

        That may stand anywhere before the floor that it hides. Nothing is assumed where no floor is in view, in wider
        directions than a strut or a mast hides.
        """
        p, count = self._p, len(belief.first)
        reach_m = np.where(self._hides(belief), 0.0, self._near_m + 2 * CELL_M)
        for run in _runs(belief.view[:, 0] <= 0):
            if len(run) * math.tau / count >= p.strut_rad:
                reach_m[run] = 0.0
        reach_m = np.min([np.roll(reach_m, shift) for shift in range(-3, 4)], axis=0)
        y, x = np.indices((CELLS, CELLS)) + 0.5
        x, y = x - eye[0], y - eye[1]
        T = self._T_rect_base
        turn = math.atan2(T[1, 0], T[0, 0]) - yaw_rad
        at = np.floor((math.pi - np.arctan2(y, x) - turn) / math.tau * count).astype(np.intp) % count
        free = np.hypot(x, y) * CELL_M < reach_m[at]
        self.known[free], self._past_views[free] = 1, p.views
        self.odds[free & (self.odds < 0)] = p.arrival

    def _hides(self, belief: RayBelief) -> Flags:
        """Return the directions (D,) in which the nearest floor in view is hidden."""
        bins = int(np.searchsorted(belief.ends_m, belief.ends_m[0] + self._p.near_m))
        hidden = belief.first[:, :bins].sum(axis=1)
        three = (np.roll(hidden, 1) + hidden + np.roll(hidden, -1)) / 3
        return np.asarray((three > self._p.hidden) & (belief.view[:, 0] > 0))

    def is_floor(self, T_odom_base: Array, ranges_m: Array, directions: int) -> Flags:
        """Return the bins (N, directions) about the viewpoint, at ranges (N,), whose cells are floor by all pairs."""
        if self._corner is None:
            return np.zeros((len(ranges_m), directions), bool)
        T = T_odom_base @ self._T_base_rect
        azimuth = math.pi - (np.arange(directions) + 0.5) * (math.tau / directions)
        unit = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) @ T[:2, :2].T
        cells = np.floor((T[:2, 3] + ranges_m[:, None, None] * unit) / CELL_M).astype(np.intp) - self._corner
        x, y = np.clip(cells[..., 0], 0, CELLS - 1), np.clip(cells[..., 1], 0, CELLS - 1)
        return np.asarray((self.known[y, x] > 0) & (self.odds[y, x] < self._p.floor))

    def _taken(self) -> Floats:
        """Return the probability of a thing in cells, 2 where nothing is known."""
        p = self._p
        hanging = np.clip(p.shown_weight * (self._shown - p.shown_least), -9.0, 6.0) + np.float32(p.hanging)
        odds = np.maximum(self.odds, hanging)
        taken = 1 / (1 + np.exp(-odds))
        return np.where((self.known > 0) | (self.odds > 0), taken, np.float32(2)).astype(np.float32)

    def _who_comes(self, passed_s: float, watched: Bytes) -> None:
        """Spread what is not known through cells that nobody sees."""
        p = self._p
        open_ = (1 - watched) & (self.odds <= 0)
        person = np.ones((p.person_cells, p.person_cells), np.uint8)
        wide = np.asarray(cv2.morphologyEx(open_, cv2.MORPH_OPEN, person), np.uint8)
        source = wide & (1 - self.known)
        self._carry += p.walk_mps * passed_s / CELL_M
        steps = int(self._carry)
        self._carry -= steps
        for step in range(min(steps, CELLS)):
            source = np.asarray(cv2.dilate(source, CROSS if step % 2 else SQUARE), np.uint8) & wide
        self.known[source > 0] = 0

    @property
    def _T_base_rect(self) -> Array:
        return se3.inverse(self._T_rect_base)

    def _gathered(self, T_odom_base: Array, first_m: Array, belief: RayBelief) -> tuple[Floats, Bytes]:
        """Return evidence (3, N, N) and states (N, N) of the cells in view, the first with its middle at first_m."""
        p = self._p
        T_rect_odom = self._T_rect_base @ se3.inverse(T_odom_base)
        x, y = (T_rect_odom @ np.array([first_m[0], first_m[1], 0.0, 1.0]))[:2]
        c, s = T_rect_odom[0, 0], T_rect_odom[1, 0]
        norm = math.hypot(c, s)
        side = 2 * REACH_CELLS + 1
        cells, states = np.empty((3, side, side), np.float32), np.empty((side, side), np.uint8)
        hides = self._hides(belief)
        near = np.where(belief.view[:, 0] > 0, np.where(hides, 2, 1), 0).astype(np.uint8)
        kernels.gather(
            belief.ratios,
            belief.view,
            belief.surface,
            near,
            belief.ends_m,
            self._at_1m,
            np.array([x, y, c / norm, s / norm]),
            CELL_M,
            float(belief.ends_m[-2]),
            p.thin_m,
            cells,
            states,
        )
        return cells, states

    def _follow(self, place: Array) -> NDArray[np.int64]:
        """Move the square where the base comes near its border; return its corner, in cells of odom."""
        cell = np.floor(place).astype(np.int64)
        if self._corner is None:
            self._corner = cell - CELLS // 2
            return self._corner
        at = cell - self._corner
        if ((at >= MARGIN_CELLS) & (at < CELLS - MARGIN_CELLS)).all():
            return self._corner
        x, y = np.clip(at - CELLS // 2, -CELLS, CELLS).tolist()
        gone = np.ones((CELLS, CELLS), bool)
        gone[max(-y, 0) : CELLS - max(y, 0), max(-x, 0) : CELLS - max(x, 0)] = False
        for layer, unknown in (
            (self.odds, self._p.prior),
            (self._before, 0),
            (self._shown, 0),
            (self.known, 0),
            (self._past_views, 0),
            (self._floor_was_behind, 0),
            (self._free_ns, NEVER_NS),
        ):
            layer[:] = np.roll(layer, (-y, -x), axis=(0, 1))
            layer[gone] = unknown
        self._corner = self._corner + np.array([x, y])
        return self._corner


def _without_specks(flags: Bytes) -> Bytes:
    """Return flags (H, W) without patches of few cells, as what hides floor from the viewpoint hides a long way."""
    _, labels, of_patch, _ = cv2.connectedComponentsWithStats(flags)
    is_kept = of_patch[:, cv2.CC_STAT_AREA] > SPECK_CELLS
    is_kept[0] = False
    return np.asarray(is_kept[labels], np.uint8)


def _runs(flags: Flags) -> list[NDArray[np.intp]]:
    """Return the runs of directions (D,) of a turn that are set."""
    if flags.all() or not flags.any():
        return [np.flatnonzero(flags)] if flags.any() else []
    start = int(np.flatnonzero(~flags)[0])
    at = np.flatnonzero(np.roll(flags, -start))
    return [(run + start) % len(flags) for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)]
