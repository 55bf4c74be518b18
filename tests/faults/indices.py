"""All compiled functions with checks of their indices, which the product leaves out: a plugin for pytest.

    python -m pytest -p tests.faults.indices -n 2 --dist loadfile tests/omnid/core tests/omnid/stages tests/replay

An index outside of its array is an IndexError there, which names the function. The tests of the compiler itself
(test_compiled.py, test_native_code.py) do not fit to it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numba

from omnid.core import compiled, native_code

OPTIONS = {**native_code.OPTIONS, "boundscheck": True}
_checked: dict[str, Any] = {}


def inner_dispatcher(function: Callable[..., object]) -> Any:
    """Return numba's object of a function that becomes part of others."""
    dispatcher = numba.njit(**OPTIONS)(function)
    template_for = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: template_for(tuple(map(numba.types.unliteral, args)), kws)
    return dispatcher


def call(self: compiled.Kernel[..., object], *args: object, **kwargs: object) -> None:
    """Call a compiled function with checks."""
    if self.symbol not in _checked:
        types = tuple(map(native_code._numba_type, self.arguments))
        _checked[self.symbol] = numba.njit(types, **OPTIONS)(self.function)
    _checked[self.symbol](*inspect.signature(self.function).bind(*args, **kwargs).args)


native_code.inner_dispatcher = inner_dispatcher
compiled.Kernel.__call__ = call  # type: ignore[method-assign, assignment]
