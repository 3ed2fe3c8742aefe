"""Loops that run at the speed of C, without Python's lock: the only door to Numba.

A compiled function calls only compiled functions of its own file: what is cached on disk is checked against that file alone.
"""

from collections.abc import Callable
from inspect import unwrap
from typing import Any, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compiles on first use for the types of its arguments, and keeps the result on disk.

    Threads run it side by side. Floating-point rules stay those of IEEE 754, but for products and sums, which may be fused.
    Division by zero gives infinity or NaN as in NumPy, without an exception.
    """
    settings: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
    bare = unwrap(function)  # the tests wrap every function of the package to check its shapes
    try:
        return numba.njit(bare, cache=True, **settings)
    except RuntimeError:  # no folder that Numba may write to: compile in every process
        return numba.njit(bare, **settings)


def _called(context: Any, address: Any, words: Any) -> Any:
    def written(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        shape = ir.FunctionType(ir.VoidType(), [ir.IntType(numba.types.intp.bitwidth)] * len(words))
        builder.call(builder.inttoptr(given[0], shape.as_pointer()), cgutils.unpack_tuple(builder, given[1]))
        return context.get_dummy_value()

    return numba.types.void(numba.types.intp, numba.types.UniTuple(numba.types.intp, len(words))), written


call_at = intrinsic(unwrap(_called))
"""`call_at(address, (word, ...))` calls a C function that takes addresses, and returns nothing, from a compiled function.

By address, not by name: another library of the process may have functions of the same name, and what is compiled may be kept on
disk. It becomes part of what calls it, so a change here is not noticed there: such a file has to be touched.
"""
