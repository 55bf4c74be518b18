"""Shows a log or a live robot in a file, a window or a browser."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from drivers.errors import FrameDecodeError
from drivers.logs.mcap_info import LogInfo, read_log_info
from drivers.logs.ros_image import RosImage
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.recordings.odometry_topic import choose_odometry_topic, no_pose, odometry_topics
from omnid.recordings.recording_reader import CLOUD, ODOMETRY, STATUS, RecordingReader
from omnid.runs.replay import ReplayOptions, Topics
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import Cloud, Diagnostics, Pose
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import OdometryRecord
from omnid.transport.scan_codec import Scan
from omnid.transport.topics import SCAN
from omnid.viewer import status_plots
from omnid.viewer.image_encoding import compressed
from omnid.viewer.layout import layout
from omnid.viewer.replay_view import MAP_EVERY_S, ReplayView
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.robot_view import RobotView
from omnid.viewer.targets import ClosedError, RrdFile, Viewer, ViewerTarget

PANORAMA: Final = "Panorama"
Replay: TypeAlias = Callable[[Path, Config, ReplayOptions], int]  # runs a log and returns the exit code


@dataclass(frozen=True, slots=True)
class Log:
    """A log and the options for its view."""

    path: Path
    robot: str | None = None
    topic: str | None = None  # of the poses
    replay: bool = False  # compute from its images, although it has poses
    rig: Path | None = None
    topics: Topics = (None, None)
    settings: Path | None = None  # file of the configuration


def target_for(out: Path | None, web: bool, port: int) -> ViewerTarget:
    """Return the named file as target, else a viewer; port: of a viewer for browsers, 0: any."""
    return RrdFile(out) if out is not None else Viewer(web, port)


def check_file(out: Path | None, *inputs: tuple[str, Path | None]) -> None:
    """Raise OmnidError where the file cannot be written, or is one of the inputs (description, path)."""
    if out is not None:
        check_outputs([("-o", out)], [(what, path) for what, path in inputs if path is not None])


def show_log(log: Log, config: Config, target: ViewerTarget, replay: Replay) -> int:
    """Show the recorded poses of a log, else what is computed from its images. Return the exit code."""
    found = read_log_info(log.path)
    reader = _reader(found, log)
    image = PANORAMA if reader is None else _image_title(reader)
    scene = RerunScene(target, layout(image, depth=reader is None), _max_poses(found, reader))
    code = 0
    with _closing(scene, target):
        code = _replayed(log, config, scene, replay) if reader is None else _recorded(reader, scene)
    return _finish(scene, target, code)


def show_robot(bus: BusConfig, seconds: float | None, target: ViewerTarget) -> int:
    """Show a live robot. Return the exit code, 1 where no pose arrived."""
    scene = RerunScene(target, layout(PANORAMA, depth=False))
    with _closing(scene, target):
        RobotView(scene).follow(bus, target, seconds)
    return _finish(scene, target, int(not scene.poses))


def _reader(found: LogInfo, log: Log) -> RecordingReader | None:
    """Return a reader of the recorded run; None where the log is to be replayed."""
    named = log.topic is not None or log.robot is not None
    if log.replay or not (named or odometry_topics(found)):
        return None
    return RecordingReader(found, choose_odometry_topic(found, log.topic, log.robot))


def _image_title(reader: RecordingReader) -> str:
    """Return the title of the recorded images, "" where there are none."""
    name = reader.image_name()
    if not name:
        return ""
    return PANORAMA if name == "panorama" else "Lower camera"


@contextmanager
def _closing(scene: RerunScene, target: ViewerTarget) -> Iterator[None]:
    """Flush and close the scene at the end. A viewer that the user closes is a normal end."""
    try:
        yield
        scene.close()
    except ClosedError as closed:
        print(f"omnid: {closed}", file=sys.stderr)
    except BaseException:
        target.abandon()
        raise
    finally:
        with suppress(OmnidError):  # reported already, or not the cause of the end
            scene.close()


def _replayed(log: Log, config: Config, scene: RerunScene, replay: Replay) -> int:
    options = ReplayOptions(
        rig=log.rig,
        topics=log.topics,
        settings=log.settings,
        map_every_s=MAP_EVERY_S,
        observer=lambda front_end, telemetry: ReplayView(scene, front_end, telemetry),
    )
    return replay(log.path, config, options)


def _recorded(reader: RecordingReader, scene: RerunScene) -> int:
    path = reader.info.path
    RecordingView(reader, scene).show()
    unreadable = reader.unreadable.total()
    if unreadable or reader.damaged:
        print(
            f"omnid: warning: {path}: {unreadable} messages and {reader.damaged} pieces of the file cannot be read "
            "and are left out",
            file=sys.stderr,
        )
    if not scene.poses:
        raise no_pose(path, reader.topic)
    return 0


def _max_poses(found: LogInfo, reader: RecordingReader | None) -> int:
    """Return an upper bound of the number of poses."""
    if reader is not None:
        return found.topics[reader.topic][1]
    return max((count for schema, count in found.topics.values() if schema.startswith("sensor_msgs/msg/")), default=0)


def _finish(scene: RerunScene, target: ViewerTarget, code: int) -> int:
    if scene.poses:
        total = f" of {scene.offered}" if scene.offered > scene.poses else ""
        print(f"{scene.poses} poses{total} and {scene.images} images shown")
    if scene.poses and not target.closed:
        print(target.finish(), flush=True)
    return code


class RecordingView:
    """Draws the messages of a recording."""

    def __init__(self, reader: RecordingReader, scene: RerunScene) -> None:
        self._reader, self._scene = reader, scene
        self._pending: OdometryRecord | None = None  # until its state is known, which is recorded after it
        self._state, self._changes = "unknown", status_plots.StatusChanges()

    def show(self) -> None:
        """Draw all messages."""
        for message in self._reader.messages((ODOMETRY, STATUS, CLOUD, SCAN, self._reader.image_name())):
            match message.content:
                case OdometryRecord():
                    self._draw_pending()
                    self._pending = message.content
                case Diagnostics():
                    self._diagnostics(message.content)
                case Cloud():
                    self._scene.cloud(message.content)
                case Scan():
                    self._scene.scan(message.content)
                case RosImage() if self._scene.wants("image"):
                    self._image(message.content)
        self._draw_pending()

    def _draw_pending(self) -> None:
        """Draw the pose that waits, in the state reported by now."""
        record, self._pending = self._pending, None
        if record is not None:
            self._scene.pose(
                Pose(
                    record.stamp_ns,
                    record.T_odom_base,
                    record.covariance,
                    record.velocity,
                    record.velocity_covariance,
                    PoseAttachment(state=self._state),
                    record.stamp_ns,
                )
            )

    def _diagnostics(self, diagnostics: Diagnostics) -> None:
        self._state = status_plots.odometry_state(diagnostics) or self._state
        counts = status_plots.odometry_landmarks(diagnostics)
        if counts is not None:
            self._scene.landmarks(diagnostics.stamp_ns, *counts)
        status_plots.draw(diagnostics, self._changes, self._scene)

    def _image(self, image: RosImage) -> None:
        try:
            self._scene.panorama(image.stamp_ns, *compressed(image))
        except FrameDecodeError:
            self._reader.unreadable[self._reader.topic_name(self._reader.image_name())] += 1
