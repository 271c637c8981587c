"""Operations for kernels, in place of forms that take seconds to compile: on small arrays, and a count from zero."""

from __future__ import annotations

import math

import numpy as np

from starid.arithmetic.arrays import Array, Array32
from starid.kernels.jit import inner


@inner
def zero() -> int:
    """Return 0 as a variable: numba would compile a function to which a constant is passed for that constant too."""
    return int(np.int64(0))


@inner
def copy_values(source: Array | Array32, target: Array | Array32) -> None:
    """Copy an array (n,); assigning to a slice or a row compiles the text of the error for other shapes too."""
    for k in range(target.size):
        target[k] = source[k]


@inner
def nth_smallest(values: Array, count: int, n: int) -> float:
    """The value that is preceded by n others in order, of the first `count`, which are reordered in place (quickselect)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if n <= j:
            high = j
        elif n >= i:
            low = i
        else:
            break
    return float(values[n])


@inner
def lower_median(values: Array, count: int) -> float:
    """Lower median of the first `count` values, which are reordered in place."""
    return nth_smallest(values, count, (count - 1) // 2)


@inner
def median(values: Array, count: int) -> float:
    """Median of the first `count` values, which are reordered in place; of an even number, the mean of both in the middle."""
    lower = lower_median(values, count)
    if count % 2 == 1:
        return lower
    upper = math.inf
    for k in range(count // 2, count):
        upper = min(upper, values[k])
    return 0.5 * (lower + upper)
