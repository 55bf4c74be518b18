"""What is drawn of the reports of a robot's parts, without rerun."""

from __future__ import annotations

from omnid.transport.codec import DiagnosticStatus
from omnid.transport.decode import Diagnostics
from omnid.viewer import status_plots as reports


def report(*statuses: DiagnosticStatus) -> Diagnostics:
    return Diagnostics(7, statuses)


def test_the_latencies_are_those_of_what_makes_a_pose() -> None:
    said = report(
        DiagnosticStatus(
            "omnid: stage odometry", 0, "", {"work_p50_ms": "30.50", "work_p99_ms": "58", "rate_hz": "10"}
        ),
        DiagnosticStatus("omnid: stage watchdog", 0, "", {"work_p50_ms": "1"}),
        DiagnosticStatus(
            "omnid: odometry", 0, "tracking", {"capture_to_pose_p50_ms": "74", "capture_to_pose_p99_ms": "146"}
        ),
        DiagnosticStatus("omnid: wheels", 0, "", {"tick_late_p50_ms": "nonsense", "tick_late_p99_ms": "inf"}),
    )
    assert dict(reports.latencies(said)) == {
        ("odometry",): 30.5, ("odometry", "capture_to_pose p50"): 74.0, ("odometry", "capture_to_pose p99"): 146.0}


def test_state_and_landmarks_are_read_where_they_are_told() -> None:
    found = report(DiagnosticStatus("omnid: odometry", 1, "degraded", {"landmarks": "31 of 60"}))
    assert reports.state(found) == "degraded" and reports.landmarks(found) == (31, 60)
    stale = report(
        DiagnosticStatus("omnid: odometry", 3, "no pose for 2.0 s", {"landmarks": "none"}),
        DiagnosticStatus("x", 0, "lost", {}),
    )
    assert reports.state(stale) is None and reports.landmarks(stale) is None


def test_only_what_has_changed_is_told_in_bounded_memory_and_plain_letters() -> None:
    changes = reports.StatusChanges(most_parts=2)
    calm, evil = (
        DiagnosticStatus("omnid: pairing", 0, "in step", {}),
        DiagnosticStatus("omnid: wheels", 2, "\x1b[2Jno", {}),
    )
    assert list(changes(report(calm, evil))) == [("pairing: in step", "INFO"), ("wheels: ?[2Jno", "ERROR")]
    assert list(changes(report(calm, evil))) == []
    other = DiagnosticStatus("omnid: pairing", 1, "they drift apart", {})
    assert list(changes(report(other, evil))) == [("pairing: they drift apart", "WARN")]
    for number in range(50):
        list(changes(report(DiagnosticStatus(f"part {number}", 0, "here", {}))))
    assert len(changes._said) == 2
