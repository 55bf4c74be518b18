"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept.

numba replaces each file at once, so what a power cut or a full disk has left is compiled again.
"""

from __future__ import annotations

import logging
import mmap
import shutil
import time
from contextlib import suppress
from importlib import import_module

from omnid.core.compiled import DECLARED, cache_folder, code_folder, is_kept, kernel_modules, why_unusable
from omnid.engine.logging_setup import Report, log
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
    # 2. A new folder for each module whose code is not kept, in place of those of its earlier states.
    started_s, unkept = time.monotonic(), why_unusable(cache_folder())
    missing = [] if unkept else [name for name in modules if not is_kept(name)]
    for folder in map(code_folder, missing):
        shutil.rmtree(folder, ignore_errors=True)  # others could write to it
        for earlier in folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*"):
            shutil.rmtree(earlier, ignore_errors=True)
        with suppress(FileExistsError):  # of another program that has just begun
            folder.mkdir(mode=0o700)
    # 3. Read, or compile.
    if missing:
        report(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes a minute")
    try:
        _compile(modules, is_kept=not unkept)
    except Exception as error:  # what pickle and LLVM raise for damaged files
        for name in modules:
            shutil.rmtree(code_folder(name), ignore_errors=True)
        unkept = f"what was there is damaged ({type(error).__name__})"
        _compile(modules, is_kept=False)
    duration_s = time.monotonic() - started_s
    if unkept:
        report(
            logging.WARNING,
            f"the compiled functions are not kept in {cache_folder()}: {unkept}: this start took {duration_s:.0f} s "
            "longer; make that folder writable, or set OMNID_CACHE_DIR",
        )
    elif missing:
        report(logging.INFO, f"compiled in {duration_s:.0f} s; kept in {cache_folder()}")
    _prepared.update(modules)


def why_no_code() -> str:
    """Return why the system runs no code that is made at run time; empty if it does."""
    try:
        mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()
    except OSError:
        return "the system allows no code that is compiled at run time"
    return ""


def _compile(modules: list[str], *, is_kept: bool) -> None:
    """Compile the functions of modules that are not ready. is_kept: read their code from the disk, or else write it."""
    for name in modules:
        import_module(name)
    for kernel in tuple(DECLARED):
        if kernel.function.__module__ in modules:
            kernel.compile(is_kept=is_kept)
