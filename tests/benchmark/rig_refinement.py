"""Report of the daemon's refinement of the rig: `python -m tests.benchmark.rig_refinement LOG:RIG ...`.

LOG: a folder with log.mcap; RIG: a rig.toml, or `perturbed` for LOG/rig.toml with the errors of self_calibration.
"""

from __future__ import annotations

import sys
from pathlib import Path

from calib.rig_file import read_rig
from omnid.config import RigConfig
from tests.benchmark.results import Column, ResultTable
from tests.benchmark.self_calibration import perturbed
from tests.omnid.refinement.test_rig_refinement import refined


def main() -> None:
    """Print a row for each log."""
    columns = (
        Column("log"),
        Column("rig"),
        Column("error", "px", 3),
        Column("error refined", "px", 3),
        Column("lengths", "%", 3),
        Column("sigma of lengths", "%", 3),
        Column("level"),
        Column("status"),
    )
    table = ResultTable("rig_refinement", "calibration", "Refinement of the rig in the daemon", columns)
    for words in sys.argv[1:]:
        folder, _, name = words.partition(":")
        rig = perturbed(read_rig(Path(folder) / "rig.toml")) if name == "perturbed" else read_rig(Path(name))
        refinement, _ = refined(Path(folder), rig, RigConfig())
        report, found = refinement.report(), refinement.found
        figures = (
            (None,) * 4
            if found is None
            else (found.error_px, found.refined_error_px, 100 * found.lengths, 100 * found.lengths_sigma)
        )
        message = report.message or "the rig fits the landmarks"
        table.add(Path(folder).name, Path(name).name, *figures, report.level, message, folder=Path(folder))


if __name__ == "__main__":
    main()
