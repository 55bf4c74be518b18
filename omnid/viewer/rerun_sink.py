"""A run drawn in Rerun: a replay as it computes, a recording, or a live robot by its messages; time is the stamp.

Entities: odom (the world) with path, map, and base_link with obstacles and the points of the newest images; panorama
with its features; depth; plots of speed, yaw_rate, landmarks, sigma; state; log. Colours are those of Okabe and Ito,
which colour-blind people can distinguish.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from calib import se3
from drivers.frame import Frame, gray
from omnid.core.odometry.stereo_frame import Features
from omnid.messages import OdometryUpdate
from omnid.plain_text import plain
from omnid.recordings.recording import Content
from omnid.sinks.encoder import Encoder, Outgoing, pose_attachment
from omnid.stages.front_end import FrontEnd
from omnid.transport import status_names
from omnid.transport.codec import Cloud, Diagnostics, Panorama, Pose, Scan
from omnid.transport.status_names import ODOMETRY, short_name
from omnid.transport.topics import PUBLISHED, SCAN

Array: TypeAlias = NDArray[np.float64]
TIMELINE: Final = "stamp"
# Messages of a kind that are drawn in full; after each further such number every 2nd, 4th, 8th ... is drawn.
MAX_DENSE: Final = {"pose": 20_000, "scan": 20_000, "image": 1_000, "cloud": 50}
MAP_POINTS, RIG_POINTS = 50_000, 3_000
# Colours, and radii of lines and points on the screen [px], whatever their distance. The worse the state of a pose is,
# the thicker is its piece of the path.
BLUE, GREEN, ORANGE, RED = "#56b4e9", "#009e73", "#e69f00", "#d55e00"
GREY = "#969696"
THIN, MEDIUM, THICK = 1.5, 2.5, 5.0
STATES: Final = {"tracking": (BLUE, THIN), "degraded": (ORANGE, MEDIUM), "lost": (RED, THICK), "unknown": (GREY, THIN)}
FEATURES: Final = {"inliers": BLUE, "rejected": RED}
PLOTS: Final = {
    "speed": "Speed",
    "yaw_rate": "Yaw rate",
    "landmarks": "Landmarks",
    "sigma": "Standard deviation",
}
# Topics of a replay that are drawn; the pose in the map is not, because it may come before that in odom.
REPLAYED: Final = ("odom", "status", "cloud", SCAN)
LEVELS: Final = ("INFO", "WARN", "ERROR", "WARN")  # of Rerun, by the level of a status
LEGEND: Final = """
**Path**: thin blue tracking, thicker orange degraded, thickest red lost, grey unknown.

**Panorama**: blue dots are inliers, red dots features that do not agree with the pose, yellow dots new landmarks.

**Obstacles**: red dots around the base; grey ones mark directions that are unknown.

**Map and points**: dark below, light above. **Depth**: m from the rig's axis.
"""


def layout() -> Any:
    """Return the blueprint: the world on the left, images on the right, plots below."""
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    until_now = rrb.VisibleTimeRanges(rrb.VisibleTimeRange(TIMELINE, start=start, end=now))
    eye = rrb.EyeControls3D(position=(-5.0, -4.0, 8.0), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0))
    world = rrb.Spatial3DView(origin="odom", name="World", overrides={"odom/path": [until_now]}, eye_controls=eye)
    images = [rrb.Spatial2DView(origin="panorama", name="Image"), rrb.Spatial2DView(origin="depth", name="Depth")]
    state = rrb.StateTimelineView(origin="state", name="State")
    log, legend = rrb.TextLogView(origin="log", name="Log"), rrb.TextDocumentView(origin="legend", name="Legend")
    plots = [rrb.TimeSeriesView(origin=name, name=title) for name, title in PLOTS.items()]
    upper = rrb.Horizontal(world, rrb.Vertical(*images, rrb.Tabs(state, log, legend)), column_shares=[5, 4])
    panels = (rrb.TimePanel(timeline=TIMELINE, state="collapsed"), rrb.SelectionPanel(state="collapsed"))
    return rrb.Blueprint(
        rrb.Vertical(upper, rrb.Grid(*plots, grid_columns=3), row_shares=[5, 3]),
        *panels,
        rrb.BlueprintPanel(state="collapsed"),
    )


class RerunSink:
    """Draws messages; opened with the first of them, so that an empty run leaves no file. For one thread only."""

    def __init__(self, open_stream: Callable[[], rr.RecordingStream]) -> None:
        self._open_stream = open_stream
        self._stream: rr.RecordingStream | None = None
        self._offered: Counter[str] = Counter()
        self._drawn: Counter[str] = Counter()
        self._end: Array | None = None  # (3,) m, of the path
        self._state = "unknown"
        self._shown_state = self._state
        self._messages: dict[str, tuple[int, str]] = {}  # level and message of each status
        self.poses = self.images = 0

    def draw(self, content: Content | Panorama) -> None:
        """Draw a decoded message."""
        match content:
            case Pose():
                self._pose(content)
            case Diagnostics():
                self._status(content)
            case Cloud() if self.wants("cloud"):
                points = content.points[np.isfinite(content.points).all(axis=1)]
                self._at(content.stamp_ns).log("odom/map", _points_3d(points, MAP_POINTS))
            case Scan() if self.wants("scan"):
                self._scan(content)
            case Frame() if self.wants("image"):
                is_compressed = content.encoding in ("jpeg", "png")
                data = bytes(content.data) if is_compressed else _jpeg(gray(content))
                self.panorama(content.stamp_ns, data, content.encoding if is_compressed else "jpeg")
            case Panorama(stamp_ns, data) if self.wants("image"):
                self.panorama(stamp_ns, data)

    def panorama(self, stamp_ns: int, data: bytes, kind: str = "jpeg") -> None:
        """Draw a compressed image; kind: jpeg or png."""
        self._at(stamp_ns).log("panorama", rr.EncodedImage(contents=data, media_type=f"image/{kind}"))
        self.images += 1

    def features(self, stamp_ns: int, features: Features) -> None:
        """Draw the features of the panorama."""
        stream = self._at(stamp_ns)
        for name, colour in FEATURES.items():
            stream.log(f"panorama/{name}", rr.Points2D(getattr(features, name), **_style(colour, MEDIUM)))

    def depth(self, stamp_ns: int, disparity: NDArray[np.float32], focal_baseline: float, points: Array) -> None:
        """Draw distances from the rig's axis over the panorama, and points (N, 3) [m] around the base.

        disparity: (H, W) px, NaN unknown; each known pixel is drawn as a square. focal_baseline: px times m.
        """
        spots = cv2.dilate(np.nan_to_num(disparity, nan=0.0), np.ones((3, 3), np.uint8))
        mm = np.where(spots > 0, np.minimum(1e3 * focal_baseline / np.maximum(spots, 1e-3), 65535), 0).astype(np.uint16)
        far_mm = float(np.percentile(mm[mm > 0], 95)) if mm.any() else 1.0
        png = cv2.imencode(".png", mm)[1].tobytes()
        image = rr.EncodedDepthImage(png, media_type="image/png", meter=1000.0, depth_range=(0.0, far_mm))
        stream = self._at(stamp_ns)
        stream.log("depth", image)
        stream.log("odom/base_link/points", _points_3d(points, RIG_POINTS))

    def close(self) -> None:
        """Flush and end the drawing; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.flush()
            stream.disconnect()

    def wants(self, kind: str) -> bool:
        """Return whether the next message of a kind is to be drawn."""
        is_due: bool = self._offered[kind] % 2 ** (self._drawn[kind] // MAX_DENSE[kind]) == 0
        self._offered[kind] += 1
        self._drawn[kind] += is_due
        return is_due

    def _opened(self) -> rr.RecordingStream:
        """Return the stream, which is opened with what never changes."""
        if self._stream is None:
            self._stream = stream = self._open_stream()
            stream.log("odom", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            axes = rr.Arrows3D(vectors=0.5 * np.eye(3), colors=[*map(_rgb, (RED, GREEN, BLUE))], radii=_px(MEDIUM))
            stream.log("odom/base_link", axes, static=True)
            stream.log("legend", rr.TextDocument(LEGEND, media_type="text/markdown"), static=True)
            colours = [_rgb(colour) for colour, _ in STATES.values()]
            stream.log("state", rr.StateConfiguration(values=list(STATES), colors=colours), static=True)
        return self._stream

    def _at(self, stamp_ns: int) -> rr.RecordingStream:
        stream = self._opened()
        stream.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        return stream

    def _plot(self, stamp_ns: int, plot: str, name: str, value: float) -> None:
        if np.isfinite(value):
            self._at(stamp_ns).log([plot, name], rr.Scalars(value))

    def _pose(self, pose: Pose) -> None:
        """Draw the robot and the newest piece of its path; plot its covariance, speeds and landmarks."""
        if pose.attachment.seq >= 0:
            self._state = pose.state
        self._show_state(pose.stamp_ns)
        self.poses += 1
        if not self.wants("pose"):
            return
        # 1. The robot and its path.
        stamp_ns, stream, position = pose.stamp_ns, self._at(pose.stamp_ns), pose.T_odom_base[:-1, -1]
        stream.log("odom/base_link", rr.Transform3D(translation=position, mat3x3=pose.T_odom_base[:-1, :-1]))
        piece = np.array([position if self._end is None else self._end, position])
        self._end = position
        stream.log("odom/path", rr.LineStrips3D([piece], **_style(*STATES.get(self._state, STATES["unknown"]))))
        # 2. The plots.
        if np.isfinite(pose.covariance).all():
            sigma_m = math.sqrt(max(0.0, np.linalg.eigvalsh(pose.covariance[:3, :3])[-1]))
            sigma_deg = math.degrees(math.sqrt(max(0.0, pose.covariance[-1, -1])))
            self._plot(stamp_ns, "sigma", "position mm", 1e3 * sigma_m)
            self._plot(stamp_ns, "sigma", "heading deg", sigma_deg)
        self._plot(stamp_ns, "speed", "m/s", float(np.linalg.norm(pose.velocity[:3])))
        self._plot(stamp_ns, "yaw_rate", "deg/s", float(np.rad2deg(pose.velocity[-1])))
        if pose.attachment.seq >= 0:
            self._plot(stamp_ns, "landmarks", "tracked", pose.attachment.tracked)
            self._plot(stamp_ns, "landmarks", "inliers", pose.attachment.inliers)

    def _status(self, diagnostics: Diagnostics) -> None:
        """Add a line to the log for each entry that has changed."""
        stamp_ns = diagnostics.stamp_ns
        for status in diagnostics.statuses:
            if status.name == ODOMETRY:
                self._state = status_names.tracking_state(status.message, status.values) or self._state
                self._show_state(stamp_ns)
            if self._messages.get(status.name) != (status.level, status.message):
                self._messages[status.name] = status.level, status.message
                text, level = f"{short_name(status.name)}: {status.message}", LEVELS[status.level % len(LEVELS)]
                self._at(stamp_ns).log("log", rr.TextLog(plain(text), level=level))

    def _show_state(self, stamp_ns: int) -> None:
        """Draw a change of the state; that of a recorded pose is recorded after it, with the same stamp."""
        if self._state != self._shown_state:
            self._shown_state = self._state
            self._at(stamp_ns).log("state", rr.StateChange(state=plain(self._state)))

    def _scan(self, scan: Scan) -> None:
        """Draw the obstacles around the base, and near it where their directions are unknown."""
        stream = self._at(scan.stamp_ns)
        rays = np.column_stack([np.cos(scan.azimuths_rad), np.sin(scan.azimuths_rad), np.zeros(len(scan.ranges_m))])
        known, unknown = np.isfinite(scan.ranges_m), np.isnan(scan.ranges_m)
        obstacles = scan.ranges_m[known, None] * rays[known]
        stream.log("odom/base_link/obstacles", rr.Points3D(obstacles, **_style(RED, MEDIUM)))
        stream.log("odom/base_link/unknown", rr.Points3D(0.5 * rays[unknown], **_style(GREY, THIN)))


class ReplayDrawing:
    """Sink of a replay: draws each message as a robot's subscribers get it, with features and depth."""

    def __init__(self, sink: RerunSink, scan_range_m: float, front_end: FrontEnd) -> None:
        """scan_range_m: obstacles.scan.max_range_m."""
        self._sink, self._geometry, self._dense = sink, front_end.geometry, front_end.dense
        self._encode = Encoder(front_end.geometry.rig, scan_range_m)

    def process(self, message: Outgoing) -> None:
        """Draw a message."""
        attachment = pose_attachment(message) if isinstance(message, OdometryUpdate) else b""
        for topic, payload in self._encode(message):
            if topic in REPLAYED:
                self._sink.draw(PUBLISHED[topic].decode(payload, attachment if topic == "odom" else b""))
        sink, rig = self._sink, self._geometry.rig
        if isinstance(message, OdometryUpdate) and sink.wants("image"):
            sink.panorama(message.stamp_ns, _jpeg(message.depth.panoramas.lower.panorama))
            sink.features(message.stamp_ns, message.features)
            dense = self._dense.of(message.depth)
            focal_baseline = self._geometry.cylinder.focal_px * rig.baseline_m
            sink.depth(message.stamp_ns, dense.disparity, focal_baseline, se3.apply(rig.T_base_rig, dense.points))


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 85))[1].tobytes()


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour.removeprefix("#")))


def _style(colour: str, size_px: float) -> dict[str, Any]:
    """Return colour and radius, on the screen, of points or lines."""
    return {"colors": _rgb(colour), "radii": _px(size_px)}


def _px(size: float) -> Any:
    """Return a radius on the screen, independent of the distance."""
    return rr.components.Radius.ui_points(size)


def _points_3d(points: NDArray[Any], most: int) -> Any:
    """Return points (N, 3), evenly chosen, dark below and light above, between percentiles of the heights."""
    points = points[:: max(1, -(-len(points) // most))]
    low, high = np.percentile(points[:, 2], (2, 98)) if len(points) else (0.0, 1.0)
    share = np.clip((points[:, 2] - low) / max(1e-3, high - low), 0, 1)
    colours = cv2.applyColorMap((255 * share).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return rr.Points3D(points, colors=colours.reshape(-1, 3)[:, ::-1], radii=_px(THIN))
