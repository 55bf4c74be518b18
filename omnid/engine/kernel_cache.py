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
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

from omnid.core.compiled import (
    KERNEL_FILES,
    PACKAGE,
    cache_folder,
    declared,
    folder_of_state,
    kept_folder,
    why_unusable,
)
from omnid.engine.logging_setup import Report, log_unlimited
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError

KEPT_STATES: Final = 20  # other states whose code stays, 3 MB each: of other installations, and of earlier versions
MOST_CHILDREN: Final = 2  # 480 MB with the program that waits, of the 768 that the service may have
TIMEOUT_S: Final = 600.0  # as long as the service may take to start; half a minute on a laptop

_state = {"ready": False}


def prepare_kernels(report: Report = log_unlimited) -> None:
    """Compile all functions, or read them from the disk; report compilations, and code that is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    if _state["ready"]:
        return
    # 1. Executable memory, without which numba would end the program.
    try:
        _make_executable_memory()
    except OSError as error:
        raise OmnidError(
            "the system allows no code that is compiled at run time: remove MemoryDenyWriteExecute= from "
            f"the service, or what else denies executable memory ({error})"
        ) from error
    # 2. Compile what is not on the disk.
    started_s, reason = time.monotonic(), why_unusable(cache_folder())
    if not reason and kept_folder() is None:
        reason = _compile_in_children(report)
    # 3. Read it.
    if not reason:
        try:
            _compile_modules(_kernel_modules(), kept_folder())
            with suppress(OSError):
                os.utime(folder_of_state())  # used: not the next to be removed
        except Exception as error:  # what pickle and LLVM raise for damaged files
            shutil.rmtree(folder_of_state(), ignore_errors=True)
            reason = f"what was there is damaged ({type(error).__name__})"
    # 4. Or compile it for this run only.
    if reason:
        _compile_modules(_kernel_modules(), None)
        report(
            logging.WARNING,
            f"the compiled functions are not kept in {cache_folder()}: {reason}: this start took "
            f"{time.monotonic() - started_s:.0f} s longer; make that folder writable, or set OMNID_CACHE_DIR",
        )
    _state["ready"] = True


def read_kept_kernels() -> None:
    """Read the functions that are on the disk: also in a thread of its own, before `prepare_kernels` does the rest."""
    if (folder := kept_folder()) is not None:
        _compile_modules(_kernel_modules(), folder)


class KeptKernels(NamedTuple):
    """Content of the disk, as the next start finds it."""

    folder: Path
    unusable: str  # why nothing can be kept there; empty if it can
    is_kept: bool


def kept_kernels(service: Path | None = None) -> KeptKernels:
    """Return what is kept in the folder of this program, or in that of the service, which belongs to another user.

    Raises OSError where the system allows no code that is made at run time, ImportError where numba is missing.
    """
    _make_executable_memory()
    if find_spec("numba") is None:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")
    if service is None:
        return KeptKernels(cache_folder(), why_unusable(cache_folder()), kept_folder() is not None)
    return KeptKernels(service, "", (service / folder_of_state().name).is_dir())


def _make_executable_memory() -> None:
    """Make and free a page of executable memory; OSError where the system denies it."""
    mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()


def _kernel_modules() -> list[str]:
    """Return the names of all modules with compiled functions, the largest files first."""
    paths = sorted(PACKAGE.rglob(KERNEL_FILES), key=lambda path: path.stat().st_size, reverse=True)
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]


def _compile_modules(names: Sequence[str], folder: Path | None) -> None:
    """Compile the functions of modules, or read them from a folder."""
    for name in names:
        import_module(name)
    for kernel in declared():
        if kernel.function.__module__ in names:
            kernel.compile(folder)


def _compile_in_children(report: Report) -> str:
    """Compile all functions into the folder of this state by programs of their own; return why that failed, or ""."""
    shutil.rmtree(folder_of_state(), ignore_errors=True)  # one that others could write to
    report(logging.INFO, "compiling the loops over pixels and landmarks for this processor, once; takes half a minute")
    started_s, names = time.monotonic(), _kernel_modules()
    count = min(MOST_CHILDREN, len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory(prefix="making-", dir=cache_folder()) as parent:
        making = Path(parent, "kernels")
        making.mkdir(mode=0o700)
        with ExitStack() as running:
            children = []
            for number in range(count):
                command = python("-m", __name__, str(making), *names[number::count])
                child = subprocess.Popen(
                    command,
                    env=python_environment(),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
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
    _remove_other_states()
    return "" if kept_folder() else "it was not written"


def _remove_other_states() -> None:
    """Remove the oldest folders of other states, and those that were left half made."""
    with suppress(OSError):
        paths = [path for path in cache_folder().glob("kernels-*") if path != folder_of_state()]
        for path in sorted(paths, key=lambda path: path.stat().st_mtime)[:-KEPT_STATES]:
            shutil.rmtree(path, ignore_errors=True)
        for path in cache_folder().glob("making-*"):
            if path.stat().st_mtime < time.time() - 2 * TIMEOUT_S:
                shutil.rmtree(path, ignore_errors=True)


def main(folder: Path, *names: str) -> None:
    """Be a program that compiles: fill a folder with the functions of modules, and wait until it is on the disk."""
    _compile_modules(names, folder)
    os.sync()


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
