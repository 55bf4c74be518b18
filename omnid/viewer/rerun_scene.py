"""The board that everything is drawn on: what a robot says and sees, as rerun has it.

Entities: odom (the world) with path, covariance, map, base_link and its rig with the points of the present images;
panorama with its features; depth; plots of speed, turn, landmarks, deviation, latency; state; log. Time is the stamp.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.stereo_frame import Features
from omnid.transport.decode import Cloud, Pose
from omnid.viewer import style as looks
from omnid.viewer.layout import CLOCK
from omnid.viewer.style import Style
from omnid.viewer.targets import ViewerTarget
from omnid.viewer.thinning import Thinning

Array = NDArray[np.float64]

MOST_POSES: Final = 20_000
MOST_SIGHTS: Final = 1_000
MOST_CLOUDS: Final = 50
MOST_CLOUD_POINTS: Final = 50_000
MOST_RIG_POINTS: Final = 3_000
MOST_LINES: Final = 1_000  # of the log
MOST_LATENCIES: Final = 64  # curves
KEPT_EVERY: Final = 20  # poses, after which all must have arrived
AXIS_M: Final = 0.3
PNG_FAST: Final = (cv2.IMWRITE_PNG_COMPRESSION, 3)

LEGEND: Final = f"""
**Way**: thin blue tracking, thicker orange degraded, thickest red lost, grey unknown.

**Panorama**: dots agree with the pose, crosses were found elsewhere than the pose has them, squares are new.

**Ellipsoid**: {looks.SIGMAS:g} sigma of the position; its label says by how many times it is magnified.

**Map and points**: dark below, light above. **Depth**: m from the rig's axis.
"""


class RerunScene:
    """Draws what it is given at its stamp; opened at the first of it, so that a run of nothing leaves no trace.

    layout: what lies where. expected: how many poses there will be, 0 unknown. From one thread only.
    """

    def __init__(self, place: ViewerTarget, layout: Any, expected: int = 0) -> None:
        self._place, self._layout = place, layout
        self._stream: rr.RecordingStream | None = None
        self._wants = {"pose": Thinning(MOST_POSES, expected), "sight": Thinning(MOST_SIGHTS, expected),
                       "image": Thinning(MOST_SIGHTS, expected), "cloud": Thinning(MOST_CLOUDS)}
        self._last: Array | None = None  # (3,) m, where the path has come to
        self._state = ""
        self._lines = 0
        self._latencies: set[tuple[str, ...]] = set()
        self.poses = self.offered = self.images = 0

    def wants(self, kind: str) -> bool:
        """Whether the next pose, sight, image or cloud is to be drawn at all."""
        return self._wants[kind]()

    def rig(self, T_base_rig: Array) -> None:
        """Where the rig is on the robot, for good."""
        pose = rr.Transform3D(translation=T_base_rig[:3, 3], mat3x3=T_base_rig[:3, :3])
        self._opened().log("odom/base_link/rig", pose, static=True)

    def pose(self, pose: Pose) -> None:
        """The robot's place and way, how sure that is, speed and landmarks."""
        self.state(pose.stamp_ns, pose.state)
        self.offered += 1
        if not self.wants("pose"):
            return
        stream, T = self._at(pose.stamp_ns), pose.T_odom_base
        stream.log("odom/base_link", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._path(T[:3, 3], looks.state_look(pose.state))
        self._deviation(pose)
        self._plot("speed", "m/s", float(np.linalg.norm(pose.velocity[:3])))
        self._plot("turn", "deg/s", float(np.rad2deg(pose.velocity[5])))
        if pose.attachment.seq >= 0:
            self.landmarks(pose.stamp_ns, pose.attachment.inliers, pose.attachment.tracked)
        self.poses += 1
        if self.poses % KEPT_EVERY == 0:
            self._place.keep()

    def state(self, stamp_ns: int, state: str) -> None:
        """The state of the odometry, where it changes."""
        if state != self._state:
            self._state = state
            self._at(stamp_ns).log("state", rr.StateChange(state=state))
            self.line(stamp_ns, f"odometry: {state}", "INFO" if state == "tracking" else "WARN")

    def landmarks(self, stamp_ns: int, inliers: int, found: int) -> None:
        """How many were found, and how many of them agree."""
        self._at(stamp_ns)
        self._plot("landmarks", "found", found)
        self._plot("landmarks", "agreeing", inliers)

    def latency(self, stamp_ns: int, name: tuple[str, ...], value_ms: float) -> None:
        """How long something took, ms."""
        if name in self._latencies or len(self._latencies) < MOST_LATENCIES:
            self._latencies.add(name)
            self._at(stamp_ns).log(["latency", *name], rr.Scalars(value_ms))

    def panorama(self, stamp_ns: int, data: bytes, kind: str = "jpeg") -> None:
        """The image, compressed; kind: jpeg or png."""
        self._at(stamp_ns).log("panorama", rr.EncodedImage(contents=data, media_type=f"image/{kind}"))
        self.images += 1

    def features(self, stamp_ns: int, features: Features) -> None:
        """What became of the panorama's features."""
        stream = self._at(stamp_ns)
        dots = rr.Points2D(features.inliers, colors=looks.AGREEING.colour, radii=_px(looks.AGREEING.size_px))
        stream.log("panorama/agreeing", dots)
        stream.log("panorama/rejected", _lines_2d(looks.crosses(features.rejected, looks.REJECTED.size_px),
                                                  looks.REJECTED))
        stream.log("panorama/new", _lines_2d(looks.squares(features.new, looks.NEW.size_px), looks.NEW))

    def depth(self, stamp_ns: int, distance_mm: NDArray[np.uint16], points: Array) -> None:
        """Distances (H, W) over the panorama, 0 unknown, and points (N, 3) [m] in the rig."""
        stream = self._at(stamp_ns)
        png = cv2.imencode(".png", distance_mm, PNG_FAST)[1].tobytes()
        stream.log("depth", rr.EncodedDepthImage(png, media_type="image/png", meter=1000.0,
                                                depth_range=looks.depth_range(distance_mm)))
        (points,) = looks.evenly(MOST_RIG_POINTS, points)
        stream.log("odom/base_link/rig/points", _points_3d(points, 2.0))

    def cloud(self, cloud: Cloud) -> None:
        """The map, in odom."""
        if self.wants("cloud"):
            (points,) = looks.evenly(MOST_CLOUD_POINTS, cloud.points[np.isfinite(cloud.points).all(axis=1)])
            self._at(cloud.stamp_ns).log("odom/map", _points_3d(points, 1.5))

    def line(self, stamp_ns: int, text: str, level: str = "INFO") -> None:
        """A line of the log; after MOST_LINES of them no more."""
        self._lines += 1
        if self._lines <= MOST_LINES:
            self._at(stamp_ns).log("log", rr.TextLog(text, level=level))

    def close(self) -> None:
        """Has everything arrive, and ends it; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            try:
                self._place.keep()
            finally:
                stream.disconnect()

    def _opened(self) -> rr.RecordingStream:
        if self._stream is None:
            self._stream = self._place.start(self._layout)
            _lay_out(self._stream)
        return self._stream

    def _at(self, stamp_ns: int) -> rr.RecordingStream:
        stream = self._opened()
        stream.set_time(CLOCK, timestamp=np.datetime64(stamp_ns, "ns"))
        return stream

    def _plot(self, plot: str, name: str, value: float) -> None:
        if np.isfinite(value):
            self._opened().log([plot, name], rr.Scalars(value))

    def _path(self, position: Array, look: Style) -> None:
        """A piece of the way, of its own, so that each moment adds to the file what is new and no more."""
        start = position if self._last is None else self._last
        self._last = position
        strip = rr.LineStrips3D([np.array([start, position])], colors=look.colour, radii=_px(look.size_px))
        self._opened().log("odom/path", strip)

    def _deviation(self, pose: Pose) -> None:
        found = looks.ellipsoid(pose.covariance[:3, :3])
        if found is None:
            return
        label = f"{looks.SIGMAS:g} sigma: {1e3 * found.largest_m:.1f} mm, drawn x{found.magnified}"
        shown = rr.Ellipsoids3D(half_sizes=[found.half_m], centers=[pose.T_odom_base[:3, 3]],
                                quaternions=[rr.Quaternion(xyzw=se3.quaternion(found.R))],
                                colors=looks.state_look(pose.state).colour, labels=[label], show_labels=False)
        self._opened().log("odom/covariance", shown)
        self._plot("deviation", "position mm", 1e3 * found.largest_m / looks.SIGMAS)
        self._plot("deviation", "heading mdeg", 1e3 * float(np.rad2deg(np.sqrt(max(0.0, pose.covariance[5, 5])))))


def _lay_out(stream: rr.RecordingStream) -> None:
    """What never changes."""
    stream.log("odom", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    axes = rr.Arrows3D(vectors=AXIS_M * np.eye(3), colors=looks.AXES, radii=_px(2.5), labels=["x", "y", "z"],
                       show_labels=False)
    stream.log("odom/base_link", axes, static=True)
    stream.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)
    known = looks.STATES | {"unknown": looks.UNKNOWN}
    stream.log("state", rr.StateConfiguration(values=list(known), colors=[look.colour for look in known.values()]),
               static=True)


def _px(size: float) -> Any:
    """A radius on the screen, whatever the distance."""
    return rr.components.Radius.ui_points(size)


def _lines_2d(strips: NDArray[np.float32], look: Style) -> Any:
    return rr.LineStrips2D(strips, colors=look.colour, radii=_px(1.0))


def _points_3d(points: NDArray[Any], size_px: float) -> Any:
    return rr.Points3D(points, colors=looks.by_height(points), radii=_px(size_px))
