"""Sections of the report: stages and latencies, and what a foreign log lacks."""

from __future__ import annotations

from pathlib import Path

from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, stage_name
from tests.omnid.report.pages import Page, html_of
from tests.omnid.report.recorded_logs import (
    odom,
    run,
    save,
    status,
)


def test_shows_stages_and_latencies(tmp_path: Path) -> None:
    def second(k: int) -> tuple[DiagnosticStatus, ...]:
        odometry = {
            "inliers": str(200 + k),
            "tracked": "300",
            "capture_to_pose_p50_ms": "81.25",
            "rate_hz": "9.5",
            "capture_to_pose_p99_ms": "163.00",
        }
        stereo = {
            "processed": str(10 * k),
            "dropped": str(k),
            "work_p50_ms": "31.5",
            "work_p99_ms": "44.0",
            "work_max_ms": "52.1",
        }
        return DiagnosticStatus(ODOMETRY, 0, "tracking", odometry), DiagnosticStatus(
            stage_name("stereo"), 0, "", stereo
        )

    entries = [*run(100), *(status(10 * k, *second(k)) for k in range(10))]
    text = Page(html_of(save(tmp_path / "log.mcap", entries))).text
    for words in (
        "81.2 / 163 ms",
        "stereo",
        "31.5",
        "52.1",
        "stereo, dropped",
        "inliers of the pose",
        "messages dropped (9)",
    ):
        assert words in text, words
    assert "no status of the daemon" not in text


def test_names_the_missing_parts_of_a_foreign_log(tmp_path: Path) -> None:
    entries = [odom(k, topic="/wheels/odometry", sigma_m=0.0) for k in range(30)]
    text = Page(html_of(save(tmp_path / "log.mcap", entries))).text
    for words in (
        "Run of wheels",
        "does not hold the state",
        "they were not set",
        "no numbers of landmarks",
        "no status of the daemon",
        "holds no images",
        "no rig.toml is attached",
        "holds no map",
        "holds no commands",
    ):
        assert words in text, words
