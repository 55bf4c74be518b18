"""No fault ends the daemon or moves the wheels without a command; `python -m tests.bench.faults` lists the results."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.faults.trials import TRIALS, Setting


@pytest.mark.slow
@pytest.mark.parametrize("fault", TRIALS)
def test_fault(tmp_path: Path, course: Path, fault: str) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    assert TRIALS[fault](Setting(course, folder)).process
