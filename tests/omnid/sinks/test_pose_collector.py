"""The poses of a run in arrays."""

from __future__ import annotations

import numpy as np

from omnid.messages import OdometryUpdate
from omnid.sinks.pose_collector import FIRST_CAPACITY, PoseCollector
from omnid.tracking_state import TrackingState


def odometry(seq: int) -> OdometryUpdate:
    state = TrackingState.LOST if seq % 7 == 0 else TrackingState.TRACKING
    return OdometryUpdate(
        seq, 10**9 + seq, np.eye(4) * seq, np.eye(6) * seq, np.zeros(6), np.eye(6), state, 0, 5, 9, None
    )  # type: ignore[arg-type]  # the depth is not used


def test_keeps_all_poses_beyond_its_first_capacity() -> None:
    collector, count = PoseCollector(), 2 * FIRST_CAPACITY + 5
    for seq in range(count):
        collector.process(odometry(seq))
    assert collector.stamps_ns.tolist() == list(range(10**9, 10**9 + count))
    assert np.array_equal(collector.T_odom_rig[:, 0, 0], np.arange(count))
    assert collector.covariances.shape == (count, 6, 6) and collector.covariances[-1, 5, 5] == count - 1
    assert len(collector.states) == count and collector.states[:2] == (TrackingState.LOST, TrackingState.TRACKING)


def test_empty_arrays_have_their_shapes() -> None:
    collector = PoseCollector()
    assert (collector.stamps_ns.shape, collector.T_odom_rig.shape, collector.covariances.shape) == (
        (0,),
        (0, 4, 4),
        (0, 6, 6),
    )
