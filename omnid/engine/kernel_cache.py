"""Compiled functions (core/compiled.py) made ready before the first image, and kept on disk between two starts.

A folder holds the code of one file in one state, of one version of numba and Python and of one processor. It is filled
in a folder of another name, which gets its name when it is complete, and its files are checked by their digests
before they are read: a power cut, a full disk or two programs at once cannot leave code that is half written. Folders
of other states are removed, the oldest first.

What is read here is run. The digests protect from damage only: they are in the same folder as the code, so anyone who
can write the code can write its digests. Other users are kept out by owner and mode alone: the folder of all states
and that of each belong to this user, and neither group nor others can write to them. A program of the same user is
not kept out: it could change this program as well."""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import os
import platform
import random
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import omnid.core
from omnid.core.compiled import KERNEL_FILES, Kernel, declared
from omnid.errors import OmnidError

MAX_FOLDERS: Final = 100  # of other states, and of files that were not compiled now
MAX_BYTES: Final = 64 << 20  # of a folder that is read: a larger one is none of ours
DIGESTS: Final = "digests.json"
_IMPORTED: Final = re.compile(r"^(?:from|import) (omnid\.core\.\S*_kernels)\b", re.MULTILINE)
_OWN_ONLY: Final = 0o022  # bits of a mode by which others could write: what is read here is run
Report: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line

_state = {"ready": False}


def prepare_kernels(report: Report) -> None:
    """Compile all functions, or read them from the disk; report what takes long, and what is not kept.

    The second call and later ones do nothing. Raises OmnidError where the system allows no code that is made at run
    time.
    """
    if _state["ready"]:
        return
    try:
        import numba  # noqa: F401 - it tries to make executable memory
    except OSError as error:
        raise OmnidError("the system allows no code that is compiled at run time: remove MemoryDenyWriteExecute= from "
                         f"the service, or what else denies executable memory ({error})") from error
    read_kept_kernels()
    missing = {name: _folder_of_state(path) for name, path in _kernel_files().items() if not _is_ready(name)}
    if missing:
        _compile_first(missing, _why_unusable(cache_folder()), report)
    _state["ready"] = True


def read_kept_kernels() -> None:
    """Read the functions that are on the disk: also in a thread of its own, before `prepare_kernels` does the rest."""
    reason = _why_unusable(cache_folder())
    for name, path in _kernel_files().items():
        importlib.import_module(name)
        folder = _folder_of_state(path)
        if not reason and not _is_ready(name) and _is_intact(folder):
            _compile_into(name, folder)
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

    Raises OSError where the system allows no code that is made at run time.
    """
    folder = service or cache_folder()
    unusable = "" if service else _why_unusable(folder)
    owner = folder.stat().st_uid if service else os.geteuid()
    counts = {True: 0, False: 0}
    for name, path in _kernel_files().items():
        importlib.import_module(name)
        if functions := len(_functions_of(name)):
            counts[not unusable and _is_intact(folder / _folder_of_state(path).name, owner)] += functions
    return KeptKernels(folder, unusable, counts[True], counts[False])


def _is_ready(name: str) -> bool:
    """True if the functions of a file (name of its module) are compiled."""
    return all(kernel.is_compiled for kernel in _functions_of(name))


def _compile_first(folders: Mapping[str, Path], reason: str, report: Report) -> None:
    """Compile what is not on the disk; reason: why it cannot be kept there, empty where it can."""
    started_s = time.monotonic()
    count = sum(1 for name in folders for _ in _functions_of(name))
    report(logging.INFO, f"compiling {count} functions for this processor, once; takes half a minute to two")
    # In any order: two programs that start at once begin with other files, and each reads what the other has made.
    for name, folder in random.sample(list(folders.items()), len(folders)):
        if not reason:
            try:
                if _is_intact(folder):
                    _compile_into(name, folder)
                else:
                    _compile_and_publish(name, folder)
                continue
            except OSError as error:
                reason = error.strerror or str(error)
        _compile_into(name, None)
    took_s = time.monotonic() - started_s
    if reason:
        report(logging.WARNING, f"the compiled functions cannot be kept in {cache_folder()}: {reason}: every start "
               f"takes {took_s:.0f} s longer; make that folder writable, or set OMNID_CACHE_DIR to another one")
    else:
        _remove_others(set(folders.values()))
        report(logging.INFO, f"compiled in {took_s:.0f} s; kept in {cache_folder()}")


def cache_folder() -> Path:
    """Return the folder for what omnid can make again: of the service (systemd), of the user, or OMNID_CACHE_DIR."""
    if own := os.environ.get("OMNID_CACHE_DIR"):
        return Path(own)
    if of_service := os.environ.get("CACHE_DIRECTORY", "").split(":")[0]:
        return Path(of_service)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()) / "omnid"


def _kernel_files() -> dict[str, Path]:
    """Return the files with compiled functions by the names of their modules."""
    root = Path(omnid.core.__path__[0]).parent
    return {f"omnid.{'.'.join(path.relative_to(root).with_suffix('').parts)}": path
            for path in sorted(root.rglob(KERNEL_FILES))}


def _folder_of_state(path: Path) -> Path:
    """Return the folder for the code of this file and those that it imports, of these versions and this processor."""
    import llvmlite.binding as llvm
    import numba
    import numpy as np

    digest = hashlib.sha256()
    processor = platform.machine(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    environment = sorted((key, value) for key, value in os.environ.items() if key.startswith("NUMBA_"))
    digest.update(repr((sys.version, numba.__version__, np.__version__, processor, environment)).encode())
    for source in (Path(omnid.core.__path__[0]) / "compiled.py", *_with_imported(path)):
        # numba compares the times of files, and names its own files by their paths.
        digest.update(repr((str(source), source.stat().st_mtime_ns)).encode() + source.read_bytes())
    return cache_folder() / f"kernels-{path.stem.removesuffix('_kernels')}-{digest.hexdigest()[:20]}"


def _with_imported(path: Path) -> list[Path]:
    """Return a file and all others with compiled functions that it imports, also by way of each other."""
    files, found, queue = _kernel_files(), [path], [path]
    while queue:
        text = queue.pop().read_text("utf-8")
        imported = [files[name] for name in _IMPORTED.findall(text) if name in files]
        queue += [file for file in imported if file not in found]
        found += [file for file in imported if file not in found]
    return [path, *sorted(found[1:])]


def _why_unusable(folder: Path) -> str:
    """Return why nothing can be kept in a folder, which is made if needed; empty if it can."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        if status.st_uid != os.geteuid() or status.st_mode & _OWN_ONLY:
            return "it belongs to another user, or others can write to it"
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _functions_of(name: str) -> list[Kernel[..., Any]]:
    """Return the compiled functions of a file (name of its module)."""
    return [kernel for kernel in declared() if kernel.function.__module__ == name]


def _compile_into(name: str, folder: Path | None) -> None:
    """Compile the functions of a file that are not in the folder; None: keep none."""
    import numba

    if folder is not None:
        numba.config.CACHE_DIR = str(folder)
    for kernel in _functions_of(name):
        kernel.compile(kept=folder is not None)


def _compile_and_publish(name: str, folder: Path) -> None:
    """Compile the functions of a file into a new folder, and give it its name."""
    making = Path(tempfile.mkdtemp(prefix="making-", dir=folder.parent))
    try:
        _compile_into(name, making)
        (making / DIGESTS).write_text(json.dumps(_digests(making)))
        if folder.exists():  # damaged, or another program was faster
            folder.rename(making / "before")
        making.rename(folder)
        shutil.rmtree(folder / "before", ignore_errors=True)
    finally:
        shutil.rmtree(making, ignore_errors=True)


def _digests(folder: Path) -> dict[str, str]:
    """Return the digests of all files in a folder."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file() and path.name != DIGESTS}


def _is_intact(folder: Path, owner: int | None = None) -> bool:
    """True if a folder is complete and its files are those that its owner wrote; None: this user."""
    try:
        status = folder.stat()
        if status.st_uid != (os.geteuid() if owner is None else owner) or status.st_mode & _OWN_ONLY:
            return False
        if sum(path.stat().st_size for path in folder.rglob("*")) > MAX_BYTES:
            return False
        expected = json.loads((folder / DIGESTS).read_text())
        return bool(expected) and expected == _digests(folder)
    except (OSError, ValueError):
        return False


def _remove_others(used: set[Path]) -> None:
    """Remove the folders of other states beyond MAX_FOLDERS, the oldest first, and what was left half made."""
    with suppress(OSError):
        others = sorted((path for path in cache_folder().glob("kernels-*") if path not in used),
                        key=lambda path: path.stat().st_mtime, reverse=True)
        for path in others[MAX_FOLDERS:]:
            shutil.rmtree(path, ignore_errors=True)
        day_ago_s = time.time() - 86400
        for path in cache_folder().glob("making-*"):
            if path.stat().st_mtime < day_ago_s:
                shutil.rmtree(path, ignore_errors=True)
