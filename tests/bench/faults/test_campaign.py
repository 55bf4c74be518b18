"""The parts of the campaign in small; `python -m tests.bench.faults` runs them all in full."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.faults import hostile_commands, stop_times
from tests.bench.faults.hostile_files import FORMATS, attack, short_run


def test_mutated_files_give_a_result_or_one_line(tmp_path: Path) -> None:
    memory_mb, found = attack(",".join(FORMATS), short_run(tmp_path), 60, seed=7)
    assert found == [] and 0 < memory_mb < 400


@pytest.mark.hazard("H09")
@pytest.mark.slow
def test_mutated_commands_never_move_the_wheels(tmp_path: Path, course: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path / "results"))
    assert hostile_commands.run(course, tmp_path, 2000, 7) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", stop_times.CAUSES)
def test_the_wheels_come_to_rest(tmp_path: Path, course: Path, name: str) -> None:
    times = stop_times.stop_times(course, tmp_path / "stops", name, 2, seed=7)
    assert len(times) == 2
