"""Coverage of omnid/core and omnid/controller by tests: `python -m tests.benchmark.coverage_figures [TESTS ...]`.

TESTS: files or folders, tests/omnid/core and tests/omnid/controller without any. Statements and branches, also those of
the controller's process. Functions that numba compiles (`*_kernels.py`) are left out: no line of them is seen to run.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Final

from tests.benchmark.results import ROOT, Column, ResultTable

TESTS: Final = ("tests/omnid/core", "tests/omnid/controller")
FOLDER: Final = ROOT / "build" / "coverage"
KERNELS: Final = "*_kernels.py"


def covered(tests: list[str]) -> dict[str, dict[str, int]]:
    """Run the tests; return the summary of each file."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    words = [sys.executable, "-m", "coverage"]
    done = subprocess.run([*words, "run", "-m", "pytest", "-q", *tests], cwd=ROOT)
    if done.returncode:
        raise SystemExit(f"pytest ended with code {done.returncode}: no figure of tests that fail")
    subprocess.run([*words, "combine", "-q"], cwd=ROOT, check=True)
    report = FOLDER / "report.json"
    subprocess.run([*words, "json", "-q", f"--omit={KERNELS}", "-o", str(report)], cwd=ROOT, check=True)
    return {path: of["summary"] for path, of in json.loads(report.read_text())["files"].items()}


def main() -> None:
    """Record a row for each room, and one for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", default=list(TESTS), metavar="TESTS")
    files = covered(parser.parse_args().tests)
    rooms: dict[str, list[dict[str, int]]] = defaultdict(list)
    for path, summary in sorted(files.items()):
        rooms[Path(path).parent.as_posix()].append(summary)
    columns = (
        Column("room"),
        Column("statements"),
        Column("of them run", "%", 1),
        Column("branches"),
        Column("of them taken", "%", 1),
    )
    table = ResultTable(
        "coverage",
        "faults",
        "Coverage of core and controller by their tests",
        columns,
        ("Compiled functions (*_kernels.py) are left out.",),
    )
    for room, summaries in [*rooms.items(), ("all", list(files.values()))]:
        statements, run, branches, taken = (
            sum(one[key] for one in summaries)
            for key in ("num_statements", "covered_lines", "num_branches", "covered_branches")
        )
        table.add(room, statements, 100 * run / max(1, statements), branches, 100 * taken / max(1, branches))


if __name__ == "__main__":
    main()
