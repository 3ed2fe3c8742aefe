"""Loops that run at the speed of C, without Python's lock: the only door to Numba.

A compiled function calls only compiled functions of its own file: what is cached on disk is checked against that file alone.
"""

from collections.abc import Callable
from inspect import unwrap
from typing import Any, TypeVar

import numba

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
