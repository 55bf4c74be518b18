"""A recorded run as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.recordings import run_series
from omnid.recordings.run_series import read_run_series
from tests.omnid.recordings.test_comparison import pose, run_of
from tests.omnid.report.recorded_logs import corrupt_chunks

COUNT = 20


def circle(off_from: int = COUNT, off_m: float = 0.0, off_deg: float = 0.0) -> list[tuple[int, np.ndarray]]:
    """Return all poses; those from one index on are displaced."""
    return [(i, pose(i, off_m, off_deg) if i >= off_from else pose(i)) for i in range(COUNT)]


@pytest.fixture
def first(tmp_path: Path) -> Path:
    return run_of(tmp_path / "a.mcap", circle())


def test_refuses_recordings_that_are_too_long(tmp_path: Path, first: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_series, "MAX_ROWS", COUNT - 1)
    with pytest.raises(run_series.OmnidError, match="cut it into shorter ones"):
        read_run_series(first)


def test_corrupt_chunks_of_a_recording_with_an_index_are_a_warning(first: Path) -> None:
    assert read_run_series(first).warnings == ()
    corrupt_chunks(first)
    run = read_run_series(first)
    assert run.warnings == (f"{first}: 2 corrupt chunks or records are left out",)
    assert 0 < run.poses.stamps_ns.size < COUNT
