"""Code in the working directory does not run: neither by a command nor by a program that a command starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.omnid.commands.test_batch import short_log

ROOT = Path(__file__).parents[2]
# Modules of the program, of its packages and of Python that a file in the working directory may pretend to be.
FOREIGN = ("omnid", "drivers", "numpy", "cv2", "zenoh", "json", "pickle", "html", "rerun_cli", "sitecustomize")

# Words of a command of each module of omnid.commands, and what it says: it has run far enough to load its packages.
COMMANDS: dict[str, str] = {
    "run --lower /dev/null --upper /dev/zero --rig none.toml": "there is no such rig",
    "replay none.mcap": "none.mcap",
    "eval none.txt none.txt": "No such file or directory",
    "calibrate rig none.mcap --corners 6x7 --square-mm 30 -o r.toml": "none.mcap",
    "calibrate drive none.mcap --rig none.toml -o r.toml": "there is no such rig",
    "calibrate import none.yaml -o r.toml": "none.yaml",
    "cameras --snapshot views --log none.mcap": "none.mcap",
    "goto 1 2 --connect nonsense": "bus.connect has 'nonsense'",
    "web --listen 127.0.0.1:99999": "expected HOST:PORT",
    "batch none.mcap --out out": "none.mcap",
    "report none.mcap -o report.html": "none.mcap",
    "map show none.omap": "No such file or directory",
}
IN_ONE_PROCESS = """
import contextlib, io, json, sys
from omnid.cli import main
for words in json.loads(sys.argv[1]):
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    print(json.dumps([code, said.getvalue()]), flush=True)
"""


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Path]:
    """A working directory with modules that write a file when they run; none is there afterwards."""
    folder, marker = tmp_path / "hostile", tmp_path / "marker"
    folder.mkdir()
    for name in FOREIGN:
        (folder / f"{name}.py").write_text(f"open({str(marker)!r}, 'a').write({name!r} + ' ')\nraise SystemExit(99)\n")
    yield folder
    assert not marker.exists(), f"ran: {marker.read_text()}"


def run(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run Python in the folder without its modules, as the installed program does."""
    return subprocess.run(
        [sys.executable, "-P", *map(str, words)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )


def test_no_command_runs_it(hostile: Path) -> None:
    calls = [words.split() for words in COMMANDS]
    done = run(hostile, "-c", IN_ONE_PROCESS, json.dumps(calls))
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(calls), (answers[-1:], done.stderr)
    wrong = {
        words: answer
        for (words, expected), answer in zip(COMMANDS.items(), answers, strict=True)
        if expected not in answer[1] or "Traceback" in answer[1]
    }
    assert not wrong


def test_the_controller_does_not_run_it(hostile: Path, tmp_path: Path) -> None:
    log, recordings = short_log(tmp_path / "log.mcap"), tmp_path / "recordings"
    recordings.mkdir()
    done = run(hostile, "-m", "omnid", "replay", log, "--motor", "simulated", "--record", recordings / "a.mcap")
    assert done.returncode == 0, done.stderr
