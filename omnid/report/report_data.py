"""Content of a recording for the report, collected in one pass and in bounded memory."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_file import parse_rig
from drivers.logs.log import LogInfo
from drivers.logs.open_log import log_info
from drivers.logs.ros_messages import IMAGE_TYPES
from omnid.formats.tum import POSITION_LIMIT_M
from omnid.recordings.odometry_topic import choose_odometry_topic, no_pose
from omnid.recordings.recording_reader import CLOUD, DRIVE, ODOMETRY, STATUS, TWIST_COMMAND, RecordingReader
from omnid.report.downsampling import Corner, Downsampled, path_trace
from omnid.report.events import Events
from omnid.report.poses import PoseHistory
from omnid.report.status_history import StatusHistory
from omnid.transport.decode import Cloud, Diagnostics, PoseInMap
from omnid.transport.records import OdometryRecord, TwistRecord
from omnid.transport.topics import MAP_POSE

Array = NDArray[np.float64]

_WAITING: Final = 256  # Most poses of odometry that are kept until a later stage gives the pose in the map.
_NO_STATE: Final = 0
MAX_EARLY: Final = 64  # status messages before the first pose
MAX_CLOCK_OFFSET_S: Final = 3600.0  # change of the offset between stamps and times of logging


class MapPoseHistory:
    """Collects the path in the map, and the correction map -> odom; times are in s since the first pose."""

    def __init__(self) -> None:
        self._odometry: OrderedDict[int, Array] = OrderedDict()
        self.path = path_trace()
        self.moved_m, self.turned_deg = Downsampled(), Downsampled()
        self.sigma_m = Downsampled()

    def add_odometry(self, record: OdometryRecord) -> None:
        """Keep a pose of odometry until that in the map comes."""
        self._odometry[record.stamp_ns] = record.T_odom_base
        if len(self._odometry) > _WAITING:
            self._odometry.popitem(last=False)

    def add(self, pose: PoseInMap, t_s: float) -> None:
        """Add a pose in the map; one without a pose of odometry of its stamp is left out."""
        T_odom_base = self._odometry.pop(pose.stamp_ns, None)
        position = pose.T_map_base[:3, 3]
        if T_odom_base is None or not (np.abs(position) <= POSITION_LIMIT_M).all():
            return
        self.path.add(Corner(float(position[0]), float(position[1]), t_s, _NO_STATE))
        # The pose in the map relative to that of odometry: the part of map -> odom that is seen at the robot.
        self.moved_m.add(t_s, float(np.linalg.norm(position[:2] - T_odom_base[:2, 3])))
        turned = float(se3.yaw(pose.T_map_base @ se3.inverse(T_odom_base)))
        self.turned_deg.add(t_s, math.degrees(turned))
        variance = float(np.diag(pose.covariance)[:3].sum())
        self.sigma_m.add(t_s, math.sqrt(variance) if variance > 0 else math.nan)


@dataclass(slots=True)
class DriveHistory:
    """Course of velocity commands."""

    speed: Downsampled = field(default_factory=Downsampled)  # m/s
    yaw_rate: Downsampled = field(default_factory=Downsampled)  # deg/s


@dataclass(slots=True)
class ReportData:
    """Everything that the report shows of a recording."""

    info: LogInfo
    topic: str  # of the odometry
    robot: str
    attachments: Mapping[str, bytes]
    rig: Rig | None
    rig_fault: str  # why there is no rig
    events: Events
    poses: PoseHistory
    statuses: StatusHistory
    map_poses: MapPoseHistory = field(default_factory=MapPoseHistory)
    drives: dict[str, DriveHistory] = field(default_factory=dict)  # by topic: DRIVE, TWIST_COMMAND
    frames: tuple[str, str] = ("odom", "base_link")  # of the odometry
    cloud: Cloud | None = None  # the newest
    unreadable: int = 0  # messages left out: not of their type, or with an invalid stamp
    corrupt: int = 0  # chunks and records of the file left out

    @property
    def T_base_rig(self) -> NDArray[np.float64]:
        """Pose of the rig on the robot; the identity where it is unknown."""
        return np.eye(4) if self.rig is None else self.rig.T_base_rig

    @property
    def has_images(self) -> bool:
        """True if the recording holds images."""
        return any(schema in IMAGE_TYPES for schema, _ in self.info.topics.values())


def collect_report_data(path: Path, topic: str | None = None, keep_poses: bool = False) -> ReportData:
    """Read a recording; topic: of the odometry, see choose_odometry_topic; keep_poses: all of them, for a truth.

    Raise OmnidError where there is no odometry in it, DriverError where there is no log.
    """
    found = log_info(path)
    reader = RecordingReader(found, choose_odometry_topic(found, topic))
    rig, fault = _rig(reader.attachments)
    events = Events()
    poses = PoseHistory(events, keep_poses)
    data = ReportData(
        found,
        reader.topic,
        reader.robot,
        reader.attachments,
        rig,
        fault,
        events,
        poses,
        StatusHistory(events, poses),
    )
    _Collector(data).collect(reader)
    if not data.poses.poses:
        raise no_pose(path, data.topic)
    return data


def _rig(attachments: Mapping[str, bytes]) -> tuple[Rig | None, str]:
    if "rig.toml" not in attachments:
        return None, "no rig.toml is attached"
    try:
        return parse_rig(attachments["rig.toml"]), ""
    except CalibError as error:
        return None, f"the attached rig.toml cannot be read: {error}"


class _Collector:
    """One pass over the messages of a recording."""

    def __init__(self, data: ReportData) -> None:
        self._data = data
        self._pending: OdometryRecord | None = None  # a new state is recorded right after its first pose
        self._offset_ns: int | None = None  # from the stamps of the poses to the times of logging
        self._early: deque[Diagnostics] = deque(maxlen=MAX_EARLY)  # before the first pose

    def collect(self, reader: RecordingReader) -> None:
        """Read all messages."""
        for message in reader.messages((ODOMETRY, MAP_POSE, STATUS, CLOUD, DRIVE, TWIST_COMMAND)):
            match message.content:
                case OdometryRecord():
                    self._add_pose(message.content, message.log_time_ns)
                case PoseInMap():
                    self._add_map_pose(message.content)
                case Diagnostics():
                    self._add_diagnostics(message.content)
                case Cloud():
                    self._data.cloud = message.content
                case TwistRecord():
                    self._add_twist(message.name, message.content)
        self._add_pending()
        self._data.unreadable += reader.unreadable.total()
        self._data.corrupt = reader.corrupt

    def _add_pose(self, record: OdometryRecord, log_time_ns: int) -> None:
        data, offset_ns = self._data, log_time_ns - record.stamp_ns
        if self._offset_ns is None:
            self._offset_ns, data.frames, data.poses.start_ns = offset_ns, record.frames, record.stamp_ns
            for diagnostics in self._early:
                data.statuses.add(diagnostics, data.poses.seconds)
        if abs(offset_ns - self._offset_ns) > MAX_CLOCK_OFFSET_S * 1e9:
            data.unreadable += 1
            return
        self._add_pending()
        self._pending = record
        data.map_poses.add_odometry(record)

    def _add_pending(self) -> None:
        """Add the pose that waits, in the state reported by now."""
        if self._pending is not None:
            self._data.poses.add(self._pending, self._data.statuses.rank)
            self._pending = None

    def _add_diagnostics(self, diagnostics: Diagnostics) -> None:
        if self._offset_ns is None:
            self._early.append(diagnostics)
        else:
            self._data.statuses.add(diagnostics, self._data.poses.seconds)

    def _add_map_pose(self, pose: PoseInMap) -> None:
        if self._offset_ns is not None:
            self._data.map_poses.add(pose, self._data.poses.seconds(pose.stamp_ns))

    def _add_twist(self, name: str, twist: TwistRecord) -> None:
        if self._offset_ns is None:
            return
        drive = self._data.drives.setdefault(name, DriveHistory())
        t_s = self._data.poses.seconds(twist.stamp_ns)
        drive.speed.add(t_s, twist.velocity_mps)
        drive.yaw_rate.add(t_s, math.degrees(twist.yaw_rate_radps))
