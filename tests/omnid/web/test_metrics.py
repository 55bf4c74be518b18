"""Metrics for Prometheus: values, labels, and what does not belong into them."""

from __future__ import annotations

import re
import time

from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.tracking_state import TrackingState
from omnid.transport.decode import Diagnostics
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.web.browsers import Browsers
from omnid.web.metrics import metrics
from tests.omnid.transport.bus_fixtures import odometry

LINE = re.compile(r'[a-z_]+(\{[a-z]+="(\\.|[^"\\\n])*"(,[a-z]+="(\\.|[^"\\\n])*")*\})? -?[0-9.e+-]+')


def test_numbers_of_the_status_with_labels_that_cannot_break_out() -> None:
    state = RobotState()
    state.alive = True
    values = {"rate_hz": "29.5", "mode": "640x480", "bad": "nan", 'a"} 1\nomnid_up 0': "7", "back\\slash": "1e3"}
    state.add_diagnostics(Diagnostics(1, (DiagnosticStatus("omnid: odometry", 1, "x", values),)))
    counts = {"dropped": 3, "stops": 0, "arms": 1}
    lines = metrics(state, Browsers([]), {"no token": 2}, counts).splitlines()
    samples = [line for line in lines if not line.startswith("#")]
    assert all(LINE.fullmatch(line) for line in samples), samples
    assert 'omnid_status_value{part="odometry",key="rate_hz"} 29.5' in samples and "omnid_up 1" in samples
    assert 'omnid_status_value{part="odometry",key="back\\\\slash"} 1000' in samples
    state.alive = None
    assert "omnid_up 0" in metrics(state, Browsers([]), {}, {}).splitlines()
    assert 'omnid_web_refused_total{reason="no token"} 2' in samples and "omnid_web_dropped_total 3" in samples
    assert sum(line.startswith("omnid_status_value") for line in samples) == 3
    assert not any("quantile" in line for line in samples), "no latency is known yet"
    names = [line.split()[2] for line in lines if line.startswith("# TYPE")]
    assert len(names) == len(set(names)) and {re.split(r"[{ ]", line)[0] for line in samples} <= set(names)


def test_the_state_of_the_newest_pose_is_one_and_the_others_nought() -> None:
    state, now_ns = RobotState(), time.time_ns()
    attachment = PoseAttachment(1, "tracking", 0, 50, 60, now_ns).to_bytes()
    state.process(ReceivedMessage(now_ns, "odom", odometry(1), attachment))
    lines = metrics(state, Browsers([]), {}, {}).splitlines()
    assert [line for line in lines if line.startswith("omnid_tracking_state")] == [
        f'omnid_tracking_state{{state="{name}"}} {int(name == "tracking")}' for name in TrackingState
    ]
