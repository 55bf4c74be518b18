"""View of a recording: draws the messages in it and computes nothing."""

from __future__ import annotations

from drivers.errors import FrameDecodeError
from drivers.logs.ros_image import RosImage
from omnid.recordings.recording_reader import CLOUD, ODOMETRY, STATUS, RecordingReader
from omnid.transport.decode import Cloud, Diagnostics, Pose
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import OdometryRecord
from omnid.transport.scan_codec import Scan
from omnid.transport.topics import SCAN
from omnid.viewer import status_plots
from omnid.viewer.image_encoding import compressed
from omnid.viewer.rerun_scene import RerunScene


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
