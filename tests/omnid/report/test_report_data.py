"""Content of a recording for the report, collected in one pass and in bounded memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.report.report import report_html
from omnid.report.report_data import ReportData, collect_report_data
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PAIRING
from tests.omnid.report.recorded_logs import (
    corrupt_chunks,
    map_pose,
    odom,
    run,
    save,
    state,
    status,
)


def event_texts(data: ReportData) -> list[tuple[str, str]]:
    return [(event.source, event.text) for event in data.events.in_order()]


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


def test_corrupt_chunks_of_a_log_with_an_index_are_counted(tmp_path: Path) -> None:
    log = save(tmp_path / "a.mcap", run(60))
    assert collect_report_data(log).corrupt == 0
    corrupt_chunks(log)
    data = collect_report_data(log)
    assert data.corrupt == 2 and 40 < data.poses.poses < 60
    page = report_html(log, data)
    assert "2 corrupt chunks or records were skipped." in page and "MB, cut or corrupt. Poses" in page


def test_a_pose_in_the_map_without_its_pose_of_odometry_is_left_out(tmp_path: Path) -> None:
    data = collect_report_data(save(tmp_path / "a.mcap", [odom(0), map_pose(1, np.eye(4)), odom(2)]))
    assert not data.map_poses.path.vertices
