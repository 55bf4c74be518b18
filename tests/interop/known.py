"""A log of each kind of message, written by omnid, and its messages as rosbags decodes them, as nested dicts and lists.

Bytes are represented by length and SHA-256, clouds also by their points, as read_log.mjs prints them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib import se3
from drivers.frame import Frame
from drivers.logs.mcap_writer import LogWriter
from omnid.transport import codec
from omnid.transport.codec import DiagnosticStatus, FrameTransform
from omnid.transport.sensor_codec import image_cdr, image_topic
from omnid.transport.status_names import ODOMETRY, Key
from tests.drivers.logs.mcap_logs import STORE

START_NS = 1_700_000_000 * 10**9 + 123_456_789
PERIOD_NS = 33_333_333
COUNT = 7
ATTACHED = {"rig.toml": b"schema = 1\n", "omnid.toml": b"a = 1\n"}
CLOUD = "sensor_msgs/msg/PointCloud2"

NOT_FINITE = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}  # JavaScript's words: JSON has no such numbers

Expected = dict[str, list[dict[str, Any]]]  # topic -> its messages, in order


def write_known(path: Path, compression: Any = "lz4") -> Expected:
    """Write the log with omnid's own writers and return its expected content."""
    numbers = np.random.default_rng(5)
    expected: Expected = {}
    with LogWriter(path, ATTACHED, compression=compression) as log:
        for stamp_ns in range(START_NS, START_NS + COUNT * PERIOD_NS, PERIOD_NS):
            for topic, schema, data in _messages(stamp_ns, numbers):
                log.write(topic, schema, data, stamp_ns)
                expected.setdefault(topic, []).append(plain(STORE.deserialize_cdr(data, schema)))
    return expected


def digest(data: bytes) -> dict[str, Any]:
    """Return length and SHA-256 of bytes."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def plain(value: Any) -> Any:
    """Return a message of rosbags as nested dicts and lists."""
    if isinstance(value, np.ndarray):
        return digest(value.tobytes()) if value.dtype == np.uint8 else plain(value.tolist())
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return NOT_FINITE[str(value)]
    if not hasattr(value, "__dataclass_fields__"):
        return value
    fields = [name for name in value.__dataclass_fields__ if not name.isupper()]  # constants are upper case
    found = {name: plain(getattr(value, name)) for name in fields if name != "__msgtype__"}
    if value.__msgtype__ == CLOUD:
        found["points"] = value.data.view("<f4").reshape(-1, value.point_step // 4).astype(float).tolist()
    return found


def _messages(stamp_ns: int, numbers: np.random.Generator) -> Iterator[tuple[str, str, bytes]]:
    """Yield topic, type and bytes of a message of each kind; the lower camera's image is a JPEG, the upper's is raw."""
    T, twist = se3.exp(numbers.normal(size=6)), numbers.normal(size=6)
    one, other = (0.01 * factor @ factor.T for factor in numbers.normal(size=(2, 6, 6)))
    packed = numbers.normal(size=(50, 4)).astype("<f4")
    pixels = numbers.integers(0, 256, (24, 32), dtype=np.uint8)
    status = DiagnosticStatus(ODOMETRY, 1, "über 90 °C", {Key.INLIERS: "3"})
    yield "/omnid/odom", codec.ODOMETRY_SCHEMA, codec.odometry_cdr(stamp_ns, T, one, twist, other)
    yield "/omnid/pose", codec.POSE_SCHEMA, codec.encoded(codec.POSE_SCHEMA, (stamp_ns, "odom"), T)
    yield "/tf", codec.TRANSFORM_SCHEMA, codec.transform_cdr(stamp_ns, [FrameTransform("odom", "base_link", T)])
    yield "/omnid/drive", codec.TWIST_SCHEMA, codec.twist_stamped_cdr(stamp_ns, "base_link", twist[0], twist[5])
    yield "/omnid/status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, [status])
    yield "/omnid/cloud", CLOUD, codec.point_cloud_cdr(stamp_ns, "odom", packed[:, :3], packed[:, 3])
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    frames = Frame(0, stamp_ns, "lower", "jpeg", jpeg), Frame(0, stamp_ns, "upper", "mono8", pixels, 32, 24)
    for frame in frames:
        yield f"/omnid/{image_topic(frame)}", *image_cdr(frame, stamp_ns)
