"""Compilation of missing functions: by one program at a time, on all cores, while others wait for it.

A program that finds functions missing takes a lock, which ends with the program, however it ends, and starts helpers:
processes of their own, because numba compiles under a lock of the process. They write to the disk (kernel_store.py),
from which all programs read. Nothing depends on the lock: without it, two programs would compile the same twice."""

from __future__ import annotations

import fcntl
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from omnid.engine import kernel_store as store
from omnid.engine.logging_setup import Report
from omnid.engine.process import python, python_environment

MAX_HELPERS: Final = 2  # each takes up to 280 MB, of the 768 that the service may have
# Without a new folder for this time, another program or a helper counts as hung. A file takes seconds; on a slow and
# busy machine a minute.
PATIENCE_S: Final = 300.0
PROGRESS_S: Final = 3.0  # Least time between two lines of progress.
_POLL_S: Final = 0.05
_LOCK: Final = "compiling.lock"


def compile_missing(folders: Mapping[str, Path], report: Report) -> None:
    """Fill the folders of files (names of their modules), or wait until another program has.

    A file that fails to compile leaves its folder missing. Raises OSError where nothing can be written.
    """
    with _lock_file() as lock:
        # 1. One program at a time. It continues without the lock where the holder makes no progress.
        if not _is_locked(lock):
            report(logging.INFO, "another program compiles the functions: waiting for it")
            if not _wait(lambda: _is_locked(lock), folders, report):
                report(logging.WARNING, f"it has compiled nothing for {PATIENCE_S:.0f} s: going on without it")
        # 2. What the holder has not made.
        missing = {name: folder for name, folder in folders.items() if not store.is_intact(folder)}
        if not missing:
            return
        started_s, count = time.monotonic(), _functions(missing)
        report(logging.INFO, f"compiling {count} functions, once; takes 10 s or more")
        _run_helpers(missing, lock, report)
        if all(store.is_intact(folder) for folder in missing.values()):
            report(logging.INFO, f"compiled in {time.monotonic() - started_s:.0f} s; kept in {store.cache_folder()}")
        store.remove_others(set(folders.values()))


@contextmanager
def _lock_file() -> Iterator[int]:
    """Open the file on which the lock is taken."""
    lock = os.open(store.cache_folder() / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        yield lock
    finally:
        os.close(lock)


def _is_locked(lock: int) -> bool:
    """True if this program has the lock now, or the file system knows no locks."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _run_helpers(folders: Mapping[str, Path], lock: int, report: Report) -> None:
    """Fill the folders by helpers, which keep the lock should this program end before them."""
    # The largest file first: the last one is short, and the helpers end at the same time.
    names = sorted(folders, key=lambda name: store.kernel_files()[name].stat().st_size, reverse=True)
    with tempfile.TemporaryDirectory(prefix=store.UNFINISHED, dir=store.cache_folder()) as claims:
        command = python("-m", __name__, claims, *(f"{name}={folders[name]}" for name in names))
        helpers: list[subprocess.Popen[bytes]] = []
        try:
            for _ in range(min(len(os.sched_getaffinity(0)), MAX_HELPERS, len(folders))):
                helpers.append(
                    subprocess.Popen(
                        command,
                        env=python_environment(),
                        pass_fds=(lock,),
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                    )
                )
            _wait(lambda: all(helper.poll() is not None for helper in helpers), folders, report)
        finally:
            for helper in helpers:
                helper.kill()
                helper.wait()


def _wait(condition: Callable[[], bool], folders: Mapping[str, Path], report: Report) -> bool:
    """Wait for a condition and report progress; False if no folder came for PATIENCE_S."""
    total, filled = _functions(folders), -1
    progress_s = reported_s = time.monotonic()
    while not condition():
        now_s, before = time.monotonic(), filled
        filled = _functions(name for name, folder in folders.items() if folder.exists())
        if filled != before:
            progress_s = now_s
        if now_s - progress_s > PATIENCE_S:
            return False
        if filled != before and now_s - reported_s > PROGRESS_S:
            reported_s = now_s
            report(logging.INFO, f"{filled} of {total} functions compiled")
        time.sleep(_POLL_S)
    return True


def _functions(names: Mapping[str, Path] | Iterator[str]) -> int:
    return sum(len(store.functions_of(name)) for name in names)


def main(claims: Path, *tasks: str) -> None:
    """Be a helper: compile the files NAME=FOLDER that no other helper has claimed by a folder in `claims`."""
    for task in tasks:
        name, _, folder = task.partition("=")
        try:
            (claims / name).mkdir()
        except FileExistsError:
            continue
        store.compile_and_publish(name, Path(folder))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
