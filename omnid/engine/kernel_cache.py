"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept.

They are compiled by programs of their own, whose memory ends with them. numba replaces each file at once, so what a
power cut or a full disk has left is compiled again.
"""

from __future__ import annotations

import logging
import mmap
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
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
CHILDREN: Final = 2  # 480 MB with the program that waits, of the 768 that the service may have

_prepared: set[str] = set()  # names of the modules whose functions are ready


def prepare_kernels(report: Report = log) -> None:
    """Compile all functions, or read them from the disk; report compilations, and code that is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    if all(name in _prepared for name in _modules()):
        return
    # 1. Without executable memory numba would end the program.
    if problem := why_no_code():
        raise OmnidError(
            f"{problem}: remove MemoryDenyWriteExecute= from the service, or what else denies executable memory"
        )
    # 2. Compile what is not on the disk, and read it.
    started_s, reason = time.monotonic(), why_unusable(cache_folder())
    if not reason and kept_folder() is None:
        reason = _compile_in_children(report)
    if not reason:
        try:
            compile_modules(_modules(), kept_folder())
        except Exception as error:  # what pickle and LLVM raise for damaged files
            shutil.rmtree(folder_of_state(), ignore_errors=True)
            reason = f"what was there is damaged ({type(error).__name__})"
    # 3. Or compile it for this run only.
    if reason:
        compile_modules(_modules(), None)
        report(
            logging.WARNING,
            f"the compiled functions are not kept in {cache_folder()}: {reason}: this start took "
            f"{time.monotonic() - started_s:.0f} s longer; make that folder writable, or set OMNID_CACHE_DIR",
        )
    _prepared.update(_modules())


def why_no_code() -> str:
    """Return why the system runs no code that is made at run time; empty if it does."""
    try:
        mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()
    except OSError:
        return "the system allows no code that is compiled at run time"
    return ""


def _modules() -> list[str]:
    """Return the names of all modules with compiled functions, the largest files first."""
    paths = sorted(PACKAGE.rglob(KERNEL_FILES), key=lambda path: path.stat().st_size, reverse=True)
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]


def compile_modules(names: Sequence[str], folder: Path | None) -> None:
    """Compile the functions of modules that were not compiled before, or read them from a folder, which keeps them."""
    for name in names:
        import_module(name)
    for kernel in tuple(DECLARED):
        if kernel.function.__module__ in names:
            kernel.compile(folder)


def _compile_in_children(report: Report) -> str:
    """Compile all functions into the folder of this state by programs of their own; return why that failed, or ""."""
    folder, names, started_s = folder_of_state(), _modules(), time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)  # one that others could write to
    # Remove the oldest folders of other states.
    others = sorted(cache_folder().glob("kernels-*"), key=lambda path: path.stat().st_mtime)
    for path in others[:-KEPT_STATES]:
        shutil.rmtree(path, ignore_errors=True)
    with suppress(FileExistsError):  # of another program that has just begun
        folder.mkdir(mode=0o700)
    report(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes half a minute")
    children = [
        subprocess.Popen(
            python("-m", __name__, str(folder), *names[number::CHILDREN]),
            env=python_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for number in range(CHILDREN)
    ]
    try:
        codes = [child.wait() for child in children]
    finally:
        for child in children:
            child.kill()
    if any(codes):
        shutil.rmtree(folder, ignore_errors=True)
        return f"the programs that compile them ended with {codes}"
    report(logging.INFO, f"compiled in {time.monotonic() - started_s:.0f} s; kept in {cache_folder()}")
    return ""


if __name__ == "__main__":  # a program that fills a folder with the functions of modules
    compile_modules(sys.argv[2:], Path(sys.argv[1]))
