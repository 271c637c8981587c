"""Bad, insufficient and unusual input of the identifier."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from starid.attitude import Attitude
from starid.camera import Camera, Model
from starid.catalog import load_catalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Effort, Identifier
from starid.identification.single_camera import FARTHEST_PX
from starid.identification.solution import Reason, Solution
from tests.starid.identification.geometric.sky_points import identifier, sky

AT = Attitude.from_radec_roll(80.0, 10.0, 30.0)
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("xy", "flux", "sigma", "message"),
    [
        ([[NAN, 1.0]], [1.0], None, "finite"),
        ([[1.0, INF]], [1.0], None, "finite"),
        ([[1.0, 1e200]], [1.0], None, "within ±1e\\+09 pixels"),
        ([[-1.1e9, 1.0]], [1.0], None, "within ±1e\\+09 pixels"),
        ([[1.0, 1.0]], [NAN], None, "finite"),
        ([[1.0, 1.0]], [INF], None, "finite"),
        ([[1.0, 1.0]], [1.0, 2.0], None, r"not \(1, 2\) and \(2,\)"),
        ([1.0, 2.0, 3.0], [1.0], None, r"not \(3,\) and"),
        ([[1.0, 2.0, 3.0]], [1.0], None, r"not \(1, 3\) and"),
        (5.0, [1.0], None, r"not \(\) and"),
        ([[1.0, 1.0], [2.0]], [1.0, 1.0], None, "positions must be an array of numbers"),
        ([[1.0, 1.0]], ["bright"], None, "flux must be an array of numbers"),
        ([[1.0, 1.0]], [1.0], [0.0], "positive"),
        ([[1.0, 1.0]], [1.0], [NAN], "positive"),
        ([[1.0, 1.0]], [1.0], [1.0, 1.0], r"errors .*, not \(2,\)"),
        ([[1.0, 1.0]], [1.0], [[1.0, 1.0, 1.0]], r"errors .*, not \(1, 3\)"),
    ],
)
def test_bad_arrays_are_rejected_in_one_line(xy: object, flux: object, sigma: object, message: str) -> None:
    for ask in (identifier().identify, lambda a, b, c: identifier().track(a, b, AT, c)):
        with pytest.raises(StaridError, match=message) as caught:
            ask(xy, flux, sigma)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("least", "ask"),
    [
        (4, lambda xy, flux: identifier().identify(xy, flux)),
        (4, lambda xy, flux: identifier().verify(xy, flux, AT, window_px=12.0)),
        (3, lambda xy, flux: identifier().track(xy, flux, AT)),
        (2, lambda xy, flux: identifier().track(xy, flux, AT, np.full(len(flux), 0.3))),
    ],
)
def test_too_few_detections_are_reported(least: int, ask: Callable[..., Solution]) -> None:
    xy, flux, _ = sky(AT)
    for count in range(least):
        solution = ask(xy[:count], flux[:count])
        assert (solution.valid, solution.reason, solution.star_count) == (False, Reason.TOO_FEW_STARS, 0)
        with pytest.raises(StaridError, match="too_few_stars"):
            _ = solution.attitude
    assert ask(xy[:least], flux[:least]).reason is not Reason.TOO_FEW_STARS


def test_an_empty_list_means_no_detections() -> None:
    assert identifier().identify([], []).reason is Reason.TOO_FEW_STARS


@pytest.mark.parametrize("count", [4, 30, 200])
def test_coincident_detections_are_not_identified(count: int) -> None:
    solution = identifier().identify(np.full((count, 2), 300.0), np.ones(count))
    assert (solution.valid, solution.reason) == (False, Reason.NO_MATCH)


def test_a_star_detected_twice_is_matched_once() -> None:
    xy, flux, _ = sky(AT)
    solution = identifier().identify(np.concatenate([xy, xy]), np.concatenate([flux, flux]))
    assert solution.valid
    assert len(set(solution.hip.tolist())) == solution.star_count
    assert solution.attitude.error_to(AT).total_arcsec < 100.0


def test_detections_without_flux_count_as_faintest() -> None:
    xy, flux, _ = sky(AT)
    dark = flux.copy()
    dark[::3], dark[3::6] = 0.0, -5.0
    solution = identifier().identify(xy, dark)
    assert solution.valid
    assert not set(solution.detection_index.tolist()) & set(np.flatnonzero(dark <= 0.0).tolist())


def test_input_arrays_are_not_modified() -> None:
    xy, flux, _ = sky(AT)
    before = xy.copy(), flux.copy()
    identifier().identify(xy, flux)
    assert (xy == before[0]).all()
    assert (flux == before[1]).all()


def test_single_precision_lists_and_strided_arrays_are_accepted() -> None:
    xy, flux, _ = sky(AT)
    expected = identifier().identify(xy, flux).quaternion_xyzw
    strided = np.zeros((len(xy), 6))
    strided[:, 1:4:2] = xy
    for positions in (xy.tolist(), np.asfortranarray(xy), strided[:, 1:4:2]):
        assert identifier().identify(positions, flux.tolist()).quaternion_xyzw == pytest.approx(expected)
    single = identifier().identify(xy.astype(np.float32), flux.astype(np.float32))
    assert single.attitude.error_to(AT).total_arcsec < 100.0


@pytest.mark.parametrize("window", [0.0, -1.0, NAN, INF])
def test_a_tracking_window_must_be_positive(window: float) -> None:
    xy, flux, _ = sky(AT)
    with pytest.raises(StaridError, match="window_px"):
        identifier().track(xy, flux, AT, window_px=window)


@pytest.mark.parametrize("tolerance", [-0.01, 0.31, NAN])
def test_a_tolerance_of_the_field_must_be_in_range(tolerance: float) -> None:
    with pytest.raises(StaridError, match="fov_tolerance"):
        Identifier(fov_tolerance=tolerance)


@pytest.mark.parametrize(
    "change",
    [{"tolerance_px": 0.0}, {"max_triangles": -1}, {"window_px": NAN}, {"max_false_probability": INF},
     {"part_stars": -1}, {"part_stars": 31}],
)  # fmt: skip
def test_an_effort_out_of_range_is_rejected_by_name(change: dict[str, float]) -> None:
    with pytest.raises(StaridError, match=next(iter(change))):
        Effort(**change)


@pytest.mark.parametrize("limit", [None, 6.0])
def test_a_catalogue_without_stars_is_rejected(limit: float | None) -> None:
    with pytest.raises(StaridError, match="identifier catalog: contains no stars"):
        Identifier(catalog=load_catalog().brighter_than(-5.0), limiting_magnitude=limit, cache=False)


@pytest.mark.long
@pytest.mark.parametrize("model", ["pinhole", "equidistant", "flat"])
def test_a_position_far_outside_the_image_counts_as_a_false_star(model: Model) -> None:
    camera = Camera.from_fov(42.0, model=model)
    stars = load_catalog().brighter_than(5.5)
    xy, inside = camera.project(AT.to_sensor(stars.vectors))
    xy = xy[inside]
    xy[0, 0] = -FARTHEST_PX
    solution = Identifier(camera, limiting_magnitude=6.0).identify(xy, 10.0 ** (-0.4 * stars.v[inside]))
    assert solution.valid
    assert 0 not in solution.detection_index


def test_a_camera_of_another_size_is_rejected() -> None:
    with pytest.raises(StaridError, match="937×937"):
        identifier().with_camera(Camera.from_fov(42.0, 640, 480))


def test_a_valid_solution_cannot_have_a_reason_for_being_invalid() -> None:
    with pytest.raises(StaridError, match="no_match"):
        Solution(valid=True, reason=Reason.NO_MATCH)
