"""A recording, read once from its beginning to its end into what a report needs."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_file import parse_rig
from drivers.logs.mcap_catalog import Catalog, LogTopic
from drivers.logs.mcap_index import read_attachments, read_summary
from drivers.logs.mcap_info import LogInfo, read_log_info
from drivers.logs.mcap_messages import DataSection, LogMessage
from drivers.logs.mcap_records import LogFile, RecordError
from drivers.logs.ros_image import COMPRESSED_IMAGE, IMAGE
from omnid.errors import OmnidError
from omnid.report.downsampling import Downsampled
from omnid.report.events import Events
from omnid.report.poses import PoseHistory
from omnid.report.statuses import StatusHistory
from omnid.transport.codec import (
    DIAGNOSTICS_SCHEMA,
    ODOMETRY_SCHEMA,
    POINT_CLOUD_SCHEMA,
    TWIST_SCHEMA,
    OdometryRecord,
    odometry_from_cdr,
    twist_from_cdr,
)
from omnid.transport.decode import Cloud, Diagnostics, decode_cloud, decode_diagnostics

LARGEST_MESSAGE: Final = 64 * 2**20  # bytes
EARLY: Final = 64  # reports
STRAY_S: Final = 3600.0  # by which a stamp may leave the time of logging, once both started together


@dataclass(slots=True)
class DriveCommand:
    """Speeds that the wheels were told, or asked for."""

    speed: Downsampled = field(default_factory=Downsampled)  # m/s
    yaw_rate: Downsampled = field(default_factory=Downsampled)  # deg/s


@dataclass(slots=True)
class ReportData:
    """What a log holds, in bounded memory."""

    survey: LogInfo
    topic: str  # of the odometry
    attachments: Mapping[str, bytes]
    rig: Rig | None
    rig_fault: str  # why there is none
    events: Events
    poses: PoseHistory
    statuses: StatusHistory
    drives: dict[str, DriveCommand] = field(default_factory=dict)  # "told" to the wheels, "asked" of the robot
    frames: tuple[str, str] = ("odom", "base_link")  # of the odometry
    cloud: Cloud | None = None
    unread: int = 0  # messages that are not what their type says, or of a senseless time

    @property
    def robot(self) -> str:
        """The first part of the topic, as omnid names them; the whole topic otherwise."""
        parts = self.topic.strip("/").split("/")
        return parts[0] if len(parts) > 1 else self.topic

    @property
    def T_base_rig(self) -> NDArray[np.float64]:
        """Where the rig stands on the robot; the identity where nobody says so."""
        return np.eye(4) if self.rig is None else self.rig.T_base_rig

    @property
    def images(self) -> bool:
        """Whether the cameras' images are there as well."""
        return any(kind in (IMAGE, COMPRESSED_IMAGE) for kind, _ in self.survey.topics.values())


def read_recording(path: Path, topic: str | None = None, keep_poses: bool = False) -> ReportData:
    """All of a log; topic: the odometry where there are several; keep_poses: each of them, to compare with a truth.

    OmnidError where there is no odometry in it, DriverError where there is no log.
    """
    found = read_log_info(path)
    with closing(LogFile(path)) as file:
        summary = read_summary(file)
        attachments = read_attachments(file, summary)
        rig, fault = _rig(attachments)
        events = Events()
        recording = ReportData(found, choose_odometry(found, topic), attachments, rig, fault, events,
                              PoseHistory(events, keep_poses), StatusHistory(events))
        reading = _Reading(recording)
        section = DataSection(file, summary.catalog if summary else Catalog())
        reading.take(section.messages(), section.catalog)
    if not recording.poses.poses:
        raise OmnidError(f"{path}: {recording.topic} holds not one pose that can be read: is the log whole? "
                         f"`omnid log info {path}` tells")
    return recording


def choose_odometry(found: LogInfo, topic: str | None) -> str:
    """The topic of the poses; OmnidError where there is none, or it is not clear which."""
    known = [name for name, (kind, count) in found.topics.items() if kind == ODOMETRY_SCHEMA and count]
    if topic is not None and topic not in known:
        raise OmnidError(f"{found.path}: no {ODOMETRY_SCHEMA} on {topic!r}; there is {_listed(known)}")
    own = [name for name in known if name.endswith("/odom")] if topic is None else [topic]
    if len(own) == 1 or len(known) == 1:
        return (own or known)[0]
    if known:
        raise OmnidError(f"{found.path}: several odometries, {_listed(known)}: choose one with --topic")
    raise OmnidError(_no_odometry(found))


def _no_odometry(found: LogInfo) -> str:
    if any(kind in (IMAGE, COMPRESSED_IMAGE) for kind, _ in found.topics.values()):
        rig = "" if "rig.toml" in found.attachments else " --rig rig.toml"
        return (f"{found.path}: images but no poses: first `omnid replay {found.path}{rig} --record out.mcap`, then "
                "`omnid report out.mcap`")
    return f"{found.path}: no {ODOMETRY_SCHEMA} in it; there is {_listed(list(found.topics))}"


def _listed(topics: list[str]) -> str:
    names = ", ".join(ascii(name) for name in topics[:8])
    return f"{names} and {len(topics) - 8} more" if len(topics) > 8 else names or "nothing"


def _rig(attachments: Mapping[str, bytes]) -> tuple[Rig | None, str]:
    if "rig.toml" not in attachments:
        return None, "no rig.toml is attached"
    try:
        return parse_rig(attachments["rig.toml"]), ""
    except CalibError as error:
        return None, f"the attached rig.toml cannot be read: {error}"


class _Reading:
    """One way through the messages."""

    def __init__(self, recording: ReportData) -> None:
        self._to = recording
        self._waiting: OdometryRecord | None = None  # the report of a new state comes right after its first pose
        self._offset_ns: int | None = None  # from the stamps of the poses to the time of logging
        self._early: deque[Diagnostics] = deque(maxlen=EARLY)  # that came before the first pose
        self._cloud: bytes | None = None

    def take(self, messages: Iterable[LogMessage], catalog: Catalog) -> None:
        """All messages."""
        for message in messages:
            topic = catalog.topic(message.channel_id)
            if topic is not None and topic.type in (ODOMETRY_SCHEMA, DIAGNOSTICS_SCHEMA, POINT_CLOUD_SCHEMA,
                                                    TWIST_SCHEMA):
                try:
                    self._message(topic, message)
                except (OmnidError, RecordError):
                    self._to.unread += 1
        self._settle()
        self._to.cloud = self._last_cloud()

    def _message(self, topic: LogTopic, message: LogMessage) -> None:
        if message.record.size > LARGEST_MESSAGE:
            raise OmnidError(f"{message.record.size} bytes")
        if topic.name == self._to.topic:
            self._pose(odometry_from_cdr(bytes(message.data())), message.log_time_ns)
        elif topic.type == DIAGNOSTICS_SCHEMA and self._of_robot(topic.name):
            self._status(bytes(message.data()))
        elif topic.type == POINT_CLOUD_SCHEMA and self._of_robot(topic.name):
            self._cloud = bytes(message.data())
        elif topic.type == TWIST_SCHEMA:
            self._twist(topic.name, bytes(message.data()))

    def _of_robot(self, topic: str) -> bool:
        """Whether a topic is of the robot whose odometry it is, where their names tell."""
        return "/" not in self._to.topic.strip("/") or topic.startswith(f"/{self._to.robot}/")

    def _pose(self, record: OdometryRecord, log_time_ns: int) -> None:
        offset_ns = log_time_ns - record.stamp_ns
        if self._offset_ns is None:
            self._offset_ns, self._to.frames, self._to.poses.start_ns = offset_ns, record.frames, record.stamp_ns
            for report in self._early:
                self._to.statuses.process(report, self._to.poses.seconds)
        if abs(offset_ns - self._offset_ns) > STRAY_S * 1e9:
            self._to.unread += 1
            return
        self._settle()
        self._waiting = record

    def _settle(self) -> None:
        if self._waiting is not None:
            self._to.poses.process(self._waiting, self._to.statuses.rank)
            self._waiting = None

    def _status(self, payload: bytes) -> None:
        report = decode_diagnostics(payload)
        if self._offset_ns is None:
            self._early.append(report)
        else:
            self._to.statuses.process(report, self._to.poses.seconds)

    def _twist(self, topic: str, payload: bytes) -> None:
        kind = "told" if topic.endswith("/drive") else "asked" if topic.endswith("/cmd/twist") else ""
        if kind and self._offset_ns is not None:
            stamp_ns, _, speed_mps, yaw_rate_radps = twist_from_cdr(payload)
            drive = self._to.drives.setdefault(kind, DriveCommand())
            t_s = self._to.poses.seconds(stamp_ns)
            drive.speed.add(t_s, speed_mps)
            drive.yaw_rate.add(t_s, math.degrees(yaw_rate_radps))

    def _last_cloud(self) -> Cloud | None:
        try:
            return None if self._cloud is None else decode_cloud(self._cloud)
        except OmnidError:
            self._to.unread += 1
            return None
