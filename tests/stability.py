"""The README's test command again and again: `python -m tests.stability` runs it on the idle machine and on a busy one.

Measures a table, one row for each run, and returns 1 where a test failed. What follows `--` goes to pytest:
`python -m tests.stability --idle 2 -- tests/drivers`.
"""

from __future__ import annotations

import argparse
import re
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.benchmark.results import Column, ResultTable, commit
from tests.busy import busy_processes

ROOT: Final = Path(__file__).parents[1]
COMMAND: Final = re.compile(r"-e '\.\[test\]' && \S+/python (-m pytest .*)$", re.MULTILINE)
COLUMNS: Final = (
    Column("commit"),
    Column("run"),
    Column("busy processes"),
    Column("passed"),
    Column("failed"),
    Column("skipped"),
    Column("time", "s", 0),
    Column("processor time", "s", 0),
    Column("failures"),
)


@dataclass(frozen=True, slots=True)
class Run:
    """The outcome of one run of all tests."""

    number: int
    busy: int  # processes that kept the processors busy meanwhile
    passed: int
    failed: int
    skipped: int
    took_s: float
    processor_s: float
    exit_code: int  # of pytest; -9 after the timeout
    failures: dict[str, str]  # names of tests and the first lines of what failed

    def cells(self) -> tuple[str | float, ...]:
        """Return the row of the table, without the commit."""
        what = ", ".join(f"`{name}`" for name in self.failures) or ("" if self.is_good else f"exit {self.exit_code}")
        counts = (self.number, self.busy, self.passed, self.failed, self.skipped)
        return (*counts, self.took_s, self.processor_s, what)

    @property
    def is_good(self) -> bool:
        """True if tests were run and none failed."""
        return self.exit_code == 0 and self.failed == 0 and self.passed > 0


def readme_command() -> list[str]:
    """Return the arguments of Python in the README's test command."""
    found = COMMAND.search((ROOT / "README.md").read_text("utf-8"))
    assert found, "README.md has no test command"
    return shlex.split(found[1])


def one_run(number: int, busy: int, words: Sequence[str], timeout_s: float, *, background: bool) -> Run:
    """Run the tests once beside busy processes; background: with SIGINT ignored, as a script's `&` starts them."""
    with tempfile.TemporaryDirectory() as name, busy_processes(busy):
        report = Path(name) / "report.xml"
        command = [sys.executable, *readme_command(), "-q", f"--junitxml={report}", *words]
        begin_s, before_s = time.monotonic(), _children_s()
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.DEVNULL, preexec_fn=_ignore_interrupts if background else None
        )
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
            code = -9
        took_s, processor_s = time.monotonic() - begin_s, _children_s() - before_s
        passed, failures, skipped = outcomes(report.read_text("utf-8")) if report.exists() else (0, {}, 0)
    return Run(number, busy, passed, len(failures), skipped, took_s, processor_s, code, failures)


def outcomes(report: str) -> tuple[int, dict[str, str], int]:
    """Return from a JUnit report how many tests passed, those that failed and why, and how many were skipped."""
    passed, skipped = 0, 0
    failures: dict[str, str] = {}  # an error at the end of a test is a case of its own
    for case in ElementTree.fromstring(report).iter("testcase"):
        kinds = {child.tag: child.get("message", "") for child in case}
        if kinds.keys() & {"failure", "error"}:
            name = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
            failures.setdefault(name, kinds.get("failure", kinds.get("error", "")).partition("\n")[0])
        elif "skipped" in kinds:
            skipped += 1
        else:
            passed += 1
    return passed, failures, skipped


def _children_s() -> float:
    """Return the processor time of the processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def main() -> int:
    """Run the tests, print the table; return 1 where a run was not good."""
    parser = argparse.ArgumentParser(prog="python -m tests.stability", description=__doc__)
    parser.add_argument("--idle", type=int, default=10, metavar="N", help="runs on the idle machine; default: 10")
    parser.add_argument("--busy", type=int, default=3, metavar="M", help="runs beside busy processes; default: 3")
    parser.add_argument("--processes", type=int, default=4, metavar="K", help="busy processes; default: 4")
    parser.add_argument("--background", action="store_true", help="with SIGINT ignored, as a script's `&` starts them")
    parser.add_argument("--timeout-s", type=float, default=3600.0, help="of one run; default: an hour")
    parser.add_argument("words", nargs="*", metavar="WORD", help="arguments of pytest, after --")
    args = parser.parse_args()
    runs: list[Run] = []
    table = ResultTable("test_runs", "faults", "Whole runs of the tests", COLUMNS)
    for number, busy in enumerate([0] * args.idle + [args.processes] * args.busy, 1):
        runs.append(one_run(number, busy, args.words, args.timeout_s, background=args.background))
        table.add(commit(), *runs[-1].cells())
        for name, reason in runs[-1].failures.items():
            print(f"{name}: {reason}", file=sys.stderr, flush=True)
    bad = sum(not run.is_good for run in runs)
    print(f"\n{len(runs)} runs, {bad} with failures", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
