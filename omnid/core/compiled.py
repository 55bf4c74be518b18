"""Functions compiled to machine code: the one way in which loops over pixels and landmarks become fast.

A compiled function lies in a file `*_kernels.py`, which imports numpy, this module and other such files only: the code
kept on disk is made again when one of them changes (engine/kernel_store.py), and constants of other files would not be
noticed. There is no second version in Python. Results are the same bytes in every run: no reordering of sums
(fastmath), no threads inside. The global lock of Python is released meanwhile.

numba makes the code (native_code.py); it is imported only where code is missing. What is kept runs without numba: LLVM
loads it, and ctypes calls it. A function writes its results to arrays and returns nothing. It does not assign an array
to an array (`a[:] = b`): the check of their shapes calls numba's run time, which is not there. Indices are not checked.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, Generic, ParamSpec, TypeVar

import numpy as np

from omnid.core.kernel_arguments import Argument, arguments_of, c_type

P = ParamSpec("P")
R = TypeVar("R")

KERNEL_FILES: Final = "*_kernels.py"
_declared: list[Kernel[Any, Any]] = []


class Kernel(Generic[P, R]):
    """A function that is compiled before its first call, for the types of its signature."""

    def __init__(self, function: Callable[P, R], arguments: Sequence[Argument]) -> None:
        self.function, self.arguments = function, arguments
        self._compiled: Any = None
        self._engine: Any = None  # has the code's memory
        self.__doc__, self.__name__ = function.__doc__, function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function, which is compiled first if that was not done; TypeError for other types."""
        if self._compiled is None:
            self.load(self.code())
        values = inspect.signature(self.function).bind(*args, **kwargs).args if kwargs else args
        try:
            status = self._compiled(id(np.ndarray), *values)
        except ctypes.ArgumentError as error:
            raise TypeError(f"{self.symbol}: {error}") from error
        if status:
            self._fail(status)
        return None  # type: ignore[return-value]  # native_code.py refuses a function that returns something

    @property
    def symbol(self) -> str:
        """Name of the function in its code."""
        return f"{self.function.__module__}.{self.function.__qualname__}"

    @property
    def is_compiled(self) -> bool:
        """True once the function is compiled."""
        return self._compiled is not None

    def code(self) -> bytes:
        """Compile the function for its signature and return its code, for this processor."""
        from omnid.core.native_code import native_code

        return native_code(self.function, self.symbol, self.arguments)

    def load(self, code: bytes) -> None:
        """Take code, which was compiled here or read from the disk."""
        types = [ctypes.c_void_p, *map(c_type, self.arguments)]
        self._engine = _loaded(code)
        self._compiled = ctypes.CFUNCTYPE(ctypes.c_int32, *types)(self._engine.get_function_address(self.symbol))

    def _fail(self, status: int) -> None:
        """Raise the error that a call has returned: the number of a wrong array below zero, or numba's above."""
        if status > 0:
            raise MemoryError(f"{self.symbol}: no memory for its arrays")
        wrong = self.arguments[-1 - status]
        layout = ", contiguous" * wrong.is_contiguous + ", writable" * wrong.is_written
        raise TypeError(f"{self.symbol}: {wrong.name} is no array of {wrong.dimensions} axes of {wrong.kind}{layout}")


def _loaded(code: bytes) -> Any:
    """Return LLVM's loader of this code only: inner functions of other codes may have the same names."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True, codemodel="jitdefault")
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


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
        from omnid.core.native_code import inner_dispatcher

        if self._dispatcher is None:
            self._dispatcher = inner_dispatcher(self.function)
        return self._dispatcher._numba_type_


def compiled(signature: str, writes: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Return a decorator that compiles a function.

    signature: numba's types of the arguments, such as "(f8[:, ::1], i8)"; "::1" marks arrays that are contiguous.
    writes: names of the arrays that the function writes to; all others may be read-only.
    """

    def decorate(function: Callable[P, R]) -> Kernel[P, R]:
        kernel = Kernel(function, tuple(arguments_of(function, signature, writes)))
        _declared.append(kernel)
        return kernel

    return decorate


def inner(function: Callable[P, R]) -> Inner[P, R]:
    """Make a function part of the compiled functions that call it."""
    return Inner(function)


def declared() -> Iterator[Kernel[Any, Any]]:
    """Return the compiled functions of all files that were imported so far, in the order of their declaration."""
    return iter(tuple(_declared))
