"""A recorded run, read once into arrays: poses, states, commands, status entries; and the events that follow from them.

Times are in s since the first pose. A pose takes 300 bytes: an hour at 30 Hz 32 MB.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from calib.errors import CalibError
from calib.rig_file import parse_rig
from omnid.formats.tum import POSITION_LIMIT_M
from omnid.plain_text import MAX_ENTRIES
from omnid.recordings.recording import CLOUD, DRIVE, ODOMETRY, STATUS, TWIST_COMMAND, RecordingReader
from omnid.report.page import Array, Curve
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.codec import Cloud, Diagnostics, DiagnosticStatus, Pose, PoseInMap, TwistRecord
from omnid.transport.status_names import Key, short_name
from omnid.transport.topics import MAP_POSE

STATES: Final = tuple(TrackingState)
UNKNOWN: Final = -1  # rank of a state that is not recorded
LEVELS: Final = ("", "warning", "error")
GOOD, WARNING, ERROR = range(len(LEVELS))
_COUNTERS: Final[Mapping[str, str]] = {  # of faults, with the text of the event when one rises
    Key.DROPS: "images dropped",
    Key.DROPPED: "messages dropped",
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
    """An event of a run."""

    start_s: float
    end_s: float
    level: int
    source: str
    text: str
    count: int = 0  # by which a counter rose; 0: no counter


class RecordedRun:
    """Everything that the report shows of a recording. N poses.

    path, log (closed), topic (of the odometry), robot, attachments, frames (of the odometry)
    T_base_rig (4, 4), the identity where no rig that can be read is attached; height_m: of the cameras, 0 if unknown
    start_ns: stamp of the first pose; t_s (N,) rising; T_odom_base (N, 4, 4)
    variances (N, 6) of x y z rx ry rz; velocity (N, 6) m/s, rad/s
    ranks (N,): of the state in STATES, UNKNOWN where it is not recorded
    by_name: times and entries of each part in the order of the file; newest: entries with the newest of all values
    map_xy (M, 2) m: the path in the map; drives: (K, 3) t, m/s, rad/s by topic, DRIVE or TWIST_COMMAND; cloud: the
    newest; resets: number of resets of odometry
    left_out: messages not of their type, poses out of range or not later than the one before
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
        """Read a recording; topic: of the odometry, see RecordingReader.

        Raise OmnidError where there is no odometry in it, DriverError where there is no log.
        """
        reader = RecordingReader(path, topic)
        self.path, self.log, self.topic, self.robot = path, reader.log, reader.topic, reader.robot
        self.attachments = reader.log.attachments()
        # 1. All messages.
        poses, map_xy, left_out = list[Pose](), list[Array](), 0
        entries: dict[str, list[tuple[int, DiagnosticStatus]]] = {}
        drives: dict[str, list[TwistRecord]] = {}
        self.cloud: Cloud | None = None
        for message in reader.messages((ODOMETRY, MAP_POSE, STATUS, CLOUD, DRIVE, TWIST_COMMAND)):
            match message.content:
                case Pose() as pose:
                    is_later = not poses or pose.stamp_ns > poses[-1].stamp_ns
                    if is_later and (np.abs(pose.T_odom_base[:-1, -1]) <= POSITION_LIMIT_M).all():
                        poses.append(pose)
                    else:
                        left_out += 1
                case PoseInMap() as in_map if (np.abs(in_map.T_map_base[:-1, -1]) <= POSITION_LIMIT_M).all():
                    map_xy.append(in_map.T_map_base[:2, -1])
                case Diagnostics(stamp_ns, statuses):
                    for status in statuses:
                        if status.name in entries or len(entries) < MAX_ENTRIES:
                            entries.setdefault(status.name, []).append((stamp_ns, status))
                case Cloud():
                    self.cloud = message.content
                case TwistRecord():
                    drives.setdefault(message.name, []).append(message.content)
        reader.close()
        if not poses:
            raise reader.no_pose()
        self.left_out = reader.unreadable.total() + left_out
        # 2. The rig.
        self.T_base_rig, self.height_m = np.eye(4), 0.0
        with suppress(CalibError):
            rig = parse_rig(self.attachments.get("rig.toml", b""))
            self.T_base_rig, self.height_m = rig.T_base_rig, rig.height_m() or 0.0
        # 3. The arrays.
        self.start_ns, self.frames = poses[0].stamp_ns, poses[0].frames

        def seconds(stamp_ns: int) -> float:
            return (stamp_ns - self.start_ns) * 1e-9

        self.t_s = np.array([seconds(pose.stamp_ns) for pose in poses])
        self.T_odom_base = np.array([pose.T_odom_base for pose in poses])
        self.variances = np.array([np.diag(pose.covariance) for pose in poses])
        self.velocity = np.array([pose.velocity for pose in poses])
        self.map_xy = np.array(map_xy).reshape(-1, 2)
        self.drives = {
            name: np.array([(seconds(twist.stamp_ns), twist.velocity_mps, twist.yaw_rate_radps) for twist in twists])
            for name, twists in drives.items()
        }
        # 4. The entries of each part with their times, and its newest values.
        self.by_name = {name: [(seconds(at_ns), status) for at_ns, status in found] for name, found in entries.items()}
        self.newest: dict[str, DiagnosticStatus] = {}
        for name, found in self.by_name.items():
            values = {key: value for _, status in found for key, value in status.values.items()}
            self.newest[name] = replace(found[-1][1], values=dict([*values.items()][:MAX_ENTRIES]))
        # 5. The state of each pose, and resets. An entry with `state` has the stamp of the first pose in it; others
        #    have the state of an earlier pose.
        of_odometry = self.by_name.get(status_names.ODOMETRY, [])
        of_odometry = [(t, status) for t, status in of_odometry if Key.STATE in status.values] or of_odometry
        states = [(t, status_names.tracking_state(status.message, status.values)) for t, status in of_odometry]
        known = sorted((t, STATES.index(state)) for t, state in states if state is not None)
        ranks = np.array([UNKNOWN, *(rank for _, rank in known)])
        self.ranks = ranks[np.searchsorted([t for t, _ in known], self.t_s + 1e-9, side="right")]
        self.resets = int(max(self.curve("", status_names.ODOMETRY, Key.RESETS).values, default=0))

    @property
    def xyz(self) -> Array:
        """Positions of the robot (N, 3) in odom, m."""
        return self.T_odom_base[:, :-1, -1]

    @property
    def end_s(self) -> float:
        """Time of the last pose."""
        return float(self.t_s[-1])

    def curve(self, title: str, name: str, key: str) -> Curve:
        """Return a number of a part over time as a curve with that title."""
        found = [(t_s, status_names.number(status.values.get(key, ""))) for t_s, status in self.by_name.get(name, [])]
        known = sorted((t_s, value) for t_s, value in found if value is not None)
        return Curve(title, np.array([t_s for t_s, _ in known]), np.array([value for _, value in known]))

    def values(self, name: str) -> Mapping[str, str]:
        """Return the newest values of a part."""
        return self.newest[name].values if name in self.newest else {}

    def length_m(self) -> float:
        """Return the length of the path."""
        return float(np.linalg.norm(np.diff(self.xyz, axis=0), axis=1).sum())

    def events(self) -> list[Event]:
        """Return the events in the order of time."""
        # 1. Times without a pose: half a second, and five periods.
        steps_s = np.diff(self.t_s)
        gaps = np.flatnonzero(steps_s > max(0.5, 5.0 * float(np.median(steps_s)) if len(steps_s) > 2 else 0.0))
        found = [
            Event(float(self.t_s[at]), float(self.t_s[at + 1]), WARNING, "poses", f"none for {steps_s[at]:.2f} s")
            for at in gaps
        ]
        # 2. Changes of the state; a run that begins well is no event.
        for index in np.flatnonzero(np.diff(self.ranks, prepend=UNKNOWN)):
            rank, t_s = int(self.ranks[index]), float(self.t_s[index])
            if index or rank != 0:
                text = STATES[rank] if rank >= 0 else "unknown"
                found.append(Event(t_s, t_s, (GOOD, WARNING, ERROR)[max(rank, 0)], "state", text))
        # 3. Messages and counters of all parts.
        for name in self.newest:
            found += self._message_events(name) if name != status_names.ODOMETRY else ()
            found += self._counter_events(name)
        return sorted(found, key=lambda event: event.start_s)

    def _message_events(self, name: str) -> Iterator[Event]:
        """Yield the changes of a part's message; a change of digits only is none."""
        before = None
        for t_s, status in self.by_name[name]:
            message = status.message.translate(_DIGITS)
            if message and message != before and (before is not None or status.level > 0):
                yield Event(t_s, t_s, min(status.level, ERROR), short_name(name), status.message)
            before = message

    def _counter_events(self, name: str) -> Iterator[Event]:
        """Yield the rises of a part's counters of faults; the first value was counted before the recording.

        Rises at most 2.5 s apart are one event.
        """
        first_s = min(found[0][0] for found in self.by_name.values())
        for key in self.values(name):
            is_reason = key.startswith(_REASONS)
            if not (key in _COUNTERS or is_reason):
                continue
            _, t_s, counts = self.curve("", name, key)
            if is_reason and len(t_s) and t_s[0] > first_s:  # The counter of a reason appears with its first count.
                t_s, counts = np.insert(t_s, 0, t_s[0]), np.insert(counts, 0, 0.0)
            rises = np.diff(counts)
            at = np.flatnonzero(rises > 0)
            for same in np.split(at, np.flatnonzero(np.diff(t_s[at + 1]) > 2.5) + 1):
                if len(same):
                    start_s, end_s = float(t_s[same[0] + 1]), float(t_s[same[-1] + 1])
                    text, count = _COUNTERS.get(key, key), int(rises[same].sum())
                    yield Event(start_s, end_s, WARNING, short_name(name), text, count)
