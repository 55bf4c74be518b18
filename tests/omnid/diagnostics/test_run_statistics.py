"""Statistics of a run: length, states, and what its images lacked."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from calib import se3
from omnid.diagnostics.run_summary import RunCounters, RunStatistics
from omnid.messages import OdometryUpdate
from omnid.tracking_state import TrackingState
from tests.omnid.core.test_frames import odometry


def pose(x_m: float, state: str = "tracking", *, frozen: bool = False) -> OdometryUpdate:
    columns = {"lower": np.array([frozen, False]), "upper": np.zeros(2, bool)}
    depth = SimpleNamespace(panoramas=SimpleNamespace(tiles=SimpleNamespace(columns=columns)))
    return odometry(se3.transform(np.eye(3), [x_m, 0, 0]), state=state, depth=cast("Any", depth))


def test_poses_are_counted_and_their_path_is_added_up() -> None:
    statistics = RunStatistics()
    for update in (pose(5.0), pose(5.5), pose(5.25, "lost"), pose(5.25, frozen=True)):
        statistics.process(update)
    assert (statistics.poses, statistics.length_m) == (4, 0.75) and statistics.states == {"tracking": 3, "lost": 1}
    assert statistics.lost_parts == {"lower": 1} and statistics.newest is not None


def test_poses_refused_for_their_speed_and_resets_are_known() -> None:
    statistics = RunStatistics()
    for refused_mps in (0.0, 7.0, 6.0):
        statistics.process(replace(pose(0.0), refused_mps=refused_mps, reset_counter=2))
    assert (statistics.too_fast, statistics.fastest_mps, statistics.resets) == (2, 7.0, 2)


def test_a_run_has_no_pose_where_all_are_lost() -> None:
    statistics = RunStatistics()
    assert RunCounters.of(statistics, 0, {}).no_pose
    statistics.process(pose(0.0, "lost"))
    assert RunCounters.of(statistics, 1, {}).no_pose
    statistics.process(pose(0.0, "degraded"))
    counters = RunCounters.of(statistics, 2, {"late": 1})
    assert not counters.no_pose and counters.states[TrackingState.TRACKING] == 0 and counters.drops == {"late": 1}
