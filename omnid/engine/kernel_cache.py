"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept.

They are compiled by programs of their own, whose memory ends with them. These fill a folder under another name, which
gets its own when it is complete: a power cut, a full disk or two programs at once cannot leave a part of it.
"""

from __future__ import annotations

import logging
import mmap
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Final

from omnid.core.compiled import (
    DECLARED,
    KERNEL_FILES,
    PACKAGE,
    cache_folder,
    folder_of_state,
    kept_folder,
    why_unusable,
)
from omnid.engine.logging_setup import Report, log
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError

KEPT_STATES: Final = 20  # other states whose code stays, 3 MB each: of other installations, and of earlier versions
MOST_CHILDREN: Final = 2  # 480 MB with the program that waits, of the 768 that the service may have
TIMEOUT_S: Final = 600.0  # as long as the service may take to start; half a minute on a laptop

_prepared: set[str] = set()  # names of the modules whose functions are ready


def prepare_kernels(report: Report = log) -> None:
    """Compile all functions, or read them from the disk; report compilations, and code that is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    names = _kernel_modules()
    if _prepared.issuperset(names):
        return
    # 1. Without executable memory numba would end the program.
    if problem := why_no_code():
        raise OmnidError(
            f"{problem}: remove MemoryDenyWriteExecute= from the service, or what else denies executable memory"
        )
    # 2. Compile what is not on the disk, and read it.
    started_s, reason = time.monotonic(), why_unusable(cache_folder())
    if not reason and kept_folder() is None:
        reason = _compile_in_children(names, report)
    if not reason:
        try:
            _compile_modules(names, kept_folder())
        except Exception as error:  # what pickle and LLVM raise for damaged files
            shutil.rmtree(folder_of_state(), ignore_errors=True)
            reason = f"what was there is damaged ({type(error).__name__})"
    # 3. Or compile it for this run only.
    if reason:
        _compile_modules(names, None)
        report(
            logging.WARNING,
            f"the compiled functions are not kept in {cache_folder()}: {reason}: this start took "
            f"{time.monotonic() - started_s:.0f} s longer; make that folder writable, or set OMNID_CACHE_DIR",
        )
    _prepared.update(names)


def read_kept_kernels() -> None:
    """Read the functions that are on the disk: also in a thread of its own, before `prepare_kernels` does the rest."""
    if (folder := kept_folder()) is not None:
        _compile_modules(_kernel_modules(), folder)


def why_no_code() -> str:
    """Return why the system runs no code that is made at run time; empty if it does."""
    try:
        mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()
    except OSError:
        return "the system allows no code that is compiled at run time"
    return ""


def _kernel_modules() -> list[str]:
    """Return the names of all modules with compiled functions, the largest files first."""
    paths = sorted(PACKAGE.rglob(KERNEL_FILES), key=lambda path: path.stat().st_size, reverse=True)
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]


def _compile_modules(names: Sequence[str], folder: Path | None) -> None:
    """Compile the functions of modules, or read them from a folder."""
    for name in names:
        import_module(name)
    for kernel in tuple(DECLARED):
        if kernel.function.__module__ in names:
            kernel.compile(folder)


def _compile_in_children(names: Sequence[str], report: Report) -> str:
    """Compile all functions into the folder of this state by programs of their own; return why that failed, or ""."""
    shutil.rmtree(folder_of_state(), ignore_errors=True)  # one that others could write to
    report(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes half a minute")
    started_s, count = time.monotonic(), min(MOST_CHILDREN, len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory(prefix="making-", dir=cache_folder()) as parent:
        making = Path(parent, "kernels")
        making.mkdir(mode=0o700)
        with ExitStack() as running:
            children = []
            for number in range(count):
                command = python("-m", __name__, str(making), *names[number::count])
                quiet = subprocess.DEVNULL
                child = subprocess.Popen(command, env=python_environment(), stdin=quiet, stdout=quiet, stderr=quiet)
                running.callback(child.wait)
                running.callback(child.kill)
                children.append(child)
            try:
                codes = [child.wait(started_s + TIMEOUT_S - time.monotonic()) for child in children]
            except subprocess.TimeoutExpired:
                return f"they were not compiled within {TIMEOUT_S:.0f} s"
        if any(codes):
            return f"the programs that compile them ended with {codes}"
        with suppress(OSError):  # Another program has been faster: its folder is not empty.
            making.rename(folder_of_state())
    report(logging.INFO, f"compiled in {time.monotonic() - started_s:.0f} s; kept in {cache_folder()}")
    # Remove the oldest folders of other states.
    with suppress(OSError):
        others = [path for path in cache_folder().glob("kernels-*") if path != folder_of_state()]
        for path in sorted(others, key=lambda path: path.stat().st_mtime)[:-KEPT_STATES]:
            shutil.rmtree(path, ignore_errors=True)
    return "" if kept_folder() else "it was not written"


if __name__ == "__main__":  # a program that fills a folder with the functions of modules
    _compile_modules(sys.argv[2:], Path(sys.argv[1]))
    os.sync()
