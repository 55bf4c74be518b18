"""Obstacle ring as LaserScan, compared with the bytes that rosbags writes."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from omnid.errors import OmnidError
from omnid.transport.scan_codec import SCAN_SCHEMA, decode_scan, scan_cdr

STORE = get_typestore(Stores.ROS2_HUMBLE)
STAMP_NS = 1_700_000_123_987_654_321
RANGES = np.array([1.5, np.inf, np.nan, 0.7], np.float32)
SIGMA = np.array([0.01, np.nan, np.nan, 0.02], np.float32)


@pytest.mark.parametrize("frame", ["base_link", "b", "base", "rig7"])
def test_the_bytes_are_those_of_ros(frame: str) -> None:
    step = math.pi / 2
    header = ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(*divmod(STAMP_NS, 10**9)), frame)
    scan = ros.sensor_msgs__msg__LaserScan(
        header, step / 2 - math.pi, math.pi - step / 2, step, 0.0, 0.0, 0.0, 6.0, RANGES, SIGMA
    )
    assert scan_cdr(STAMP_NS, frame, RANGES, SIGMA, (0.0, 6.0)) == bytes(STORE.serialize_cdr(scan, SCAN_SCHEMA))


def test_round_trip() -> None:
    scan = decode_scan(scan_cdr(STAMP_NS, "base_link", RANGES, SIGMA, (0.0, 6.0)))
    assert (scan.stamp_ns, scan.frame, scan.max_range_m) == (STAMP_NS, "base_link", 6.0)
    np.testing.assert_array_equal(scan.ranges_m, RANGES)
    np.testing.assert_array_equal(scan.sigma_m, SIGMA)
    np.testing.assert_allclose(np.rad2deg(scan.azimuths_rad), [-135, -45, 45, 135], atol=1e-4)


def test_any_bytes_give_a_scan_or_an_error() -> None:
    rng = random.Random(2)
    good = scan_cdr(STAMP_NS, "base_link", RANGES, SIGMA, (0.0, 6.0))
    for _ in range(1000):
        damaged = bytearray(good[: rng.randint(0, len(good))])
        for _ in range(rng.randint(0, 3) if damaged else 0):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            assert len(decode_scan(bytes(damaged)).ranges_m) <= len(good)
        except OmnidError as error:
            assert "\n" not in str(error)


def test_a_stamp_must_fit() -> None:
    with pytest.raises(OmnidError, match="stamp"):
        scan_cdr(-1, "base_link", RANGES, SIGMA, (0.0, 6.0))
