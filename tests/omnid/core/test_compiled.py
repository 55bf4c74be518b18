"""Compiled functions: types, arrays that are not written, functions within them, and what their files import."""

from __future__ import annotations

import ast
from pathlib import Path

import numba
import numpy as np
import pytest

from omnid.core.compiled import KERNEL_FILES, PACKAGE, compiled, inner

FILES = sorted(PACKAGE.rglob(KERNEL_FILES))


@inner
def twice(value: float) -> float:
    return 2 * value


@compiled("(i8, f4, UniTuple(f8, 2), f8[:], f8[::1])", writes=("out",))
def listed(number: int, real: float, two: tuple[float, float], values: np.ndarray, out: np.ndarray) -> None:
    out[0], out[1], out[2] = number, real, two[1]
    for n in range(len(values)):
        out[3 + n] = twice(values[n])


def test_numbers_tuples_strided_and_read_only_arrays_and_named_arguments_are_passed() -> None:
    values, out = np.arange(8.0), np.zeros(7)
    values.flags.writeable = False
    listed(np.int64(-5), np.float32(0.5), (1.5, 2.5), values=values[::2], out=out)
    assert out.tolist() == [-5, 0.5, 2.5, 0, 4, 8, 12]
    assert twice(1.5) == 3.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": None},
        {"values": [1.0]},
        {"values": np.zeros((4, 2))},
        {"values": np.zeros(4, ">f8")},
        {"values": np.zeros(4, np.float32)},
        {"two": (1.0,)},
        {"out": np.zeros(20)[::2]},
        {"out": np.broadcast_to(0.0, 7)},
    ],
    ids=str,
)
def test_other_types_are_refused_and_not_compiled(wrong: dict[str, object]) -> None:
    right = {"number": 1, "real": 0.5, "two": (1.0, 2.0), "values": np.zeros(4), "out": np.zeros(7)}
    with pytest.raises(TypeError):
        listed(**(right | wrong))


def test_an_array_that_is_not_named_as_written_cannot_be_written() -> None:
    @compiled("(f8[::1],)")
    def wrong(values: np.ndarray) -> None:
        values[0] = 1.0

    with pytest.raises(numba.TypingError):
        wrong(np.zeros(1))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_of_compiled_functions_depend_on_each_other_only(path: Path) -> None:
    # The code on disk is made again when one of these files changes, and not when others do.
    allowed = {"__future__", "heapq", "math", "numpy", "numpy.typing", "omnid.core.compiled", "typing"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert all(alias.name in allowed for alias in node.names), ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            assert node.module in allowed or str(node.module).endswith("_kernels"), ast.unparse(node)
