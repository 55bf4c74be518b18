"""The rerun recording that all views draw on.

Entities: odom (the world) with path, covariance, map, base_link and its rig with the points of the newest images;
its keyframes and loops; panorama with its features; depth; plots of speed, yaw_rate, landmarks, sigma, latency,
correction; state; log. Time is the stamp.
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
from omnid.transport.scan_codec import Scan
from omnid.viewer import style
from omnid.viewer.layout import TIMELINE
from omnid.viewer.style import Style
from omnid.viewer.targets import ViewerTarget

Array = NDArray[np.float64]

MAX_POSES: Final = 20_000
MAX_FRAMES: Final = 1_000  # images with features and depth
MAX_CLOUDS: Final = 50
MAX_PLACES: Final = 200  # drawings of all keyframes
MAX_CLOUD_POINTS: Final = 50_000
MAX_RIG_POINTS: Final = 3_000
MAX_LOG_LINES: Final = 1_000
MAX_LATENCIES: Final = 64  # curves
FLUSH_EVERY: Final = 20  # poses
AXIS_M: Final = 0.3
UNKNOWN_AT_M: Final = 0.4  # distance at which unknown directions are marked
PNG_FAST: Final = (cv2.IMWRITE_PNG_COMPRESSION, 3)

LEGEND: Final = f"""
**Path**: thin blue tracking, thicker orange degraded, thickest red lost, grey unknown.

**Panorama**: dots are inliers, crosses are features that do not agree with the pose, squares are new.

**Ellipsoid**: {style.SIGMAS:g} sigma of the position; its label says by how many times it is magnified.

**Obstacles**: red dots around the base; grey ones mark directions that are unknown.

**Keyframes** of the map: dark dots and the path through them, corrected by loops (violet); odometry's path stays.

**Map and points**: dark below, light above. **Depth**: m from the rig's axis.
"""


class RerunScene:
    """Draws poses, images and maps at their stamps; opened with the first of them, so that an empty run leaves no file.

    layout: the blueprint. expected: number of poses, 0 unknown. To be used from one thread only.
    """

    def __init__(self, target: ViewerTarget, layout: Any, expected: int = 0) -> None:
        self._target, self._layout = target, layout
        self._stream: rr.RecordingStream | None = None
        self._thinning = {
            "pose": Thinning(MAX_POSES, expected),
            "frame": Thinning(MAX_FRAMES, expected),
            "image": Thinning(MAX_FRAMES, expected),
            "cloud": Thinning(MAX_CLOUDS),
            "scan": Thinning(MAX_POSES),
            "places": Thinning(MAX_PLACES),
        }
        self._last_position: Array | None = None  # (3,) m, end of the path
        self._state = ""
        self._lines = 0
        self._latencies: set[tuple[str, ...]] = set()
        self.poses = self.offered = self.images = 0

    def wants(self, kind: str) -> bool:
        """Return whether the next pose, frame, image or cloud is to be drawn."""
        return self._thinning[kind]()

    def rig(self, T_base_rig: Array) -> None:
        """Draw the rig's frame on the robot, once for all times."""
        pose = rr.Transform3D(translation=T_base_rig[:3, 3], mat3x3=T_base_rig[:3, :3])
        self._opened().log("odom/base_link/rig", pose, static=True)

    def pose(self, pose: Pose) -> None:
        """Draw the robot, its path and covariance; plot speed, yaw rate and landmarks."""
        self.state(pose.stamp_ns, pose.state)
        self.offered += 1
        if not self.wants("pose"):
            return
        stream, T = self._at(pose.stamp_ns), pose.T_odom_base
        stream.log("odom/base_link", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._path(T[:3, 3], style.state_style(pose.state))
        self._sigma(pose)
        self._plot("speed", "m/s", float(np.linalg.norm(pose.velocity[:3])))
        self._plot("yaw_rate", "deg/s", float(np.rad2deg(pose.velocity[5])))
        if pose.attachment.seq >= 0:
            self.landmarks(pose.stamp_ns, pose.attachment.inliers, pose.attachment.tracked)
        self.poses += 1
        if self.poses % FLUSH_EVERY == 0:
            self._target.flush()

    def state(self, stamp_ns: int, state: str) -> None:
        """Draw the tracking state where it changes."""
        if state != self._state:
            self._state = state
            self._at(stamp_ns).log("state", rr.StateChange(state=state))
            self.line(stamp_ns, f"odometry: {state}", "INFO" if state == "tracking" else "WARN")

    def landmarks(self, stamp_ns: int, inliers: int, tracked: int) -> None:
        """Plot the numbers of landmarks."""
        self._at(stamp_ns)
        self._plot("landmarks", "tracked", tracked)
        self._plot("landmarks", "inliers", inliers)

    def latency(self, stamp_ns: int, name: tuple[str, ...], value_ms: float) -> None:
        """Plot a time in ms."""
        if name in self._latencies or len(self._latencies) < MAX_LATENCIES:
            self._latencies.add(name)
            self._at(stamp_ns).log(["latency", *name], rr.Scalars(value_ms))

    def panorama(self, stamp_ns: int, data: bytes, kind: str = "jpeg") -> None:
        """Draw a compressed image; kind: jpeg or png."""
        self._at(stamp_ns).log("panorama", rr.EncodedImage(contents=data, media_type=f"image/{kind}"))
        self.images += 1

    def features(self, stamp_ns: int, features: Features) -> None:
        """Draw the features of the panorama."""
        stream = self._at(stamp_ns)
        dots = rr.Points2D(features.inliers, colors=style.INLIER.colour, radii=_px(style.INLIER.size_px))
        stream.log("panorama/inliers", dots)
        stream.log(
            "panorama/rejected", _lines_2d(style.crosses(features.rejected, style.REJECTED.size_px), style.REJECTED)
        )
        stream.log("panorama/new", _lines_2d(style.squares(features.new, style.NEW.size_px), style.NEW))

    def depth(self, stamp_ns: int, distance_mm: NDArray[np.uint16], points: Array) -> None:
        """Draw distances (H, W) over the panorama, 0 unknown, and points (N, 3) [m] in the rig."""
        stream = self._at(stamp_ns)
        png = cv2.imencode(".png", distance_mm, PNG_FAST)[1].tobytes()
        stream.log(
            "depth",
            rr.EncodedDepthImage(png, media_type="image/png", meter=1000.0, depth_range=style.depth_range(distance_mm)),
        )
        (points,) = style.evenly(MAX_RIG_POINTS, points)
        stream.log("odom/base_link/rig/points", _points_3d(points, 2.0))

    def cloud(self, cloud: Cloud) -> None:
        """Draw the map, in odom."""
        if self.wants("cloud"):
            (points,) = style.evenly(MAX_CLOUD_POINTS, cloud.points[np.isfinite(cloud.points).all(axis=1)])
            self._at(cloud.stamp_ns).log("odom/map", _points_3d(points, 1.5))

    def correction(self, stamp_ns: int, T_map_odom: Array) -> None:
        """Plot by how much the map corrects odometry."""
        self._at(stamp_ns)
        self._plot("correction", "position mm", 1e3 * float(np.linalg.norm(T_map_odom[:3, 3])))
        self._plot("correction", "heading mdeg", 1e3 * float(np.rad2deg(se3.yaw(T_map_odom))))

    def places(self, stamp_ns: int, keyframes: Array, loops: Array) -> None:
        """Draw keyframes (K, 3) in the order of the drives, the path through them, and loops (L, 2, 3), in odom [m]."""
        stream = self._at(stamp_ns)
        dots = rr.Points3D(keyframes, colors=style.KEYFRAME.colour, radii=_px(style.KEYFRAME.size_px))
        stream.log("odom/keyframes", dots)
        path, joined = [keyframes.astype(np.float32)], list(loops.astype(np.float32))
        stream.log("odom/keyframes/path", rr.LineStrips3D(path, colors=style.KEYFRAME.colour, radii=_px(1.0)))
        stream.log("odom/loops", rr.LineStrips3D(joined, colors=style.LOOP.colour, radii=_px(style.LOOP.size_px)))

    def scan(self, scan: Scan) -> None:
        """Draw the obstacles around the base, and where their directions are unknown."""
        if not self.wants("scan"):
            return
        stream, known = self._at(scan.stamp_ns), np.isfinite(scan.ranges_m)
        unknown = np.isnan(scan.ranges_m)
        ranges = np.where(known, scan.ranges_m, UNKNOWN_AT_M)
        points = np.column_stack(
            [ranges * np.cos(scan.azimuths_rad), ranges * np.sin(scan.azimuths_rad), np.zeros(len(ranges))]
        )
        for name, chosen, one in (("obstacles", known, style.OBSTACLE), ("unknown", unknown, style.UNKNOWN)):
            dots = rr.Points3D(points[chosen], colors=one.colour, radii=_px(one.size_px))
            stream.log(f"odom/base_link/{name}", dots)

    def line(self, stamp_ns: int, text: str, level: str = "INFO") -> None:
        """Add a line to the log, up to MAX_LOG_LINES."""
        self._lines += 1
        if self._lines <= MAX_LOG_LINES:
            self._at(stamp_ns).log("log", rr.TextLog(text, level=level))

    def close(self) -> None:
        """Flush and end the recording; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            try:
                self._target.flush()
            finally:
                stream.disconnect()

    def _opened(self) -> rr.RecordingStream:
        if self._stream is None:
            self._stream = self._target.start(self._layout)
            _log_static(self._stream)
        return self._stream

    def _at(self, stamp_ns: int) -> rr.RecordingStream:
        stream = self._opened()
        stream.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        return stream

    def _plot(self, plot: str, name: str, value: float) -> None:
        if np.isfinite(value):
            self._opened().log([plot, name], rr.Scalars(value))

    def _path(self, position: Array, path_style: Style) -> None:
        """Draw the newest piece of the path as an entity state of its own: each pose adds only what is new."""
        start = position if self._last_position is None else self._last_position
        self._last_position = position
        strip = rr.LineStrips3D([np.array([start, position])], colors=path_style.colour, radii=_px(path_style.size_px))
        self._opened().log("odom/path", strip)

    def _sigma(self, pose: Pose) -> None:
        ellipsoid = style.ellipsoid(pose.covariance[:3, :3])
        if ellipsoid is None:
            return
        label = f"{style.SIGMAS:g} sigma: {1e3 * ellipsoid.largest_m:.1f} mm, drawn x{ellipsoid.magnified}"
        shape = rr.Ellipsoids3D(
            half_sizes=[ellipsoid.half_m],
            centers=[pose.T_odom_base[:3, 3]],
            quaternions=[rr.Quaternion(xyzw=se3.quaternion(ellipsoid.R))],
            colors=style.state_style(pose.state).colour,
            labels=[label],
            show_labels=False,
        )
        self._opened().log("odom/covariance", shape)
        self._plot("sigma", "position mm", 1e3 * ellipsoid.largest_m / style.SIGMAS)
        self._plot("sigma", "heading mdeg", 1e3 * float(np.rad2deg(np.sqrt(max(0.0, pose.covariance[5, 5])))))


def _log_static(stream: rr.RecordingStream) -> None:
    """Log the entities that never change."""
    stream.log("odom", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    axes = rr.Arrows3D(
        vectors=AXIS_M * np.eye(3), colors=style.AXES, radii=_px(2.5), labels=["x", "y", "z"], show_labels=False
    )
    stream.log("odom/base_link", axes, static=True)
    stream.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)
    states = style.STATES | {"unknown": style.UNKNOWN}
    colours = [state.colour for state in states.values()]
    stream.log("state", rr.StateConfiguration(values=list(states), colors=colours), static=True)


def _px(size: float) -> Any:
    """Return a radius on the screen, independent of the distance."""
    return rr.components.Radius.ui_points(size)


def _lines_2d(strips: NDArray[np.float32], line_style: Style) -> Any:
    return rr.LineStrips2D(strips, colors=line_style.colour, radii=_px(1.0))


def _points_3d(points: NDArray[Any], size_px: float) -> Any:
    return rr.Points3D(points, colors=style.by_height(points), radii=_px(size_px))


class Thinning:
    """Keeps every message at first, then every 2nd, 4th, 8th ...

    Each rate serves for `most` kept messages: of n messages about most * log2(n / most) are kept. expected: number of
    messages, where it is known; they are thinned evenly then.
    """

    def __init__(self, most: int, expected: int = 0) -> None:
        self._most = most
        self._step = max(1, -(-expected // most))
        self._count = self._kept = 0

    def __call__(self) -> bool:
        """Return whether to keep the next message."""
        keep = self._count % self._step == 0
        self._count += 1
        self._kept += keep
        if keep and self._kept % self._most == 0:
            self._step *= 2
        return keep
