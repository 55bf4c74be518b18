"""Machine code of compiled functions (compiled.py), made by numba so that it runs without numba."""

from __future__ import annotations

import numba

from omnid.core.compiled import inner
from omnid.core.native_code import inner_dispatcher


@inner
def twice(value: float) -> float:
    return 2 * value


def test_an_inner_function_becomes_part_of_others_only() -> None:
    """Code of its own, which nothing would call, takes a fifth of all compilation."""
    dispatcher = inner_dispatcher(twice.function)
    dispatcher.compile((numba.float64,))
    found = dispatcher.overloads[(numba.float64,)]
    engine = found.library.codegen._engine
    assert not engine.is_symbol_defined(found.fndesc.llvm_func_name)
