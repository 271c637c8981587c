"""Medians in kernels are those of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from starid.arithmetic.arrays import Array
from starid.kernels.jit import compiled_ieee
from starid.kernels.small_arrays import lower_median, median

pytestmark = [pytest.mark.long, pytest.mark.lowest("numba")]


@compiled_ieee
def both(values: Array, count: int) -> tuple[float, float]:
    return median(values, count), lower_median(values, count)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_medians_of_the_first_values_are_those_of_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    for values in (*rng.normal(size=(50, 12)), *np.round(rng.normal(size=(50, 12)))):
        expected = np.median(values[:count]), np.sort(values[:count])[(count - 1) // 2]
        assert both(values, count) == expected
