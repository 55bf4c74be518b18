"""The camera driver on real kernel devices: guest/cameras.py in one guest, each of its tests reported here."""

from __future__ import annotations

import pytest

from tests.hardware.guest_report import names_in, passed, run_tests
from tests.hardware.machine import Guest, Result

pytestmark = pytest.mark.vm
SCRIPT = "cameras.py"


@pytest.fixture(scope="module")
def result() -> Result:
    return run_tests(SCRIPT, Guest(timeout_s=400))


@pytest.mark.parametrize("name", names_in(SCRIPT))
def test_in_the_guest(result: Result, name: str) -> None:
    passed(result, name)
