"""Protocols by their names: those of omnid, and those that other packages add by entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from drivers.errors import DriverError
from drivers.motors.protocols import protocol_registry
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.protocols.protocol_registry import GROUP, motor_protocol


def test_a_name_leads_to_a_protocol_of_omnid_or_of_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = EntryPoints(
        [
            EntryPoint("another", "drivers.motors.protocols.line_protocol:LineProtocol", GROUP),
            EntryPoint("missing", "no_such_package:Protocol", GROUP),
        ]
    )
    monkeypatch.setattr(protocol_registry, "entry_points", lambda group: installed.select(group=group))
    assert motor_protocol("line") is LineProtocol and motor_protocol("another") is LineProtocol
    with pytest.raises(DriverError, match="expected one of line, roboteq, odrive_ascii, vesc, another, missing;"):
        motor_protocol("waveshare_json")
    with pytest.raises(DriverError, match="its package cannot be loaded"):
        motor_protocol("missing")
