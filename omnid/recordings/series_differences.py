"""Differences between series of two recorded runs: poses, states and commands of the same stamps, as arrays."""

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
        """Return the rows with these indices."""
        return Series(self.stamps_ns[rows], self.values[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Excess:
    """Differences of two runs at the stamps that are in both, one row per stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    amounts: Array  # (N, 2) in the units of the limits, >= 0
    limits: tuple[float, float]  # within which the runs agree

    @property
    def first(self) -> int | None:
        """First row that is beyond a limit in either column; None where all agree."""
        return _first(np.any(self.amounts > self.limits, axis=1))

    @property
    def beyond(self) -> int:
        """Number of rows beyond a limit."""
        return int(np.count_nonzero(np.any(self.amounts > self.limits, axis=1)))

    @property
    def first_different(self) -> int | None:
        """First row that is not bit-identical; None where all are."""
        return _first(np.any(self.amounts > 0.0, axis=1))


@dataclass(frozen=True, slots=True)
class Gaps:
    """Rows of one run that the other lacks."""

    missing: int
    stretches: int  # of consecutive missing rows
    longest: int  # rows in the longest stretch
    longest_ns: int  # stamp of its first row; 0 without any


def in_both(a: Series, b: Series) -> tuple[Series, Series]:
    """Return the rows of both series whose stamps, to the nanosecond, are in both."""
    _, rows_a, rows_b = np.intersect1d(a.stamps_ns, b.stamps_ns, assume_unique=True, return_indices=True)
    return a.at(rows_a), b.at(rows_b)


def gaps(whole: Series, other: Series) -> Gaps:
    """Return the gaps of a series: stamps of the whole that are not in the other."""
    lacks = ~np.isin(whole.stamps_ns, other.stamps_ns, assume_unique=True)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lacks, [False]]).astype(np.int8)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2]
    if not lengths.size:
        return Gaps(0, 0, 0, 0)
    longest = int(np.argmax(lengths))
    return Gaps(int(lacks.sum()), lengths.size, int(lengths[longest]), int(whole.stamps_ns[starts[longest]]))


def pose_excess(a: Series, b: Series, limit_m: float, limit_rad: float) -> Excess:
    """Return distances [m] and angles [rad] between poses (N, 7) = x y z [m], qx qy qz qw, of the same stamps."""
    distances_m = np.linalg.norm(a.values[:, :3] - b.values[:, :3], axis=1)
    amounts = np.column_stack([distances_m, _angles(a.values[:, 3:], b.values[:, 3:])])
    return Excess(a.stamps_ns, amounts, (limit_m, limit_rad))


def excess(a: Series, b: Series, limits: tuple[float, float]) -> Excess:
    """Return absolute differences of values (N, 2) of the same stamps; NaN means unknown and counts as equal."""
    return Excess(a.stamps_ns, np.nan_to_num(np.abs(a.values - b.values), nan=0.0), limits)


def aligned(poses: Series, T_to_from: Array) -> Series:
    """Return poses (N, 7) = x y z [m], qx qy qz qw transformed into another world by T_to_from (4, 4)."""
    T = T_to_from @ se3.transform(se3.rotation(poses.values[:, 3:]), poses.values[:, :3])
    return Series(poses.stamps_ns, np.column_stack([T[:, :3, 3], se3.quaternion(T[:, :3, :3])]))


def first_transform(a: Series, b: Series) -> Array:
    """Return T_a_b (4, 4) between the worlds of two runs in which their first poses coincide."""
    T_a, T_b = (se3.transform(se3.rotation(run.values[0, 3:]), run.values[0, :3]) for run in (a, b))
    return np.asarray(T_a @ se3.inverse(T_b))


def held(changes: Series, stamps_ns: NDArray[np.int64]) -> Series:
    """Return the values in force at the stamps according to a series of changes; NaN before the first change."""
    rows = np.searchsorted(changes.stamps_ns, stamps_ns, side="right") - 1
    values = np.full((stamps_ns.size, changes.values.shape[1]), np.nan)
    values[rows >= 0] = changes.values[rows[rows >= 0]]
    return Series(stamps_ns, values)


def changes(values: Array) -> int:
    """Return how often consecutive rows of (N, k) differ."""
    return int((np.diff(values, axis=0) != 0.0).any(axis=1).sum())


def _angles(q_a: Array, q_b: Array) -> Array:
    """Return angles (N,) [rad] between unit quaternions (N, 4), exactly 0 for equal ones."""
    v_a, w_a, v_b, w_b = q_a[:, :3], q_a[:, 3:], q_b[:, :3], q_b[:, 3:]
    vector = w_a * v_b - w_b * v_a - np.cross(v_a, v_b)
    scalar = np.abs((q_a * q_b).sum(axis=1))
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(vector, axis=1), scalar))


def _first(rows: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(rows)) if rows.any() else None
