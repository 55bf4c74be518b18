"""The script that runs all tests again and again: what it reads, and a run of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.stability import ROOT, outcomes, readme_command

REPORT = """<testsuites><testsuite><testcase classname="tests.a" name="good"/>
<testcase classname="tests.a" name="bad"><failure message="no">no</failure></testcase>
<testcase classname="tests.a" name="bad"><error message="at its end">no</error></testcase>
<testcase classname="tests.b" name="left"><skipped message="no"/></testcase></testsuite></testsuites>"""


def test_reads_the_command_and_the_outcomes() -> None:
    assert readme_command()[:2] == ["-m", "pytest"] and "-n" in readme_command()
    assert outcomes(REPORT) == (1, {"tests/a.py::bad": "no"}, 1)


def test_a_failure_is_reported_and_is_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "test_one.py").write_text("def test_good():\n    pass\n\ndef test_bad():\n    assert False\n")
    command = [
        sys.executable,
        "-m",
        "tests.stability",
        "--idle",
        "1",
        "--busy",
        "1",
        "--processes",
        "1",
        "--json",
        str(tmp_path / "rows.json"),
        "--",
        "-n",
        "0",
        "--rootdir",
        str(tmp_path),
        "--override-ini",
        "testpaths=",
        str(tmp_path / "test_one.py"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "2 runs, 2 with failures" in done.stdout, done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["busy"], row["passed"], row["failed"]) for row in rows] == [(0, 1, 1), (1, 1, 1)]
    assert [(name.endswith("::test_bad"), why) for name, why in rows[0]["failures"].items()] == [(True, "assert False")]
    assert "::test_bad: assert False" in done.stderr
