"""A log of known numbers, written by omnid, and messages as nested dicts and lists, the same for all readers.

Bytes are represented by length and SHA-256, clouds also by their points, as read_log.mjs prints them.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib import se3
from drivers.frame import Frame
from drivers.logs.mcap_writer import LogWriter
from omnid.transport import codec, map_codec
from omnid.transport.image_codec import image_cdr, image_topic
from omnid.transport.records import DiagnosticStatus, FrameTransform
from omnid.transport.status_names import ODOMETRY, Key

START_NS = 1_700_000_000 * 10**9 + 123_456_789
PERIOD_NS = 33_333_333
COUNT = 7
ATTACHED = {"rig.toml": b"schema = 1\n", "omnid.toml": b"a = 1\n"}
CLOUD = "sensor_msgs/msg/PointCloud2"

Expected = dict[str, list[dict[str, Any]]]  # topic -> its messages, in order


def write_known(path: Path, compression: Any = "lz4") -> Expected:
    """Write the log with omnid's own writers and return its expected content."""
    numbers = np.random.default_rng(5)
    expected: Expected = {}
    with LogWriter(path, ATTACHED, compression=compression) as log:
        for index in range(COUNT):
            for topic, schema, data, message in _messages(START_NS + index * PERIOD_NS, numbers):
                log.write(topic, schema, data, START_NS + index * PERIOD_NS)
                expected.setdefault(topic, []).append(message)
    return expected


def digest(data: bytes) -> dict[str, Any]:
    """Return length and SHA-256 of bytes."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def plain(value: Any) -> Any:
    """Return a message of rosbags as nested dicts and lists."""
    if isinstance(value, np.ndarray):
        return digest(value.tobytes()) if value.dtype == np.uint8 else value.tolist()
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    if not hasattr(value, "__dataclass_fields__"):
        return value
    fields = [name for name in value.__dataclass_fields__ if not name.isupper()]  # constants are upper case
    found = {name: plain(getattr(value, name)) for name in fields if name != "__msgtype__"}
    if value.__msgtype__ == CLOUD:
        found["points"] = value.data.view("<f4").reshape(-1, value.point_step // 4).astype(float).tolist()
    return found


def _messages(stamp_ns: int, numbers: np.random.Generator) -> list[tuple[str, str, bytes, dict[str, Any]]]:
    """Return one message of each kind: topic, type, bytes, expected content."""
    T, twist = se3.exp(numbers.normal(size=6)), numbers.normal(size=6)
    covariances = [0.01 * factor @ factor.T for factor in numbers.normal(size=(2, 6, 6))]
    return [
        (
            "/omnid/odom",
            codec.ODOMETRY_SCHEMA,
            codec.odometry_cdr(stamp_ns, T, covariances[0], twist, covariances[1]),
            {
                "header": _header(stamp_ns, "odom"),
                "child_frame_id": "base_link",
                "pose": {"pose": _pose(T), "covariance": covariances[0].ravel().tolist()},
                "twist": {
                    "twist": {"linear": _xyz(twist[:3]), "angular": _xyz(twist[3:])},
                    "covariance": covariances[1].ravel().tolist(),
                },
            },
        ),
        (
            "/omnid/pose",
            codec.POSE_SCHEMA,
            codec.pose_stamped_cdr(stamp_ns, T),
            {"header": _header(stamp_ns, "odom"), "pose": _pose(T)},
        ),
        (
            "/tf",
            codec.TRANSFORM_SCHEMA,
            codec.transform_cdr(stamp_ns, [FrameTransform("odom", "base_link", T)]),
            {
                "transforms": [
                    {
                        "header": _header(stamp_ns, "odom"),
                        "child_frame_id": "base_link",
                        "transform": {"translation": _pose(T)["position"], "rotation": _pose(T)["orientation"]},
                    }
                ]
            },
        ),
        (
            "/omnid/drive",
            codec.TWIST_SCHEMA,
            codec.twist_stamped_cdr(stamp_ns, "base_link", twist[0], twist[5]),
            {
                "header": _header(stamp_ns, "base_link"),
                "twist": {"linear": _xyz((twist[0], 0.0, 0.0)), "angular": _xyz((0.0, 0.0, twist[5]))},
            },
        ),
        _status(stamp_ns),
        _cloud(stamp_ns, numbers),
        *(_image(frame) for frame in _frames(stamp_ns, numbers)),
    ]


def _status(stamp_ns: int) -> tuple[str, str, bytes, dict[str, Any]]:
    status = DiagnosticStatus(ODOMETRY, 1, "über 90 °C", {Key.INLIERS: "3"})
    message = {
        "header": _header(stamp_ns, ""),
        "status": [
            {
                "level": 1,
                "name": ODOMETRY,
                "message": "über 90 °C",
                "hardware_id": "",
                "values": [{"key": "inliers", "value": "3"}],
            }
        ],
    }
    return "/omnid/status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, [status]), message


def _cloud(stamp_ns: int, numbers: np.random.Generator) -> tuple[str, str, bytes, dict[str, Any]]:
    packed = numbers.normal(size=(50, 4)).astype("<f4")
    fields = [
        {"name": name, "offset": 4 * i, "datatype": 7, "count": 1}
        for i, name in enumerate(("x", "y", "z", "confidence"))
    ]
    message = {
        "header": _header(stamp_ns, "odom"),
        "height": 1,
        "width": 50,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 800,
        "data": digest(packed.tobytes()),
        "is_dense": True,
        "points": packed.astype(float).tolist(),
    }
    data = map_codec.point_cloud_cdr(stamp_ns, "odom", packed[:, :3], packed[:, 3])
    return "/omnid/cloud", CLOUD, data, message


def _frames(stamp_ns: int, numbers: np.random.Generator) -> list[Frame]:
    """Return a JPEG of the lower camera and raw pixels of the upper one."""
    pixels = numbers.integers(0, 256, (24, 32), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    return [Frame(0, stamp_ns, "lower", "jpeg", jpeg), Frame(0, stamp_ns, "upper", "mono8", pixels, 32, 24)]


def _image(frame: Frame) -> tuple[str, str, bytes, dict[str, Any]]:
    schema, data = image_cdr(frame, frame.stamp_ns)
    message: dict[str, Any] = {"header": _header(frame.stamp_ns, frame.camera)}
    if frame.encoding == "jpeg":
        message |= {"format": "jpeg"}
    else:
        message |= {"height": 24, "width": 32, "encoding": "mono8", "is_bigendian": 0, "step": 32}
    return f"/omnid/{image_topic(frame)}", schema, data, message | {"data": digest(bytes(frame.data))}


def _header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _pose(T: np.ndarray) -> dict[str, Any]:
    return {
        "position": _xyz(T[:3, 3]),
        "orientation": dict(zip("xyzw", map(float, se3.quaternion(T[:3, :3])), strict=True)),
    }
