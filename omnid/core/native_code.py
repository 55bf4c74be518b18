"""Machine code of compiled functions (compiled.py), made by numba so that it runs without numba.

numba's own entry from Python needs numba's library in addition to the code. The entry made here takes numpy's arrays as
they lie in memory (struct PyArrayObject, the same in numpy 1 and 2 on all processors of 64 bits), checks type, axes,
layout and writability, and returns 0, the number of a wrong array below zero, or numba's status above zero. Of numba's
library a function needs the memory of its arrays only; those few functions become part of its code.

Functions that a compiled function calls are compiled to LLVM's code only, and linked into the caller. numba would
also optimise each of them and make it callable, which takes 1.5 times the processor time for the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numba
import numpy as np
from llvmlite import ir
from numba import _dynfunc
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
from numba.np.arrayobj import populate_array

from omnid.core.kernel_arguments import Argument

# error_model: a division by zero gives inf or NaN as in numpy.
OPTIONS: Final = {"nogil": True, "error_model": "numpy", "fastmath": False, "parallel": False}
# Entries of numba for Python and C, which nothing calls, take a tenth of all compilation.
UNWRAPPED: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# Bytes from the start of an array's struct, and of its type's; source: numpy/core/include/numpy/ndarraytypes.h.
TYPE_AT, DATA_AT, AXES_AT, SHAPE_AT, STRIDES_AT, DTYPE_AT, FLAGS_AT = 8, 16, 24, 32, 40, 56, 64
BYTE_ORDER_AT, NUMBER_AT = 26, 28
CONTIGUOUS, ALIGNED, WRITABLE = 0x1, 0x100, 0x400
# Memory of numba's arrays (source: numba/core/runtime/nrt.h): a count of references first, the address of the data
# fourth; the rest is not used where arrays are made and freed by compiled functions only.
HEADER_BYTES, DATA_FIELD = 64, 3

# So many bits because the fields of numpy's structs have them.
I8, I32, I64 = ir.IntType(8), ir.IntType(32), ir.IntType(64)
ADDRESS: Final = I8.as_pointer()


class _LinkedCode(JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """Code of a function that is linked into another one: only the whole is optimised and made into instructions."""

    def _optimize_final_module(self) -> None:
        """Do nothing, because the code into which this one is linked is optimised."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


def _no_executable(library: Any, description: Any, environment: Any) -> Any:
    """Return an object of the type by which numba knows a compiled function; nothing calls it."""
    module, name = description.lookup_module(), description.qualname
    return _dynfunc.make_function(module, name, "", 0, environment, (library,))


class _LinkedCompiler(CompilerBase):  # type: ignore[misc]
    """numba's way from Python to LLVM's code, which ends before instructions of a processor."""

    def define_pipelines(self) -> list[Any]:
        """Return the steps of numba; their result goes to code that is linked only."""
        state = self.state
        if state.library is None:
            state.library = _LinkedCode(state.targetctx.codegen(), state.func_id.func_qualname)
            state.targetctx = state.targetctx.subtarget(get_executable=_no_executable)
        return [DefaultPassBuilder.define_nopython_pipeline(state)]


def inner_dispatcher(function: Callable[..., object]) -> Any:
    """Return numba's object of a function that becomes part of others."""
    dispatcher = numba.njit(**OPTIONS, **UNWRAPPED, pipeline_class=_LinkedCompiler)(function)
    # An argument such as 0 counts as an integer, not as a type of its own, which would be compiled once more.
    template_for = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: template_for(tuple(map(numba.types.unliteral, args)), kws)
    return dispatcher


def native_code(function: Callable[..., object], symbol: str, arguments: Sequence[Argument]) -> bytes:
    """Compile a function for its arguments and return its code, whose entry has the name symbol."""
    numba_types = tuple(map(_numba_type, arguments))
    dispatcher = numba.njit(**OPTIONS, **UNWRAPPED, pipeline_class=_LinkedCompiler)(function)
    dispatcher.compile(numba_types)
    found = dispatcher.overloads[numba_types]
    if found.fndesc.restype is not types.none:
        raise TypeError(f"{symbol} returns {found.fndesc.restype}: a compiled function writes its results to arrays")
    context = found.target_context
    module = context.create_module(symbol)
    _write_entry(context, module, symbol, (found.fndesc, arguments, numba_types))
    _write_memory(module)
    library = context.codegen().create_library(symbol)
    library.enable_object_caching()
    library.add_ir_module(module)
    with global_compiler_lock:
        library.add_linking_library(found.library)
        library.finalize()
    return bytes(library._get_compiled_object())


def _numba_type(argument: Argument) -> Any:
    """Return numba's type of an argument; arrays that are not written may be read-only ones."""
    number: Any = types.boolean if argument.kind == "b1" else numba.from_dtype(np.dtype(argument.kind))
    if argument.dimensions:
        return types.Array(
            number, argument.dimensions, "C" if argument.is_contiguous else "A", readonly=not argument.is_written
        )
    return numba.types.UniTuple(number, argument.count) if argument.count else number


def _write_entry(context: Any, module: Any, symbol: str, what: tuple[Any, Sequence[Argument], Sequence[Any]]) -> None:
    """Write the entry: (address of numpy's type of arrays, arguments...) -> status.

    what: numba's description of the function, the arguments and their types.
    """
    description, arguments, numba_types = what
    passed = [
        ADDRESS if argument.dimensions or argument.count else context.get_argument_type(kind)
        for argument, kind in zip(arguments, numba_types, strict=True)
    ]
    entry = ir.Function(module, ir.FunctionType(I32, [ADDRESS, *passed]), symbol)
    builder = ir.IRBuilder(entry.append_basic_block())
    values = []
    for number, (argument, kind) in enumerate(zip(arguments, numba_types, strict=True)):
        value = entry.args[number + 1]
        if argument.dimensions:
            is_wrong = _is_wrong(builder, value, argument, entry.args[0])
            with builder.if_then(is_wrong):
                builder.ret(I32(-1 - number))
            values.append(_array(context, builder, value, kind))
        elif argument.count:
            values.append(context.make_tuple(builder, kind, list(_numbers(context, builder, value, kind))))
        else:
            values.append(context.get_argument_value(builder, kind, value))
    function = context.declare_function(module, description)
    status, _ = context.call_conv.call_function(builder, function, description.restype, description.argtypes, values)
    builder.ret(status.code)


def _is_wrong(builder: Any, array: Any, argument: Argument, array_type: Any) -> Any:
    """Return a flag: this is no array of numpy, or not one of the type that the signature names."""
    dtype = np.dtype(argument.kind)
    flags = ALIGNED | CONTIGUOUS * argument.is_contiguous | WRITABLE * argument.is_written
    # 1. Another object has none of the fields below, so it is refused first.
    is_array = builder.icmp_unsigned("==", _field(builder, array, TYPE_AT, ADDRESS), array_type)
    before = builder.basic_block
    with builder.if_then(is_array):
        # 2. Axes, layout, and the type in the processor's order of bytes.
        described = _field(builder, array, DTYPE_AT, ADDRESS)
        swapped = I8(ord(">" if np.little_endian else "<"))
        found = [
            builder.icmp_signed("!=", _field(builder, array, AXES_AT, I32), I32(argument.dimensions)),
            builder.icmp_signed("!=", builder.and_(_field(builder, array, FLAGS_AT, I32), I32(flags)), I32(flags)),
            builder.icmp_signed("!=", _field(builder, described, NUMBER_AT, I32), I32(dtype.num)),
            builder.icmp_signed("==", _field(builder, described, BYTE_ORDER_AT, I8), swapped),
        ]
        differs = found[0]
        for flag in found[1:]:
            differs = builder.or_(differs, flag)
        inside = builder.basic_block
    wrong = builder.phi(ir.IntType(1))
    wrong.add_incoming(ir.IntType(1)(1), before)
    wrong.add_incoming(differs, inside)
    return wrong


def _field(builder: Any, struct: Any, at: int, kind: Any) -> Any:
    """Return a field of a struct at an offset [bytes]."""
    return builder.load(builder.bitcast(builder.gep(struct, [I64(at)]), kind.as_pointer()))


def _array(context: Any, builder: Any, array: Any, kind: Any) -> Any:
    """Return numba's value of an array of numpy, which the caller owns."""
    shape = list(_elements(builder, _field(builder, array, SHAPE_AT, I64.as_pointer()), kind.ndim))
    strides = list(_elements(builder, _field(builder, array, STRIDES_AT, I64.as_pointer()), kind.ndim))
    element = context.get_data_type(kind.dtype)
    value = context.make_array(kind)(context, builder)
    populate_array(
        value,
        data=_field(builder, array, DATA_AT, element.as_pointer()),
        shape=shape,
        strides=strides,
        itemsize=I64(context.get_abi_sizeof(element)),
        meminfo=None,
    )
    return value._getvalue()


def _elements(builder: Any, first: Any, count: int) -> Iterator[Any]:
    return (builder.load(builder.gep(first, [I64(index)])) for index in range(count))


def _numbers(context: Any, builder: Any, address: Any, kind: Any) -> Iterator[Any]:
    """Return numba's values of the numbers of a tuple, which lie one after the other."""
    number = context.get_argument_type(kind.dtype)
    for value in _elements(builder, builder.bitcast(address, number.as_pointer()), kind.count):
        yield context.get_argument_value(builder, kind.dtype, value)


def _write_memory(module: Any) -> None:
    """Write the functions of numba's library that make and free the memory of arrays, by malloc and free."""
    malloc = ir.Function(module, ir.FunctionType(ADDRESS, [I64]), "malloc")
    free = ir.Function(module, ir.FunctionType(ir.VoidType(), [ADDRESS]), "free")
    makes = ir.FunctionType(ADDRESS, [I64, I32])

    def body(name: str, kind: Any) -> tuple[Any, Any]:
        function = ir.Function(module, kind, name)
        function.linkage = "weak_odr"  # each file of code has them
        return function, ir.IRBuilder(function.append_basic_block())

    aligned, builder = body("NRT_MemInfo_alloc_aligned", makes)
    size, align = aligned.args[0], builder.zext(aligned.args[1], I64)
    memory = builder.call(malloc, [builder.add(builder.add(size, align), I64(HEADER_BYTES))])
    is_none = builder.icmp_unsigned("==", memory, ADDRESS(None))
    with builder.if_then(is_none):
        builder.ret(ADDRESS(None))
    fields = builder.bitcast(memory, I64.as_pointer())
    start = builder.add(builder.add(builder.ptrtoint(memory, I64), I64(HEADER_BYTES - 1)), align)
    for index in range(HEADER_BYTES // 8):
        builder.store(I64(1 if index == 0 else 0), builder.gep(fields, [I64(index)]))
    builder.store(builder.and_(start, builder.neg(align)), builder.gep(fields, [I64(DATA_FIELD)]))
    builder.ret(memory)

    plain, builder = body("NRT_Allocate", ir.FunctionType(ADDRESS, [I64]))
    builder.ret(builder.call(malloc, [plain.args[0]]))
    for name in ("NRT_MemInfo_call_dtor", "NRT_Free"):
        end, builder = body(name, ir.FunctionType(ir.VoidType(), [ADDRESS]))
        builder.call(free, [end.args[0]])
        builder.ret_void()
