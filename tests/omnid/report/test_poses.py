"""Poses of a recording: invalid ones are left out and counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.report.report import report_html
from omnid.report.report_data import collect_report_data
from tests.omnid.report.pages import Page, html_of
from tests.omnid.report.recorded_logs import (
    at,
    odom,
    run,
    save,
)


def test_leaves_invalid_poses_out_and_counts_them(tmp_path: Path) -> None:
    far, early = np.eye(4), np.eye(4)
    far[0, 3] = 1e12
    stray = (at(10), "/omnid/odom", "nav_msgs/msg/Odometry", odom(10**6)[3])
    entries = [*run(10), (at(10), *odom(10, far)[1:]), stray, (at(11), *odom(5, early)[1:]), odom(12)]
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    assert (data.poses.poses, data.poses.out_of_range, data.unreadable, data.poses.late) == (11, 1, 1, 1)
    text = Page(report_html(tmp_path / "log.mcap", data)).text
    assert "2 messages were left out" in text and "1 poses were left out" in text


def test_a_single_pose_gives_a_report(tmp_path: Path) -> None:
    assert "0.0 s" in Page(html_of(save(tmp_path / "log.mcap", [odom(0)]))).text
