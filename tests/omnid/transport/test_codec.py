"""CDR messages against rosbags, which is the oracle of their bytes; decoders that take any bytes."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calib import se3
from drivers.frame import Frame
from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.codec import (
    MOVING_FIELDS,
    DiagnosticStatus,
    Pose,
    PoseAttachment,
    decode_cloud,
    decode_diagnostics,
    decode_map,
    decode_scan,
    moving_cdr,
    scan_cdr,
)
from omnid.transport.sensor_codec import image_cdr, image_topic
from tests.omnid.sinks.test_recorder import frame
from tests.omnid.transport.bus_fixtures import damaged

STAMP_NS = 1_700_000_123_987_654_321
STORE = get_typestore(Stores.ROS2_HUMBLE)
T_ODOM_BASE = se3.transform(se3.rotation_exp([0.1, -0.2, 2.9]), [1.5, -2.25, 0.125])
COVARIANCE = np.arange(36.0).reshape(6, 6)
VELOCITY = np.array([0.5, 0.01, -0.02, 0.003, -0.004, 0.7])
RANGES = np.array([1.5, np.inf, np.nan, 0.7], np.float32)
SIGMA = np.array([0.01, np.nan, np.nan, 0.02], np.float32)
POINTS = np.random.default_rng(2).normal(size=(50, 3)).astype(np.float32)
CONFIDENCE = np.arange(50, dtype=np.float32) / 50
CELLS = np.arange(-1, 11, dtype=np.int8).reshape(3, 4)
PERSON = MovingObstacle(1.5, -0.25, 0.0, 0.75, np.diag([0.01, 0.04, 0.25, 0.09]), 0.25)
STATUSES = [DiagnosticStatus("a", 1, "so so", {"k": "v"}), DiagnosticStatus("b", 0, "", {})]
EDGES = [("map", "odom", np.eye(4)), ("odom", "base_link", T_ODOM_BASE)]


def odometry(stamp_ns: int = STAMP_NS) -> bytes:
    return codec.odometry_cdr(stamp_ns, T_ODOM_BASE, COVARIANCE, VELOCITY, 2.0 * COVARIANCE)


CLOUD = codec.point_cloud_cdr(STAMP_NS, "rig", POINTS, CONFIDENCE)
GRID = codec.grid_cdr(STAMP_NS, "odom", CELLS, 0.1, (-2.0, 5.5))
SCAN = scan_cdr(STAMP_NS, "base_link", RANGES, SIGMA, (0.1, 6.0))
DIAGNOSTICS = codec.diagnostics_cdr(STAMP_NS, STATUSES)


def test_messages_for_other_programs_have_the_layout_of_ros() -> None:
    """Transforms, headings, moving obstacles and a cloud without points, by rosbags: omnid does not read them."""

    def read(schema: str, payload: bytes) -> Any:
        return STORE.deserialize_cdr(payload, schema)

    edges = read(codec.TRANSFORM_SCHEMA, codec.transform_cdr(STAMP_NS, EDGES)).transforms
    assert [(edge.header.frame_id, edge.child_frame_id) for edge in edges] == [("map", "odom"), ("odom", "base_link")]
    moved = edges[1].transform
    assert (moved.translation.x, moved.translation.y, moved.translation.z) == (1.5, -2.25, 0.125)
    q = moved.rotation
    np.testing.assert_allclose(se3.rotation((q.x, q.y, q.z, q.w)), T_ODOM_BASE[:3, :3], atol=1e-12)
    moving = read(codec.POINT_CLOUD_SCHEMA, moving_cdr(STAMP_NS, "odom", [PERSON] * 3))
    assert (moving.header.frame_id, moving.width, moving.point_step) == ("odom", 3, 32)
    assert [field.name for field in moving.fields] == list(MOVING_FIELDS)
    row = moving.data.view("<f4").reshape(3, 8)[2]
    np.testing.assert_allclose(row, [1.5, -0.25, 0, 0, 0.75, 0.25, 0.2, 0.5], rtol=1e-6)
    empty = codec.point_cloud_cdr(STAMP_NS, "rig", np.empty((0, 3)), np.empty(0))
    assert (read(codec.POINT_CLOUD_SCHEMA, empty).width, decode_cloud(empty).points.shape) == (0, (0, 3))


def test_decoded_messages_equal_the_encoded_ones() -> None:
    report = decode_diagnostics(DIAGNOSTICS)
    assert report.stamp_ns == STAMP_NS and [status.name for status in report.statuses] == ["a", "b"]
    assert (report.value("a", "k"), report.value("b", "k"), report.value("c", "k")) == ("v", "", "")
    cloud = decode_cloud(CLOUD)
    assert (cloud.stamp_ns, cloud.frame) == (STAMP_NS, "rig")
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.confidence, CONFIDENCE)
    grid = decode_map(GRID)
    assert (grid.stamp_ns, grid.frame, grid.cell_m, grid.corner) == (STAMP_NS, "odom", pytest.approx(0.1), (-2.0, 5.5))
    np.testing.assert_array_equal(grid.cells, CELLS)
    scan = decode_scan(SCAN)
    assert (scan.stamp_ns, scan.frame, scan.max_range_m) == (STAMP_NS, "base_link", 6.0)
    np.testing.assert_array_equal(scan.ranges_m, RANGES)
    np.testing.assert_array_equal(scan.sigma_m, SIGMA)
    np.testing.assert_allclose(np.rad2deg(scan.azimuths_rad), [-135, -45, 45, 135], atol=1e-4)


@pytest.mark.parametrize(
    "encoding", ["jpeg", "mono8", "mono16", "bgr8", "rgb8", "bgra8", "rgba8", "yuyv", "uyvy", "nv12"]
)
def test_image_messages_have_the_layout_of_ros(encoding: str) -> None:
    each = frame(7, "upper", encoding)
    schema, payload = image_cdr(each, 1_700_000_000 * 10**9 + 5)
    message: Any = STORE.deserialize_cdr(payload, schema)
    assert bytes(STORE.serialize_cdr(message, schema)) == payload
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (1_700_000_000, 5, "upper")
    if encoding == "jpeg":
        assert (message.format, bytes(message.data)) == ("jpeg", each.data)
        return
    names = {"yuyv": "yuv422_yuy2", "uyvy": "yuv422"}
    assert (message.encoding, message.width, message.height) == (names.get(encoding, encoding), 6, 4)
    rows = 4 * 3 // 2 if encoding == "nv12" else 4
    assert message.step == each.step and bytes(message.data) == bytes(each.data)[: each.step * rows]
    packed = Frame(0, 0, "lower", "bgr8", bytes(6 * 4 * 3), 6, 4)  # rows without padding
    assert STORE.deserialize_cdr(image_cdr(packed, 0)[1], schema).step == 18  # type: ignore[attr-defined]
    assert image_topic(packed) == "lower/image_raw"


def overwritten(offset: int, value: bytes) -> bytes:
    return odometry()[:offset] + value + odometry()[offset + len(value) :]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        *(
            (lambda data=data: codec.decode_pose(data), ".")
            for data in (b"", b"\x00", b"\x00\x01\x00\x00", b"hello", bytes(724), odometry()[:-9])
        ),
        *(
            (lambda at=at, value=value: codec.decode_pose(overwritten(at, value)), "stamp|quaternion")
            for at, value in (
                (4, struct.pack("<i", -1)),
                (8, struct.pack("<I", 10**9)),
                (68, bytes(32)),
                (92, struct.pack("<d", 3.0)),
            )
        ),
        (lambda: codec.decode_pose(overwritten(44, struct.pack("<d", math.nan))), "expected finite"),
        (lambda: odometry(stamp_ns=-1), "stamp"),
        (lambda: odometry(stamp_ns=2**31 * 10**9), "stamp"),
        (lambda: scan_cdr(-1, "base_link", RANGES, SIGMA, (0.0, 6.0)), "stamp"),
        (lambda: moving_cdr(2**31 * 10**9, "odom", []), "stamp"),
        (lambda: decode_map(codec.grid_cdr(STAMP_NS, "odom", CELLS, math.inf, (0.0, 0.0))), "finite, positive size"),
        (lambda: image_cdr(frame(7, "upper", "bgr8"), -1), "-1 ns"),
        *(
            (lambda data=data: PoseAttachment.from_bytes(data), f"the {len(data)} bytes attached to a pose")
            for data in (b"", b"[1]", b"{", b"\xff", b"[" * 4000)
        ),
    ],
)
def test_malformed_messages_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(OmnidError, match=words):
        make()


@pytest.mark.parametrize(
    ("decode", "good"),
    [
        (codec.decode_pose, odometry()),
        (decode_scan, SCAN),
        (decode_map, GRID),
        (decode_cloud, CLOUD),
        (decode_diagnostics, DIAGNOSTICS),
    ],
)
def test_any_bytes_give_a_message_or_one_line(decode: Callable[[bytes], object], good: bytes) -> None:
    rng = random.Random(1)
    for _ in range(2000):
        payload = damaged(rng, good)
        if rng.random() < 0.2:
            payload = good[:4] + rng.randbytes(rng.randint(0, 900))
        try:
            decoded: Any = decode(payload)
        except OmnidError as error:
            assert "\n" not in str(error)
        else:
            assert not isinstance(decoded, Pose) or se3.is_rigid(decoded.T_odom_base)
