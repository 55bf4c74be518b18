"""Plots and log lines from status entries, without rerun."""

from __future__ import annotations

from omnid.transport.decode import Diagnostics
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PAIRING, WHEELS, stage_name
from omnid.viewer import status_plots


def report(*statuses: DiagnosticStatus) -> Diagnostics:
    return Diagnostics(7, statuses)


def test_plots_latencies_of_the_stages_that_make_a_pose() -> None:
    entries = report(
        DiagnosticStatus(stage_name("odometry"), 0, "", {"work_p50_ms": "30.50", "work_p99_ms": "58", "rate_hz": "10"}),
        DiagnosticStatus(stage_name("watchdog"), 0, "", {"work_p50_ms": "1"}),
        DiagnosticStatus(ODOMETRY, 0, "tracking", {"capture_to_pose_p50_ms": "74", "capture_to_pose_p99_ms": "146"}),
        DiagnosticStatus(WHEELS, 0, "", {"tick_late_p50_ms": "nonsense", "tick_late_p99_ms": "inf"}),
    )
    assert dict(status_plots.latencies(entries)) == {
        ("odometry",): 30.5,
        ("odometry", "capture_to_pose p50"): 74.0,
        ("odometry", "capture_to_pose p99"): 146.0,
    }


def test_reads_state_and_landmarks() -> None:
    found = report(DiagnosticStatus(ODOMETRY, 1, "degraded", {"inliers": "31", "tracked": "60"}))
    assert status_plots.odometry_state(found) == "degraded" and status_plots.odometry_landmarks(found) == (31, 60)
    stale = report(
        DiagnosticStatus(ODOMETRY, 3, "no new pose", {"landmarks": "none"}),
        DiagnosticStatus("x", 0, "lost", {}),
    )
    assert status_plots.odometry_state(stale) is None and status_plots.odometry_landmarks(stale) is None


def test_logs_changes_only_in_bounded_memory_and_plain_text() -> None:
    changes = status_plots.StatusChanges(max_entries=2)
    calm, evil = (
        DiagnosticStatus(PAIRING, 0, "synchronised", {}),
        DiagnosticStatus(WHEELS, 2, "\x1b[2Jno", {}),
    )
    assert list(changes(report(calm, evil))) == [("pairing: synchronised", "INFO"), ("wheels: \\x1b[2Jno", "ERROR")]
    assert list(changes(report(calm, evil))) == []
    other = DiagnosticStatus(PAIRING, 1, "they drift apart", {})
    assert list(changes(report(other, evil))) == [("pairing: they drift apart", "WARN")]
    for number in range(50):
        list(changes(report(DiagnosticStatus(f"part {number}", 0, "here", {}))))
    assert len(changes._last) == 2
