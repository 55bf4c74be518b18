"""Compiled functions (core/compiled.py) made ready before the first image: read from the disk, or compiled and kept."""

from __future__ import annotations

import logging
import mmap
import os
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from omnid.engine import kernel_store as store
from omnid.engine.kernel_compiler import compile_missing
from omnid.engine.logging_setup import Report, log_unlimited
from omnid.errors import OmnidError

_state = {"ready": False}


def prepare_kernels(report: Report = log_unlimited) -> None:
    """Compile all functions, or read them from the disk; report compilations that take long, and code that is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    if _state["ready"]:
        return
    try:
        _make_executable_memory()
    except OSError as error:
        raise OmnidError(
            "the system allows no code that is compiled at run time: remove MemoryDenyWriteExecute= from "
            f"the service, or what else denies executable memory ({error})"
        ) from error
    read_kept_kernels()
    missing = _not_ready()
    if missing and not (reason := store.why_unusable(store.cache_folder())):
        try:
            compile_missing(missing, report)
        except OSError as error:
            reason = error.strerror or str(error)
        read_kept_kernels()
        missing = _not_ready()
    if missing:
        _compile_here(missing, reason, report)
    _state["ready"] = True


def read_kept_kernels() -> None:
    """Read the functions that are on the disk: also in a thread of its own, before `prepare_kernels` does the rest."""
    if store.why_unusable(store.cache_folder()):
        return
    for name, folder in _not_ready().items():
        if store.is_intact(folder):
            store.compile_into(name, folder)
            with suppress(OSError):
                os.utime(folder)  # used: not the next to be removed


class KeptKernels(NamedTuple):
    """Content of the disk, as the next start finds it."""

    folder: Path
    unusable: str  # why nothing can be kept there; empty if it can
    kept: int  # functions
    missing: int  # functions that the next start compiles


def kept_kernels(service: Path | None = None) -> KeptKernels:
    """Return what is kept in the folder of this program, or in that of the service, which belongs to another user.

    Raises OSError where the system allows no code that is made at run time, ImportError where numba is missing.
    """
    _make_executable_memory()
    if find_spec("numba") is None:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")
    folder = service or store.cache_folder()
    unusable = "" if service else store.why_unusable(folder)
    owner = folder.stat().st_uid if service else os.geteuid()
    counts = {True: 0, False: 0}
    for name, path in store.kernel_files().items():
        if functions := len(store.functions_of(name)):
            is_kept = store.is_intact(folder / store.folder_of_state(name, path).name, owner)
            counts[not unusable and is_kept] += functions
    return KeptKernels(folder, unusable, counts[True], counts[False])


def _make_executable_memory() -> None:
    """Make and free a page of executable memory; OSError where the system denies it."""
    mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC).close()


def _not_ready() -> dict[str, Path]:
    """Return the folders of the files, by the names of their modules, whose functions this program has not yet."""
    return {
        name: store.folder_of_state(name, path)
        for name, path in store.kernel_files().items()
        if not store.is_ready(name)
    }


def _compile_here(folders: dict[str, Path], reason: str, report: Report) -> None:
    """Compile in this program, one after the other; reason: why nothing is kept, empty where helpers have failed."""
    started_s = time.monotonic()
    for name, folder in folders.items():
        if not reason:
            try:
                store.compile_and_publish(name, folder)
            except OSError as error:
                reason = error.strerror or str(error)
        if not store.is_ready(name):
            store.compile_into(name, None)
    if reason:
        report(
            logging.WARNING,
            f"the compiled functions cannot be kept in {store.cache_folder()}: {reason}: every "
            f"start takes {time.monotonic() - started_s:.0f} s longer; make that folder writable, or set "
            "OMNID_CACHE_DIR to another one",
        )
