"""Decorators that compile kernels with numba, which is imported with this module.

A kernel is compiled, or loaded from the cache (`starid.kernels.kernel_cache`), when it is first called with arguments of certain
types. The process that answers the bus imports no module with kernels. Sums are never reordered (no ``fastmath``), so
that a kernel gives the same bytes on each processor, and kernels call the functions of `starid.arithmetic.elementary` in place of those of
`math`. Numba lets a function inherit an option that it does not set from the kernel that calls it, so all set the error model.
"""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Final, TypeVar, cast

from starid.arithmetic import elementary
from starid.kernels.kernel_cache import use_kernel_cache

_CACHED: Final = use_kernel_cache()  # before numba reads its environment

from numba import njit  # noqa: E402
from numba.extending import register_jitable  # noqa: E402

for _function in vars(elementary).values():
    if isinstance(_function, FunctionType):
        register_jitable(error_model="numpy")(_function)

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a function of numbers and plain arrays, cached on disk and run without the GIL."""
    return cast("Kernel", njit(nogil=True, cache=_CACHED, error_model="python")(function))


def compiled_ieee(function: Kernel) -> Kernel:
    """Compile as `compiled`, with IEEE 754 division (x/0 is infinite or NaN, as in numpy arrays).

    Without numba's test of every divisor a loop over pixels has no branch and is vectorised.
    """
    return cast("Kernel", njit(nogil=True, cache=_CACHED, error_model="numpy")(function))


def inner(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, with IEEE 754 division; it is cached as part of them."""
    return cast("Kernel", njit(nogil=True, error_model="numpy")(function))


def inner_checked(function: Kernel) -> Kernel:
    """Compile as `inner`, but division by zero raises an exception, as in `compiled`."""
    return cast("Kernel", njit(nogil=True, error_model="python")(function))


def inlined(function: Kernel) -> Kernel:
    """Merge a function, with IEEE 754 division, into the kernel that calls it, before types are inferred.

    Numba optimises each function with all that it calls, so that the last of a chain of functions is optimised once for each function
    before it. To merge those in the middle saves that; to merge many costs more, because the inference of types slows down.
    """
    return cast("Kernel", njit(nogil=True, error_model="numpy", inline="always")(function))
