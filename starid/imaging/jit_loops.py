"""The numba decorator for loops over pixels, which the compiler has to turn into vector instructions."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

from starid.jit import stamped

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled_loops(function: Kernel) -> Kernel:
    """Compile a function whose divisions follow IEEE 754 (x/0 is infinite or NaN, as in numpy arrays).

    Without numba's test of every divisor a loop over pixels has no branch left and becomes vector instructions.
    The result is cached on disk and runs free of the interpreter's lock.
    """
    return cast("Kernel", stamped(njit(cache=True, nogil=True, error_model="numpy")(function)))


def compiled_sums(function: Kernel) -> Kernel:
    """As `compiled_loops`, and sums may be taken in any order, so that they become vector instructions too."""
    fast = {"reassoc", "nsz", "contract"}
    kernel = njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function)
    return cast("Kernel", stamped(kernel))
