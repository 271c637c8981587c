from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starid.attitude import ARCSEC_PER_RAD
from starid.camera import Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.identification.geometric.identifier import Identifier
from starid.identification.geometric.pattern_stars import select_pattern_stars
from starid.imaging.detection import DetectionSettings, detect
from starid.photograph import field_sweep, solver
from starid.photograph.field_sweep import FieldSweep, solve_any_field
from starid.photograph.rough_search import CELLS, RoughSearch, distorted, even_selection
from starid.photograph.solver import ImageSolution, solve_image
from starid.photograph.typical_camera import blend_in_typical, typical_camera
from starid.photograph.views import View, correlation, has_dark_tail, views
from tests.starid.photograph.night_sky import FOV_DEG, HEIGHT, WIDTH, photograph

pytestmark = pytest.mark.long

CENTRE_ARCSEC = 10.0
NOMINAL = Camera.from_fov(FOV_DEG * 0.92, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def sky() -> StarCatalog:
    return load_catalog()


def centre_error_arcsec(found: ImageSolution, truth, camera: Camera) -> float:
    """Angle between the true and the found direction of the centre of the image."""
    middle = np.array([[(WIDTH - 1) / 2, (HEIGHT - 1) / 2]])
    seen = found.solution.attitude.to_icrs(found.camera.back_project(middle))[0]
    true = truth.to_icrs(camera.back_project(middle))[0]
    return float(np.linalg.norm(seen - true) * ARCSEC_PER_RAD)


@pytest.mark.parametrize(
    ("seed", "defects"),
    [
        (1, {}),
        (2, {"distortion": -0.1}),
        (3, {"distortion": 0.05}),
        (4, {"foreground": 0.5}),
        (5, {"spot_px": 5.0}),
    ],
    ids=["plain", "barrel", "pincushion", "hill", "out of focus"],
)
def test_attitude_field_and_distortion_of_a_photograph_are_found(sky, seed, defects) -> None:
    image, truth, camera = photograph(sky, seed, **defects)
    solution = solve_image(image, NOMINAL, sky, fov_tolerance=0.1)
    assert solution.solution.valid
    assert not solution.mirrored
    assert centre_error_arcsec(solution, truth, camera) < CENTRE_ARCSEC
    assert solution.camera.fov_deg == pytest.approx(camera.fov_deg, rel=2e-3)


WIDE = {"fov_deg": 34.0, "width": 808, "height": 608}
HOT_WIDE = 2000 / (808 * 608)


@pytest.mark.parametrize(
    ("seed", "defects"),
    [
        (24003, {"hot": 2000 / 480000, "quality": 85}),
        (48003, WIDE | {"hot": HOT_WIDE, "limit": 6.0, "spot_px": 0.8, "clouds": 0.9}),
        (45000, {"hot": 2000 / 480000, "spot_px": 0.45}),
        (
            54001,
            WIDE
            | {"distortion": -0.12, "straight": 0.8, "hot": 5000 / (808 * 608), "spot_px": 0.8, "limit": 6.0},
        ),
    ],
    ids=["compressed", "clouds", "sharper than a pixel", "distortion removed"],
)
def test_hot_pixels_without_a_dark_frame_neither_hide_the_stars_nor_cost_much(
    sky, monkeypatch, seed, defects
) -> None:
    image, truth, camera = photograph(sky, seed, **defects)
    monkeypatch.setattr(solver, "SCHEDULE", solver.SCHEDULE[:1])  # the others are there for other defects
    rough = Camera.from_fov(camera.fov_deg * 0.95, camera.width, camera.height)
    found = solve_image(image, rough, sky, fov_tolerance=0.1)
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    seen = found.solution.attitude.to_icrs(found.camera.back_project(middle))[0]
    pixel_arcsec = camera.pixel_scale_rad * ARCSEC_PER_RAD
    assert (
        np.linalg.norm(seen - truth.to_icrs(camera.back_project(middle))[0]) * ARCSEC_PER_RAD < pixel_arcsec
    )


def grain(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(0.0, 4.0, (608, 808))


def counts(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


DARK = {
    "independent": counts(10.0 + grain(1)),
    "demosaiced": counts(cv2.GaussianBlur(10.0 + grain(2), (0, 0), 0.8)),
    "enlarged": cv2.resize(counts(10.0 + grain(3)), (1600, 1200), interpolation=cv2.INTER_CUBIC),
    "compressed": cv2.imdecode(
        cv2.imencode(".jpg", counts(4.0 + grain(4)), [cv2.IMWRITE_JPEG_QUALITY, 80])[1], -1
    ),
}


@pytest.mark.parametrize("name", DARK)
def test_a_frame_without_stars_is_reported_as_such_without_a_search(sky, monkeypatch, name) -> None:
    def search(*_: object, **__: object) -> None:
        raise AssertionError("no search for stars that are not there")

    monkeypatch.setattr(RoughSearch, "identify", search)
    found = solve_any_field(DARK[name], sky)
    assert found.solution.reason == "too_few_stars"
    assert len(found.detections) < 4


def test_the_noise_of_a_resampled_image_is_taken_as_the_detection_smooths_it() -> None:
    assert correlation(counts(50.0 + grain(5))) == pytest.approx(1.0, abs=0.02)
    blurred = counts(50.0 + cv2.GaussianBlur(4.0 * grain(6), (0, 0), 1.5))
    expected = 1.5 / math.hypot(1.5, 0.9) * 2.0 * math.sqrt(math.pi) * 0.9
    assert correlation(blurred) == pytest.approx(expected, rel=0.1)


def test_a_hopeless_search_ends_with_its_time_and_reports_its_progress(sky) -> None:
    image, _, _ = photograph(sky, 9)
    mixed = image.reshape(20, 30, 20, 40).swapaxes(0, 2).reshape(image.shape)  # stars, but no constellation
    attempts: list[str] = []
    found = solve_image(mixed, NOMINAL, sky, fov_tolerance=0.1, time_limit_s=0.0, progress=attempts.append)
    assert found.solution.reason == "no_match"
    assert not found.complete
    assert attempts == ["round 1 of 5, view 1, field 10° wide"]


def test_what_compression_leaves_is_not_taken_for_noise_of_light(sky) -> None:
    image, *_ = photograph(sky, 17001, quality=50)
    found, noiseless = detect(image), detect(image, DetectionSettings(gain_e_per_dn=1e9))
    assert len(found) == len(noiseless) > 20
    assert found.xy_sigma_px == pytest.approx(noiseless.xy_sigma_px, rel=1e-3)


def test_negative_and_mirrored_photographs_are_recognised(sky) -> None:
    image, truth, camera = photograph(sky, 6)
    negative = solve_image(np.invert(image), NOMINAL, sky, fov_tolerance=0.1)
    assert centre_error_arcsec(negative, truth, camera) < CENTRE_ARCSEC
    mirror = solve_image(np.ascontiguousarray(image[:, ::-1]), NOMINAL, sky, fov_tolerance=0.1)
    assert mirror.mirrored
    assert centre_error_arcsec(mirror, truth, camera) < CENTRE_ARCSEC
    on_image = mirror.on_image(mirror.detections.xy_px)
    np.testing.assert_allclose(on_image[:, 0], WIDTH - 1 - mirror.detections.xy_px[:, 0])


def test_a_failed_lens_calibration_keeps_the_solution(sky, monkeypatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise StaridError("calibration: folds the image")

    image, truth, camera = photograph(sky, 1)
    monkeypatch.setattr(solver, "calibrate_identified", fail)
    found = solve_image(image, NOMINAL, sky, fov_tolerance=0.1)
    assert found.solution.valid
    assert centre_error_arcsec(found, truth, camera) < CENTRE_ARCSEC


def test_random_stars_are_not_identified(sky) -> None:
    rng = np.random.default_rng(7)
    search = RoughSearch(NOMINAL, sky, fov_tolerance=0.1)
    xy = rng.uniform(0.0, [WIDTH - 1, HEIGHT - 1], (100, 2))
    assert not search.identify(xy, 10.0 ** rng.uniform(0, 2, 100), rounds=[0]).valid


def test_an_unknown_field_is_found_by_trying(sky, monkeypatch) -> None:
    image, truth, camera = photograph(sky, 8)
    monkeypatch.setattr(field_sweep, "FIELDS_DEG", (6.2, 9.3))
    found = solve_any_field(image, sky)
    assert centre_error_arcsec(found, truth, camera) < CENTRE_ARCSEC
    assert found.camera.fov_deg == pytest.approx(FOV_DEG, rel=2e-3)


def test_a_sweep_makes_each_search_once_for_all_its_images(sky, monkeypatch) -> None:
    made: list[float] = []

    def noted(camera, *arguments, **options):
        made.append(camera.fov_deg)
        return RoughSearch(camera, *arguments, **options)

    monkeypatch.setattr(field_sweep, "FIELDS_DEG", (6.2, 9.3))
    monkeypatch.setattr(field_sweep, "RoughSearch", noted)
    sweep = FieldSweep(WIDTH, HEIGHT, sky)
    for seed in (8, 1):
        image, truth, camera = photograph(sky, seed)
        assert centre_error_arcsec(sweep.solve(image), truth, camera) < CENTRE_ARCSEC
    assert len(made) == 2


def test_fields_of_the_sweep_leave_no_gap() -> None:
    fields = np.sort(field_sweep.FIELDS_DEG)
    reach = 1.0 + field_sweep.TOLERANCE
    assert (fields[1:] / fields[:-1] <= reach / (1.0 - field_sweep.TOLERANCE)).all()
    assert fields[0] < 6.0
    assert fields[-1] > 62.0


def test_similar_cameras_share_an_index_with_pixels_no_finer_than_theirs() -> None:
    one = typical_camera(Camera.from_fov(10.4, 1024, 768))
    assert one is not None
    assert one == typical_camera(Camera.from_fov(11.0, 1280, 960))
    for width, fov_deg in ((640, 6.0), (1024, 11.4), (4000, 25.0)):
        camera = Camera.from_fov(fov_deg, width, width * 3 // 4)
        typical = typical_camera(camera)
        assert typical is not None
        assert typical.pixel_scale_rad > camera.pixel_scale_rad
    assert typical_camera(Camera.from_fov(120.0, 1000, 1000)) is None


@pytest.mark.parametrize("fov_deg", [19.0, 20.0, 21.0])
def test_stars_that_the_image_shows_apart_are_not_merged_whatever_the_first_field(sky, fov_deg) -> None:
    """26237 and 26268 are 2.2 pixels apart, 25044 and 25028 2.1; a typical camera has pixels 1.2 times as large."""
    camera = Camera.from_fov(20.0, 640, 480)
    search = RoughSearch(Camera.from_fov(fov_deg, 640, 480), sky, fov_tolerance=0.1)
    assert {26237, 26268, 25044, 25028} <= set(search.identifier.stars.hip.tolist())
    assert (
        blend_in_typical(camera, typical_camera(camera)) * typical_camera(camera).pixel_scale_rad
        <= 2.0 * camera.pixel_scale_rad * 1.01
    )


def test_an_even_selection_has_the_brightest_of_each_part() -> None:
    rng = np.random.default_rng(9)
    xy = np.concatenate(
        [rng.uniform(0, [WIDTH, HEIGHT], (300, 2)), rng.uniform(0, 40, (300, 2))]
    )  # half of all are in one corner
    flux = rng.uniform(1.0, 100.0, 600)
    brightest = np.argsort(-flux)
    rows = even_selection(xy, brightest, NOMINAL, 2)
    assert brightest[0] in rows
    assert np.count_nonzero(rows >= 300) <= 2
    assert CELLS < len(rows) <= 2 * CELLS + 40
    assert (np.diff(flux[rows]) <= 0.0).all()


@pytest.mark.parametrize("displacement", [-0.12, 0.05])
def test_a_distorted_lens_keeps_the_width_of_the_field(displacement) -> None:
    lens = distorted(NOMINAL, displacement)
    assert lens.fov_deg == pytest.approx(NOMINAL.fov_deg)
    corner = np.array([[-0.5, -0.5]])
    at_centre = lens.focal_px[0] / NOMINAL.focal_px[0]
    seen = NOMINAL.project(lens.back_project(corner))[0] - np.array(NOMINAL.centre_px)
    stretch = np.linalg.norm(corner - np.array(NOMINAL.centre_px)) / np.linalg.norm(seen) / at_centre
    assert stretch == pytest.approx(1.0 + displacement, abs=0.03)


def test_a_negative_is_recognised_by_its_dark_tail(sky) -> None:
    image, _, _ = photograph(sky, 10)
    assert not has_dark_tail(image)
    assert has_dark_tail(np.invert(image))
    ways = list(views(image))
    assert isinstance(ways[0], View)
    assert [view.mirrored for view in ways] == [False] * (len(ways) - 1) + [True]


@pytest.mark.parametrize("bits", [8, 16])
def test_a_coarser_view_gives_the_same_detections(sky, bits) -> None:
    image, _, _ = photograph(sky, 12, trail_px=12.0)
    if bits == 16:
        image = image.astype(np.uint16) * 100
    plain, coarse = (view.detections for view in list(views(image))[:2])
    distance, twin = cKDTree(coarse.xy_px).query(plain.xy_px)
    bright = (distance < 1.0) & (plain.flux > 20.0 * plain.flux_sigma)
    assert np.count_nonzero(bright) > 20
    ratio = coarse.flux[twin[bright]] / plain.flux[bright]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    errors = coarse.flux_sigma[twin[bright]] / plain.flux_sigma[bright]
    assert np.median(errors) == pytest.approx(1.0, abs=0.3)
    assert coarse.background == pytest.approx(plain.background, rel=0.01)
    assert coarse.noise == pytest.approx(plain.noise, rel=0.2)
    assert coarse.trail_px == pytest.approx(plain.trail_px, rel=0.1)


def test_pattern_stars_match_the_plain_rule() -> None:
    rng = np.random.default_rng(11)
    vectors = rng.normal(size=(1500, 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    area, quota = 0.15, 4
    near = vectors @ vectors.T >= 1.0 - area / (2.0 * np.pi)
    taken = np.zeros(1500, dtype=bool)
    for star in range(1500):
        taken[star] = np.count_nonzero(near[star] & taken) < quota
    np.testing.assert_array_equal(select_pattern_stars(vectors, area, quota), np.flatnonzero(taken))


def test_narrow_windows_are_tried_for_all_fields_before_wide_ones(sky, monkeypatch) -> None:
    image, _, camera = photograph(sky, 1)
    windows: list[tuple[float, float]] = []
    identify = Identifier.identify

    def noted(self, *arguments, **options):
        windows.append((self.camera.fov_deg, self._effort.window_px))
        return identify(self, *arguments, **options)

    monkeypatch.setattr(Identifier, "identify", noted)
    monkeypatch.setattr(field_sweep, "FIELDS_DEG", (40.0, 20.0, FOV_DEG * (HEIGHT / WIDTH) ** 0.5))
    found = solve_any_field(image, sky)
    assert found.solution.valid
    assert found.camera.fov_deg == pytest.approx(camera.fov_deg, rel=2e-3)
    del windows[0]  # the warm-up
    sweep = windows[: 1 + next(n for n, (fov, _) in enumerate(windows) if abs(fov / FOV_DEG - 1.0) < 0.1)]
    assert {window for _, window in sweep} == {sweep[0][1]}
