"""The runner of mutants: which code is replaced, and a small campaign on a copy of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.faults.mutant_runner import Reached, Record, _computes, _waited, changed_functions, replace_functions
from tests.faults.mutants import Mutant, Results, mutants_of

ROOT = Path(__file__).parents[2]
SOURCE = """LIMIT = 3


class Gate:
    def is_open(self, value):
        return value < LIMIT


def never(value):
    return value > LIMIT


def elsewhere(value):
    return value == LIMIT
"""
TESTS = """import subprocess
import sys

from small import gate


def test_the_gate():
    assert gate.Gate().is_open(2) and not gate.Gate().is_open(3)


def test_a_program():
    subprocess.run([sys.executable, "-c", "from small import gate; assert gate.elsewhere(3)"], check=True)
"""


def test_only_functions_that_changed_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "gate.py"
    namespace: dict[str, object] = {}
    exec(compile(SOURCE, str(path), "exec", dont_inherit=True), namespace)
    path.write_text(SOURCE.replace("value < LIMIT", "value <= LIMIT"))
    changed = changed_functions(SOURCE, path)
    assert [code.co_name for code in changed] == ["is_open"]
    replace_functions(changed)
    assert namespace["Gate"]().is_open(3)  # type: ignore[operator]
    path.write_text(SOURCE.replace("LIMIT = 3", "LIMIT = 4"))
    assert changed_functions(SOURCE, path) == {}, "the module is to be imported again"


def test_the_tests_of_the_innermost_function_run_the_fast_ones_first() -> None:
    calls = {"a.py": [(1, 20, ["other"]), (5, 8, ["slow", "fast"])]}
    reached = Reached({"slow": 2.0, "fast": 0.1, "other": 0.2}, calls)
    assert reached.of(Mutant("a.py", 6, 0, 1, "")) == ["fast", "slow"]
    assert reached.of(Mutant("a.py", 12, 0, 1, "")) == ["other"]
    assert reached.of(Mutant("a.py", 40, 0, 1, "")) == ["fast", "other", "slow"], "outside functions"
    assert reached.of(Mutant("b.py", 1, 0, 1, "")) == ["fast", "other", "slow"], "never called in this process"
    assert reached.of(Mutant("a.py", 6, 0, 1, ""), in_function=False) == ["fast", "other", "slow"], "beside a lambda"


def test_a_function_that_only_the_import_calls_needs_a_new_python() -> None:
    reached = Reached({"one": 0.1}, {"a.py": [(5, 8, ["one"])]})
    code = compile("\n\n\n\ndef called():\n    pass\n\n\ndef imported():\n    pass\n", "a.py", "exec")
    called, imported = (const for const in code.co_consts if hasattr(const, "co_firstlineno"))
    assert reached.calls_all("a.py", [called]) and not reached.calls_all("a.py", [called, imported])


def test_tests_that_start_programs_run_after_those_that_call_the_function() -> None:
    names = {"calls": 3.0, "starts": 1.0, "starts slowly": 2.0, "another": 0.1}
    reached = Reached(names, {"a.py": [(1, 9, ["calls"])]}, ["starts slowly", "starts"])
    assert reached.of(Mutant("a.py", 2, 0, 1, "")) == ["calls", "starts", "starts slowly"]


def test_the_tests_of_the_own_module_run_first() -> None:
    names = {"tests/test_b.py::fast": 0.1, "tests/test_a.py::slow": 2.0, "tests/test_a.py::quick": 1.0}
    reached = Reached(names, {"a.py": [(1, 9, list(names))]})
    assert reached.of(Mutant("a.py", 2, 0, 1, "")) == [
        "tests/test_a.py::quick",
        "tests/test_a.py::slow",
        "tests/test_b.py::fast",
    ]


def test_a_constant_gets_the_tests_of_the_own_module_that_call_nothing() -> None:
    names = {"tests/test_a.py::reads": 0.1, "tests/test_a.py::calls": 0.2, "tests/test_b.py::other": 0.1}
    reached = Reached(names, {"a.py": [(5, 9, ["tests/test_a.py::calls"])]})
    assert reached.of(Mutant("a.py", 2, 0, 1, "")) == ["tests/test_a.py::reads", "tests/test_a.py::calls"]
    assert reached.of(Mutant("a.py", 6, 0, 1, "")) == ["tests/test_a.py::calls"]


def test_tests_that_noticed_earlier_mutants_of_the_file_run_first() -> None:
    names = {"tests/test_a.py::quick": 0.1, "tests/test_b.py::slow": 1.0, "tests/test_b.py::fast": 0.01}
    reached = Reached(names, {"a.py": [(1, 9, list(names))]})
    mutant = Mutant("a.py", 2, 0, 1, "")
    records = {"tests/test_b.py::slow": Record(ran=9, noticed=8)}
    records |= {name: Record(ran=200) for name in names if name not in records}
    assert reached.of(mutant)[0] == "tests/test_a.py::quick"
    assert reached.of(mutant, records=records)[0] == "tests/test_b.py::slow"


def test_a_child_that_sleeps_for_too_long_is_ended_and_one_that_computes_is_known() -> None:
    assert _computes(os.getpid())
    sleeping = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"], start_new_session=True)
    assert _waited(sleeping.pid, 0.3) is None
    ending = subprocess.Popen([sys.executable, "-c", "import sys; sys.exit(3)"], start_new_session=True)
    assert _waited(ending.pid, 20.0) == 3


def test_a_campaign_finds_what_no_test_notices_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    copy, results = tmp_path / "copy", tmp_path / "results.jsonl"
    (copy / "small").mkdir(parents=True)
    (copy / "small" / "__init__.py").write_text("")
    (copy / "small" / "gate.py").write_text(SOURCE)
    (copy / "test_gate.py").write_text(TESTS)
    mutants = {mutant.apply(SOURCE): mutant for mutant in mutants_of("small/gate.py", SOURCE)}
    asked = {"mutants": mutants, "tests": ["test_gate.py"], "limit_s": 20.0, "results": str(results)}
    code = "import sys; sys.path.insert(0, sys.argv[1]); from tests.faults.mutant_runner import main; sys.exit(main())"
    subprocess.run(
        [sys.executable, "-c", code, str(ROOT)],
        cwd=copy,
        input=json.dumps(asked),
        text=True,
        check=True,
        timeout=120,
        env={"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    outcomes = Results(results).outcomes
    assert outcomes == {after: "survived" if "value >= LIMIT" in after else "noticed" for after in mutants}
    assert (copy / "small" / "gate.py").read_text() == SOURCE, "left as it was"
