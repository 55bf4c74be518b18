"""Arguments of compiled functions: read from a signature, and passed by ctypes."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from omnid.core.kernel_arguments import Argument, arguments_of, c_type


def sums(image: object, factor: float, pair: tuple[float, float], count: int, out: object) -> None: ...


def test_a_signature_is_read() -> None:
    found = list(arguments_of(sums, "f4[:, ::1], f8, UniTuple(f8, 2), i8, f8[:]", ("out",)))
    assert found == [
        Argument("image", "f4", dimensions=2, is_contiguous=True),
        Argument("factor", "f8"),
        Argument("pair", "f8", count=2),
        Argument("count", "i8"),
        Argument("out", "f8", dimensions=1, is_written=True),
    ]


def test_numbers_of_numpy_are_passed_as_those_of_python() -> None:
    of_float, of_int = c_type(Argument("a", "f8")), c_type(Argument("b", "i8"))
    assert of_float.from_param(np.float32(0.5)).value == of_float.from_param(0.5).value == 0.5
    assert of_int.from_param(np.int32(7)).value == 7 and c_type(Argument("c", "f4[:]", 1)) is ctypes.py_object
    with pytest.raises(TypeError):
        of_int.from_param(1.5)


def test_a_tuple_has_its_length() -> None:
    pair = c_type(Argument("pair", "f8", count=2))
    assert list(pair.from_param((1.0, 2.0))) == [1.0, 2.0]
    with pytest.raises(TypeError, match="expected 2 numbers, found 3"):
        pair.from_param((1.0, 2.0, 3.0))
