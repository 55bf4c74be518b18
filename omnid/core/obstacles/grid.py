"""Log-odds of floor and of surfaces in cells of a square in odom, which follows the robot.

Evidence of pairs is added up cell by cell. A cell is free only by floor that was seen in each direction that crosses
it, and taken where a surface is more likely than not. docs/obstacles.md has them.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import azimuths
from omnid.core.obstacles import grid_kernels as kernels
from omnid.core.obstacles.cell_kernels import (
    ABOVE,
    BELOW,
    FLOOR,
    FLOOR_LOW,
    FLOOR_PRIOR,
    FREE_ODDS,
    FREE_SHOWN,
    LIMIT,
    MOST_RATIO,
    SURFACE,
    SURFACE_PRIOR,
    TAKEN_ODDS,
    UNSEEN_SURFACE,
    VISIBLE,
    VISIBLE_PRIOR,
    add_pair,
    free_cells,
)
from omnid.core.obstacles.column import THIN_M, ColumnEvidence, floor_plane
from omnid.core.obstacles.near_field import FLOORS, NearField, lose_before
from omnid.core.obstacles.settings import RingSettings
from omnid.core.obstacles.usual_floor import FRESH_NS, NARROW_CELLS, Arrivals, Hidden, UsualFloor, Watch, arrivals_at

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

# Log-odds of the layers where nothing was seen: steps up and down are even, because nothing speaks for either.
PRIOR: Final = (FLOOR_PRIOR, 0.0, 0.0, SURFACE_PRIOR, VISIBLE_PRIOR)
WIDE_CELLS: Final = 3  # Side of the mean that shows floor or a low object, because single cells are noisy.
# The same of an edge: a hole into which a base falls is wide. With 3, by trial, bases stood before joints of tiles.
EDGE_CELLS: Final = 5


def cells_of(odds: Floats, shown: Floats) -> Bytes:
    """Return the cells (H, W) by their log-odds (5, H, W): 0 unknown, 1 free (by all layers), 2 taken.

    shown (H, W): mean surface of single pairs.
    """
    floor, cells = mean_over(odds[FLOOR], WIDE_CELLS), np.empty(shown.shape, np.uint8)
    free_cells(odds, shown, floor, level_odds(odds), cells)
    return cells


def level_odds(odds: Floats) -> Floats:
    """Return the least log-odds (H, W) against steps up and down, which are wider than a cell.

    An edge is remembered by lower log-odds than FLOOR_LOW, but a few such cells are not as wide as one.
    """
    return np.minimum(mean_over(odds[ABOVE], WIDE_CELLS), mean_over(np.maximum(odds[BELOW], FLOOR_LOW), EDGE_CELLS))


def mean_over(odds: Floats, cells: int) -> Floats:
    """Return the mean (H, W) of log-odds over a patch with a side of so many cells."""
    return np.asarray(cv2.blur(odds, (cells, cells)), np.float32)


Array = NDArray[np.float64]

# Distance kept before the end of the free floor, because at the foot of an object patches show both.
END_M: Final = 0.1
# Share of the longest range from which on a direction is open, because few pairs show the last cells.
OPEN_SHARE: Final = 0.9


class GridRing(NamedTuple):
    """Nearest obstacles and free floor around the base, by the grid."""

    ranges_m: Floats  # (SECTORS,) nearest surface; inf: floor up to the longest range; NaN: unknown
    sigma_m: Floats  # (SECTORS,) of the ranges, NaN without one
    free_m: Floats  # (SECTORS,) up to which the way is free
    arrivals: Arrivals  # of this pair


class RingView(NamedTuple):
    """Directions from a place in the grid, and the gaps in the floor that are passed."""

    place: Array  # (2,) in cells
    angles: Array  # (N,) of the directions, in the axes of the grid
    cell_m: float
    max_range_m: float
    nearest_m: Array  # (N,) of the floor in view
    gap_share: float  # of the range, that what is lower than an obstacle may hide: such gaps are passed
    gap_m: float  # least gap that is passed


def circle_from(directions: Array, middle_m: Array, radius_m: float) -> Array:
    """Return the way (N,) from the origin along directions (N, 2) to a circle around it, whose middle lies off it."""
    along_m = directions @ middle_m
    return np.asarray(along_m + np.sqrt(np.maximum(radius_m**2 - middle_m @ middle_m + along_m**2, 0.0)))


def ring_of(cells: Bytes, view: RingView, arrivals: Arrivals) -> GridRing:
    """Return the ring by the cells (H, W): 0 unknown, 1 free, 2 taken."""
    first, hit, free = np.empty((3, len(view.angles)))
    # 1. Up to the first taken cell, and to the end of the free floor.
    origin = np.array(
        [*view.place, view.cell_m / 2, view.max_range_m, view.cell_m, view.gap_share, view.gap_m], np.float64
    )
    kernels.march(cells, origin, view.angles, first, free)
    # Too near for floor, a part of a surface that shows nothing, such as a white margin, is no opening.
    kernels.close_openings(first, free, view.nearest_m, NARROW_CELLS * view.cell_m, END_M + view.cell_m, hit)
    # 2. A direction between cells may belong to either side.
    around = np.concatenate([free[-1:], free, free[:1]])
    free = np.minimum(free, np.minimum(around[:-2], around[2:]))
    is_open = np.isinf(hit) & (free >= OPEN_SHARE * view.max_range_m)
    ranges = np.where(np.isfinite(hit), hit, np.where(is_open, np.inf, np.nan))
    sigma = np.where(np.isfinite(ranges), view.cell_m / 2, np.nan)
    # 3. What stands at an end may be nearer: in view, by its foot; an end nearer than that, found before, by a cell.
    end_m = np.where(free > view.nearest_m, np.minimum(END_M, free - view.nearest_m + view.cell_m), view.cell_m)
    free = np.where(free < hit, np.maximum(free - end_m, 0.0), hit)
    return GridRing(ranges.astype(np.float32), sigma.astype(np.float32), free.astype(np.float32), arrivals)


Flags = NDArray[np.bool_]

CELL_M: Final = 0.05  # Side of a cell.
CELLS: Final = 256  # Cells of a side, because they hold twice the largest range, and the way until the square is moved.
MARGIN_CELLS: Final = 110  # nearer to the border than this, the square is moved: enough for each 0.9 m of the way
VIEW_CELLS: Final = 90  # Cells on either side of the robot that a pair changes, because they are within the margin.

MEAN_FLOOR: Final = 4  # Index in the evidence of cells, because 0 to 3 are those of the layers.

# A thin thing shows a surface in half of the pairs, and floor in the others, which contradict it: its log-odds stay at
# the prior. So a cell is free only where the mean surface of single pairs is low. Set on development seeds 1 and 2.
SHOWN_RATE: Final = np.float32(0.1)  # part of a pair in the mean; by trial, too
# Side of the patch of the mean, because errors of the range move what a pair shows by some cells.
SHOWN_CELLS: Final = 5
MOST_SHOWN: Final = np.float32(1.5)  # limit of one pair; by trial, too

APART_M: Final = 0.05  # Least distance of places so that the errors of their pairs are independent: a cell.
APART_S: Final = 0.2  # A pair from the same place counts in full after it, so that a base that stands sees what comes.
# A cell takes the evidence of patches so much farther, because at the foot of an object they show both.
END_BINS: Final = 2


class ObstacleGrid:
    """Layers of log-odds (5, CELLS, CELLS), and how well they are watched."""

    def __init__(self, at_1m: float, settings: RingSettings) -> None:
        """at_1m: disparity at 1 m; `set_floor` comes before the first pair."""
        self._at_1m, self._low_m = at_1m, settings.heights_m[0]
        self._max_range_m = min(settings.max_range_m, (MARGIN_CELLS - 2) * CELL_M)
        self._T_rect_base, self._T_base_eye, self._gap_share = np.eye(4), np.eye(4), 0.0
        self._lean_m = np.zeros(2)
        self._azimuths = azimuths()
        self._directions = np.column_stack([np.cos(self._azimuths), np.sin(self._azimuths)])
        self.clear()

    def set_floor(self, T_rect_base: Array, height_m: float) -> None:
        """Take T_rect_base (4, 4), from the base level on the floor to the columns, and the viewpoint's height."""
        self._T_rect_base = T_rect_base
        self._T_base_eye[:2, 3] = se3.inverse(T_rect_base)[:2, 3]
        plane = floor_plane(T_rect_base)
        self._lean_m = height_m * np.array([plane.a, plane.b])
        # What is lower than an obstacle may hide this share of the range.
        self._gap_share = self._low_m / max(height_m - self._low_m, self._low_m)

    def viewpoint(self, T_odom_base: Array) -> Array:
        """Return the pose (4, 4) of axes parallel to the base's at the viewpoint: what stands hides floor behind it."""
        return np.asarray(T_odom_base @ self._T_base_eye)

    def clear(self) -> None:
        """Forget everything."""
        self._odds = np.empty((len(PRIOR), CELLS, CELLS), np.float32)
        self._odds[:] = np.array(PRIOR, np.float32)[:, None, None]
        self._shown = np.zeros((CELLS, CELLS), np.float32)  # mean surface of single pairs
        self._near = NearField(CELLS, CELL_M, self._directions)
        self._watch = Watch(CELLS, CELL_M)
        self._usual, self._usual_thin = UsualFloor(CELLS), UsualFloor(CELLS)
        self._corner: NDArray[np.int64] | None = None  # cell (0, 0) in odom
        self._start_ns: int | None = None
        self._nearest_m = 0.0  # range of the nearest floor in view
        self._eye_m = np.zeros(2)  # viewpoint of the last pair
        self._place_m: Array | None = None  # of the last pair
        self._last_ns: int | None = None

    def begin_again(self) -> None:
        """Forget what is known, as the way since then is not, but for what stands nearer than the floor in view.

        No pair would show that again, and a base whose odometry is lost stops, so that it is still about there.
        """
        if self._start_ns is None or self._corner is None:  # nothing has been added since the last time
            return
        surface, corner, near = self._odds[SURFACE], self._corner, self._near
        kept = near.within(self._eye_m / CELL_M - corner, self._nearest_m / CELL_M) & (surface > TAKEN_ODDS)
        self.clear()
        self._odds[SURFACE][kept], self._corner = surface[kept], corner
        self._near.keep(near, kept)

    def update(self, stamp_ns: int, T_odom_base: Array, evidence: ColumnEvidence) -> GridRing:
        """Add the evidence of a pair, whose base has the planar pose T_odom_base (4, 4); return what is known."""
        place = T_odom_base[:2, 3] / CELL_M
        corner = self._follow(place)
        at = np.floor(place).astype(np.int64) - corner
        self._eye_m = self.viewpoint(T_odom_base)[:2, 3]
        eye = self._eye_m / CELL_M - corner
        rows, columns = (slice(int(n) - VIEW_CELLS, int(n) + VIEW_CELLS + 1) for n in (at[1], at[0]))
        self._nearest_m = evidence.nearest_floor_m
        if self._start_ns is None:
            # The robot is where nothing else can be: the floor too near to be seen counts until it is reached.
            self._start_ns = stamp_ns
            self._assume_free(np.floor(eye).astype(np.int64), T_odom_base, evidence)
        passed_ns = FRESH_NS if self._last_ns is None else max(stamp_ns - self._last_ns, 0)
        self._last_ns = stamp_ns
        weight, at_rest = self._weights(passed_ns, T_odom_base[:2, 3])
        # 1. Evidence of each cell, and what has come onto floor that was free.
        found = self._gathered(T_odom_base, CELL_M * (corner + (columns.start, rows.start) + 0.5), evidence)
        angles = self._azimuths + float(se3.yaw(T_odom_base))
        in_view, nearest = np.isfinite(found[FLOOR]), int(evidence.nearest_floor_m / CELL_M)
        in_view_m = evidence.nearest_floor_m
        arrivals, thin, hidden = self._hidden(stamp_ns, (rows, columns), found, eye, angles, in_view_m, weight)
        # 2. Log-odds; all floor behind something is hidden, and a cell that is so by itself is noise.
        lost = np.where(thin.behind, hidden, np.minimum(hidden, 0))
        lose_before(lost, thin.near, eye, angles, nearest)
        past = partial(self._near.seen_past, self._odds, self._watch, eye, max(nearest, 1))
        gone = self._near.gone((rows, columns), found[SURFACE], in_view, past, eye, nearest)
        amount = self._add((rows, columns), found, lost, gone, weight, at_rest)
        self._near.forget((self._odds[SURFACE] <= PRIOR[SURFACE]) & (self._shown <= FREE_SHOWN))
        # 3. What is not watched, and may have changed.
        self._watch.take(passed_ns, (rows, columns), amount)
        if stamp_ns - self._start_ns >= FRESH_NS:
            visible = np.zeros((CELLS, CELLS), bool)
            visible[rows, columns] = in_view
            flooded = self._watch.spread(stamp_ns, passed_ns, self._odds[FLOOR] > FREE_ODDS, visible)
            self._odds[FLOOR][flooded] = PRIOR[FLOOR]
        self._near.clear_seen_past(self._odds, self._watch, eye, nearest)
        i, j = int(at[1]), int(at[0])
        own = slice(i - 3, i + 4), slice(j - 3, j + 4)
        self._odds[FLOORS, *own], self._odds[VISIBLE, *own], self._shown[own] = LIMIT, PRIOR[VISIBLE], 0.0
        self._odds[SURFACE, *own] = PRIOR[SURFACE]
        # 4. The ring.
        gaps = self._gap_share, CELL_M + self._gap_share * self._nearest_m
        nearest_m = circle_from(self._directions, self._T_base_eye[:2, 3], in_view_m)
        view = RingView(place - corner, angles, CELL_M, self._max_range_m, nearest_m, *gaps)
        cells = self.state()
        self._watch.free_ns[cells == 1] = stamp_ns
        return ring_of(cells, view, arrivals)

    def _hidden(
        self,
        stamp_ns: int,
        window: tuple[slice, slice],
        found: Floats,
        eye: Array,
        angles: Array,
        in_view_m: float,
        weight: np.float32,
    ) -> tuple[Arrivals, Hidden, Floats]:
        """Return who comes, what floor something thin hides, and the log-odds (CELLS, CELLS) that it does.

        found (5, N, N): evidence of the cells of a window; eye (2,): viewpoint in cells; angles (SECTORS,) of the
        directions in odom; in_view_m: range of the nearest floor in view; weight: of the pair.
        """
        nearest, nearest_m = int(in_view_m / CELL_M), in_view_m + 2 * CELL_M
        origin = np.array([*eye, CELL_M, self._max_range_m, self._at_1m])
        was_floor, stands = self._watch.was_floor(stamp_ns), self._odds[SURFACE] > TAKEN_ODDS
        # Who comes is wide: the mean of a cell is less noisy than its weakest directions, which show something thin.
        wide_odds = self._usual.compare(window, found[MEAN_FLOOR], weight)
        comes = self._usual.hidden(wide_odds, was_floor, stands, origin, angles, nearest_m)
        # A surface too near for floor explains that it hides the floor: nothing thin need stand before it.
        stands |= self._near.surely_shown(window, found[SURFACE], np.isfinite(found[FLOOR]), eye, nearest)
        odds = self._usual_thin.compare(window, found[FLOOR], weight)
        thin = self._usual_thin.hidden(odds, was_floor, stands, origin, angles, nearest_m)
        return arrivals_at(comes.ranges_m, nearest_m, self._at_1m), thin, odds

    def _add(
        self,
        window: tuple[slice, slice],
        cells: Floats,
        lost: Floats,
        gone: Flags,
        weight: np.float32,
        at_rest: np.float32,
    ) -> Floats:
        """Add the evidence of a pair to the log-odds of a window; return the most of each cell, of floor or surface.

        cells (5, N, N): evidence of the cells; lost (CELLS, CELLS): log-odds that visible floor loses; gone (N, N):
        surfaces that would be seen; weight, at_rest: of the pair, and the part of it by time alone.
        """
        # What a pair shows around a surface that is known is that surface, and a little in single directions is noise.
        known = _patches(self._odds[SURFACE][window] > TAKEN_ODDS) > 0
        shown = np.where(known, np.float32(0), np.clip(cells[SURFACE] - UNSEEN_SURFACE, 0, MOST_SHOWN))
        amount: Floats = np.empty_like(cells[FLOOR])
        add_pair(
            cells,
            gone.view(np.uint8),
            _patches(gone),
            np.asarray(cv2.blur(shown, (SHOWN_CELLS, SHOWN_CELLS)), np.float32),
            lost,
            self._usual_thin.mean,
            (window[0].start, window[1].start),
            (weight, at_rest, weight * SHOWN_RATE),
            self._odds,
            self._shown,
            amount,
        )
        return amount

    def state(self) -> Bytes:
        """Return the cells (CELLS, CELLS): 0 unknown, 1 free (by all layers), 2 taken."""
        return cells_of(self._odds, self._shown)

    def _gathered(self, T_odom_base: Array, first_m: NDArray[np.floating[Any]], evidence: ColumnEvidence) -> Floats:
        """Return the evidence (5, N, N) of the cells of the view, the first of which has its middle at first_m."""
        T_rect_odom = self._T_rect_base @ se3.inverse(T_odom_base)
        x, y = (T_rect_odom @ np.array([first_m[0], first_m[1], 0.0, 1.0]))[:2]
        c, s = T_rect_odom[0, 0], T_rect_odom[1, 0]
        norm = math.hypot(c, s)
        cells = np.empty((MEAN_FLOOR + 1, 2 * VIEW_CELLS + 1, 2 * VIEW_CELLS + 1), np.float32)
        floor, level = np.empty_like(evidence.floor), np.empty_like(evidence.level)
        floor[:END_BINS], level[:, :END_BINS] = np.nan, 0.0
        floor[END_BINS:], level[:, END_BINS:] = evidence.floor[:-END_BINS], evidence.level[:, :-END_BINS]
        kernels.gather(
            floor,
            evidence.surface,
            level,
            np.array([x, y, c / norm, s / norm, *self._lean_m]),
            self._at_1m,
            CELL_M,
            VIEW_CELLS * CELL_M,
            THIN_M,
            cells,
        )
        return cells

    def _weights(self, passed_ns: int, place_m: Array) -> tuple[np.float32, np.float32]:
        """Return the weight of a pair, and the part of it by time alone: pairs from one place have the same errors."""
        if self._place_m is None:
            self._place_m = place_m.copy()
            return np.float32(1.0), np.float32(0.0)
        by_way = min(math.dist(place_m, self._place_m) / APART_M, 1.0)
        self._place_m = place_m.copy()
        weight = min(max(by_way, passed_ns * 1e-9 / APART_S), 1.0)
        return np.float32(weight), np.float32(weight - by_way)

    def _assume_free(self, eye: NDArray[np.int64], T_odom_base: Array, evidence: ColumnEvidence) -> None:
        """Take the floor nearer than what is in view for free, up to a surface that hides the nearest floor in view."""
        y, x = np.ogrid[:CELLS, :CELLS]
        in_view = np.isfinite(evidence.floor)
        reach = np.where(evidence.shown | ~in_view.any(), (evidence.nearest_floor_m + 2 * CELL_M) / CELL_M, 0.0)
        nearest = np.flatnonzero(in_view.any(axis=1))[-1:]
        stands = (evidence.floor[nearest] < -MOST_RATIO).any(axis=0) & (evidence.surface.max(axis=0) > 0)
        range_m = self._at_1m / np.maximum(evidence.surface.argmax(axis=0), 1)
        reach[stands] = np.minimum(reach, range_m / CELL_M - 1.0)[stands]
        yaw = float(se3.yaw(self._T_rect_base)) - float(se3.yaw(T_odom_base))
        turned = (math.pi - np.arctan2(y - eye[1], x - eye[0]) - yaw) / math.tau
        reach_there = reach[np.floor(turned * len(reach)).astype(np.intp) % len(reach)]
        self._odds[FLOORS, (x - eye[0]) ** 2 + (y - eye[1]) ** 2 < reach_there**2] = FREE_ODDS + 1.0

    def _follow(self, place: Array) -> NDArray[np.int64]:
        """Move the square where the robot comes near its border; return its corner, in cells of odom."""
        cell = np.floor(place).astype(np.int64)
        if self._corner is None:
            self._corner = cell - CELLS // 2
            return self._corner
        at = cell - self._corner
        if ((at >= MARGIN_CELLS) & (at < CELLS - MARGIN_CELLS)).all():
            return self._corner
        shift = at - CELLS // 2
        gone = np.ones((CELLS, CELLS), bool)
        x, y = np.clip(shift, -CELLS, CELLS).tolist()
        gone[max(-y, 0) : CELLS - max(y, 0), max(-x, 0) : CELLS - max(x, 0)] = False
        usual = (self._usual.mean, 0), (self._usual_thin.mean, 0)
        layers = *zip(self._odds, PRIOR, strict=True), (self._shown, 0), *usual, *self._watch.layers, *self._near.layers
        for layer, unknown in layers:
            layer[:] = np.roll(layer, (-y, -x), axis=(0, 1))
            layer[gone] = unknown
        self._corner = self._corner + shift
        return self._corner


def _patches(cells: Flags) -> Bytes:
    """Return 1 in the patches (N, N) of the mean of single pairs around cells."""
    return np.asarray(cv2.dilate(cells.view(np.uint8), np.ones((SHOWN_CELLS, SHOWN_CELLS), np.uint8)), np.uint8)
