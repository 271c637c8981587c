"""The one numba decorator of the package, typed, so that compiled kernels keep their signatures."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a function of numbers and plain arrays: cached on disk, and free of the interpreter's lock."""
    return cast("Kernel", njit(cache=True, nogil=True)(function))
