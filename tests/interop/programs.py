"""Programs of other projects, found or installed for the tests; tests of missing programs are skipped."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
TIMEOUT_S = 300.0
NO_ANALYTICS = {"CI": "1"}  # with it Rerun sends no usage statistics
NPM = ("package.json", "read_log.mjs")


def run(words: Sequence[object], folder: Path) -> str:
    """Return the stdout of a program; raise AssertionError with its stderr where it fails."""
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env=os.environ | NO_ANALYTICS,
    )
    assert done.returncode == 0, f"{words}: {done.stderr[-2000:]}"
    return done.stdout


def lines(words: Sequence[object], folder: Path) -> list[Any]:
    """Return the stdout of a program, parsed as JSON line by line."""
    return [json.loads(line) for line in run(words, folder).splitlines()]


def program(name: str, package: str) -> Path:
    """Return the path of a program on the PATH."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(
            f"{name} is not on the PATH: python3 -m venv VENV && VENV/bin/pip install {package}, then "
            "PATH=VENV/bin:$PATH"
        )
    return Path(found)


def npm_reader() -> Path:
    """Return read_log.mjs beside the packages of package.json, which are installed at the first use.

    In $OMNID_INTEROP_CACHE, else in ~/.cache/omnid-interop.
    """
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("node or npm is not on the PATH: apt install nodejs npm (node 18 or newer)")
    folder = Path(os.environ.get("OMNID_INTEROP_CACHE") or Path.home() / ".cache" / "omnid-interop")
    wanted = (HERE / "package.json").read_bytes()
    fresh = not (folder / "node_modules").is_dir() or (folder / "package.json").read_bytes() != wanted
    folder.mkdir(parents=True, exist_ok=True)
    for name in NPM:
        shutil.copyfile(HERE / name, folder / name)
    if fresh:
        _install(folder)
    return folder / "read_log.mjs"


def _install(folder: Path) -> None:
    """Install the packages without running their scripts and without a lock file."""
    words = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    try:
        run(words, folder)
    except (AssertionError, subprocess.TimeoutExpired) as error:
        shutil.rmtree(folder / "node_modules", ignore_errors=True)
        pytest.skip(f"the packages of {HERE / 'package.json'} cannot be installed: {error}")
