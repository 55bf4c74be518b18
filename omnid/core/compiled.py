"""Functions compiled to machine code by numba: the one way in which loops over pixels and landmarks become fast.

A compiled function lies in a file `*_kernels.py`, which imports numpy, this module and other such files only. numba
keeps its code on disk, and notices a change of that file, but none of the files that it imports: the folder of the code
is therefore named by a digest of all of them. There is no second version in Python. Results are the same bytes in every
run: no reordering of sums (fastmath), no threads inside. The global lock of Python is released meanwhile. Indices are
not checked. numba is imported with the first compilation.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Generic, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

KERNEL_FILES: Final = "*_kernels.py"
PACKAGE: Final = Path(__file__).parents[1]
# error_model: a division by zero gives inf or NaN as in numpy.
OPTIONS: Final = {"nogil": True, "error_model": "numpy"}
DECLARED: Final[list[Kernel[Any, Any]]] = []  # the compiled functions of all files that were imported so far


class Kernel(Generic[P, R]):
    """A function that is compiled, or read from the disk, before its first call, for the types of its signature."""

    def __init__(self, function: Callable[P, R], signature: str, writes: tuple[str, ...]) -> None:
        self.function, self.signature, self.writes = function, signature, writes
        self._compiled: Callable[P, R] | None = None
        self.__doc__, self.__name__ = function.__doc__, function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function, which is compiled first if that was not done; TypeError for other types."""
        if self._compiled is None:
            self.compile(is_kept=is_kept(self.function.__module__))
        return self._compiled(*args, **kwargs)  # type: ignore[misc]  # it is compiled now

    def compile(self, *, is_kept: bool) -> None:
        """Compile the function. is_kept: read it from the folder of its file's code, or else write it there."""
        if self._compiled is not None:
            return
        import numba

        numba.config.CACHE_DIR = str(code_folder(self.function.__module__))
        types = eval(self.signature, dict(self.function.__globals__), vars(numba.types))
        names = inspect.signature(self.function).parameters
        wanted = [
            # Arrays that are not written may be read-only ones.
            kind.copy(readonly=True) if isinstance(kind, numba.types.Array) and name not in self.writes else kind
            for kind, name in zip(types, names, strict=True)
        ]
        self._compiled = numba.njit(tuple(wanted), cache=is_kept, **OPTIONS)(self.function)


class Inner(Generic[P, R]):
    """A function that only compiled functions call; it becomes part of them."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.function = function
        self._dispatcher: Any = None
        self.__doc__, self.__name__ = function.__doc__, function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function as it is written in Python, as a test does."""
        return self.function(*args, **kwargs)

    @property
    def _numba_type_(self) -> Any:
        """The type by which numba compiles calls of this object."""
        import numba

        if self._dispatcher is None:
            self._dispatcher = numba.njit(**OPTIONS)(self.function)
        return self._dispatcher._numba_type_


def compiled(signature: str, writes: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Return a decorator that compiles a function.

    signature: numba's types of the arguments, such as "(f8[:, ::1], i8)"; "::1" marks arrays that are contiguous.
    writes: names of the arrays that the function writes to; all others may be read-only.
    """

    def decorate(function: Callable[P, R]) -> Kernel[P, R]:
        kernel = Kernel(function, signature, writes)
        DECLARED.append(kernel)
        return kernel

    return decorate


def inner(function: Callable[P, R]) -> Inner[P, R]:
    """Make a function part of the compiled functions that call it."""
    return Inner(function)


def cache_folder() -> Path:
    """Return the folder for what omnid can make again: of the service (systemd), of the user, or OMNID_CACHE_DIR."""
    if own := os.environ.get("OMNID_CACHE_DIR"):
        return Path(own)
    if of_service := os.environ.get("CACHE_DIRECTORY", "").split(":")[0]:
        return Path(of_service)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()) / "omnid"


def kernel_modules() -> list[str]:
    """Return the names of all modules with compiled functions, the largest files first."""
    paths = sorted(PACKAGE.rglob(KERNEL_FILES), key=lambda path: path.stat().st_size, reverse=True)
    return [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]


def code_folder(module: str) -> Path:
    """Return the folder for the code of a module: <module>-<digest of this installation>-<digest of its state>."""
    return cache_folder() / _folder_name(module)


@cache
def _folder_name(module: str) -> str:
    installation = hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:8]
    # numba compares the time of the module's own file.
    state = hashlib.sha256(repr((sys.version, version("numba"), _file(module).stat().st_mtime_ns)).encode())
    for text in (Path(__file__).read_bytes(), *_texts(module)):
        state.update(text)
    return f"{module.rpartition('.')[2]}-{installation}-{state.hexdigest()[:20]}"


def _file(module: str) -> Path:
    return PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py")


def _texts(module: str) -> Iterator[bytes]:
    """Yield the content of the file of a module, and of those that it imports."""
    text = _file(module).read_bytes()
    yield text
    for name in re.findall(rb"^from (\S+_kernels) import", text, re.MULTILINE):
        yield from _texts(name.decode())


def why_unusable(folder: Path) -> str:
    """Return why no code can be kept in the cache folder, which is made if needed; empty if it can.

    What is read there is run. Other users are kept out by owner and mode; a program of the same user could change this
    program as well.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        if status.st_uid != os.geteuid() or status.st_mode & 0o022:
            return "it belongs to another user, or others can write to it"
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def is_kept(module: str) -> bool:
    """True if the code of a module was compiled into a folder that only this user can write."""
    folder = code_folder(module)
    return folder.is_dir() and not (why_unusable(cache_folder()) or why_unusable(folder))
