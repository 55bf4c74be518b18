"""Types of the arguments of compiled functions (compiled.py): read from a signature, and passed by ctypes."""

from __future__ import annotations

import ctypes
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

# An argument of a signature: "f8[:, ::1]", "f8", "UniTuple(f8, 5)".
_ARGUMENT: Final = re.compile(r"UniTuple\((?P<of>\w+), (?P<count>\d+)\)|(?P<kind>[a-z]\d)(?:\[(?P<axes>[^]]*)\])?")


@dataclass(frozen=True, slots=True)
class Argument:
    """Type of an argument: an array, a number, or a tuple of numbers."""

    name: str
    kind: str  # type of the numbers, as numpy names it: f8
    dimensions: int = 0  # number of axes of an array; 0: no array
    is_contiguous: bool = False
    is_written: bool = False
    count: int = 0  # length of a tuple; 0: no tuple


def arguments_of(function: Callable[..., object], signature: str, writes: tuple[str, ...]) -> Iterator[Argument]:
    """Yield the arguments of a function by its signature and the names of those that it writes to."""
    names = function.__code__.co_varnames
    for found, name in zip(_ARGUMENT.finditer(signature), names, strict=False):
        axes = found["axes"]
        if axes is None:
            yield Argument(name, found["of"] or found["kind"], count=int(found["count"] or 0))
        else:
            yield Argument(name, found["kind"], axes.count(",") + 1, axes.endswith("1"), name in writes)


@cache
def _number(kind: str) -> Any:
    """Return the type of ctypes of a number, which takes those of numpy, too."""
    base = np.ctypeslib.as_ctypes_type(np.dtype(kind))
    read: Callable[[Any], Any] = float if kind[0] == "f" else operator.index
    return type(kind, (base,), {"from_param": classmethod(lambda _, value: base(read(value)))})


def c_type(argument: Argument) -> Any:
    """Return the type by which ctypes passes an argument; the code itself checks arrays."""
    if argument.dimensions:
        return ctypes.py_object
    number = _number(argument.kind)
    if not argument.count:
        return number
    numbers = number.__base__ * argument.count
    name, count = f"{argument.kind}x{argument.count}", argument.count

    def from_param(_: Any, values: Any) -> Any:
        if len(values) != count:
            raise TypeError(f"expected {count} numbers, found {len(values)}")
        return numbers(*values)

    return type(name, (ctypes.c_void_p,), {"from_param": classmethod(from_param)})
