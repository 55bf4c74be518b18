"""Remedies."""

from __future__ import annotations

from omnid.transport import status_names
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import (
    CALIBRATION,
    PREFIX,
    SIMULATION,
    STAGE_PREFIX,
    SUMMARY,
    THREADS,
    WHEELS,
    camera_name,
)
from omnid.web.remedies import remedy_of


def test_every_part_that_can_warn_has_a_remedy() -> None:
    names = {value for value in vars(status_names).values() if isinstance(value, str) and value.startswith(PREFIX)}
    silent = {PREFIX, STAGE_PREFIX, SUMMARY, CALIBRATION, SIMULATION, THREADS}
    parts = {*names - silent, camera_name("lower"), camera_name("upper")}
    assert WHEELS in parts and len(parts) > 8
    assert [name for name in parts if not remedy_of(DiagnosticStatus(name, 1, "", {}))] == []
    assert remedy_of(DiagnosticStatus("omnid: wheels", 1, "", {"remedy": "send cmd/arm"})) == "send cmd/arm"
    assert remedy_of(DiagnosticStatus("omnid: stage pair", 0, "", {})) == ""
