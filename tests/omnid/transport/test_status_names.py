"""Names of status entries and their keys, and the parsing of values."""

from __future__ import annotations

import pytest

from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import Key, TimeKey


def test_names_of_entries() -> None:
    assert status_names.camera_name("lower") == "omnid: lower camera"
    assert status_names.stage_name("stereo") == "omnid: stage stereo"
    assert status_names.short_name(status_names.ODOMETRY) == "odometry"
    assert status_names.short_name("foreign") == "foreign"


def test_time_keys_round_trip() -> None:
    assert status_names.time_key("capture_to_pose", "p50") == "capture_to_pose_p50_ms"
    assert status_names.parsed_time_key("capture_to_pose_p50_ms") == TimeKey("capture_to_pose", "p50")
    assert status_names.parsed_time_key("rate_hz") is None and status_names.parsed_time_key("_ms") is None


@pytest.mark.parametrize(
    ("text", "number", "count"),
    [
        ("12", 12.0, 12),
        ("0", 0.0, 0),
        ("-3", -3.0, None),
        ("1.5", 1.5, None),
        ("nan", None, None),
        ("inf", None, None),
        ("", None, None),
        ("12 of 40", None, None),
    ],
)
def test_values_are_numbers_or_nothing(text: str, number: float | None, count: int | None) -> None:
    assert status_names.number(text) == number and status_names.count(text) == count


def test_every_part_that_can_warn_has_a_remedy() -> None:
    names = {value for value in vars(status_names).values() if isinstance(value, str) and value.startswith("omnid: ")}
    silent = {"omnid: ", *map("omnid: ".__add__, ("stage ", "summary", "calibration", "simulation", "threads"))}
    for name in (*names - silent, status_names.camera_name("lower")):
        assert status_names.with_remedy(DiagnosticStatus(name, 1, "", {})).values[Key.REMEDY], name
    own = DiagnosticStatus(status_names.WHEELS, 1, "", {Key.REMEDY: "omnid arm"})
    good = DiagnosticStatus(status_names.WHEELS, 0, "", {})
    assert status_names.with_remedy(own) is own and status_names.with_remedy(good) is good


def test_tracking_state_is_the_key_else_the_message() -> None:
    assert status_names.tracking_state("", {Key.STATE: "lost"}) is TrackingState.LOST
    assert status_names.tracking_state("degraded", {}) is TrackingState.DEGRADED
    assert status_names.tracking_state("no new pose", {}) is None
