"""Log-odds of floor, surfaces and edges in cells of a square in odom, which follows the robot.

Evidence of pairs is added up cell by cell. A cell is free only by floor that was seen in each direction that crosses
it, and taken where a surface or an edge is more likely than not.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from tests.experiments.obstacle_posterior import grid_kernels as kernels
from tests.experiments.obstacle_posterior.column import BIN_MIDDLE, ColumnEvidence

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

CELL_M: Final = 0.05
CELLS: Final = 256  # on each side of the square
MARGIN_CELLS: Final = 110  # nearer to the border than this, the square is moved
VIEW_CELLS: Final = 90  # on either side of the robot, that a pair changes
NEVER: Final = np.iinfo(np.int64).min

# Log-likelihood ratios of a pair by its evidence, fitted by tests/benchmark/obstacle_posterior.py.
FLOOR_RATIO: Final = (0.06, 3.0, 3.0)  # slope, evidence without a preference by each nearer disparity, bound
SURFACE_RATIO: Final = (2.0, 15.0, 6.0)  # factor of the logarithm, evidence without a preference, most
EDGE_RATIO: Final = (0.04, 15.0, 2.5)  # slope, evidence without a preference, most
MOST_RATIO: Final = 3.0  # of a cell and a pair: the errors of pairs that follow each other are alike
PAIR_ODDS: Final = 3.5  # of a surface in one pair, that may move
PRIOR: Final = (-1.0, -6.0, -6.0)  # log-odds of floor, surface and edge where nothing was seen
LIMIT: Final = 6.0  # of all log-odds: what changes is believed after a few pairs
FREE_ODDS: Final = 1.5  # of the floor, for a cell that is free
TAKEN_ODDS: Final = 0.0  # of a surface or an edge
CONTRADICTION: Final = -1.2  # to a surface where the floor is seen and no surface
APART_M: Final = 0.05  # between places whose errors differ
APART_S: Final = 0.5  # of pairs from one place that are one more
# Unknown cells that are so few, with floor around: a box is larger, and what is tall hides floor behind it.
SPECK_CELLS: Final = 6
# Evidence up to which nothing was to be compared, and its ratio: floor mostly shows something, what hides it need not.
BLANK: Final = 3
BLANK_RATIO: Final = -1.0
END_BINS: Final = 2  # so many bins before the end of what looks like floor there may be the foot of something
FRESH_NS: Final = 500_000_000  # time constant of the evidence with which a cell is watched
LEAST_FRESH: Final = 1.0  # evidence of floor, surface or edge in a cell that is watched
FLOOD_MPS: Final = 1.6  # speed at which something may come in unseen
NARROW_CELLS: Final = 5  # what comes in is wider
OPEN_SHARE: Final = 0.9  # of the longest range, up to which an open direction is free
LOWEST_M: Final = 0.06  # height of what may be hidden in a gap of the floor


class GridRing(NamedTuple):
    """Nearest obstacles and free floor around the base, by the grid."""

    ranges_m: Floats  # (SECTORS,) nearest surface or edge; inf: floor up to the longest range; NaN: unknown
    sigma_m: Floats  # (SECTORS,) of the ranges, NaN without one
    free_m: Floats  # (SECTORS,) up to which the way is free


class ObstacleGrid:
    """Layers of log-odds (3, CELLS, CELLS): floor, surface, edge; and when a cell was seen last."""

    def __init__(self, T_rect_base: Array, disparity_at_1m: float, focal_px: float, height_m: float,
                 max_range_m: float) -> None:
        """T_rect_base (4, 4): from the base to the frame of the columns; height_m: of the viewpoint over the floor."""
        self._T_rect_base, self._at_1m, self._focal_px = T_rect_base, disparity_at_1m, focal_px
        self._max_range_m = min(max_range_m, (MARGIN_CELLS - 2) * CELL_M)
        self._gap_share = LOWEST_M / (height_m - LOWEST_M)
        self._azimuths = azimuths()
        self.clear()

    def clear(self) -> None:
        """Forget everything: the pose has lost its relation to the past."""
        self._odds = np.empty((3, CELLS, CELLS), np.float32)
        self._odds[:] = np.array(PRIOR, np.float32)[:, None, None]
        self._fresh = np.zeros((CELLS, CELLS), np.float32)  # evidence of the last FRESH_NS
        self._corner: NDArray[np.int64] | None = None  # cell (0, 0) in odom
        self._start_ns: int | None = None
        self._least_gap_m = CELL_M  # in the floor, that is passed
        self._place_m: Array | None = None  # of the last pair
        self._last_ns, self._carry = NEVER, 0.0

    def update(self, stamp_ns: int, T_odom_base: Array, evidence: ColumnEvidence) -> GridRing:
        """Add the evidence of a pair, whose base has the planar pose T_odom_base (4, 4); return what is known."""
        place = T_odom_base[:2, 3] / CELL_M
        self._follow(place)
        assert self._corner is not None
        at = np.floor(place).astype(np.int64) - self._corner
        rows, columns = (slice(int(n) - VIEW_CELLS, int(n) + VIEW_CELLS + 1) for n in (at[1], at[0]))
        # 1. Evidence of each cell.
        found = self._gathered(T_odom_base, (rows.start, columns.start), evidence)
        floor, surface, edge = found
        in_view = np.isfinite(floor)
        # 2. Log-odds.
        odds = self._odds[:, rows, columns]
        weight = self._weight(stamp_ns, T_odom_base[:2, 3])
        floor = np.where(in_view, floor, 0)
        floor = np.clip(floor, -MOST_RATIO, MOST_RATIO)
        surface = np.minimum(np.nan_to_num(surface), np.float32(MOST_RATIO))
        edge = np.clip(np.nan_to_num(edge), -MOST_RATIO, MOST_RATIO)
        seen_surface = surface > 0
        passes = in_view & (floor > 0) & ~seen_surface
        odds[0] += weight * np.where(seen_surface, np.minimum(floor, 0), floor)
        odds[1] += weight * np.where(seen_surface, surface, np.where(passes, np.float32(CONTRADICTION), np.float32(0)))
        odds[2] += weight * np.where(in_view, np.where(floor > 0, np.minimum(-floor, edge), edge), 0)
        prior = np.array(PRIOR, np.float32)[:, None, None]
        np.clip(odds, np.minimum(prior, -LIMIT / 2), LIMIT, out=odds)
        odds[1:] = np.maximum(odds[1:], prior[1:])
        self._keep_fresh(stamp_ns, (rows, columns), np.maximum(np.maximum(floor, edge), surface).clip(0))
        # 3. What is not watched, and may have changed.
        if self._start_ns is None:
            # The robot stands where nothing else can be: the floor too near to be seen counts until it is reached.
            self._start_ns = stamp_ns
            self._least_gap_m = CELL_M + self._gap_share * evidence.nearest_floor_m
            self._assume_free(at, evidence.nearest_floor_m)
        self._flood(stamp_ns, in_view, rows, columns)
        i, j = int(at[1]), int(at[0])
        self._odds[0, i - 3 : i + 4, j - 3 : j + 4] = LIMIT
        return self._ring(T_odom_base, place)

    @property
    def corner_m(self) -> Array:
        """Place (2,) of the corner of cell (0, 0) in odom."""
        return CELL_M * (np.zeros(2) if self._corner is None else self._corner.astype(float))

    @property
    def floor_odds(self) -> Floats:
        """Log-odds (CELLS, CELLS) that a cell is floor, a copy."""
        return np.array(self._odds[0])

    def state(self) -> NDArray[np.uint8]:
        """Return the cells: 0 unknown, 1 free, 2 taken."""
        # No edge is thin.
        edge = cv2.morphologyEx((self._odds[2] > TAKEN_ODDS).astype(np.uint8), cv2.MORPH_OPEN, EDGE_BOX)
        taken = (self._odds[1] > TAKEN_ODDS) | (edge > 0)
        free = (self._odds[0] > FREE_ODDS) | taken
        _, patch, about, _ = cv2.connectedComponentsWithStats((~free).astype(np.uint8), connectivity=8)
        free |= about[patch, cv2.CC_STAT_AREA] <= SPECK_CELLS
        return np.where(taken, np.uint8(2), free.astype(np.uint8))

    def _gathered(self, T_odom_base: Array, first: tuple[int, int], evidence: ColumnEvidence) -> Floats:
        T_rect_odom = self._T_rect_base @ se3.inverse(T_odom_base)
        assert self._corner is not None
        corner = CELL_M * (np.array([self._corner[0] + first[1], self._corner[1] + first[0]]) + 0.5)
        x, y = (T_rect_odom @ np.array([corner[0], corner[1], 0.0, 1.0]))[:2]
        c, s = T_rect_odom[0, 0], T_rect_odom[1, 0]
        norm = math.hypot(c, s)
        cells = np.empty((3, 2 * VIEW_CELLS + 1, 2 * VIEW_CELLS + 1), np.float32)
        floor, surface, edge = ratios(evidence)
        kernels.gather(floor, surface, edge, np.array([x, y, c / norm, s / norm]),
                       np.array([self._focal_px, self._at_1m, BIN_MIDDLE]), CELL_M, cells)
        return cells

    def _weight(self, stamp_ns: int, place_m: Array) -> np.float32:
        """Return the weight of a pair: pairs from one place have the same errors, and are little more than one."""
        if self._place_m is None:
            self._place_m = place_m.copy()
            return np.float32(1.0)
        way_m = math.dist(place_m, self._place_m)
        self._place_m = place_m.copy()
        return np.float32(min(max(way_m / APART_M, (stamp_ns - self._last_ns) * 1e-9 / APART_S), 1.0))

    def _keep_fresh(self, stamp_ns: int, window: tuple[slice, slice], amount: Floats) -> None:
        """Add the amount of evidence of a pair to what is fresh, which decays."""
        passed_ns = 0 if self._last_ns == NEVER else max(stamp_ns - self._last_ns, 0)
        self._fresh *= np.float32(math.exp(-passed_ns / FRESH_NS))
        self._fresh[window] += amount

    def _assume_free(self, at: NDArray[np.int64], within_m: float) -> None:
        y, x = np.ogrid[:CELLS, :CELLS]
        near = (x - at[0]) ** 2 + (y - at[1]) ** 2 < ((within_m + 2 * CELL_M) / CELL_M) ** 2
        unknown = near & (self._odds[0] <= FREE_ODDS) & (self._fresh == 0)
        self._odds[0][unknown] = FREE_ODDS + 1.0

    def _flood(self, stamp_ns: int, in_view: Flags, rows: slice, columns: slice) -> None:
        """Forget the floor that something may have come to that was not seen, from cells that are not watched."""
        passed_s = 0.0 if self._last_ns == NEVER else min((stamp_ns - self._last_ns) * 1e-9, 1.0)
        self._last_ns = stamp_ns
        if self._start_ns is None or stamp_ns - self._start_ns < FRESH_NS:
            return
        self._carry += max(passed_s, 0.0) * FLOOD_MPS / CELL_M
        steps, self._carry = int(self._carry), self._carry % 1.0
        watched = (self._fresh > LEAST_FRESH).astype(np.uint8)
        box = np.ones((NARROW_CELLS, NARROW_CELLS), np.uint8)
        free = (self._odds[0] > FREE_ODDS).astype(np.uint8)
        visible = np.zeros((CELLS, CELLS), np.uint8)
        visible[rows, columns] = in_view
        passable = free & (1 - watched)
        source = cv2.morphologyEx((1 - watched) & ((1 - free) | visible), cv2.MORPH_OPEN, box)
        reached = source.copy()
        for step in range(steps):
            kernel = np.ones((3, 3), np.uint8) if step % 2 else CROSS
            reached = cv2.dilate(reached, kernel) & (passable | source)
        gone = (reached > 0) & (passable > 0) & (visible == 0)
        self._odds[0][gone] = PRIOR[0]

    def _ring(self, T_odom_base: Array, place: Array) -> GridRing:
        assert self._corner is not None
        yaw = float(se3.yaw(T_odom_base))
        hit, free = np.empty(SECTORS), np.empty(SECTORS)
        x, y = place - self._corner
        kernels.march(self.state(), np.array([x, y, CELL_M / 2, self._max_range_m, CELL_M, self._gap_share,
                                              self._least_gap_m]),
                      self._azimuths + yaw, hit, free)
        is_open = np.isinf(hit) & (free >= OPEN_SHARE * self._max_range_m)
        ranges = np.where(np.isfinite(hit), hit, np.where(is_open, np.inf, np.nan))
        sigma = np.where(np.isfinite(ranges), CELL_M / 2, np.nan)
        return GridRing(ranges.astype(np.float32), sigma.astype(np.float32), np.minimum(free, hit).astype(np.float32))

    def pair_ring(self, evidence: ColumnEvidence) -> tuple[Floats, Floats]:
        """Return the nearest surface (SECTORS,) of one pair, inf or NaN without one, and its sigma."""
        surface = ratios(evidence)[1] > PAIR_ODDS
        bins, width = surface.shape
        nearest = np.where(surface.any(axis=0), bins - 1 - np.argmax(surface[::-1], axis=0), -1)
        azimuth = math.pi - (np.arange(width) + 0.5) / self._focal_px
        T = se3.inverse(self._T_rect_base)
        found = np.full(SECTORS, -1)
        turned = (azimuth + math.atan2(T[1, 0], T[0, 0]) + math.pi) * (SECTORS / math.tau)
        np.maximum.at(found, np.floor(turned).astype(np.intp) % SECTORS, nearest)
        with np.errstate(divide="ignore"):
            ranges = np.where(found >= 0, self._at_1m / (found + BIN_MIDDLE), np.nan)
        return ranges.astype(np.float32), (0.5 * ranges**2 / self._at_1m).astype(np.float32)

    def _follow(self, place: Array) -> None:
        """Move the square where the robot comes near its border."""
        cell = np.floor(place).astype(np.int64)
        if self._corner is None:
            self._corner = cell - CELLS // 2
            return
        at = cell - self._corner
        if ((at >= MARGIN_CELLS) & (at < CELLS - MARGIN_CELLS)).all():
            return
        shift = at - CELLS // 2
        gone = np.ones((CELLS, CELLS), bool)
        x, y = np.clip(shift, -CELLS, CELLS).tolist()
        gone[max(-y, 0) : CELLS - max(y, 0), max(-x, 0) : CELLS - max(x, 0)] = False
        self._odds[:] = np.roll(self._odds, (-y, -x), axis=(1, 2))
        self._fresh[:] = np.roll(self._fresh, (-y, -x), axis=(0, 1))
        self._odds[:, gone] = np.array(PRIOR, np.float32)[:, None]
        self._fresh[gone] = 0.0
        self._corner += shift


EDGE_BOX: Final = np.ones((3, 3), np.uint8)
CROSS: Final = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def ratios(evidence: ColumnEvidence) -> tuple[Floats, Floats, Floats]:
    """Return the log-likelihood ratios (K, W) of floor, surface and edge; of the floor and the edge NaN where nothing
    is compared.
    """
    slope, by_bin, most = FLOOR_RATIO
    tested = evidence.tested[:, None]
    level = evidence.floor.astype(np.float32)
    # The nearer the floor, the more disparities there are whose best it must beat.
    floor = np.clip(slope * (level + by_bin * np.arange(len(level))[:, None]), -most, most)
    floor = np.where(np.abs(level) <= BLANK, np.float32(BLANK_RATIO), floor)
    # At the foot of a surface a window shows both, and so do rows in which their disparities are alike.
    floor[END_BINS:] = np.minimum(floor[END_BINS:], floor[:-END_BINS])
    factor, neutral, largest = SURFACE_RATIO
    found = evidence.surface.astype(np.float32)
    peak = np.ones_like(found, bool)
    peak[1:] &= found[1:] >= found[:-1]
    peak[:-1] &= found[:-1] >= found[1:]
    surface = np.where(peak, np.clip(factor * np.log(np.maximum(found, 1.0) / neutral), 0.0, largest), 0.0)
    slope, neutral, most = EDGE_RATIO
    edge = np.clip(slope * (evidence.below.astype(np.float32) - neutral), -most, most)
    edge = np.where(evidence.below != 0, edge, 0.0)
    return (np.where(tested, floor, np.nan).astype(np.float32), surface.astype(np.float32),
            np.where(tested, edge, np.nan).astype(np.float32))
