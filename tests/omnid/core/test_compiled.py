"""Compiled functions: types, arrays that are not written, functions within them, and what their files import."""

from __future__ import annotations

import ast
from pathlib import Path

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


def test_an_array_that_is_not_named_as_written_cannot_be_written() -> None:
    import numba

    @compiled("(f8[::1],)")
    def wrong(values: np.ndarray) -> None:
        values[0] = 1.0

    with pytest.raises(numba.TypingError):
        wrong(np.zeros(1))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_of_compiled_functions_depend_on_each_other_only(path: Path) -> None:
    # The code on disk is made again when one of these files changes, and not when others do.
    allowed = {"__future__", "math", "numpy", "numpy.typing", "omnid.core.compiled"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert all(alias.name in allowed for alias in node.names), ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            assert node.module in allowed or str(node.module).endswith("_kernels"), ast.unparse(node)
