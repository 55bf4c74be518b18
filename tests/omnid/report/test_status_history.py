"""Status entries in the order of their poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.report.report_data import collect_report_data
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PAIRING
from tests.omnid.report.recorded_logs import (
    odom,
    run,
    save,
    state,
    status,
)
from tests.omnid.report.test_report_data import STARTED_AGAIN, event_texts, length, straight


def test_poses_have_the_state_reported_after_them(tmp_path: Path) -> None:
    data = collect_report_data(save(tmp_path / "log.mcap", run(100, lost=range(40, 50))))
    assert data.poses.states == {0: 90, 2: 10}
    assert event_texts(data) == [("state", "lost"), ("state", "tracking")]
    assert [round(event.start_s, 6) for event in data.events.in_order()] == [4.0, 5.0]


def test_orders_status_from_before_the_first_pose_and_late_status(tmp_path: Path) -> None:
    entries = [
        status(
            -20,
            DiagnosticStatus(ODOMETRY, 3, "no pose yet", {}),
            DiagnosticStatus(PAIRING, 1, "none", {}),
        ),
        odom(0),
        state(0, "tracking"),
        odom(5),
        state(5, "lost"),
        state(4, "tracking"),
        odom(6),
    ]  # status from before the loss, recorded after it
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    assert data.poses.states == {0: 1, 2: 2}
    assert event_texts(data)[0] == ("pairing", "none") and data.events.in_order()[0].start_s == -2.0


def test_a_gap_and_late_status_are_no_restart(tmp_path: Path) -> None:
    """The way during the gap counts; a report that was recorded late has fewer resets than the one before."""
    entries = [*straight(0, 10), length(9, 0.9), state(9, "tracking", 1)]
    entries += [odom(60, se3.transform(np.eye(3), [5.0, 0.0, 0.0])), length(60, 5.0, 1), state(8, "tracking", 0)]
    data = collect_report_data(save(tmp_path / "a.mcap", entries))
    assert data.poses.length_m == pytest.approx(5.0) and STARTED_AGAIN not in event_texts(data)
