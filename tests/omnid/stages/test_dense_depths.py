"""Dense depth is computed when it is first asked for, and for the pairs that enter the map."""

from __future__ import annotations

import gc
import threading
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.config import MappingConfig
from omnid.core.odometry.earlier_view import EarlierView
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.types.pixel_times import PixelTimes
from omnid.core.types.stereo_model import StereoModel
from omnid.messages import DensePoints, OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.mapping import Mapping
from omnid.tracking_state import TrackingState
from tests.omnid.core.scenery import wrapped

IMAGE = np.zeros((4, 100), np.uint8)


class Counted:
    """Depth of pairs, and how often it was computed for which."""

    def __init__(self) -> None:
        self.computed: list[int] = []
        self.exposures: list[Exposure | None] = []

    def __call__(self, pair: Panoramas, exposure: Exposure | None) -> DensePoints:
        self.computed.append(pair.seq)
        self.exposures.append(exposure)
        points = np.array([[1.0, 2.0, 0.5]])
        return DensePoints(np.full((4, 100), np.nan, np.float32), np.zeros((1, 2)), points, np.full(1, 1e-4))


def panoramas(seq: int, stamp_ns: int = 0) -> Panoramas:
    panorama = wrapped(IMAGE)
    return Panoramas(seq, stamp_ns, panorama, panorama, IMAGE > 0)


def test_depth_is_computed_once() -> None:
    counted = Counted()
    depths, depth = DenseDepths(counted), StereoDepth(panoramas(3))
    assert depths.of(depth) is depths.of(depth) and counted.computed == [3]


def test_two_threads_that_read_at_the_same_time_compute_the_depth_once() -> None:
    counted, begun = Counted(), threading.Barrier(2, timeout=20)

    def slow(pair: Panoramas, exposure: Exposure | None) -> DensePoints:
        time.sleep(0.1)
        return counted(pair, exposure)

    depths, depth = DenseDepths(slow), StereoDepth(panoramas(3))
    found: list[DensePoints] = []

    def read() -> None:
        begun.wait()
        found.append(depths.of(depth))

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join(20)
    assert counted.computed == [3] and found[0] is found[1]


@pytest.mark.parametrize(
    ("rate_hz", "speed_mps", "expected"),
    [
        (5.0, 1.0, 10),  # as often as the rate says, of 30 pairs a second for 2 s
        (0.0, 0.0, 60),  # all
        (5.0, 0.0, 2),  # at rest, once a second
        (1000.0, 0.5, 30),  # as soon as the view has changed by 3 cm, which is every second pair
    ],
)
def test_pairs_enter_the_map_at_its_rate_while_the_robot_moves(rate_hz: float, speed_mps: float, expected: int) -> None:
    counted = Counted()
    mapping = Mapping(MappingConfig(rate_hz=rate_hz), DenseDepths(counted))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([speed_mps * stamp_ns * 1e-9, 0, 0]))
        mapping.process(
            OdometryUpdate(
                seq,
                stamp_ns,
                T,
                np.eye(6),
                np.zeros(6),
                np.eye(6),
                TrackingState.TRACKING,
                0,
                50,
                50,
                StereoDepth(panoramas(seq, stamp_ns)),
            )
        )
    assert len(counted.computed) == expected
    path_xy = mapping.finish()[0].path_xy  # it goes on where no pair enters the map
    np.testing.assert_allclose(path_xy[-1], [speed_mps * 59 / 30, 0], atol=1e-6)


def test_keyframes_enter_the_map_after_half_the_time() -> None:
    """Their dense stereo is computed in any case: with one in time, no other pair needs it."""
    counted = Counted()
    mapping = Mapping(MappingConfig(rate_hz=5.0), DenseDepths(counted))
    for seq in range(60):
        stamp_ns = round(seq * 1e9 / 30)
        T = se3.transform(np.eye(3), np.array([stamp_ns * 1e-9, 0, 0]))
        mapping.process(
            OdometryUpdate(
                seq,
                stamp_ns,
                T,
                np.eye(6),
                np.zeros(6),
                np.eye(6),
                TrackingState.TRACKING,
                0,
                50,
                50,
                StereoDepth(panoramas(seq, stamp_ns)),
                is_keyframe=seq % 4 == 0,
            )
        )
    assert counted.computed == list(range(0, 60, 4))


def test_keyframes_alone_enter_a_map_without_readers() -> None:
    """Later readers find it; from then on pairs enter it at its rate."""
    counted, seqs = Counted(), [0]
    mapping = Mapping(MappingConfig(rate_hz=15.0), DenseDepths(counted), 0.5, is_read=lambda: seqs[-1] > 30)
    maps = 0
    for seq in range(60):
        seqs.append(seq)
        stamp_ns = round(seq * 1e9 / 30)
        update = OdometryUpdate(
            seq,
            stamp_ns,
            se3.transform(np.eye(3), np.array([stamp_ns * 1e-9, 0, 0])),
            np.eye(6),
            np.zeros(6),
            np.eye(6),
            TrackingState.TRACKING,
            0,
            50,
            50,
            StereoDepth(panoramas(seq, stamp_ns)),
            is_keyframe=seq % 10 == 0,
        )
        maps += mapping.process(update) is not None
    assert counted.computed == [0, 10, 20, 30, *range(32, 60, 2)]
    assert maps == 3, "a query for the newest one finds it"


def test_depth_is_computed_for_each_motion_that_is_asked_for() -> None:
    counted = Counted()
    depths, model = DenseDepths(counted), StereoModel(Cylinder(100, 4, 2.0), 0.2)
    slow, fast = (Exposure(PixelTimes(0.015), RigVelocity(v * np.ones(6), np.eye(6)), model) for v in (0.0, 1.0))
    pair = panoramas(3)
    depths.points(pair, slow)
    depths.points(pair, fast)
    assert counted.exposures == [slow, fast]
    assert depths.of(StereoDepth(pair, fast)) is depths.points(pair, fast) and len(counted.exposures) == 2
    depths.of(StereoDepth(pair))
    assert counted.exposures == [slow, fast, None]


def test_points_are_confirmed_once_for_each_earlier_view() -> None:
    """Odometry, which makes the keyframe before its pose is known well, gets the points as they were matched."""
    pair, views = panoramas(3), [EarlierView(wrapped(IMAGE), IMAGE > 0, np.eye(4)) for _ in range(2)]
    confirmed: list[EarlierView | None] = []

    def none_of(depth: StereoDepth, dense: DensePoints) -> DensePoints:
        confirmed.append(depth.earlier)
        return replace(dense, points=dense.points[:0])

    depths = DenseDepths(Counted(), none_of)
    for view in (views[0], views[0], views[1]):
        assert len(depths.of(StereoDepth(pair, earlier=view)).points) == 0
    assert confirmed == views and len(depths.points(pair).points) == 1


def test_depth_is_forgotten_with_its_pair() -> None:
    depths, pair = DenseDepths(Counted()), panoramas(3)
    found = weakref.ref(depths.points(pair).points)
    assert found() is not None
    del pair
    gc.collect()
    assert found() is None
