"""The package: commands of the README, the sample, a command line that starts fast."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.logs.log_reader import LogReader
from omnid.version import __version__

ROOT = Path(__file__).parents[2]


def commands(text: str) -> list[str]:
    return re.findall(r"^(python3 -m venv .*)$", text, re.MULTILINE)


def test_the_checks_run_the_readmes_test_command() -> None:
    job, tests = commands((ROOT / "README.md").read_text())
    assert "omnid" in job and "pytest" in tests
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    assert all(part in lines for part in tests.rsplit(" && ", 1)), "first what it needs, then the tests"


def test_the_sample_is_small_and_whole() -> None:
    log = files("omnid.sample") / "log.mcap"
    assert isinstance(log, Path) and log.stat().st_size < 8e6
    reader = LogReader(log)
    assert sum(1 for _ in reader.frames()) == 194 and not reader.warnings
    assert "rig.toml" in reader.attachments()


def test_version_and_help_load_nothing_heavy() -> None:
    program = "import sys; from omnid.cli import main; main(['--version'])"
    check = f"import sys, atexit; atexit.register(lambda: print('cv2' in sys.modules)); {program}"
    out = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert out.splitlines() == [f"omnid {__version__}", "False"]


def tracked(*folders: str) -> set[str]:
    """Return the files of the repository, those of some folders or all."""
    listed = subprocess.run(["git", "ls-files", "-z", *folders], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no clone: what the packages should hold is not known")
    return {name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()}


def test_wheel_and_sdist_are_complete_and_the_wheel_runs_by_itself(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="needs hatchling, the build backend")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path)], cwd=ROOT, check=True, capture_output=True
    )
    (wheel,), (sdist,) = tmp_path.glob("*.whl"), tmp_path.glob("*.tar.gz")
    # 1. The wheel has each file of the three packages and the units of systemd; the sdist all of the repository.
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        packed.extractall(tmp_path / "installed")
    (metadata,) = (tmp_path / "installed").glob("*/METADATA")
    assert "License-Expression: Apache-2.0" in metadata.read_text()
    assert not [name for name in names if name.startswith("tests/")]
    assert tracked("omnid", "drivers", "calib") - names == set()
    assert {f"omnid/service/{name}" for name in tracked("systemd")} - names == set()
    with tarfile.open(sdist) as source:
        assert tracked() - {name.partition("/")[2] for name in source.getnames()} == set()
    # 2. Away from the repository, with nothing but the wheel, the sample is read. Replays are those of the same files.
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "installed"), "PYTHONSAFEPATH": "1"}

    def python(*words: str) -> str:
        command = [sys.executable, *words]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout

    found = python("-c", "import omnid; print(omnid.__file__)")
    assert found.startswith(str(tmp_path / "installed"))
    imported = "import importlib, omnid.runs.replay, omnid.runs.live, omnid.web, omnid.report, omnid.doctor"
    python("-c", imported)
    assert "194" in python("-m", "omnid", "log", "info", str(tmp_path / "installed/omnid/sample/log.mcap"))
