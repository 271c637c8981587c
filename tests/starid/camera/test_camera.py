"""Camera against OpenCV's projections, against itself, and against numerical derivatives."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.camera.camera import flat_view
from starid.errors import StaridError

pytestmark = pytest.mark.lowest("numpy")

ROUND_TRIP_PX = 1e-6
SAME_AS_OPENCV_PX = 1e-9

CAMERAS = {
    "default": DEFAULT_CAMERA,
    "narrow": Camera.from_fov(5.0, 1024, 768),
    "barrel": Camera.from_fov(60.0, 937, 937, distortion=(-0.25, 0.08, 1e-3, -2e-3, 0.01)),
    "pincushion": Camera.from_fov(90.0, 640, 480, distortion=(0.3,)),
    "calibrated": Camera(
        1024, 768, (1300.0, 1310.0), (500.0, 390.0), "pinhole", (-0.1, 0.05, 1e-3, 5e-4, 0.0)
    ),
    "equidistant": Camera.from_fov(90.0, model="equidistant"),
    "fisheye": Camera.from_fov(170.0, model="equidistant", distortion=(-0.02, 0.001, 1e-4, -2e-4, 0.0)),
    "flat": Camera.from_fov(42.0, model="flat"),
    "flat distorted": Camera.from_fov(42.0, model="flat", distortion=(-0.05, 0.01, 1e-3, 1e-3, 0.0)),
}


def image_positions(camera: Camera, n: int = 4000, seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    inner = rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (n, 2))
    return np.concatenate([inner, camera.border(33)])


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_project_and_back_project_are_inverse_over_the_whole_image(camera: Camera) -> None:
    xy = image_positions(camera)
    vectors = camera.back_project(xy)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-14)
    again, inside = camera.project(vectors)
    np.testing.assert_allclose(again, xy, atol=ROUND_TRIP_PX)
    assert inside[:4000].all()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_only_directions_that_the_image_sees_are_inside(camera: Camera) -> None:
    """A direction is inside if and only if its pixel projects back to it: nothing is folded in."""
    vectors = np.random.default_rng(6).standard_normal((200_000, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    xy, inside = camera.project(vectors)
    np.testing.assert_allclose(camera.back_project(xy[inside]), vectors[inside], atol=1e-9)
    reach = np.arccos(np.clip(vectors[inside][:, 2], -1, 1)).max()
    assert reach <= camera.field_radius_rad + 1e-3
    solid_angle = 4.0 * math.pi * inside.mean()
    assert solid_angle == pytest.approx(solid_angle_by_area(camera), rel=0.12)


def solid_angle_by_area(camera: Camera) -> float:
    """Solid angle of the image, from the areas of pixels on the sphere, on a coarse grid."""
    x, y = np.linspace(-0.5, camera.width - 0.5, 60), np.linspace(-0.5, camera.height - 0.5, 60)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    v = camera.back_project(grid.reshape(-1, 2)).reshape(60, 60, 3)
    cross = np.cross(v[1:, 1:] - v[:-1, :-1], v[1:, :-1] - v[:-1, 1:])
    return float(0.5 * np.linalg.norm(cross, axis=-1).sum())


@pytest.mark.parametrize("name", ["default", "barrel", "pincushion", "calibrated"])
def test_pinhole_agrees_with_opencv(name: str) -> None:
    camera = CAMERAS[name]
    vectors = camera.back_project(image_positions(camera, 500))
    matrix = np.array(
        [
            [camera.focal_px[0], 0, camera.centre_px[0]],
            [0, camera.focal_px[1], camera.centre_px[1]],
            [0, 0, 1],
        ]
    )
    theirs, _ = cv2.projectPoints(vectors, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.project(vectors)[0], theirs[:, 0], atol=SAME_AS_OPENCV_PX)


def test_equidistant_agrees_with_opencv_fisheye() -> None:
    camera = Camera.from_fov(120.0, model="equidistant", distortion=(-0.02, 0.003, 0.0, 0.0, -0.0005))
    vectors = camera.back_project(image_positions(camera, 500))
    vectors = vectors[vectors[:, 2] > 0.05]
    matrix = np.array(
        [
            [camera.focal_px[0], 0, camera.centre_px[0]],
            [0, camera.focal_px[1], camera.centre_px[1]],
            [0, 0, 1],
        ]
    )
    k1, k2, _, _, k3 = camera.distortion
    theirs, _ = cv2.fisheye.projectPoints(
        vectors[:, None], np.zeros(3), np.zeros(3), matrix, np.array([k1, k2, k3, 0.0])
    )
    np.testing.assert_allclose(camera.project(vectors)[0], theirs[:, 0], atol=1e-7)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_jacobian_is_the_derivative(camera: Camera) -> None:
    centre = np.array([camera.centre_px])
    vectors = camera.back_project(np.concatenate([image_positions(camera, 200), centre, centre + 1e-3]))
    jacobian = camera.jacobian(vectors)
    h = 1e-6
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = h
        slope = (camera.project(vectors + step)[0] - camera.project(vectors - step)[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[:, :, axis], slope, atol=1e-4 * camera.focal_px[0])
        np.testing.assert_allclose(np.nanmedian(np.abs(jacobian[:, :, axis] - slope)), 0.0, atol=1e-4)
    along = np.einsum("nij,nj->ni", jacobian, vectors)
    np.testing.assert_allclose(along, 0.0, atol=1e-9 * camera.focal_px[0])


@pytest.mark.parametrize("model", ["pinhole", "equidistant", "flat"])
@pytest.mark.parametrize("fov", [5.0, 42.0, 90.0, 150.0])
@pytest.mark.parametrize("distortion", [(), (-0.01, 0.0, 1e-4, 2e-4)])
def test_from_fov_has_the_requested_field(model: str, fov: float, distortion: tuple[float, ...]) -> None:
    if model == "pinhole" and fov > 100:
        distortion = ()  # the terms above would fold such a wide field
    camera = Camera.from_fov(fov, 937, 701, model, distortion)
    assert camera.fov_deg == pytest.approx(fov, abs=1e-9)
    row = camera.centre_px[1]
    left, right = camera.back_project([[-0.5, row], [936.5, row]])
    between = math.degrees(math.atan2(np.linalg.norm(np.cross(left, right)), left @ right))
    assert between == pytest.approx(fov, abs=1e-3)


def test_default_camera_is_the_camera_of_the_thesis() -> None:
    assert (DEFAULT_CAMERA.width, DEFAULT_CAMERA.height) == (937, 937)
    assert DEFAULT_CAMERA.fov_deg == pytest.approx(42.0, abs=1e-12)
    assert DEFAULT_CAMERA.focal_px[0] == pytest.approx(468.5 / math.tan(math.radians(21.0)), rel=1e-15)
    assert DEFAULT_CAMERA.centre_px == (468.0, 468.0)
    assert DEFAULT_CAMERA.pixel_scale_rad == pytest.approx(1 / DEFAULT_CAMERA.focal_px[0], rel=1e-15)


def test_axes_run_right_and_down() -> None:
    xy, inside = DEFAULT_CAMERA.project([[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1], [0, 0, -1]])
    assert xy[0] == pytest.approx([468, 468])
    assert xy[1, 0] > 468
    assert xy[2, 1] > 468
    assert inside.tolist() == [True, True, True, False]


def test_pixel_array_ends_half_a_pixel_beyond_the_outer_centres() -> None:
    camera = DEFAULT_CAMERA
    vectors = camera.back_project([[-0.499, 10], [-0.501, 10], [936.499, 10], [936.501, 10], [10, 936.501]])
    xy, inside = camera.project(vectors)
    assert inside.tolist() == [True, False, True, False, False]
    assert np.isfinite(xy).all(), "light of stars just outside spills in, so their position is needed"


def test_strong_barrel_does_not_fold_outer_stars_in() -> None:
    """With k1 = −0.25 the polynomial turns back: a star at 75° would land inside without the limit."""
    camera = Camera.from_fov(40.0, distortion=(-0.25,))
    naive = [math.tan(a) * (1 - 0.25 * math.tan(a) ** 2) for a in np.radians(np.arange(55.0, 80.0, 0.5))]
    assert min(abs(n) for n in naive) * camera.focal_px[0] < 468.0, "the case must be one that would fold"
    rays = [[math.sin(a), 0.0, math.cos(a)] for a in np.radians(np.arange(55.0, 80.0, 0.5))]
    assert not camera.project(rays)[1].any()


@given(
    st.floats(8.0, 80.0),
    st.floats(-0.1, 0.1),
    st.floats(-0.03, 0.03),
    st.floats(-2e-3, 2e-3),
    st.floats(-2e-3, 2e-3),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_any_accepted_distortion_round_trips(fov: float, k1: float, k2: float, p1: float, p2: float) -> None:
    try:
        camera = Camera.from_fov(fov, 320, 200, distortion=(k1, k2, p1, p2))
    except StaridError as error:
        assert "folds" in str(error)  # noqa: PT017 - rejecting is also correct
        return
    xy = image_positions(camera, 300)
    np.testing.assert_allclose(camera.project(camera.back_project(xy))[0], xy, atol=ROUND_TRIP_PX)


def test_flat_view_is_the_thesis_plane() -> None:
    camera = Camera.from_fov(42.0, model="flat")
    for ra, dec in [(115.0, -65.0), (359.0, 30.0), (0.0, 0.0), (10.0, 60.0)]:
        view, attitude = flat_view(camera, ra, dec)
        offsets = np.array([[0.0, 0.0], [20.0, 19.0], [-20.0, 5.0], [3.5, -12.25]])
        a, d = np.radians(ra + offsets[:, 0]), np.radians(dec + offsets[:, 1])
        stars = np.column_stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
        xy, inside = view.project(attitude.to_sensor(stars))
        scale = 937 / 42.0
        np.testing.assert_allclose(xy, 468.0 - scale * offsets, atol=1e-9)
        assert inside.all()
        np.testing.assert_allclose(attitude.to_icrs(view.back_project(xy)), stars, atol=1e-12)


def test_flat_view_shows_no_sky_beyond_the_pole() -> None:
    view, _ = flat_view(Camera.from_fov(42.0, model="flat"), 10.0, -80.0)
    seen = view.back_project([[468.0, 468.0], [468.0, 900.0]])
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()
    with pytest.raises(StaridError, match="flat"):
        flat_view(DEFAULT_CAMERA, 0.0, 0.0)


def test_equidistant_image_circle_ends_at_the_antipode() -> None:
    camera = Camera.from_fov(360.0, 200, 200, "equidistant")
    seen = camera.back_project([[99.5, 0.0], [0.0, 0.0]])
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()


def test_camera_sees_north_up_and_east_left() -> None:
    attitude = Attitude.from_radec_roll(83.8, -1.2, 30.0)
    north = Attitude.from_radec_roll(83.8, 3.8, 0.0).boresight
    x, y = DEFAULT_CAMERA.project(attitude.to_sensor(north)[None])[0][0]
    assert math.degrees(math.atan2(-(x - 468.0), -(y - 468.0))) == pytest.approx(30.0, abs=1e-9)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_dict_json_and_pickle_round_trip(camera: Camera) -> None:
    again = Camera.from_dict(json.loads(json.dumps(camera.to_dict())))
    assert again == camera
    assert again.identity == camera.identity
    assert pickle.loads(pickle.dumps(camera)) == camera


def test_from_dict_takes_a_field_of_view() -> None:
    assert Camera.from_dict({"fov_deg": 42.0}) == DEFAULT_CAMERA
    assert DEFAULT_CAMERA.identity != dataclasses.replace(DEFAULT_CAMERA, width=938).identity


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"width": 0}, "width"),
        ({"height": 1.5}, "height"),
        ({"focal_px": (0.0, 1.0)}, "focal_px"),
        ({"focal_px": (1.0,)}, "focal_px"),
        ({"centre_px": (math.nan, 1.0)}, "centre_px"),
        ({"centre_px": "ab"}, "centre_px"),
        ({"centre_px": "12"}, "centre_px"),
        ({"focal_px": 1000.0}, "focal_px"),
        ({"focal_px": (True, True)}, "focal_px"),
        ({"focal_px": (10**400, 1)}, "focal_px"),
        ({"width": "937"}, "width"),
        ({"model": ["pinhole"]}, "model"),
        ({"distortion": 0.1}, "distortion"),
        ({"distortion": ("a",)}, "distortion"),
        ({"model": "fisheye"}, "model"),
        ({"distortion": (1,) * 6}, "distortion"),
        ({"distortion": (math.inf,)}, "distortion"),
        ({"distortion": (-5.0,)}, "folds"),
        ({"distortion": (0.0, 0.0, 5.0, 5.0)}, "folds"),
        ({"colour": 1}, "unknown key 'colour'"),
        ({"fov_deg": 20.0}, "exclude"),
    ],
)
def test_bad_cameras_are_rejected_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(StaridError, match=message):
        Camera.from_dict({**DEFAULT_CAMERA.to_dict(), **values})


@pytest.mark.parametrize("fov", [0.0, -1.0, 170.1, math.nan, "42", None, True, [42.0]])
def test_bad_fields_of_view_are_rejected(fov: float) -> None:
    with pytest.raises(StaridError, match="fov_deg"):
        Camera.from_fov(fov)


@pytest.mark.parametrize(
    "values",
    [{"width": "937"}, {"height": 0}, {"model": ["pinhole"]}, {"model": "fisheye"}, {"distortion": 0.1}],
)
def test_other_values_beside_a_field_of_view_are_rejected_by_name(values: dict[str, object]) -> None:
    with pytest.raises(StaridError, match=f"camera {next(iter(values))}"):
        Camera.from_dict({"fov_deg": 42.0, **values})


def test_missing_key_is_named() -> None:
    with pytest.raises(StaridError, match="'height' missing"):
        Camera.from_dict({"width": 3, "focal_px": (1, 1), "centre_px": (1, 1)})


def test_tables_of_the_wrong_shape_are_rejected() -> None:
    with pytest.raises(StaridError, match="directions"):
        DEFAULT_CAMERA.project([1.0, 2.0, 3.0])
    with pytest.raises(StaridError, match="positions"):
        DEFAULT_CAMERA.back_project([[1.0, 2.0, 3.0]])
    assert DEFAULT_CAMERA.project(np.empty((0, 3)))[0].shape == (0, 2)
