"""Gaps, resets and lost cameras are reported."""

from __future__ import annotations

from pathlib import Path

from omnid.report.report import report_html
from omnid.report.report_data import ReportData, collect_report_data
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import WHEELS, camera_name
from tests.omnid.report.pages import Page
from tests.omnid.report.recorded_logs import (
    run,
    save,
    state,
    status,
)


def event_texts(data: ReportData) -> list[tuple[str, str]]:
    return [(event.source, event.text) for event in data.events.in_order()]


def test_reports_gaps_resets_and_lost_cameras(tmp_path: Path) -> None:
    camera = camera_name("upper")
    entries = [
        *run(100, missing=range(30, 50)),
        state(60, "tracking", resets=1),
        status(
            61,
            DiagnosticStatus(camera, 0, "streaming", {"drops": "3"}),
            DiagnosticStatus(WHEELS, 0, "driving", {}),
        ),
        status(
            71,
            DiagnosticStatus(camera, 2, "lost since 1.0 s", {"drops": "3"}),
            DiagnosticStatus(WHEELS, 1, "the pose is lost", {"stopped, the pose is lost": "1"}),
        ),
        status(
            81,
            DiagnosticStatus(camera, 2, "lost since 2.0 s", {"drops": "8"}),
            DiagnosticStatus(WHEELS, 0, "driving", {"stopped, the pose is lost": "1"}),
        ),
    ]
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    assert event_texts(data) == [
        ("poses", "none for 2.10 s"),
        ("state", "odometry was reset, with an unknown gap"),
        ("upper camera", "lost since 1.0 s"),
        ("wheels", "the pose is lost"),
        ("wheels", "stopped, the pose is lost"),
        ("upper camera", "images dropped"),
        ("wheels", "driving"),
    ]
    assert data.statuses.resets == 1
    page = Page(report_html(tmp_path / "log.mcap", data))
    assert "images dropped (5)" in page.text and "upper camera" in page.text
