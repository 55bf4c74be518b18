"""The screen of a live calibration shows where boards were."""

from __future__ import annotations

from omnid.calibration.coverage import CameraCoverage
from omnid.calibration.coverage_screen import COLUMNS, ROWS, disc
from tests.omnid.calibration.test_coverage import RIM, at


def test_the_disc_shows_where_boards_were() -> None:
    coverage = CameraCoverage(RIM)
    for _ in range(12):
        coverage.add(at(3, 60))
    rows = disc(coverage, at(9, 60))
    assert len(rows) == ROWS and all(len(row) == COLUMNS for row in rows)
    middle = rows[ROWS // 2]
    assert middle.index("@") < COLUMNS // 2 < middle.index("9") and rows[0].strip(" .") == ""
