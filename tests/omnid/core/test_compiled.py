"""Compiled functions: types, arrays that are not written, functions within them, and what their files import."""

from __future__ import annotations

import ast
from pathlib import Path

import numba
import numpy as np
import pytest

import omnid.core
from omnid.core.compiled import KERNEL_FILES, compiled, inner

FILES = sorted(Path(omnid.core.__path__[0]).rglob(KERNEL_FILES))


@inner
def twice(value: float) -> float:
    return 2 * value


@compiled("(f8[:], f8[::1])", writes=("out",))
def doubled(values: np.ndarray, out: np.ndarray) -> None:
    for n in range(len(values)):
        out[n] = twice(values[n])


def test_strided_and_read_only_arrays_are_read() -> None:
    values, out = np.arange(8.0), np.zeros(4)
    values.flags.writeable = False
    doubled(values[::2], out)
    assert out.tolist() == [0, 4, 8, 12]
    assert twice(1.5) == 3.0


def test_other_types_are_an_error_and_not_a_wait() -> None:
    out = np.zeros(4)
    with pytest.raises(TypeError):
        doubled(np.arange(4, dtype=np.float32), out)
    out.flags.writeable = False
    with pytest.raises(TypeError):
        doubled(np.arange(4.0), out)


@pytest.mark.parametrize("wrong", [None, [1.0], np.zeros((4, 2)), np.zeros(4, ">f8"), np.zeros(4, np.int64)])
def test_what_is_not_the_array_of_the_signature_is_not_read(wrong: object) -> None:
    with pytest.raises(TypeError, match="values is no array of 1 axes of f8"):
        doubled(wrong, np.zeros(4))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="out is no array of 1 axes of f8, contiguous, writable"):
        doubled(np.zeros(2), np.zeros(4)[::2])


@compiled("(u1, i8, f4, UniTuple(f8, 2), f8[:, :], b1[::1], f8[::1])", writes=("out",))
def listed(
    byte: int,
    number: int,
    real: float,
    two: tuple[float, float],
    table: np.ndarray,
    flags: np.ndarray,
    out: np.ndarray,
) -> None:
    kept = np.empty(3)
    kept[0], kept[1], kept[2] = two[0], two[1], table[1, 2]
    out[0], out[1], out[2] = byte, number, real
    for n in range(3):
        out[3 + n] = kept[n] if flags[n] else -1.0


def test_numbers_tuples_and_named_arguments_are_passed() -> None:
    out, flags, table = np.zeros(6), np.array([True, False, True]), np.arange(12.0).reshape(4, 3).T
    listed(np.uint8(200), np.int64(-5), np.float32(0.5), (1.5, 2.5), table=table, flags=flags, out=out)
    assert out.tolist() == [200, -5, 0.5, 1.5, -1.0, table[1, 2]]
    for two in ((1.0,), 1.0):
        with pytest.raises(TypeError):
            listed(1, 2, 3.0, two, table, flags, out)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        listed(1, 2.5, 3.0, (1.0, 2.0), table, flags, out)  # type: ignore[arg-type]


def test_a_function_that_returns_something_is_refused() -> None:
    @compiled("(f8,)")
    def returned(value: float) -> float:
        return value

    with pytest.raises(TypeError, match="returns float64"):
        returned(1.0)


def test_an_array_that_is_not_named_as_written_cannot_be_written() -> None:

    @compiled("(f8[::1],)")
    def wrong(values: np.ndarray) -> None:
        values[0] = 1.0

    with pytest.raises(numba.TypingError):
        wrong(np.zeros(1))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_of_compiled_functions_depend_on_each_other_only(path: Path) -> None:
    # The code on disk is made again when one of these files changes, and not when others do.
    allowed = {"__future__", "math", "numpy", "numpy.typing", "omnid.core.compiled", "typing"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert all(alias.name in allowed for alias in node.names), ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            assert node.module in allowed or str(node.module).endswith("_kernels"), ast.unparse(node)
