"""The bound on the probability of an error, against the distributions of SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from starid.identification.error_risk import error_risk

LIMIT = math.radians(0.1)


@pytest.mark.parametrize("freedom", [5.0, 15.0, 47.0])
@pytest.mark.parametrize("sigmas", [2.0, 4.0, 7.0])
def test_the_risk_across_the_boresight_is_that_of_students_distribution(
    freedom: float, sigmas: float
) -> None:
    """The square of a length over twice that of its scale is F-distributed."""
    sigma = LIMIT / sigmas
    scale2 = sigma**2 * (freedom - 2.0) / freedom
    risk = error_risk(np.diag([sigma**2, sigma**2, 1e-30]), freedom, LIMIT)
    assert risk == pytest.approx(stats.f.sf(0.5 * LIMIT**2 / scale2, 2, freedom), rel=1e-9)


@pytest.mark.parametrize("freedom", [5.0, 15.0, 47.0, 1e4])
@pytest.mark.parametrize("sigmas", [2.0, 4.0, 7.0])
def test_the_risk_about_the_boresight_is_bounded(freedom: float, sigmas: float) -> None:
    """The bound on the tail is at most half as large again, as that of Mills's ratio is from two standard deviations on."""
    sigma = LIMIT / sigmas
    exact = 2.0 * stats.t.sf(sigmas * math.sqrt(freedom / (freedom - 2.0)), freedom)
    risk = error_risk(np.diag([1e-30, 1e-30, sigma**2]), freedom, LIMIT)
    assert exact < risk < 1.5 * exact


def test_the_larger_axis_counts() -> None:
    """Errors across the boresight are correlated: the longest axis of their ellipse is between x and y."""
    sigma = LIMIT / 5.0
    turned = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1e-20]]) * sigma**2
    straight = np.diag([sigma**2, 0.0, 1e-20 * sigma**2])
    assert error_risk(turned, 15.0, LIMIT) == pytest.approx(error_risk(straight, 15.0, LIMIT))
    assert error_risk(turned, 15.0, LIMIT) > 1e-5
    assert error_risk(turned / 4.0, 15.0, LIMIT) < 1e-5
