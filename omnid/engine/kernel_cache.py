"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept."""

from __future__ import annotations

import logging
import shutil
from importlib import import_module

from omnid.core.compiled import DECLARED, cache_folder, code_folder, is_kept, kernel_modules, why_unusable
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError


def prepare_kernels() -> None:
    """Compile all functions, or read them from the disk; log compilations.

    Raises OmnidError where the code cannot be kept: a robot that compiles for a minute at each start is of no use.
    """
    modules = kernel_modules()
    if problem := why_unusable(cache_folder()):
        raise OmnidError(f"compiled functions cannot be kept in {cache_folder()}: {problem}: set OMNID_CACHE_DIR")
    # 1. New folders for the code of files that have none, without that of their earlier states.
    missing = [name for name in modules if not is_kept(name)]
    if missing:
        log(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes a minute")
    for name in missing:
        folder = code_folder(name)
        for found in folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*"):
            if found != folder or not is_kept(name):  # of an earlier state of the file, or others could write to it
                shutil.rmtree(found, ignore_errors=True)
        folder.mkdir(mode=0o700, exist_ok=True)  # Another program may just have made it.
    # 2. The code.
    try:
        for name in modules:
            import_module(name)
        for kernel in DECLARED:
            if kernel.function.__module__ in modules:
                kernel.compile(is_kept=True)
    except Exception as error:  # Pickle and LLVM raise any error for damaged files.
        for name in modules:
            shutil.rmtree(code_folder(name), ignore_errors=True)
        raise OmnidError(f"what was compiled earlier is damaged ({error}); it is deleted now: start again") from error
