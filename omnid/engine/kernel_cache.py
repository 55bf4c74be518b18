"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept.

They are compiled by a program of its own, whose memory ends with it. numba replaces each file at once, so what a
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

from omnid.core.compiled import DECLARED, cache_folder, code_folder, is_kept, kernel_modules, why_unusable
from omnid.engine.logging_setup import Report, log
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError

_prepared: set[str] = set()  # names of the modules whose functions are ready


def prepare_kernels(report: Report = log) -> None:
    """Compile all functions, or read them from the disk; report compilations, and code that is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    modules = kernel_modules()
    if _prepared.issuperset(modules):
        return
    # 1. Without executable memory numba would end the program.
    if problem := why_no_code():
        raise OmnidError(
            f"{problem}: remove MemoryDenyWriteExecute= from the service, or what else denies executable memory"
        )
    # 2. Compile what is not on the disk, and read it.
    started_s, reason = time.monotonic(), why_unusable(cache_folder())
    if not reason:
        reason = _compile_in_child([name for name in modules if not is_kept(name)], report)
    if not reason:
        try:
            compile_modules(modules, is_kept=True)
        except Exception as error:  # what pickle and LLVM raise for damaged files
            for name in modules:
                shutil.rmtree(code_folder(name), ignore_errors=True)
            reason = f"what was there is damaged ({type(error).__name__})"
    # 3. Or compile it for this run only.
    if reason:
        compile_modules(modules, is_kept=False)
        report(
            logging.WARNING,
            f"the compiled functions are not kept in {cache_folder()}: {reason}: this start took "
            f"{time.monotonic() - started_s:.0f} s longer; make that folder writable, or set OMNID_CACHE_DIR",
        )
    _prepared.update(modules)


def why_no_code() -> str:
    """Return why the system runs no code that is made at run time; empty if it does."""
    try:
        mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()
    except OSError:
        return "the system allows no code that is compiled at run time"
    return ""


def compile_modules(names: Sequence[str], *, is_kept: bool) -> None:
    """Compile the functions of modules that were not compiled before. is_kept: read them, or else write them."""
    for name in names:
        import_module(name)
    for kernel in tuple(DECLARED):
        if kernel.function.__module__ in names:
            kernel.compile(is_kept=is_kept)


def _compile_in_child(names: Sequence[str], report: Report) -> str:
    """Compile modules into their folders by a program of its own; return why that failed, or ""."""
    if not names:
        return ""
    # 1. A new folder for each, in place of those of its earlier states.
    started_s = time.monotonic()
    for folder in map(code_folder, names):
        if why_unusable(folder):  # others could write to it
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(FileExistsError):  # of another program that has just begun
                folder.mkdir(mode=0o700)
        for earlier in {*folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*")} - {folder}:
            shutil.rmtree(earlier, ignore_errors=True)
    # 2. The program.
    report(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes a minute")
    child = subprocess.run(python("-m", __name__, *names), env=python_environment(), capture_output=True)
    if child.returncode:
        for folder in map(code_folder, names):
            shutil.rmtree(folder, ignore_errors=True)
        return f"the program that compiles them ended with {child.returncode}"
    report(logging.INFO, f"compiled in {time.monotonic() - started_s:.0f} s; kept in {cache_folder()}")
    return ""


if __name__ == "__main__":  # a program that compiles modules and keeps their code
    compile_modules(sys.argv[1:], is_kept=True)
