"""The script that runs all tests again and again: what it reads, and a run of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmark.results import FOLDER_VARIABLE, read_result
from tests.stability import ROOT, outcomes, readme_command

REPORT = """<testsuites><testsuite><testcase classname="tests.a" name="good"/>
<testcase classname="tests.a" name="bad"><failure message="no">no</failure></testcase>
<testcase classname="tests.a" name="bad"><error message="at its end">no</error></testcase>
<testcase classname="tests.b" name="left"><skipped message="no"/></testcase></testsuite></testsuites>"""


def test_reads_the_command_and_the_outcomes() -> None:
    assert readme_command()[:2] == ["-m", "pytest"] and "-n" in readme_command()
    assert outcomes(REPORT) == (1, {"tests/a.py::bad": "no"}, 1)


def test_a_failure_is_reported_and_is_the_exit_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        "--",
        "-n",
        "0",
        "--rootdir",
        str(tmp_path),
        "--override-ini",
        "testpaths=",
        str(tmp_path / "test_one.py"),
    ]
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "2 runs, 2 with failures" in done.stdout, done.stderr
    rows = read_result(tmp_path / "test_runs.json")["rows"]
    assert [row[1:5] for row in rows] == [[1, 0, 1, 1], [2, 1, 1, 1]]
    assert rows[0][-1].endswith("test_one.py::test_bad`")
    assert "::test_bad: assert False" in done.stderr
