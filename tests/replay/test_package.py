"""The package: commands of the README, the sample, a command line that starts fast."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from drivers.logs.log_reader import LogReader
from omnid.version import __version__
from tests.replay.command import Command

ROOT = Path(__file__).parents[2]


def commands(text: str) -> list[str]:
    return re.findall(r"^(python3 -m venv .*)$", text, re.MULTILINE)


def test_the_checks_run_the_readmes_test_command() -> None:
    job, tests = commands((ROOT / "README.md").read_text())
    assert "omnid" in job and "pytest" in tests
    assert commands((ROOT / ".ci" / "run").read_text()) == [tests]


def test_the_sample_is_small_and_whole() -> None:
    log = files("omnid.sample") / "log.mcap"
    assert isinstance(log, Path) and log.stat().st_size < 8e6
    reader = LogReader(log)
    assert sum(1 for _ in reader.frames()) == 198 and not reader.warnings
    assert "rig.toml" in reader.attachments()


def test_version(omnid: Command) -> None:
    assert omnid("--version") == (0, f"omnid {__version__}\n", "")


def test_version_and_help_load_nothing_heavy() -> None:
    program = "import sys; from omnid.cli import main; main(['--version'])"
    check = f"import sys, atexit; atexit.register(lambda: print('cv2' in sys.modules)); {program}"
    out = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert out.splitlines() == [f"omnid {__version__}", "False"]


def test_help_of_every_command(omnid: Command) -> None:
    listed = omnid("--help").out
    for command in ("replay", "demo", "eval", "calibrate", "config"):
        assert command in listed
        assert f"omnid {command}" in omnid(command, "--help").out
