"""Report of the daemon's refinement of the rig: `python -m tests.benchmark.rig_refinement LOG:RIG ...`.

LOG: a folder with log.mcap; RIG: a rig.toml, or `perturbed` for LOG/rig.toml with the errors of self_calibration.
"""

from __future__ import annotations

import sys
from pathlib import Path

from calib.rig_file import read_rig
from omnid.config import RigConfig
from tests.benchmark.self_calibration import perturbed
from tests.omnid.refinement.test_rig_refinement import refined


def main() -> None:
    """Print a line for each log."""
    for words in sys.argv[1:]:
        folder, _, name = words.partition(":")
        rig = perturbed(read_rig(Path(folder) / "rig.toml")) if name == "perturbed" else read_rig(Path(name))
        refinement, _ = refined(Path(folder), rig, RigConfig())
        status, found = refinement.status(), refinement.found
        figures = "" if found is None else (
            f": error {found.error_px:.3f} -> {found.refined_error_px:.3f} px, lengths {100 * found.lengths:+.3f} % "
            f"(sigma {100 * found.lengths_sigma:.3f})")
        print(f"{words}: level {status.level}, {status.message}{figures}", flush=True)


if __name__ == "__main__":
    main()
