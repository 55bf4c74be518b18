"""Metrics for Prometheus, read by the parser of its own client: values, labels, and what does not belong into them."""

from __future__ import annotations

import time

from prometheus_client import parser

from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.tracking_state import TrackingState
from omnid.transport.codec import DiagnosticStatus, PoseAttachment
from omnid.transport.decode import Diagnostics
from omnid.web.metrics import metrics
from tests.omnid.transport.bus_fixtures import odometry


def samples(state: RobotState) -> dict[tuple[str, ...], float]:
    """Return the values by their name and the values of their labels, in the order of these."""
    text = metrics(state, {"no token": 2}, {"dropped": 3, "stops": 0, "arms": 1}).decode()
    found = [sample for family in parser.text_string_to_metric_families(text) for sample in family.samples]
    by_name = {
        (sample.name, *(sample.labels[label] for label in sorted(sample.labels))): sample.value for sample in found
    }
    assert len(by_name) == len(found)
    return by_name


def test_numbers_of_the_status_with_labels_that_cannot_break_out() -> None:
    state = RobotState()
    state.alive = True
    values = {"rate_hz": "29.5", "mode": "640x480", "bad": "nan", 'a"} 1\nomnid_up 0': "7", "back\\slash": "1e3"}
    state.add_diagnostics(Diagnostics(1, (DiagnosticStatus("omnid: odometry", 1, "x", values),)))
    found = samples(state)
    assert found["omnid_up",] == 1 and found["omnid_status_level", "odometry"] == 1
    numbers = {labels[1]: value for labels, value in found.items() if labels[0] == "omnid_status_value"}
    assert len(numbers) == 3 and numbers["rate_hz"] == 29.5 and numbers["back\\slash"] == 1000
    assert found["omnid_web_refused_total", "no token"] == 2 and found["omnid_web_dropped_total",] == 3
    assert not any("0.99" in labels for labels in found), "no latency is known yet"
    state.alive = None
    assert samples(state)["omnid_up",] == 0


def test_the_state_of_the_newest_pose_is_one_and_the_others_nought() -> None:
    state, now_ns = RobotState(), time.time_ns()
    attachment = PoseAttachment(1, "tracking", 0, 50, 60, now_ns).to_bytes()
    state.process(ReceivedMessage(now_ns, "odom", odometry(1), attachment, time.monotonic_ns()))
    found = samples(state)
    assert {name: found["omnid_tracking_state", name] for name in TrackingState} == {
        name: name == "tracking" for name in TrackingState
    }
    assert found["omnid_poses_total",] == 1
