"""The unit under a real systemd: guest/service.py in one guest, each of its tests told of here by itself."""

from __future__ import annotations

import ast
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

import pytest

from tests.hardware.machine import Guest, Result, run_in_vm

pytestmark = pytest.mark.vm
SCRIPT = Path(__file__).with_name("guest") / "service.py"
NAMES = [entry.name for entry in ast.parse(SCRIPT.read_text("utf-8")).body
         if isinstance(entry, ast.FunctionDef) and entry.name.startswith("test_")]


@pytest.fixture(scope="module")
def result() -> Result:
    report = "--junitxml=/mnt/job/results/report.xml"
    command = ["python3", "-m", "pytest", "--noconftest", "-p", "no:cacheprovider", "--durations=10", report]
    guest = Guest(systemd=True, serial=("null",), timeout_s=400)
    return run_in_vm([*command, "tests/hardware/guest/service.py"], guest)


@pytest.mark.parametrize("name", NAMES)
def test_in_the_guest(result: Result, name: str) -> None:
    cases = defaultdict(list)
    for case in ElementTree.fromstring(result.files["report.xml"]).iter("testcase"):
        cases[str(case.get("name")).partition("[")[0]].append(case)
    assert cases[name], f"it was not run:\n{result.output[-4000:]}"
    faults = [fault.text for case in cases[name] for fault in case if fault.tag in ("failure", "error", "skipped")]
    assert not faults, "\n".join(map(str, faults))
