"""Code of compiled functions (core/compiled.py) on disk: one folder for each file in each state.

The name of a folder is a digest of all that decides about the code: the text of the file and of those that it imports,
the versions of numba, numpy and Python, and the processor. Paths and times of files do not count, so that all
installations of the same sources share what one of them has compiled.

A folder is filled under another name, and gets its own when it is complete; its files are checked by their digests
before they are read: a power cut, a full disk or two programs at once cannot leave code that is half written.

What is read here is run. The digests protect from damage only: they are in the same folder as the code, so anyone who
can write the code can write its digests. Other users are kept out by owner and mode alone: the folder of all states
and that of each belong to this user, and neither group nor others can write to them. A program of the same user is
not kept out: it could change this program as well."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import omnid.core
from omnid.core.compiled import KERNEL_FILES, Kernel, declared

MAX_FOLDERS: Final = 100  # Most folders of other states, and of files that were not compiled now.
MAX_BYTES: Final = 64 << 20  # A larger folder is not read, because omnid writes none.
DIGESTS: Final = "digests.json"
CODE: Final = ".o"  # end of the names of files with the code of one function
UNFINISHED: Final = "making-"  # begin of the names of folders that are being filled
_IMPORTED: Final = re.compile(r"^(?:from|import) (omnid\.core\.\S*_kernels)\b", re.MULTILINE)
_OWN_ONLY: Final = 0o022  # bits of a mode by which others could write: what is read here is run
_DAY_S: Final = 86400.0  # a folder that was begun longer ago will not be finished


def cache_folder() -> Path:
    """Return the folder for what omnid can make again: of the service (systemd), of the user, or OMNID_CACHE_DIR."""
    if own := os.environ.get("OMNID_CACHE_DIR"):
        return Path(own)
    if of_service := os.environ.get("CACHE_DIRECTORY", "").split(":")[0]:
        return Path(of_service)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()) / "omnid"


@cache
def kernel_files() -> dict[str, Path]:
    """Return the files with compiled functions by the names of their modules."""
    root = Path(omnid.core.__path__[0]).parent
    return {
        f"omnid.{'.'.join(path.relative_to(root).with_suffix('').parts)}": path
        for path in sorted(root.rglob(KERNEL_FILES))
    }


def functions_of(name: str) -> list[Kernel[..., Any]]:
    """Return the compiled functions of a file (name of its module), which is imported if it was not."""
    importlib.import_module(name)
    return [kernel for kernel in declared() if kernel.function.__module__ == name]


def is_ready(name: str) -> bool:
    """True if the functions of a file (name of its module) are compiled or read in this program."""
    return all(kernel.is_compiled for kernel in functions_of(name))


def folder_of_state(name: str, path: Path) -> Path:
    """Return the folder for the code of this file and those that it imports, of these versions and this processor."""
    settings = sorted((key, value) for key, value in os.environ.items() if key.startswith("NUMBA_"))
    digest = hashlib.sha256(repr((_versions_and_processor(), settings)).encode())
    core = Path(omnid.core.__path__[0])
    makers = (("", core / f"{maker}.py") for maker in ("compiled", "kernel_arguments", "native_code"))
    for module, source in (*makers, (name, path), *sorted(imported_files(path).items())):
        # The code contains the names of the modules.
        digest.update(repr((module, source.read_bytes())).encode())
    return cache_folder() / f"kernels-{path.stem.removesuffix('_kernels')}-{digest.hexdigest()[:20]}"


@cache
def _versions_and_processor() -> tuple[object, ...]:
    """Return what decides about the code and stays the same while a program runs; numba itself is not loaded."""
    import llvmlite.binding as llvm

    versions = [version(package) for package in ("numba", "llvmlite", "numpy")]
    features = llvm.get_host_cpu_features().flatten()
    return sys.version, versions, platform.machine(), llvm.get_host_cpu_name(), features


def imported_files(path: Path) -> dict[str, Path]:
    """Return the other files with compiled functions that a file imports, also by way of each other."""
    files, queue = kernel_files(), [path]
    found: dict[str, Path] = {}
    while queue:
        names = _IMPORTED.findall(queue.pop().read_text("utf-8"))
        fresh = {name: files[name] for name in names if name in files and name not in found and files[name] != path}
        found |= fresh
        queue += fresh.values()
    return found


def why_unusable(folder: Path) -> str:
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


def compile_into(name: str, folder: Path | None) -> None:
    """Read the functions of a file from the folder, or compile them into it; None: compile, and keep nothing."""
    for kernel in functions_of(name):
        kept = None if folder is None else folder / f"{kernel.__name__}{CODE}"
        if kept is not None and kept.exists():
            code = kept.read_bytes()
        else:
            code = kernel.code()
            if kept is not None:
                kept.write_bytes(code)
        kernel.load(code)


def compile_and_publish(name: str, folder: Path) -> None:
    """Compile the functions of a file into a new folder, and give it its name."""
    making = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder.parent))
    try:
        compile_into(name, making)
        (making / DIGESTS).write_text(json.dumps(_digests(making)))
        if folder.exists():  # damaged, or another program was faster
            folder.rename(making / "before")
        making.rename(folder)
        shutil.rmtree(folder / "before", ignore_errors=True)
    finally:
        shutil.rmtree(making, ignore_errors=True)


def is_intact(folder: Path, owner: int | None = None) -> bool:
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


def _digests(folder: Path) -> dict[str, str]:
    """Return the digests of all files in a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != DIGESTS
    }


def remove_others(used: set[Path]) -> None:
    """Remove the folders of other states beyond MAX_FOLDERS, the oldest first, and what was left half made."""
    with suppress(OSError):
        others = sorted(
            (path for path in cache_folder().glob("kernels-*") if path not in used),
            key=lambda path: path.stat().st_mtime,
            reverse=True,
        )
        for path in others[MAX_FOLDERS:]:
            shutil.rmtree(path, ignore_errors=True)
        day_ago_s = time.time() - _DAY_S
        for path in cache_folder().glob(f"{UNFINISHED}*"):
            if path.stat().st_mtime < day_ago_s:
                shutil.rmtree(path, ignore_errors=True)
