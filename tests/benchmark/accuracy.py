"""Table of errors against the truth: `python -m tests.benchmark.accuracy FOLDER ... [-- OPTION OF omnid replay ...]`.

Each folder holds log.mcap, truth.txt and a rig.toml or camchain.yaml, as `python -m tests.simulation` writes them.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path

from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import Metrics, evaluate

HEAD = "| log | pairs | length | ATE rmse | end | heading, max | RPE | states |\n|---|---|---|---|---|---|---|---|"


def omnid(*arguments: str | Path) -> str:
    """Run the command and return its stdout; raise CalledProcessError if it fails."""
    command = [sys.executable, "-m", "omnid", *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def measure(folder: Path, options: list[str]) -> tuple[Metrics, str]:
    """Return the errors of one log and the shares of its tracking states."""
    with tempfile.TemporaryDirectory() as work:
        rig, estimate = Path(work) / "rig.toml", Path(work) / "estimate.txt"
        if (folder / "camchain.yaml").exists():
            omnid("calibrate", "import", folder / "camchain.yaml", "-o", rig)
        else:
            rig = folder / "rig.toml"
        printed = omnid("replay", folder / "log.mcap", "--rig", rig, "--tum", estimate, "--quiet", *options)
        states = next(line for line in printed.splitlines() if line.startswith("states"))
        return evaluate(read_tum(estimate), read_tum(folder / "truth.txt")), states.removeprefix("states").strip()


def row(folder: Path, options: list[str]) -> str:
    """Return one row of the table."""
    m, states = measure(folder, options)
    shown = [folder.name, str(m.pairs), f"{100 * m.length_error_ratio:+.3f} %", f"{1e3 * m.ate_rmse_m:.2f} mm",
             f"{1e3 * m.end_error_m:.2f} mm", f"{math.degrees(m.heading_max_rad):.3f}°",
             f"{1e3 * m.rpe_translation_rmse_m:.2f} mm", states]
    return f"| {' | '.join(shown)} |"


def main(arguments: list[str]) -> None:
    """Print the table, each row as soon as it is known."""
    split = arguments.index("--") if "--" in arguments else len(arguments)
    print(HEAD)
    for folder in arguments[:split]:
        print(row(Path(folder), arguments[split + 1 :]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
