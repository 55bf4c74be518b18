"""Programs of a batch: `omnid` in a process of its own, in a folder that also gets its messages."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Final

from omnid.engine.python_program import python, python_environment

LOG_FILE: Final = "messages.txt"
_END_S: Final = 10.0  # A program is killed if it has not ended this long after SIGTERM.
_MAX_MESSAGES: Final = 64 * 1024  # bytes of a program's messages that are kept
# One thread for each program: as many programs run as there are cores.
_ENVIRONMENT: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}

_RUNNING: set[subprocess.Popen[str]] = set()  # programs that run now: at most one for each worker


class BatchInterrupted(Exception):  # noqa: N818 - no error of the job
    """The batch ends before the program of a job has ended."""


def run_omnid(words: list[str], folder: Path, timeout_s: float) -> tuple[int | None, str]:
    """Run omnid in a folder; return its exit code, None after the time, and its output.

    Raise BatchInterrupted after `end_programs`: then there is no result.
    """
    with (folder / LOG_FILE).open("ab") as messages:
        process = subprocess.Popen(
            python("-m", "omnid", *words),
            cwd=folder,
            env=python_environment(**_ENVIRONMENT),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=messages,
            text=True,
        )
        _RUNNING.add(process)
        try:
            text, _ = process.communicate(timeout=timeout_s)
            if process not in _RUNNING:
                raise BatchInterrupted
            return process.returncode, text
        except subprocess.TimeoutExpired:
            return None, ""
        finally:
            _end(process)
            _RUNNING.discard(process)


def _end(process: subprocess.Popen[str]) -> None:
    """End a running program: by SIGTERM first, so that it leaves no wheel turning and no file half written."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def end_programs() -> None:
    """End the programs of the jobs that run now, so that an interrupted batch leaves none; their results are lost."""
    while _RUNNING:
        _RUNNING.pop().terminate()


def messages(folder: Path) -> list[str]:
    """Return the lines of the messages in a folder, the last ones where they are many."""
    return (folder / LOG_FILE).read_bytes()[-_MAX_MESSAGES:].decode("utf-8", "replace").strip().splitlines()
