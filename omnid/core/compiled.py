"""Functions compiled to machine code by numba: the one way in which loops over pixels and landmarks become fast.

A compiled function lies in a file `*_kernels.py`, which imports numpy, this module and other such files only: the code
kept on disk is made again when one of them changes (engine/kernel_store.py), and constants of other files would not be
noticed. There is no second version in Python. Results are the same bytes in every run: no reordering of sums
(fastmath), no threads inside. The global lock of Python is released meanwhile.

numba is imported at the first compilation, not with this module: most commands compile nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, Generic, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

# error_model: a division by zero gives inf or NaN as in numpy.
OPTIONS: Final = {"nogil": True, "error_model": "numpy", "fastmath": False, "parallel": False}
# Functions that only compiled functions call need no entries for Python and C, which take a tenth of all compilation.
UNWRAPPED: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
KERNEL_FILES: Final = "*_kernels.py"

_declared: list[Kernel[Any, Any]] = []


class Kernel(Generic[P, R]):
    """A function that is compiled before it is called first; callable with what its signature allows."""

    def __init__(self, function: Callable[P, R], signature: str, writes: tuple[str, ...]) -> None:
        self.function, self.signature, self.writes = function, signature, writes
        self._compiled: Any = None
        self.__doc__, self.__name__ = function.__doc__, function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function, which is compiled first if that was not done."""
        if self._compiled is None:
            self.compile()
        result: R = self._compiled(*args, **kwargs)
        return result

    @property
    def is_compiled(self) -> bool:
        """True once the function is compiled."""
        return self._compiled is not None

    def compile(self, folder: Path | None = None) -> None:
        """Compile the function for its signature; folder: read it from there, or write it there."""
        dispatcher = self._dispatcher()
        if folder is not None:
            dispatcher._cache = _cache_in(folder, self.function)
        dispatcher.compile(self._types())
        dispatcher.disable_compile()  # other types are an error, not a wait of seconds
        self._compiled = dispatcher

    def _dispatcher(self) -> Any:
        import numba

        return numba.njit(**OPTIONS, no_cfunc_wrapper=True)(self.function)

    def _types(self) -> tuple[Any, ...]:
        """Return the types of the arguments: arrays that are not written may be read-only ones."""
        from numba.core import sigutils, types

        arguments, _ = sigutils.normalize_signature(self.signature)
        names = self.function.__code__.co_varnames
        return tuple(
            types.Array(kind.dtype, kind.ndim, kind.layout, readonly=name not in self.writes)
            if isinstance(kind, types.Array)
            else kind
            for kind, name in zip(arguments, names, strict=False)
        )


class _Locator:
    """Place where numba keeps a function: a folder that depends on neither path nor time of the source file.

    The methods are those that numba.core.caching calls; numba's own locators name folders by the path of the source.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def from_function(self, function: object, file: str) -> _Locator:
        return self

    def get_cache_path(self) -> str:
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        self._folder.mkdir(exist_ok=True)

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return ""


def _cache_in(folder: Path, function: Callable[..., object]) -> Any:
    """Return numba's cache of a function in a folder."""
    from numba.core import caching

    in_folder = type("InFolder", (caching.CompileResultCacheImpl,), {"_locator_classes": [_Locator(folder)]})
    return type("FolderCache", (caching.FunctionCache,), {"_impl_class": in_folder})(function)


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
            self._dispatcher = numba.njit(**OPTIONS, **UNWRAPPED)(self.function)
            # An argument such as 0 counts as an integer, not as a type of its own, which would be compiled once more.
            template_for = self._dispatcher.get_call_template
            self._dispatcher.get_call_template = lambda args, kws: template_for(
                tuple(map(numba.types.unliteral, args)), kws
            )
        return self._dispatcher._numba_type_


def compiled(signature: str, writes: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Return a decorator that compiles a function.

    signature: numba's types of the arguments, such as "(f8[:, ::1], i8)"; "::1" marks arrays that are contiguous.
    writes: names of the arrays that the function writes to; all others may be read-only.
    """

    def decorate(function: Callable[P, R]) -> Kernel[P, R]:
        kernel = Kernel(function, signature, writes)
        _declared.append(kernel)
        return kernel

    return decorate


def inner(function: Callable[P, R]) -> Inner[P, R]:
    """Make a function part of the compiled functions that call it."""
    return Inner(function)


def declared() -> Iterator[Kernel[Any, Any]]:
    """Return the compiled functions of all files that were imported so far, in the order of their declaration."""
    return iter(tuple(_declared))
