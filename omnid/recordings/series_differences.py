"""Where two recorded runs part: poses, states and commands of the same stamps, compared as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Values over time."""

    stamps_ns: NDArray[np.int64]  # (N,) rising strictly
    values: Array  # (N, k)

    def at(self, rows: Rows) -> Series:
        """The rows with these numbers."""
        return Series(self.stamps_ns[rows], self.values[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Excess:
    """How far two runs are apart at the stamps that both have; one row per stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    amounts: Array  # (N, 2) in the units of the limits, >= 0
    limits: tuple[float, float]  # what is still taken for the same

    @property
    def first(self) -> int | None:
        """The first row that is beyond a limit in either column; None where all agree."""
        return _first(np.any(self.amounts > self.limits, axis=1))

    @property
    def beyond(self) -> int:
        """How many rows are beyond a limit."""
        return int(np.count_nonzero(np.any(self.amounts > self.limits, axis=1)))

    @property
    def first_trace(self) -> int | None:
        """The first row that differs at all."""
        return _first(np.any(self.amounts > 0.0, axis=1))


@dataclass(frozen=True, slots=True)
class Gaps:
    """What one run has and the other lacks."""

    missing: int
    stretches: int  # of missing ones that follow one another
    longest: int
    longest_ns: int  # stamp of the first one missing in the longest stretch; 0 without any


def in_both(a: Series, b: Series) -> tuple[Series, Series]:
    """The rows of either series whose stamps, to the nanosecond, are in the other as well."""
    _, rows_a, rows_b = np.intersect1d(a.stamps_ns, b.stamps_ns, assume_unique=True, return_indices=True)
    return a.at(rows_a), b.at(rows_b)


def gaps(whole: Series, other: Series) -> Gaps:
    """Which stamps of the whole the other lacks."""
    lacks = ~np.isin(whole.stamps_ns, other.stamps_ns, assume_unique=True)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lacks, [False]]).astype(np.int8)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2]
    if not lengths.size:
        return Gaps(0, 0, 0, 0)
    longest = int(np.argmax(lengths))
    return Gaps(int(lacks.sum()), lengths.size, int(lengths[longest]), int(whole.stamps_ns[starts[longest]]))


def pose_excess(a: Series, b: Series, limit_m: float, limit_rad: float) -> Excess:
    """Distances [m] and angles [rad] between poses (N, 7) = x y z [m], qx qy qz qw, of the same stamps."""
    away_m = np.linalg.norm(a.values[:, :3] - b.values[:, :3], axis=1)
    amounts = np.column_stack([away_m, _angles(a.values[:, 3:], b.values[:, 3:])])
    return Excess(a.stamps_ns, amounts, (limit_m, limit_rad))


def excess(a: Series, b: Series, limits: tuple[float, float]) -> Excess:
    """Absolute differences of values (N, 2) of the same stamps; NaN, that is unknown, differs from nothing."""
    return Excess(a.stamps_ns, np.nan_to_num(np.abs(a.values - b.values), nan=0.0), limits)


def aligned(poses: Series, T_to_from: Array) -> Series:
    """Poses (N, 7) = x y z [m], qx qy qz qw carried into another world by T_to_from (4, 4)."""
    T = T_to_from @ se3.transform(se3.rotation(poses.values[:, 3:]), poses.values[:, :3])
    return Series(poses.stamps_ns, np.column_stack([T[:, :3, 3], se3.quaternion(T[:, :3, :3])]))


def first_transform(a: Series, b: Series) -> Array:
    """T_a_b (4, 4) between the worlds of two runs, by which their first poses become one."""
    T_a, T_b = (se3.transform(se3.rotation(run.values[0, 3:]), run.values[0, :3]) for run in (a, b))
    return np.asarray(T_a @ se3.inverse(T_b))


def held(changes: Series, stamps_ns: NDArray[np.int64]) -> Series:
    """The values that are in force at the stamps, by a series of changes; NaN before the first of them."""
    rows = np.searchsorted(changes.stamps_ns, stamps_ns, side="right") - 1
    values = np.full((stamps_ns.size, changes.values.shape[1]), np.nan)
    values[rows >= 0] = changes.values[rows[rows >= 0]]
    return Series(stamps_ns, values)


def changes(values: Array) -> int:
    """How often the rows (N, k) become others."""
    return int((np.diff(values, axis=0) != 0.0).any(axis=1).sum())


def _angles(q_a: Array, q_b: Array) -> Array:
    """Angles (N,) [rad] between unit quaternions (N, 4), exactly 0 for equal ones."""
    v_a, w_a, v_b, w_b = q_a[:, :3], q_a[:, 3:], q_b[:, :3], q_b[:, 3:]
    vector = w_a * v_b - w_b * v_a - np.cross(v_a, v_b)
    scalar = np.abs((q_a * q_b).sum(axis=1))
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(vector, axis=1), scalar))


def _first(rows: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(rows)) if rows.any() else None
