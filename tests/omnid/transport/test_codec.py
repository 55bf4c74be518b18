"""CDR messages, decoded with rosbags and compared byte by byte."""

from __future__ import annotations

import random
import struct
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import codec, map_codec
from omnid.transport.records import DiagnosticStatus, FrameTransform
from tests.omnid.allocations import taken

STAMP_NS = 1_700_000_123_987_654_321
STORE = get_typestore(Stores.ROS2_HUMBLE)
T_ODOM_BASE = se3.transform(se3.rotation_exp([0.1, -0.2, 2.9]), [1.5, -2.25, 0.125])
COVARIANCE = np.arange(36.0).reshape(6, 6)
VELOCITY = np.array([0.5, 0.01, -0.02, 0.003, -0.004, 0.7])


def read(payload: bytes, schema: str) -> Any:
    return STORE.deserialize_cdr(payload, schema)


def odometry() -> bytes:
    return codec.odometry_cdr(STAMP_NS, T_ODOM_BASE, COVARIANCE, VELOCITY, 2.0 * COVARIANCE)


def test_odometry_round_trip() -> None:
    record = codec.odometry_from_cdr(odometry())
    assert record.stamp_ns == STAMP_NS
    assert record.frames == ("odom", "base_link")
    np.testing.assert_allclose(record.T_odom_base, T_ODOM_BASE, atol=1e-14)
    np.testing.assert_array_equal(record.covariance, COVARIANCE)
    np.testing.assert_array_equal(record.velocity, VELOCITY)
    np.testing.assert_array_equal(record.velocity_covariance, 2.0 * COVARIANCE)


def test_odometry_bytes_are_where_ros_expects_them() -> None:
    payload = odometry()
    body = payload[4:]
    assert payload[:4] == b"\x00\x01\x00\x00" and len(payload) == 4 + 720
    assert struct.unpack_from("<iI", body) == divmod(STAMP_NS, 10**9)
    assert body[8:17] == b"\x05\x00\x00\x00odom\x00"
    np.testing.assert_allclose(struct.unpack_from("<3d", body, 40), T_ODOM_BASE[:3, 3])
    np.testing.assert_allclose(struct.unpack_from("<4d", body, 64), se3.quaternion(T_ODOM_BASE[:3, :3]))
    assert struct.unpack_from("<36d", body, 96) == tuple(float(i) for i in range(36))
    assert struct.unpack_from("<6d", body, 384) == tuple(VELOCITY)


def test_odometry_frames_can_be_named() -> None:
    eye = np.eye(6)
    payload = codec.odometry_cdr(1, T_ODOM_BASE, eye, VELOCITY, eye, frames=("map", "rig"))
    assert codec.odometry_from_cdr(payload).frames == ("map", "rig")


def test_decoder_raises_no_other_error_for_any_bytes() -> None:
    rng = random.Random(1)
    good = odometry()
    for _ in range(4000):
        damaged = bytearray(good)
        for _ in range(rng.randint(1, 6)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        payload = bytes(damaged[: rng.randint(0, len(damaged))]) if rng.random() < 0.5 else bytes(damaged)
        expect_record_or_refusal(payload)
    for _ in range(2000):
        expect_record_or_refusal(b"\x00\x01\x00\x00" + rng.randbytes(rng.randint(0, 900)))


def expect_record_or_refusal(payload: bytes) -> None:
    try:
        record = codec.odometry_from_cdr(payload)
    except OmnidError as error:
        assert "\n" not in str(error)
    else:
        assert se3.is_rigid(record.T_odom_base) and record.covariance.shape == (6, 6)


@pytest.mark.parametrize("payload", [b"", b"\x00", b"\x00\x01\x00\x00", b"hello", bytes(724), odometry()[:-9]])
def test_decoder_refuses(payload: bytes) -> None:
    with pytest.raises(OmnidError):
        codec.odometry_from_cdr(payload)


@pytest.mark.parametrize(("offset", "value"), [(4, struct.pack("<i", -1)), (8, struct.pack("<I", 10**9)),
                                               (68, bytes(32)), (92, struct.pack("<d", 3.0))])  # fmt: skip
def test_decoder_refuses_invalid_stamps_and_rotations(offset: int, value: bytes) -> None:
    payload = bytearray(odometry())
    payload[offset : offset + len(value)] = value
    with pytest.raises(OmnidError, match=r"stamp|quaternion"):
        codec.odometry_from_cdr(bytes(payload))


def test_decoder_refuses_a_pose_that_is_not_finite() -> None:
    T = T_ODOM_BASE.copy()
    T[0, 3] = np.nan
    with pytest.raises(OmnidError, match="expected finite"):
        codec.odometry_from_cdr(codec.odometry_cdr(STAMP_NS, T, COVARIANCE, VELOCITY, COVARIANCE))


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_stamp_must_fit(stamp_ns: int) -> None:
    with pytest.raises(OmnidError, match="stamp"):
        codec.pose_stamped_cdr(stamp_ns, T_ODOM_BASE)


def test_covariance_must_have_36_numbers() -> None:
    with pytest.raises(OmnidError, match="covariance"):
        codec.odometry_cdr(STAMP_NS, T_ODOM_BASE, np.eye(3), VELOCITY, COVARIANCE)


def test_pose_stamped() -> None:
    message = read(codec.pose_stamped_cdr(STAMP_NS, T_ODOM_BASE), codec.POSE_SCHEMA)
    position, q = message.pose.position, message.pose.orientation
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP_NS, 10**9)
    assert message.header.frame_id == "odom"
    np.testing.assert_array_equal([position.x, position.y, position.z], T_ODOM_BASE[:3, 3])
    np.testing.assert_allclose(se3.rotation([q.x, q.y, q.z, q.w]), T_ODOM_BASE[:3, :3], atol=1e-14)


def test_transforms() -> None:
    edges = [FrameTransform("map", "odom", np.eye(4)), FrameTransform("odom", "base_link", T_ODOM_BASE)]
    message = read(codec.transform_cdr(STAMP_NS, edges), codec.TRANSFORM_SCHEMA)
    names = [(edge.header.frame_id, edge.child_frame_id) for edge in message.transforms]
    shift = message.transforms[1].transform.translation
    assert names == [("map", "odom"), ("odom", "base_link")]
    assert message.transforms[0].transform.rotation.w == 1.0
    np.testing.assert_array_equal([shift.x, shift.y, shift.z], T_ODOM_BASE[:3, 3])


def test_point_cloud() -> None:
    rng = np.random.default_rng(2)
    points, confidence = rng.normal(size=(50, 3)).astype(np.float32), rng.random(50, np.float32)
    message = read(map_codec.point_cloud_cdr(STAMP_NS, "rig", points, confidence), codec.POINT_CLOUD_SCHEMA)
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("confidence", 12, 7, 1)
    ]  # fmt: skip
    assert (message.height, message.width, message.point_step, message.row_step) == (1, 50, 16, 800)
    assert message.is_dense and not message.is_bigendian
    rows = message.data.view("<f4").reshape(-1, 4)
    np.testing.assert_array_equal(rows, np.column_stack([points, confidence]))


def test_a_point_cloud_is_transformed_with_little_extra_memory() -> None:
    """The map's cloud is published every two seconds and grows for hours; memory once taken stays with the process."""
    rng = np.random.default_rng(2)
    points, confidence = rng.normal(size=(50_000, 3)).astype(np.float32), rng.random(50_000, np.float32)

    def cloud() -> bytes:
        return map_codec.point_cloud_cdr(STAMP_NS, "odom", points, confidence, T_frame_points=T_ODOM_BASE)

    rows = read(cloud(), codec.POINT_CLOUD_SCHEMA).data.view("<f4").reshape(-1, 4)
    moved = se3.apply(T_ODOM_BASE, points).astype(np.float32)
    np.testing.assert_array_equal(rows, np.column_stack([moved, confidence]))
    assert taken(cloud).most < 3.5 * len(cloud())  # the points, the message of rosbags, and its copy as bytes


def test_grid() -> None:
    cells = np.arange(-1, 11, dtype=np.int8).reshape(3, 4)
    message = read(map_codec.grid_cdr(STAMP_NS, "odom", cells, 0.1, (-2.0, 5.5)), codec.GRID_SCHEMA)
    info = message.info
    assert message.header.frame_id == "odom" and message.data.tolist() == list(range(-1, 11))
    assert (info.width, info.height, info.resolution) == (4, 3, pytest.approx(0.1))
    origin = info.origin
    assert (origin.position.x, origin.position.y, origin.position.z, origin.orientation.w) == (-2.0, 5.5, 0.0, 1.0)


def test_empty_point_cloud() -> None:
    message = read(map_codec.point_cloud_cdr(STAMP_NS, "rig", np.empty((0, 3)), np.empty(0)), codec.POINT_CLOUD_SCHEMA)
    assert message.width == 0 and len(message.data) == 0


def test_diagnostics() -> None:
    payload = codec.diagnostics_cdr(
        STAMP_NS, [DiagnosticStatus("omnid/odometry", 1, "degraded", {"inliers": "12", "fps": "9.8"})]
    )
    (status,) = read(payload, codec.DIAGNOSTICS_SCHEMA).status
    assert (status.level, status.name, status.message) == (1, "omnid/odometry", "degraded")
    assert [(pair.key, pair.value) for pair in status.values] == [("inliers", "12"), ("fps", "9.8")]


def test_diagnostic_level_must_exist() -> None:
    with pytest.raises(OmnidError, match="level 4"):
        codec.diagnostics_cdr(STAMP_NS, [DiagnosticStatus("omnid", 4, "", {})])


def test_twist_stamped() -> None:
    message = read(codec.twist_stamped_cdr(STAMP_NS, "base_link", 0.4, -0.3), codec.TWIST_SCHEMA)
    linear, angular = message.twist.linear, message.twist.angular
    assert message.header.frame_id == "base_link"
    assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == (0.4, 0, 0, 0, 0, -0.3)
