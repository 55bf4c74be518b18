"""The poses of a recording: path, states, speeds, standard deviations and gaps."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.formats.tum import POSITION_LIMIT_M, Trajectory
from omnid.report.downsampling import Corner, Downsampled, path_trace
from omnid.report.events import ERROR, GOOD, WARNING, Event, Events
from omnid.tracking_state import TrackingState
from omnid.transport.records import OdometryRecord

STATES: Final = tuple(TrackingState)
UNKNOWN: Final = -1  # rank of a state that is not recorded
GAP_S: Final = 0.5  # A gap is a time without pose; where poses are rare, GAP_PERIODS times their mean period.
GAP_PERIODS: Final = 5.0
MAX_KEPT: Final = 500_000  # whole poses, for the comparison with a truth: 4.6 h at 30 Hz, 32 MB
_MAX_GAPS: Final = 200
_PERIOD_GAIN: Final = 0.1  # Gain of the running mean of the period.
_SERIES: Final = ("speed", "yaw_rate", "sigma_position", "sigma_heading", "state", "height")

Array = NDArray[np.float64]


class _Gap(NamedTuple):
    """A time without pose; sorts by its duration."""

    duration_s: float = 0.0
    step_m: float = 0.0  # between the poses before and after it
    end_s: float = 0.0


class PoseHistory:
    """Collects the poses in their order; times are in s since the first one."""

    def __init__(self, events: Events, keep: bool) -> None:
        self._events, self._keep = events, keep
        self._kept = (array("q"), array("d"))
        self._position: Array | None = None
        self._period_s = math.nan
        self._rank = UNKNOWN
        self.start_ns = 0  # stamp of the first pose
        self.end_s = 0.0
        self.first = np.eye(4)
        self.path = path_trace()
        self.series = {name: Downsampled() for name in _SERIES}
        self.gaps: list[tuple[float, float]] = []
        self.states: Counter[int] = Counter()
        self.poses = self.late = self.out_of_range = 0
        self.length_m = 0.0
        self.restarts_s: list[float] = []  # of the first pose after each start of the daemon but the first
        self._gap = _Gap()  # the longest since `continue_run`
        self._leaves_out_gap = False  # the step across the next gap is that from one odom to another

    def add(self, record: OdometryRecord, rank: int) -> None:
        """Add a pose; rank: of its state in STATES."""
        if not (np.abs(record.T_odom_base[:3, 3]) <= POSITION_LIMIT_M).all():
            self.out_of_range += 1
            return
        if not self.poses:
            self.first = record.T_odom_base
        t_s = self.seconds(record.stamp_ns)
        if self.poses and t_s <= self.end_s:
            self.late += 1
            return
        gap_s = self._add_gap(t_s)
        self._add_state(t_s, rank)
        self._add_position(record, t_s, gap_s)
        self._add_measurements(record, t_s)
        self.end_s, self.poses = t_s, self.poses + 1

    def continue_run(self) -> None:
        """Note that the poses so far are of one run of the daemon."""
        self._gap, self._leaves_out_gap = _Gap(), False

    def begin_run(self) -> None:
        """Note that the daemon has been started again, with a new odom, since the last call of `continue_run`.

        The step across the longest gap since then is no part of the path; without one, that across the next gap.
        """
        gap = self._gap
        self.length_m -= gap.step_m
        self.continue_run()
        if gap.duration_s > 0.0:
            self._add_restart(gap.end_s)
        self._leaves_out_gap = gap.duration_s == 0.0 and self.poses > 0

    def seconds(self, stamp_ns: int) -> float:
        """Return the time since the first pose."""
        return (stamp_ns - self.start_ns) * 1e-9

    @property
    def trajectory(self) -> Trajectory:
        """The first MAX_KEPT poses, T_odom_base; empty unless they are kept."""
        stamps_ns, numbers = np.array(self._kept[0], np.int64), np.array(self._kept[1]).reshape(-1, 7)
        return Trajectory(stamps_ns, se3.transform(se3.rotation(numbers[:, 3:]), numbers[:, :3]))

    def _add_gap(self, t_s: float) -> float:
        """Return the duration of the gap before a pose, s; 0 where there is none."""
        step_s = t_s - self.end_s
        if not self.poses or step_s <= 0:
            return 0.0
        if step_s > max(GAP_S, GAP_PERIODS * (self._period_s if self.poses > 2 else step_s)):
            self.gaps = [*self.gaps, (self.end_s, t_s)][-_MAX_GAPS:]
            self._events.add(Event(self.end_s, t_s, WARNING, "poses", f"none for {step_s:.2f} s"))
            return step_s
        if math.isnan(self._period_s):
            self._period_s = step_s
        else:
            self._period_s += _PERIOD_GAIN * (step_s - self._period_s)
        return 0.0

    def _add_state(self, t_s: float, rank: int) -> None:
        self.states[rank] += 1
        if rank != self._rank and not (self._rank == UNKNOWN and rank == 0):
            level = (GOOD, WARNING, ERROR)[max(rank, 0)]
            self._events.add(Event(t_s, t_s, level, "state", STATES[rank] if rank >= 0 else "unknown"))
        self._rank = rank
        if rank != UNKNOWN:
            self.series["state"].add(t_s, rank)

    def _add_position(self, record: OdometryRecord, t_s: float, gap_s: float) -> None:
        """Add a position; gap_s: duration of the gap before it, 0 without one."""
        position = record.T_odom_base[:3, 3]
        step_m = 0.0 if self._position is None else float(np.linalg.norm(position - self._position))
        if gap_s > 0.0 and self._leaves_out_gap:
            self.continue_run()
            self._add_restart(t_s)
        else:
            self.length_m += step_m
            self._gap = max(self._gap, _Gap(gap_s, step_m, t_s) if gap_s > 0.0 else _Gap())
        self._position = position
        self.path.add(Corner(float(position[0]), float(position[1]), t_s, self._rank))
        if self._keep and self.poses < MAX_KEPT:
            self._kept[0].append(record.stamp_ns)
            self._kept[1].extend([*position, *se3.quaternion(record.T_odom_base[:3, :3])])

    def _add_restart(self, t_s: float) -> None:
        self.restarts_s = [*self.restarts_s, t_s][-_MAX_GAPS:]

    def _add_measurements(self, record: OdometryRecord, t_s: float) -> None:
        variances = np.diag(record.covariance)
        measured = {
            "speed": record.velocity[0],
            "yaw_rate": math.degrees(record.velocity[5]),
            "sigma_position": _root(float(variances[:3].sum())),
            "sigma_heading": math.degrees(_root(float(variances[5]))),
            "height": record.T_odom_base[2, 3],
        }
        for name, value in measured.items():
            self.series[name].add(t_s, float(value))


def _root(variance: float) -> float:
    """Return the standard deviation; NaN for a variance that is not positive, which means that it was not set."""
    return math.sqrt(variance) if variance > 0 else math.nan
