"""The progress of a drive, as commands show it until its end."""

from __future__ import annotations

import contextlib
import time

import pytest

from omnid.client import NavigationReport, Robot
from omnid.errors import OmnidError
from omnid.monitor import navigation
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import NAVIGATION, Key
from tests.omnid.transport.bus_fixtures import free_endpoint

COMMAND_NS = 7


def test_a_robot_that_is_not_heard_any_more_is_not_said_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing on a robot watches the program that has asked for a drive: it goes on without the network."""
    monkeypatch.setattr(navigation, "SILENCE_S", 0.5)
    endpoint = free_endpoint()
    shown: list[NavigationReport] = []
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        values = {Key.STATE: "driving", Key.COMMAND_NS: str(COMMAND_NS)}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))
        with Robot("omnid", endpoint, timeout_s=30.0) as robot, pytest.raises(OmnidError, match="silent") as caught:
            navigation.follow(robot, COMMAND_NS, shown.append)
    assert [report.state for report in shown] == ["driving"]
    assert "it drives on (`omnid stop`" in str(caught.value)
