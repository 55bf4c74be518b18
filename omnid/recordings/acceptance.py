"""The acceptance drive: a robot goes to and fro between two marks on the floor whose distance was measured.

A round is mark A, mark B, mark A. The distance shows the error of lengths, the return to A the error at the end of a
round, and several rounds how well positions repeat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory

Array = NDArray[np.float64]
Mark = Literal["A", "B"]

# A robot is at rest while it stays within this distance and angle of where it stopped, for this time at least: more
# than the noise of the poses, less than the placing of a robot by hand.
STAND_M: Final = 0.02
STAND_RAD: Final = math.radians(2.0)
STAND_S: Final = 2.0
# A place is a mark if it is nearer to it than this part of the marks' distance: far above any error of odometry.
NEAR_PART: Final = 0.2
# Stands in a row on one mark are nearer: no robot is placed worse by eye, and a wait on the way is farther.
ONE_PLACE_M: Final = 0.3
# Error of a robot that is placed on a mark by eye, of the two placings of a length or a return.
PLACING_M: Final = 0.01
# Headings are compared if the robot is on the mark as it was the first time, turned by less than this.
SAME_WAY_RAD: Final = math.radians(20.0)


@dataclass(frozen=True, slots=True)
class Visit:
    """A time at which the robot was on a mark, and where it was by its poses."""

    mark: Mark
    time_s: float  # since the first pose
    T: Array  # (4, 4)


@dataclass(frozen=True, slots=True)
class Round:
    """The errors of one round."""

    there_m: float  # distance from A to B by the poses
    back_m: float
    way_m: float  # length of the path
    length_error_ratio: float  # of both distances against the measured one; negative: too short
    end_error_m: float  # distance of A at the end from A at the start
    end_heading_rad: float  # NaN where the robot has another heading


@dataclass(frozen=True, slots=True)
class Acceptance:
    """The errors of an acceptance drive."""

    distance_m: float  # between the marks, by tape
    rounds: tuple[Round, ...]
    visits: tuple[Visit, ...]
    repeatability_m: float  # rms distance of the visits from the mean place of their mark; NaN for one round

    @property
    def length_error_ratio(self) -> float:
        """Return the mean error of the distances, against the measured one."""
        return float(np.mean([one.length_error_ratio for one in self.rounds]))

    @property
    def length_spread_ratio(self) -> float:
        """Return the standard deviation of the single distances, against the measured one."""
        return float(np.std([m for one in self.rounds for m in (one.there_m, one.back_m)], ddof=1) / self.distance_m)

    def faults(self, within: float) -> list[str]:
        """Return what exceeds the accepted part of lengths and ways, one line each."""
        lines = []
        limit_m = within * self.distance_m + PLACING_M
        # Each length is judged: in the mean, one that is too long would hide one that is too short. The mean of all is
        # never farther off than the worst.
        lengths = [
            (length_m, f"{way} in round {number}")
            for number, one in enumerate(self.rounds, 1)
            for length_m, way in ((one.there_m, "from A to B"), (one.back_m, "from B to A"))
        ]
        worst_m, worst_way = max(lengths, key=lambda length: abs(length[0] - self.distance_m))
        if abs(worst_m - self.distance_m) > limit_m:
            lines.append(
                f"lengths are off by {100 * self.length_error_ratio:+.2f} % in the mean, the worst by "
                f"{100 * (worst_m / self.distance_m - 1):+.2f} % {worst_way}, expected {100 * within:g} % and the "
                f"{1e3 * PLACING_M:g} mm of placing the robot"
            )
        for number, one in enumerate(self.rounds, 1):
            if one.end_error_m > within * one.way_m + PLACING_M:
                lines.append(
                    f"round {number} ends {1e3 * one.end_error_m:.0f} mm beside its start, expected "
                    f"{1e3 * (within * one.way_m + PLACING_M):.0f} mm on {one.way_m:.1f} m"
                )
        return lines


def visits_by_standing(path: Trajectory, distance_m: float) -> list[Visit]:
    """Return the visits of the marks at which the robot rested; A is where it rested first.

    Places far from both marks are left out, as the robot may wait. Raises OmnidError where no round is found, and
    where a wait may be taken for a mark: two stops apart that may both be on one mark.
    """
    found = list[Visit]()
    for time_s, T in _stands(path):
        mark: Mark = "A"
        if found:
            moved_m = _distance_m(found[0].T, T)
            if abs(moved_m - distance_m) < NEAR_PART * distance_m:
                mark = "B"
            elif moved_m > NEAR_PART * distance_m:
                continue
        # Of several stops on one mark the last one counts for the first A, the first one for all others.
        if found and mark == found[-1].mark:
            _require_one_place(found[-1], time_s, T)
            if len(found) == 1:
                found[0] = Visit(mark, time_s, T)
            continue
        found.append(Visit(mark, time_s, T))
    if len(found) < 3:
        places = ", ".join(f"{visit.mark} at {visit.time_s:.1f} s" for visit in found) or "none"
        raise OmnidError(
            f"expected a robot that stands {STAND_S:g} s on mark A, on B {distance_m:g} m away, and on A again, found "
            f"{places}; check --distance-m, or give the times of the marks: --marks 12.5 60 110"
        )
    return found


def _require_one_place(visit: Visit, time_s: float, T: Array) -> None:
    apart_m = _distance_m(visit.T, T)
    if apart_m > ONE_PLACE_M:
        raise OmnidError(
            f"expected one place of mark {visit.mark}, found stops {apart_m:.2f} m apart, at {visit.time_s:.1f} and "
            f"{time_s:.1f} s; give the times of the marks: --marks 12.5 60 110"
        )


def visits_at_times(path: Trajectory, times_s: Sequence[float]) -> list[Visit]:
    """Return the visits of A, B, A, ... at times since the first pose; OmnidError for times that are none."""
    if len(times_s) < 3 or any(after <= before for before, after in pairwise(times_s)):
        raise OmnidError(f"--marks: expected 3 or more times that rise, of A, B, A ..., found {_listed(times_s)}")
    stamps_s = _seconds(path)
    if times_s[0] < 0 or times_s[-1] > stamps_s[-1]:
        raise OmnidError(
            f"--marks: expected times within the {stamps_s[-1]:.1f} s of the poses, found {_listed(times_s)}"
        )
    return [Visit("B" if k % 2 else "A", time_s, _pose_at(path, stamps_s, time_s)) for k, time_s in enumerate(times_s)]


def accept(path: Trajectory, visits: Sequence[Visit], distance_m: float) -> Acceptance:
    """Return the errors of the rounds of a path, by its poses at the times of the visits.

    path: T_odom_base, or in the map. A way to B without a return is no round and is left out.
    """
    stamps_s = _seconds(path)
    seen = [Visit(visit.mark, visit.time_s, _pose_at(path, stamps_s, visit.time_s)) for visit in visits]
    seen = seen[: len(seen) - 1 + len(seen) % 2]
    rounds = []
    for first, middle, last in zip(seen[:-2:2], seen[1:-1:2], seen[2::2], strict=True):
        there_m, back_m = _distance_m(first.T, middle.T), _distance_m(middle.T, last.T)
        turned_rad = float(se3.yaw(se3.inverse(first.T) @ last.T))
        rounds.append(
            Round(
                there_m,
                back_m,
                _way_m(path, stamps_s, first.time_s, last.time_s),
                (there_m + back_m) / (2 * distance_m) - 1,
                _distance_m(first.T, last.T),
                turned_rad if abs(turned_rad) < SAME_WAY_RAD else math.nan,
            )
        )
    return Acceptance(distance_m, tuple(rounds), tuple(seen), _repeatability_m(seen) if len(rounds) > 1 else math.nan)


def _stands(path: Trajectory) -> list[tuple[float, Array]]:
    """Return the middle time and the mean pose of each time at rest."""
    stamps_s, yaw = _seconds(path), np.unwrap(se3.yaw(path.T))
    found, first = list[tuple[float, Array]](), 0
    while first < len(stamps_s):
        apart = np.linalg.norm(path.T[first:, :3, 3] - path.T[first, :3, 3], axis=1)
        moved = (apart > STAND_M) | (np.abs(yaw[first:] - yaw[first]) > STAND_RAD)
        end = first + int(moved.argmax()) if moved.any() else len(stamps_s)
        if stamps_s[end - 1] - stamps_s[first] >= STAND_S:
            T = path.T[(first + end - 1) // 2].copy()
            T[:3, 3] = path.T[first:end, :3, 3].mean(axis=0)
            found.append((float(stamps_s[first] + stamps_s[end - 1]) / 2, T))
            first = end
        else:
            first += 1
    return found


def _seconds(path: Trajectory) -> Array:
    return np.asarray((path.stamps_ns - path.stamps_ns[0]) * 1e-9)


def _pose_at(path: Trajectory, stamps_s: Array, time_s: float) -> Array:
    """Return the pose at a time: the mean position about it while the robot is at rest, else between its neighbours."""
    after = int(np.clip(np.searchsorted(stamps_s, time_s), 1, len(stamps_s) - 1))
    near = np.abs(stamps_s - time_s) <= STAND_S / 2
    positions = path.T[near, :3, 3]
    part = float(np.clip((time_s - stamps_s[after - 1]) / (stamps_s[after] - stamps_s[after - 1]), 0, 1))
    T = path.T[after if part > 0.5 else after - 1].copy()
    if len(positions) and float(np.ptp(positions, axis=0).max()) < STAND_M:
        T[:3, 3] = positions.mean(axis=0)
    else:
        T[:3, 3] = (1 - part) * path.T[after - 1, :3, 3] + part * path.T[after, :3, 3]
    return np.asarray(T)


def _way_m(path: Trajectory, stamps_s: Array, start_s: float, end_s: float) -> float:
    positions = path.T[(stamps_s >= start_s) & (stamps_s <= end_s), :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _repeatability_m(visits: Sequence[Visit]) -> float:
    squares = list[float]()
    for mark in ("A", "B"):
        places = np.array([visit.T[:3, 3] for visit in visits if visit.mark == mark])
        squares += ((places - places.mean(axis=0)) ** 2).sum(axis=1).tolist()
    return math.sqrt(sum(squares) / len(squares))


def _distance_m(T: Array, other: Array) -> float:
    return float(np.linalg.norm(T[:3, 3] - other[:3, 3]))


def _listed(times_s: Sequence[float]) -> str:
    return ", ".join(f"{time_s:g}" for time_s in times_s) or "none"
