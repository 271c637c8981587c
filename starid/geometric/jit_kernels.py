"""The numba decorators for identification: few entries, and many small functions behind them.

Only an entry can be called from Python, and only an entry is kept on disk, with all that it calls inside.
The functions behind it go without the wrappers that numba makes for callers in Python and C, which would take
longer to compile than they themselves. Divisions follow IEEE 754.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

from starid.jit import stamped

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def entry(function: Kernel) -> Kernel:
    """Compile a function that Python calls: cached on disk, and free of the interpreter's lock."""
    return cast("Kernel", stamped(njit(cache=True, nogil=True, error_model="numpy")(function)))


def inner(function: Kernel) -> Kernel:
    """Compile a function that only other kernels call."""
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
    return cast("Kernel", njit(nogil=True, **options)(function))
