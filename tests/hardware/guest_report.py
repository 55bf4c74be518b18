"""Runs pytest in a guest and reports the result of each test to the host."""

from __future__ import annotations

import ast
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from tests.hardware.machine import Guest, Result, run_in_vm

FOLDER = "tests/hardware/guest"


def names_in(script: str) -> list[str]:
    """Return the tests of a script of the guest, in their order."""
    tree = ast.parse((Path(__file__).with_name("guest") / script).read_text("utf-8"))
    return [entry.name for entry in tree.body if isinstance(entry, ast.FunctionDef) and entry.name.startswith("test_")]


def run_tests(script: str, guest: Guest, *options: str) -> Result:
    """Run a script with pytest in the guest."""
    report = "--junitxml=/mnt/job/results/report.xml"
    command = ["python3", "-m", "pytest", "--noconftest", "-p", "no:cacheprovider", "--durations=10", report, *options]
    return run_in_vm([*command, f"{FOLDER}/{script}"], guest)


def passed(result: Result, name: str) -> None:
    """Raise AssertionError, with the output of the guest, unless the test ran there and passed with all parameters."""
    cases = [
        case
        for case in ElementTree.fromstring(result.files["report.xml"]).iter("testcase")
        if str(case.get("name")).partition("[")[0] == name
    ]
    assert cases, f"it was not run:\n{result.output[-4000:]}"
    faults = [fault.text for case in cases for fault in case if fault.tag in ("failure", "error", "skipped")]
    assert not faults, "\n".join(map(str, faults))
