"""Medians and ranks in kernels are those of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from starid.arithmetic.arrays import Array
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import lower_median, median, nth_smallest

pytestmark = [pytest.mark.long, pytest.mark.lowest("numba")]


@compiled_ieee
def ranked(values: Array, count: int) -> tuple[float, float, float]:
    return median(values, count), lower_median(values, count), nth_smallest(values, count, count // 4)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_medians_and_ranks_of_the_first_values_are_those_of_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    for values in (*rng.normal(size=(50, 12)), *np.round(rng.normal(size=(50, 12)))):
        ordered = np.sort(values[:count])
        expected = np.median(ordered), ordered[(count - 1) // 2], ordered[count // 4]
        assert ranked(values, count) == expected
