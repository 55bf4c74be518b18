"""The tests of one room, collected once in a process that never runs one itself: each mutant gets a fork of it.

A fork puts the changed functions into the modules that are imported already, runs the tests that called them in
an unchanged run, and ends at the first that fails. First come those that promise most in a second: of the file's own
test module, fast, and such that noticed earlier mutants of the file. A
mutant outside functions (a constant, a default of a class) needs its module imported again: all tests of its file run
in a new Python. The changed file also lies in the folder of the copy meanwhile, for tests that start programs.
"""

from __future__ import annotations

import gc
import json
import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, Final

import pytest
from _pytest.runner import runtestprotocol

from omnid.engine import kernel_cache
from tests.faults.mutants import NOTICED, SURVIVED, TIMEOUT, UNFINISHED, Mutant, Results

POLL_S: Final = 0.02
UNFINISHED_CODE: Final = 77  # of a fork; pytest itself uses 0 to 5
LONGER: Final = 10.0  # Time on the clock in which the tests of a mutant end, by their own time: they may sleep.
OWN_SHARE: Final = 0.5  # of mutants that a test of the file's own test module notices, before anything is known
OTHER_SHARE: Final = 0.02
KNOWN: Final = 4.0  # mutants that the shares above count for


@dataclass(slots=True)
class Record:
    """Number of mutants of a file on which a test was run, and of those that it noticed."""

    ran: int = 0
    noticed: int = 0

    def share(self, own: bool) -> float:
        """Return the share of mutants that the test may notice. own: it is in the file's own test module."""
        return (self.noticed + KNOWN * (OWN_SHARE if own else OTHER_SHARE)) / (self.ran + KNOWN)


@dataclass(frozen=True, slots=True)
class Reached:
    """Result of an unchanged run."""

    tests: dict[str, float]  # names of the tests that passed, with their durations [s]
    calls: dict[str, list[tuple[int, int, list[str]]]]  # of a file: first and last line of a function, its tests
    starting: list[str] = field(default_factory=list)  # tests that start programs

    def calls_all(self, path: str, functions: Iterable[CodeType]) -> bool:
        """True if tests call all these functions: those that only the import calls have done their work by then."""
        called = {first for first, *_ in self.calls.get(path, [])}
        return all(function.co_firstlineno in called for function in functions)

    def of(self, mutant: Mutant, *, in_function: bool = True, records: Mapping[str, Record] | None = None) -> list[str]:
        """Return the tests for a mutant: first those that may notice most in a second.

        A line in no function that a test has called in this process gets the tests of its file, and if there are none,
        all: they may reach it in another process. in_function: False where more than a function changes, although one
        (a lambda in a table) may be in the same line. records: of the tests on earlier mutants of the file.
        """
        functions = self.calls.get(mutant.path, [])
        around = [(last - first, names) for first, last, names in functions if first <= mutant.line <= last]
        every = sorted({name for *_, names in functions for name in names})
        chosen = (min(around)[1] if around and in_function else every) or list(self.tests)
        own, starting = f"test_{Path(mutant.path).name}::", set(self.starting) - set(chosen)
        if not (around and in_function):  # a constant may be tested without a call
            chosen = [*chosen, *(name for name in self.tests if own in name)]

        def rank(name: str) -> tuple[bool, float, str]:
            share = (records or {}).get(name, Record()).share(own in name)
            return name in starting, self.tests[name] / share, name

        return sorted({*chosen, *starting}, key=rank)


class MutantRunner:
    """A plugin of pytest that tries mutants in the place of running the collected tests."""

    def __init__(
        self, copy: Path, mutants: Sequence[Mutant], limit_s: float, report: Callable[[Mutant, str], None]
    ) -> None:
        """copy: folder of the repository that may be changed; limit_s: for the tests of one mutant."""
        self._copy, self._mutants, self._limit_s, self._report = copy, mutants, limit_s, report
        self._sources = {mutant.path: (copy / mutant.path).read_text("utf-8") for mutant in mutants}

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run the tests unchanged, then try each mutant."""
        items = {item.nodeid: item for item in session.items}
        reached = self._unchanged(items)
        records: dict[str, dict[str, Record]] = defaultdict(lambda: defaultdict(Record))
        for mutant in self._mutants:
            path = self._copy / mutant.path
            path.write_text(mutant.apply(self._sources[mutant.path]), "utf-8")
            try:
                changed = changed_functions(self._sources[mutant.path], path)
                if not reached.calls_all(mutant.path, changed):
                    changed = {}
                found = reached.of(mutant, in_function=bool(changed), records=records[mutant.path])
                names = [name for name in found if name in items]
                # A test that has begun within the limit is given the time to end.
                times_s = [reached.tests[name] for name in names]
                patience_s = 10.0 + 5.0 * (min(self._limit_s, sum(times_s)) + max(times_s))
                outcome = (
                    self._in_a_fork([items[name] for name in names], changed, patience_s, records[mutant.path])
                    if changed
                    else (self._in_a_new_python(names, patience_s))
                )
            finally:
                path.write_text(self._sources[mutant.path], "utf-8")
            self._report(mutant, outcome)
        return True

    def _in_a_fork(
        self,
        items: Sequence[pytest.Item],
        changed: dict[CodeType, CodeType],
        patience_s: float,
        records: dict[str, Record],
    ) -> str:
        """Return the outcome of the tests with changed functions, and add to the records of those that ran."""
        begun = self._copy / "begun-tests.txt"
        begun.write_text("")
        pid = os.fork()
        if pid == 0:
            _quiet()
            replace_functions(changed)
            os._exit(_tried(items, self._limit_s, begun))
        outcome = _outcome(_waited(pid, patience_s))
        ran = begun.read_text("utf-8").splitlines()
        for name in ran:
            records[name].ran += 1
        if ran and outcome not in (SURVIVED, UNFINISHED):
            records[ran[-1]].noticed += 1
        return outcome

    def _in_a_new_python(self, names: Sequence[str], patience_s: float) -> str:
        """Return the outcome of the tests where the file is imported again."""
        listed = self._copy / "mutant-tests.txt"
        listed.write_text("\n".join(names))
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"@{listed}"]
        process = subprocess.Popen(
            command, cwd=self._copy, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        return _outcome(_waited(process.pid, patience_s + 30.0))

    def _unchanged(self, items: dict[str, pytest.Item]) -> Reached:
        """Run all tests in a fork, and return what they reached; tests that fail are left out."""
        listed = self._copy / "reached.json"
        pid = os.fork()
        if pid == 0:
            _quiet()
            listed.write_text(json.dumps(_reached(items, {str(self._copy / path): path for path in self._sources})))
            os._exit(0)
        _waited(pid, 3600.0)
        return Reached(*json.loads(listed.read_text()))


def changed_functions(source: str, path: Path) -> dict[CodeType, CodeType]:
    """Return the code of functions before and after the change of a file; empty where more than functions changed."""
    before, after = (compile(text, str(path), "exec", dont_inherit=True) for text in (source, path.read_text("utf-8")))
    return _changed(before, after) or {}


def _changed(before: CodeType, after: CodeType) -> dict[CodeType, CodeType] | None:
    """Return the changed functions within a module or class; None where its own statements changed."""
    inner = [[const for const in code.co_consts if isinstance(const, CodeType)] for code in (before, after)]
    own = [
        (code.co_code, code.co_names, [const for const in code.co_consts if not isinstance(const, CodeType)])
        for code in (before, after)
    ]
    if repr(own[0]) != repr(own[1]) or len(inner[0]) != len(inner[1]):
        return None
    found: dict[CodeType, CodeType] = {}
    for old, new in zip(*inner, strict=True):
        if old == new:
            continue
        is_function = bool(old.co_flags & 0x2)  # CO_NEWLOCALS: the body of a class has none
        within = {old: new} if is_function else _changed(old, new)
        if within is None:
            return None
        found |= within
    return found


def replace_functions(changed: dict[CodeType, CodeType]) -> None:
    """Give all functions with one of these codes the changed one."""
    for thing in gc.get_objects():
        # Not isinstance, which asks the object itself for its class: a weak proxy raises where its object is gone.
        if type(thing) is FunctionType and thing.__code__ in changed:
            thing.__code__ = changed[thing.__code__]


def _reached(
    items: dict[str, pytest.Item], files: dict[str, str]
) -> tuple[dict[str, float], dict[str, Any], list[str]]:
    """Run all tests; return the durations of those that pass, which called each function of the files, and which
    started programs."""
    durations: dict[str, float] = {}
    called: dict[CodeType, set[str]] = defaultdict(set)
    current = [""]
    starting = set[str]()

    def trace(frame: FrameType, event: str, argument: object) -> None:
        if frame.f_code.co_filename in files:
            called[frame.f_code].add(current[0])

    # A hook cannot be removed: this process ends with the tests.
    sys.addaudithook(lambda event, _: starting.add(current[0]) if event == "subprocess.Popen" else None)
    threading.settrace(trace)
    sys.settrace(trace)
    for name, item in items.items():
        current[0], begin_s = name, time.monotonic()
        if all(report.passed or report.skipped for report in _reports(item)):
            durations[name] = time.monotonic() - begin_s
    sys.settrace(None)
    calls: dict[str, list[Any]] = {path: [] for path in files.values()}
    for code, names in called.items():
        last = max(line for *_, line in code.co_lines() if line)
        calls[files[code.co_filename]].append((code.co_firstlineno, last, sorted(names & durations.keys())))
    return durations, calls, sorted(starting & durations.keys())


def _tried(items: Iterable[pytest.Item], limit_s: float, begun: Path) -> int:
    """Run the tests until one fails; return 0 if all pass, UNFINISHED_CODE where the time is over before the last.

    limit_s: of this process's own time, so that a busy machine changes nothing. begun: a file to which the name of each
    test is added before it runs.
    """
    until_s, own_until_s = time.monotonic() + LONGER * limit_s, time.process_time() + limit_s
    for item in items:
        if time.process_time() >= own_until_s or time.monotonic() >= until_s:
            return UNFINISHED_CODE
        with begun.open("a", encoding="utf-8") as file:
            file.write(f"{item.nodeid}\n")
        if not all(report.passed or report.skipped for report in _reports(item)):
            return 1
    return 0


def _reports(item: pytest.Item) -> Iterable[pytest.TestReport]:
    """Run a test with its fixtures."""
    return runtestprotocol(item, nextitem=None, log=False)


def _quiet() -> None:
    """Make this fork the head of its own group, whose output is lost."""
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(null, number)


def _waited(pid: int, patience_s: float) -> int | None:
    """Return the exit code of a child, which with all its children is ended after a time; None: it was ended.

    What it waits for a processor does not count. The time that it computes is limited to a third, because it is longer
    on a busy machine by a little only.
    """
    most_s = math.ceil(patience_s / 3)
    with suppress(ProcessLookupError):
        resource.prlimit(pid, resource.RLIMIT_CPU, (most_s, most_s + 1))
    left_s, last_s = patience_s, time.monotonic()
    status: int | None = None
    while status is None and left_s > 0:
        found, code = os.waitpid(pid, os.WNOHANG)
        if found:
            status = os.waitstatus_to_exitcode(code)
        else:
            time.sleep(POLL_S)
            now_s = time.monotonic()
            left_s, last_s = left_s - (0.0 if _computes(pid) else now_s - last_s), now_s
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    if status is None:
        os.waitpid(pid, 0)
    return None if status == -signal.SIGXCPU else status


def _computes(pid: int) -> bool:
    """True if a process computes or waits for a processor: neither sleeps nor has ended."""
    return Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] == "R"


def _outcome(code: int | None) -> str:
    if code is None:
        return TIMEOUT
    return {0: SURVIVED, UNFINISHED_CODE: UNFINISHED}.get(code, NOTICED)


def main() -> int:
    """Try the mutants that standard input names, in the copy of the repository that is the working directory."""
    asked = json.load(sys.stdin)
    results, names = Results(Path(asked["results"])), {Mutant(*row): name for name, row in asked["mutants"].items()}
    # None of these folders calls a compiled function: not to prepare them all saves minutes in a new folder.
    kernel_cache._state["ready"] = True
    runner = MutantRunner(
        Path.cwd(), list(names), asked["limit_s"], lambda mutant, outcome: results.add(names[mutant], outcome)
    )
    code = pytest.main(["-p", "no:cacheprovider", "-p", "no:terminal", *asked["tests"]], plugins=[runner])
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
