"""The bound on the probability of an error, against the distributions of SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from starid.attitude import random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.catalog import load_catalog
from starid.errors import StaridError
from starid.identification.error_risk import error_risk, normal_above
from starid.identification.geometric.identifier import Identifier
from starid.identification.options import UNLIMITED_DEG
from starid.identification.solution import Reason

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


def test_the_tail_of_the_normal_distribution() -> None:
    for x in np.linspace(-6.0, 6.0, 101):
        assert normal_above(float(x)) == pytest.approx(stats.norm.sf(x), abs=7.5e-8)


@pytest.mark.parametrize("freedom", [1.0, 2.0])
def test_without_a_variance_nothing_is_known(freedom: float) -> None:
    assert error_risk(np.eye(3) * 1e-12, freedom, LIMIT) == 1.0
    assert error_risk(np.eye(3) * 1e-12, freedom, math.pi) == 0.0


@pytest.mark.long
def test_an_identifier_gives_no_attitude_that_may_be_off_by_more_than_its_limit() -> None:
    """Five stars close together, with noise of up to half a pixel: without a limit, some valid attitudes are wrong."""
    catalog = load_catalog()
    limited, open_ended = (
        Identifier(catalog=catalog, largest_error_deg=largest) for largest in (0.1, UNLIMITED_DEG)
    )
    bright = catalog.brighter_than(5.0)
    wrong = answers = flagged = 0
    for seed in range(150):
        rng = np.random.default_rng(seed)
        truth = random_attitude(rng)
        xy, inside = DEFAULT_CAMERA.project(truth.to_sensor(bright.vectors))
        rows = np.flatnonzero(inside)
        rows = rows[np.argsort(np.hypot(*(xy[rows] - rng.uniform(0.0, 937.0, 2)).T))][:5]
        sigma_px = (0.5, 0.02)[seed % 3 == 0]
        seen = xy[rows] + sigma_px * rng.standard_normal((len(rows), 2))
        flux = 10.0 ** (-0.4 * bright.v[rows])
        errors = np.full(len(rows), sigma_px)
        for predicted in (None, truth):
            first, second = (
                each.identify(seen, flux, errors)
                if predicted is None
                else each.track(seen, flux, predicted, errors)
                for each in (open_ended, limited)
            )
            if not first.valid:
                assert not second.valid
                continue
            answers += 1
            off = first.attitude.error_to(truth)
            is_wrong = max(off.cross_boresight_arcsec, off.roll_arcsec) > 360.0
            wrong += is_wrong
            if second.valid:
                assert not is_wrong
                assert second.quaternion_xyzw.tolist() == first.quaternion_xyzw.tolist()
            else:
                assert second.reason is Reason.UNCERTAIN
                flagged += 1
    assert wrong > 5
    assert wrong <= flagged < answers


@pytest.mark.parametrize("largest", [0.0, 181.0, math.nan])
def test_a_limit_that_makes_no_sense_is_named(largest: float) -> None:
    with pytest.raises(StaridError, match="largest_error_deg"):
        Identifier(largest_error_deg=largest)
