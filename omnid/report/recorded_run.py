"""A recorded run, read once into arrays: poses, states, commands, status entries; and the events that follow from them.

Times are in s since the first pose. A pose takes 300 bytes: an hour at 30 Hz 32 MB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_file import parse_rig
from drivers.logs.open_log import log_info
from omnid.formats.tum import POSITION_LIMIT_M
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.recordings.recording import (
    CLOUD,
    DRIVE,
    ODOMETRY,
    STATUS,
    TWIST_COMMAND,
    RecordingReader,
    choose_odometry_topic,
    no_pose,
)
from omnid.report.charts import Array, Curve
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.codec import Cloud, Diagnostics, DiagnosticStatus, Pose, PoseInMap, TwistRecord
from omnid.transport.status_names import Key, short_name
from omnid.transport.topics import MAP_POSE

STATES: Final = tuple(TrackingState)
UNKNOWN: Final = -1  # rank of a state that is not recorded
GOOD, WARNING, ERROR = range(3)
_COUNTERS: Final[Mapping[str, str]] = {  # of faults, with the text of the event when one rises
    Key.DROPS: "images dropped",
    Key.DROPPED: "messages dropped",
    Key.MISSED: "deadlines missed",
    Key.ERRORS: "errors",
    Key.LOSSES: "camera lost",
    Key.RESTARTS: "stream restarted",
    Key.RESETS: "odometry was reset, with an unknown gap",
    Key.BROKEN: "images that cannot be decoded",
    Key.EXPIRIES: "watchdog expired",
    Key.UNPAIRED_LOWER: "lower images without a partner",
    Key.UNPAIRED_UPPER: "upper images without a partner",
}
_REASONS: Final = (status_names.STOPPED_PREFIX, status_names.REFUSED_PREFIX)  # begin counters with a reason
_DIGITS: Final = str.maketrans("", "", "0123456789")


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened."""

    start_s: float
    end_s: float
    level: int
    source: str
    text: str
    count: int = 0  # by which a counter rose; 0: no counter


class RecordedRun:
    """Everything that the report shows of a recording. N poses.

    path, info (LogInfo), topic (of the odometry), robot, attachments, frames (of the odometry)
    rig, or None and why there is none (rig_fault)
    start_ns: stamp of the first pose; t_s (N,) rising; T_odom_base (N, 4, 4)
    variances (N, 6) of x y z rx ry rz; velocity (N, 6) m/s, rad/s
    ranks (N,): of the state in STATES, UNKNOWN where it is not recorded
    statuses: messages in the order of the file; by_name: times and entries of each part; newest: entries with the
    newest of all values
    map_poses (M, 3): t, position's and heading's correction by the map [m, rad]; map_xy (M, 2) m
    drives: (K, 3) t, m/s, rad/s by topic, DRIVE or TWIST_COMMAND; cloud: the newest
    resets: number of resets of odometry
    left_out: messages not of their type, poses out of range or not later than the one before; corrupt: chunks and
    records of the file left out
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        """Read a recording; topic: of the odometry, see choose_odometry_topic.

        Raise OmnidError where there is no odometry in it, DriverError where there is no log.
        """
        self.path, self.info = path, log_info(path)
        reader = RecordingReader(self.info, choose_odometry_topic(self.info, topic))
        self.topic, self.robot, self.attachments = reader.topic, reader.robot, reader.attachments
        # 1. All messages.
        poses, map_poses = list[Pose](), list[PoseInMap]()
        statuses, names = list[Diagnostics](), set[str]()
        drives: dict[str, list[TwistRecord]] = {}
        self.cloud: Cloud | None = None
        left_out = 0
        for message in reader.messages((ODOMETRY, MAP_POSE, STATUS, CLOUD, DRIVE, TWIST_COMMAND)):
            match message.content:
                case Pose() as pose:
                    is_later = not poses or pose.stamp_ns > poses[-1].stamp_ns
                    if is_later and (np.abs(pose.T_odom_base[:-1, -1]) <= POSITION_LIMIT_M).all():
                        poses.append(pose)
                    else:
                        left_out += 1
                case PoseInMap() as in_map if (np.abs(in_map.T_map_base[:-1, -1]) <= POSITION_LIMIT_M).all():
                    map_poses.append(in_map)
                case Diagnostics(stamp_ns, entries):
                    bounded = [_bounded(status) for status in entries]
                    names |= {status.name for status in bounded[: MOST_ENTRIES - len(names)]}
                    statuses.append(Diagnostics(stamp_ns, tuple(status for status in bounded if status.name in names)))
                case Cloud():
                    self.cloud = message.content
                case TwistRecord():
                    drives.setdefault(message.name, []).append(message.content)
        if not poses:
            raise no_pose(path, reader.topic)
        self.left_out, self.corrupt = reader.unreadable.total() + left_out, reader.corrupt
        # 2. The rig.
        self.rig: Rig | None = None
        self.rig_fault = "no rig.toml is attached"
        if (rig_toml := reader.attachments.get("rig.toml")) is not None:
            try:
                self.rig = parse_rig(rig_toml)
            except CalibError as error:
                self.rig_fault = f"the attached rig.toml cannot be read: {error}"
        # 3. The arrays.
        self.start_ns, self.frames = poses[0].stamp_ns, poses[0].frames

        def seconds(stamp_ns: int) -> float:
            return (stamp_ns - self.start_ns) * 1e-9

        self.t_s = np.array([seconds(pose.stamp_ns) for pose in poses])
        self.T_odom_base = np.array([pose.T_odom_base for pose in poses])
        self.variances = np.array([np.diag(pose.covariance) for pose in poses])
        self.velocity = np.array([pose.velocity for pose in poses])
        self.statuses = [(seconds(report.stamp_ns), report.statuses) for report in statuses]
        self.drives = {
            name: np.array([(seconds(twist.stamp_ns), twist.velocity_mps, twist.yaw_rate_radps) for twist in twists])
            for name, twists in drives.items()
        }
        # 4. The pose in the map relative to that of odometry with the same stamp: map -> odom as seen at the robot.
        by_stamp = {pose.stamp_ns: pose.T_odom_base for pose in poses}
        corrections, map_xy = [], []
        for in_map in map_poses:
            if (T_odom := by_stamp.get(in_map.stamp_ns)) is not None:
                T_map = in_map.T_map_base
                moved_m, turned_rad = math.dist(T_map[:2, -1], T_odom[:2, -1]), se3.yaw(T_map @ se3.inverse(T_odom))
                corrections.append((seconds(in_map.stamp_ns), moved_m, turned_rad))
                map_xy.append(T_map[:2, -1])
        self.map_poses, self.map_xy = np.array(corrections).reshape(-1, 3), np.array(map_xy).reshape(-1, 2)
        # 5. The newest values of each part, the state of each pose, resets.
        self.newest: dict[str, DiagnosticStatus] = {}
        self.by_name: dict[str, list[tuple[float, DiagnosticStatus]]] = {}
        for t_s, status in ((t_s, status) for t_s, report in self.statuses for status in report):
            self.by_name.setdefault(status.name, []).append((t_s, status))
            values = self.newest[status.name].values if status.name in self.newest else {}
            merged = dict([*{**values, **status.values}.items()][:MOST_ENTRIES])
            self.newest[status.name] = replace(status, values=merged)
        # An entry with `state` has the stamp of the first pose in it; others tell the state of an earlier pose.
        found = self.entries(status_names.ODOMETRY)
        found = [(t, status) for t, status in found if Key.STATE in status.values] or found
        states = [(t, status_names.tracking_state(status.message, status.values)) for t, status in found]
        known = sorted((t, STATES.index(state)) for t, state in states if state is not None)
        ranks = np.array([UNKNOWN, *(rank for _, rank in known)])
        self.ranks = ranks[np.searchsorted([t for t, _ in known], self.t_s + 1e-9, side="right")]
        self.resets = int(max(self.series(status_names.ODOMETRY, Key.RESETS)[1], default=0))

    @property
    def T_base_rig(self) -> Array:
        """Pose of the rig on the robot; the identity where it is unknown."""
        return np.eye(4) if self.rig is None else self.rig.T_base_rig

    @property
    def xyz(self) -> Array:
        """Positions of the robot (N, 3) in odom, m."""
        return self.T_odom_base[:, :-1, -1]

    @property
    def end_s(self) -> float:
        """Time of the last pose."""
        return float(self.t_s[-1])

    def entries(self, name: str) -> Sequence[tuple[float, DiagnosticStatus]]:
        """Return the entries of a part with their times, in the order of the file."""
        return self.by_name.get(name, [])

    def series(self, name: str, key: str) -> tuple[Array, Array]:
        """Return times and values of a number of a part."""
        found = [(t_s, status_names.number(status.values.get(key, ""))) for t_s, status in self.entries(name)]
        known = sorted((t_s, value) for t_s, value in found if value is not None)
        return np.array([t_s for t_s, _ in known]), np.array([value for _, value in known])

    def curve(self, title: str, name: str, key: str) -> Curve:
        """Return a number of a part as a curve with that title."""
        return Curve(title, *self.series(name, key))

    def values(self, name: str) -> Mapping[str, str]:
        """Return the newest values of a part."""
        return self.newest[name].values if name in self.newest else {}

    def gaps(self) -> Array:
        """Return begin and end (G, 2) of the times without a pose: half a second, and five periods."""
        steps_s = np.diff(self.t_s)
        longest_s = max(0.5, 5.0 * float(np.median(steps_s))) if len(steps_s) > 2 else 0.5
        return np.column_stack([self.t_s[:-1], self.t_s[1:]])[steps_s > longest_s]

    def length_m(self) -> float:
        """Return the length of the path."""
        return float(np.linalg.norm(np.diff(self.xyz, axis=0), axis=1).sum())

    def events(self) -> list[Event]:
        """Return the events in the order of time."""
        found = [Event(a, b, WARNING, "poses", f"none for {b - a:.2f} s") for a, b in self.gaps()]
        for index in np.flatnonzero(np.diff(self.ranks, prepend=UNKNOWN)):
            rank, t_s = int(self.ranks[index]), float(self.t_s[index])
            if index or rank != 0:  # a run that begins well is no event
                text = STATES[rank] if rank >= 0 else "unknown"
                found.append(Event(t_s, t_s, (GOOD, WARNING, ERROR)[max(rank, 0)], "state", text))
        for name in self.newest:
            found += self._message_events(name) if name not in (status_names.ODOMETRY, status_names.SUMMARY) else ()
            found += self._counter_events(name)
        return sorted(found, key=lambda event: event.start_s)

    def _message_events(self, name: str) -> Iterator[Event]:
        """Yield the changes of a part's message; a change of digits only is none."""
        before = None
        for t_s, status in self.entries(name):
            message = status.message.translate(_DIGITS)
            if message and message != before and (before is not None or status.level > 0):
                level = (GOOD, WARNING, ERROR, ERROR)[min(status.level, 3)]
                yield Event(t_s, t_s, level, short_name(name), status.message)
            before = message

    def _counter_events(self, name: str) -> Iterator[Event]:
        """Yield the rises of a part's counters of faults; the first value is from before the recording.

        One that rises again with the next report but one is the same event.
        """
        for key in self.values(name):
            is_reason = key.startswith(_REASONS)
            if not (key in _COUNTERS or is_reason):
                continue
            t_s, counts = self.series(name, key)
            if is_reason and len(t_s) and t_s[0] > self.statuses[0][0]:  # the first one of this reason
                t_s, counts = np.insert(t_s, 0, t_s[0]), np.insert(counts, 0, 0.0)
            rises = np.diff(counts)
            at = np.flatnonzero(rises > 0)
            for same in np.split(at, np.flatnonzero(np.diff(t_s[at + 1]) > 2.5) + 1):
                if len(same):
                    start_s, end_s = float(t_s[same[0] + 1]), float(t_s[same[-1] + 1])
                    text, count = _COUNTERS.get(key, key), int(rises[same].sum())
                    yield Event(start_s, end_s, WARNING, short_name(name), text, count)


def root(variances: Array) -> Array:
    """Return standard deviations; NaN for a variance that is not positive, which means that it was not set."""
    return np.sqrt(np.where(variances > 0, variances, np.nan))


def _bounded(status: DiagnosticStatus) -> DiagnosticStatus:
    """Return a status as the report shows it: with short texts, and not too many."""
    values = {plain(key): plain(value) for key, value in [*status.values.items()][:MOST_ENTRIES]}
    return DiagnosticStatus(plain(status.name), status.level, plain(status.message), values)
