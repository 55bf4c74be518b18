"""Checks of access to devices."""

from __future__ import annotations

import os
from pathlib import Path

from omnid.doctor.devices import holders, memberships
from tests.omnid.doctor.test_doctor import opened_elsewhere

ROOT = Path(__file__).parents[3]


def test_names_the_process_that_has_a_device_open() -> None:
    with open(os.devnull), opened_elsewhere(ROOT / "pyproject.toml"):
        (holder,) = holders(ROOT / "pyproject.toml")
    assert holder.startswith("python") and "pid" in holder
    assert holders(ROOT / "pyproject.toml") == []


def test_checks_the_groups() -> None:
    assert memberships(()).level == "ok"
    if os.geteuid():
        missing = memberships(("no-such-group",))
        assert missing.level == "warning" and "no-such-group" in missing.advice
