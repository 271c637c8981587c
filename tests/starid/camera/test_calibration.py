"""Calibration on simulated skies: errors at the noise floor, and a calibrated covariance."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from starid.attitude import Attitude, random_attitude
from starid.attitude.wahba import solve_wahba
from starid.camera import DEFAULT_CAMERA, Camera
from starid.camera.calibration import NAMES, Calibration, CalibrationFrame, calibrate
from starid.camera.file import load_camera, save_camera
from starid.camera.position_errors import attitude_covariance
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.photograph.self_calibration import IMAGE_MODELS, Stars, _best, self_calibrate

pytestmark = pytest.mark.long

WIDE = Camera(937, 937, (1230.0, 1226.0), (474.0, 463.0), "pinhole", (-0.06, 0.03, 8e-4, -5e-4, 0.0))
NARROW = Camera(1024, 768, (5100.0, 5100.0), (512.0, 384.0), "pinhole", (-0.5, 0.0, 0.0, 0.0, 0.0))
FISHEYE = Camera(937, 937, (600.0, 600.0), (460.0, 473.0), "equidistant", (-0.02, 0.005, 2e-4, 1e-4, 0.0))
WITH_ASPECT = ("aspect", "centre", "k1", "k2", "p1", "p2")
SIGMA_PX = 0.2


@pytest.fixture(scope="module")
def sky() -> StarCatalog:
    return load_catalog().brighter_than(6.5)


def simulated(
    sky: StarCatalog, camera: Camera, frames: int, seed: int, *, sigma: float = SIGMA_PX, false: int = 0
) -> tuple[list[CalibrationFrame], list[Attitude]]:
    """Matched stars for random attitudes, some moved by up to 15 px, like false matches."""
    rng = np.random.default_rng(seed)
    out, truths = [], []
    for _ in range(frames):
        truth = random_attitude(rng)
        near = sky.in_cone(truth.boresight, camera.field_radius_rad)
        xy, inside = camera.project(truth.to_sensor(sky.vectors[near]))
        xy = xy[inside] + sigma * rng.standard_normal((int(inside.sum()), 2))
        wrong = rng.choice(len(xy), false, replace=False)
        xy[wrong] += rng.uniform(-15, 15, (false, 2))
        out.append(CalibrationFrame(xy, sky.vectors[near][inside]))
        truths.append(truth)
    return out, truths


def mapping_error_px(truth: Camera, estimated: Camera) -> float:
    """RMS distance between two cameras' images of the same sky, after removing a common rotation."""
    x, y = np.meshgrid(np.linspace(0, truth.width - 1, 25), np.linspace(0, truth.height - 1, 25))
    grid = np.column_stack([x.ravel(), y.ravel()])
    sky, seen = truth.back_project(grid), estimated.back_project(grid)
    moved = estimated.project(solve_wahba(seen, sky).to_sensor(sky))[0]
    return float(np.sqrt(((moved - grid) ** 2).sum(axis=1).mean()))


def values(camera: Camera) -> np.ndarray:
    return np.array([*camera.focal_px, *camera.centre_px, *camera.distortion])


def test_distortion_of_four_pixels_is_recovered_to_the_noise_floor(sky: StarCatalog) -> None:
    corner = [[-0.5, -0.5]]
    plain = dataclasses.replace(WIDE, distortion=(0.0,) * 5)
    bent = np.linalg.norm(WIDE.project(plain.back_project(corner))[0] - corner)
    assert bent > 4.0, "the lens under test must bend the corners by more than four pixels"
    frames, truths = simulated(sky, WIDE, 10, 1)
    result = calibrate(frames, DEFAULT_CAMERA, WITH_ASPECT)
    assert mapping_error_px(WIDE, DEFAULT_CAMERA) > 1.5
    assert mapping_error_px(WIDE, result.camera) < 0.03
    assert result.sigma_px == pytest.approx(SIGMA_PX, rel=0.05)
    assert result.rms_px == pytest.approx(SIGMA_PX * np.sqrt(2.0), rel=0.05)
    assert result.star_count == sum(len(f.xy_px) for f in frames)
    for attitude, truth in zip(result.attitudes, truths, strict=True):
        assert attitude.error_to(truth).roll_arcsec < 60.0


@pytest.mark.parametrize("camera", [WIDE, FISHEYE])
@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_an_error_of_the_camera_turns_the_attitude_by_what_its_covariance_says(
    sky: StarCatalog, camera: Camera, number: int
) -> None:
    """Compared with the attitude that fits the stars best, found by `scipy.optimize`, for an error small enough to be linear."""
    (frame,), (truth,) = simulated(sky, camera, 1, 5, sigma=0.0)
    sigma = np.random.default_rng(6).uniform(0.05, 0.5, len(frame.xy_px))
    error = 1e-4 if number < 4 else 1e-6
    constants = [*camera.focal_px, *camera.centre_px, *camera.distortion]
    constants[number] += error
    wrong = dataclasses.replace(
        camera,
        focal_px=(constants[0], constants[1]),
        centre_px=(constants[2], constants[3]),
        distortion=tuple(constants[4:]),
    )

    def residuals(turn: np.ndarray) -> np.ndarray:
        xy, _ = wrong.project(truth.rotated(turn).to_sensor(frame.reference))
        return ((xy - frame.xy_px) / sigma[:, None]).ravel()

    turn = least_squares(residuals, np.zeros(3), x_scale=1e-6, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    camera_covariance = np.zeros((9, 9))
    camera_covariance[number, number] = error**2
    exact = np.zeros_like(frame.xy_px)
    with_error, _ = attitude_covariance(camera, camera_covariance, frame.xy_px, sigma, exact, 1e12)
    noise, _ = attitude_covariance(camera, 0.0 * camera_covariance, frame.xy_px, sigma, exact, 1e12)
    np.testing.assert_allclose(
        with_error - noise, np.outer(turn, turn), atol=2e-3 * np.abs(turn).max() ** 2 + 1e-12 * noise.max()
    )


def test_what_errors_of_the_camera_explain_is_not_noise(sky: StarCatalog) -> None:
    """The mean square is that of a least-squares fit of attitude and camera at once, whose camera is held by its errors."""
    (frame,), (truth,) = simulated(sky, WIDE, 1, 7, sigma=0.0)
    rng = np.random.default_rng(8)
    sigma = rng.uniform(0.05, 0.3, len(frame.xy_px))
    sigmas = np.array([0.67, 0.67, 0.04, 0.04, 3e-4, 4e-4, 1e-5, 1e-5, 1e-6])
    wrong = values(WIDE) + sigmas * rng.standard_normal(9)
    measured = frame.xy_px + sigma[:, None] * rng.standard_normal(frame.xy_px.shape)

    def shown(p: np.ndarray, turn: np.ndarray) -> np.ndarray:
        camera = Camera(937, 937, (p[0], p[1]), (p[2], p[3]), "pinhole", tuple(p[4:]))
        return (camera.project(truth.rotated(turn).to_sensor(frame.reference))[0] - measured) / sigma[:, None]

    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    alone = least_squares(lambda turn: shown(wrong, turn).ravel(), np.zeros(3), x_scale=1e-6, **options)
    both = least_squares(
        lambda x: np.append(shown(wrong + sigmas * x[3:], x[:3]).ravel(), x[3:]), np.zeros(12),
        x_scale=np.append(np.full(3, 1e-6), np.ones(9)), **options,
    )  # fmt: skip
    freedom = 2 * len(measured) - 3
    camera = Camera(937, 937, (wrong[0], wrong[1]), (wrong[2], wrong[3]), "pinhole", tuple(wrong[4:]))
    offset = -shown(wrong, alone.x) * sigma[:, None]
    _, noise_px = attitude_covariance(camera, np.diag(sigmas**2), measured, sigma, offset, 0.0)
    expected = math.sqrt(2.0 * both.cost / freedom * np.mean(sigma**2))
    assert noise_px == pytest.approx(expected, rel=1e-3)
    assert alone.cost > 1.5 * both.cost, "the error of the camera must matter"


@pytest.mark.parametrize(
    ("truth", "start", "estimate", "limit"),
    [
        (NARROW, Camera.from_fov(10.7, 1024, 768), ("focal", "k1"), 0.1),
        (
            FISHEYE,
            Camera.from_fov(86.0, model="equidistant"),
            ("focal", "centre", "k1", "k2", "p1", "p2"),
            0.05,
        ),
    ],
)
def test_other_lenses_and_false_matches(
    sky: StarCatalog, truth: Camera, start: Camera, estimate: tuple[str, ...], limit: float
) -> None:
    frames, _ = simulated(sky, truth, 8, 2, false=2)
    result = calibrate(frames, start, estimate)
    assert mapping_error_px(truth, result.camera) < limit
    total = sum(len(f.xy_px) for f in frames)
    assert total - 16 - 4 <= result.star_count < total


def test_the_covariance_matches_the_errors(sky: StarCatalog) -> None:
    """Chi-squared of eight degrees of freedom, a mean of its share: within three standard errors."""
    ratios = []
    for seed in range(10):
        frames, _ = simulated(sky, WIDE, 3, 100 + seed)
        result = calibrate(frames, DEFAULT_CAMERA, WITH_ASPECT)
        error = (values(result.camera) - values(WIDE))[:8]
        ratios.append(error @ np.linalg.solve(result.covariance[:8, :8], error) / 8.0)
    assert np.mean(ratios) == pytest.approx(1.0, abs=3.0 * math.sqrt(2.0 / 8.0 / len(ratios)))


def test_the_minimum_agrees_with_scipy(sky: StarCatalog) -> None:
    """scipy, minimising the same residuals over camera and rotation vectors, finds the same camera."""
    frames, truths = simulated(sky, WIDE, 2, 5, sigma=0.05)
    result = calibrate(frames, WIDE, ("focal", "k1"))

    def residuals(x: np.ndarray) -> np.ndarray:
        focal = (WIDE.focal_px[0] * x[0], WIDE.focal_px[1] * x[0])
        camera = dataclasses.replace(WIDE, focal_px=focal, distortion=(x[1], *WIDE.distortion[1:]))
        parts = []
        for i, (frame, truth) in enumerate(zip(frames, truths, strict=True)):
            attitude = truth.rotated(x[2 + 3 * i : 5 + 3 * i] * 1e-3)
            parts.append(camera.project(attitude.to_sensor(frame.reference))[0] - frame.xy_px)
        return np.concatenate(parts).ravel()

    theirs = least_squares(
        residuals,
        np.r_[1.0, WIDE.distortion[0], np.zeros(6)],
        x_scale="jac",
        xtol=1e-13,
        ftol=1e-13,
        f_scale=0.1,
    )
    noise = result.sigmas
    assert result.camera.focal_px[0] == pytest.approx(theirs.x[0] * WIDE.focal_px[0], abs=0.3 * noise["fx"])
    assert result.camera.distortion[0] == pytest.approx(theirs.x[1], abs=0.3 * noise["k1"])


def test_parameters_that_are_not_estimated_keep_their_values(sky: StarCatalog) -> None:
    frames, _ = simulated(sky, WIDE, 3, 6)
    result = calibrate(frames, WIDE, ("focal",))
    assert result.camera.centre_px == WIDE.centre_px
    assert result.camera.distortion == WIDE.distortion
    assert result.camera.focal_px[1] / result.camera.focal_px[0] == pytest.approx(1226.0 / 1230.0, rel=1e-12)
    assert [name for name, sigma in result.sigmas.items() if sigma > 0.0] == ["fx", "fy"]


def test_given_sigmas_weight_the_stars(sky: StarCatalog) -> None:
    frames, _ = simulated(sky, WIDE, 4, 7)
    rng = np.random.default_rng(7)
    noisy = []
    for frame in frames:
        sigma = np.where(rng.random(len(frame.xy_px)) < 0.5, SIGMA_PX, 10.0 * SIGMA_PX)
        shift = np.sqrt(sigma**2 - SIGMA_PX**2)[:, None] * rng.standard_normal(frame.xy_px.shape)
        noisy.append(CalibrationFrame(frame.xy_px + shift, frame.reference, sigma))
    weighted = calibrate(noisy, DEFAULT_CAMERA, WITH_ASPECT)
    clean = calibrate(frames, DEFAULT_CAMERA, WITH_ASPECT)
    assert weighted.sigmas["fx"] == pytest.approx(clean.sigmas["fx"] / np.sqrt(0.505), rel=0.15)
    error = abs(weighted.camera.focal_px[0] - WIDE.focal_px[0])
    assert error < 4.0 * weighted.sigmas["fx"]


def test_errors_may_differ_along_x_and_y(sky: StarCatalog) -> None:
    """Trails blur x only: the camera is as accurate as the sharp axis allows, and so is the covariance."""
    frames, _ = simulated(sky, WIDE, 4, 10)
    rng = np.random.default_rng(10)
    trailed = []
    for frame in frames:
        shift = np.column_stack([rng.normal(0.0, 3.0, len(frame.xy_px)), np.zeros(len(frame.xy_px))])
        sigma = np.broadcast_to([np.hypot(3.0, SIGMA_PX), SIGMA_PX], shift.shape)
        trailed.append(CalibrationFrame(frame.xy_px + shift, frame.reference, sigma))
    result = calibrate(trailed, DEFAULT_CAMERA, WITH_ASPECT)
    assert result.sigmas["fy"] < 0.5 * result.sigmas["fx"]
    error = (values(result.camera) - values(WIDE))[:8]
    assert 0.1 < error @ np.linalg.solve(result.covariance[:8, :8], error) / 8.0 < 3.0
    assert abs(error[1]) < 4.0 * result.sigmas["fy"]


def test_bad_calibrations_are_rejected(sky: StarCatalog) -> None:
    frames, _ = simulated(sky, WIDE, 1, 8)
    with pytest.raises(StaridError, match="'k9'"):
        calibrate(frames, WIDE, ("k9",))
    with pytest.raises(StaridError, match="nothing"):
        calibrate(frames, WIDE, ())
    with pytest.raises(StaridError, match="no frames"):
        calibrate([], WIDE)
    few = CalibrationFrame(frames[0].xy_px[:3], frames[0].reference[:3])
    with pytest.raises(StaridError, match="do not determine"):
        calibrate([few], WIDE)
    behind = CalibrationFrame(
        frames[0].xy_px, frames[0].reference, attitude=Attitude(np.array([1.0, 2.0, 3.0, 4.0]))
    )
    with pytest.raises(StaridError, match="outside the start camera"):
        calibrate([behind], WIDE)


def test_a_frame_of_false_matches_among_good_ones_is_reported(sky: StarCatalog) -> None:
    frames, truths = simulated(sky, WIDE, 3, 12)
    order = np.random.default_rng(1).permutation(len(frames[1].xy_px))
    frames[1] = CalibrationFrame(frames[1].xy_px[order], frames[1].reference, attitude=truths[1])
    with pytest.raises(StaridError, match=r"frame 2 of 3: . of \d+ matched stars fit .* leave it out"):
        calibrate(frames, WIDE)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_precise_frame_counts_in_the_choice_of_the_model(sky: StarCatalog, seed: int) -> None:
    """Only one of six frames determines the distortion; the others are consistent with it."""
    bent = dataclasses.replace(DEFAULT_CAMERA, distortion=(-1e-3, 0.0, 0.0, 0.0, 0.0))
    frames = []
    for sigma, count in ((0.05, 1), (1.0, 5)):
        seen, _ = simulated(sky, bent, count, seed + 100 * (count > 1), sigma=sigma)
        frames += [dataclasses.replace(f, sigma_px=np.full(len(f.xy_px), sigma)) for f in seen]
    assert _best(frames, DEFAULT_CAMERA, IMAGE_MODELS).estimated == ("focal", "k1")


def test_a_model_that_folds_the_image_leaves_the_choice_to_the_others(sky: StarCatalog) -> None:
    camera = Camera.from_fov(90.0)
    (frame,), _ = simulated(sky, camera, 1, 31, sigma=0.5)
    off = frame.xy_px - camera.centre_px
    radius = np.linalg.norm(off, axis=1)
    barrel = 1.0 - 0.4 * (radius / camera.focal_px[0]) ** 2  # which would fold within the image
    central = radius < 150.0
    middle = CalibrationFrame((camera.centre_px + off * barrel[:, None])[central], frame.reference[central])
    with pytest.raises(StaridError, match="folds"):
        calibrate([middle], camera, ("focal", "k1"))
    assert _best([middle], camera, (("focal",), ("focal", "k1"))).estimated == ("focal",)
    with pytest.raises(StaridError, match="folds"):
        _best([middle], camera, (("focal", "k1"),))


@pytest.mark.parametrize(
    ("xy", "reference", "sigma", "message"),
    [
        (np.zeros((3, 3)), np.eye(3), None, "xy_px"),
        (np.full((3, 2), np.nan), np.eye(3), None, "xy_px"),
        (np.zeros((2, 2)), np.eye(3), None, "2 positions but 3 directions"),
        (np.zeros((1, 2)), np.eye(3)[:1], None, "1 matched stars"),
        (np.zeros((3, 2)), np.eye(3), np.zeros(3), "standard deviations"),
    ],
)
def test_bad_frames_are_rejected(
    xy: np.ndarray, reference: np.ndarray, sigma: np.ndarray | None, message: str
) -> None:
    with pytest.raises(StaridError, match=message):
        CalibrationFrame(xy, reference, sigma)


@pytest.fixture(scope="module")
def calibration(sky: StarCatalog) -> Calibration:
    return calibrate(simulated(sky, WIDE, 3, 9)[0], DEFAULT_CAMERA, WITH_ASPECT)


def test_profile_brings_the_camera_back_exactly(tmp_path: Path, calibration: Calibration) -> None:
    save_camera(tmp_path / "camera.toml", calibration.camera, calibration)
    assert load_camera(tmp_path / "camera.toml") == calibration.camera
    stored = tomllib.loads((tmp_path / "camera.toml").read_text())["calibration"]
    assert stored["parameters"] == list(NAMES)
    assert stored["frames"] == 3
    np.testing.assert_array_equal(stored["covariance"], calibration.covariance)
    save_camera(tmp_path / "plain.toml", FISHEYE)
    assert load_camera(tmp_path / "plain.toml") == FISHEYE
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.toml", "plain.toml"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera = 1", r"no table \[camera\]"),
        ("", r"no table \[camera\]"),
        ("[camera", "is not valid TOML"),
        ("[camera]\nwidth = 5\nheight = 5\nfov_deg = 9\ncolour = 1", "unknown key 'colour'"),
        ("[camera]\nwidth = 0\nheight = 5\nfov_deg = 9", "width"),
        ("[camera]\nheight = 5\nfocal_px = [1, 1]\ncentre_px = [1, 1]", "'width' missing"),
        ('[camera]\nfov_deg = "42"', r"camera fov_deg: must be degrees in \(0, 170\] for .*, not '42'"),
        ('[camera]\nfov_deg = 42\nwidth = "937"', "camera width: must be a whole number .*, not '937'"),
        ("[camera]\nfov_deg = 42\nheight = [937]", r"camera height: must be a whole number .*, not \[937\]"),
        (
            "[camera]\nfov_deg = 42\ndistortion = 0.1",
            "camera distortion: must be at most 5 finite numbers .*, not 0.1",
        ),
        (
            '[camera]\nfov_deg = 42\nmodel = ["pinhole"]',
            r"camera model: must be one of pinhole.*, not \['pinhole'\]",
        ),
    ],
)
def test_bad_profiles_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(StaridError, match=message) as caught:
        load_camera(tmp_path / "bad.toml")
    assert "bad.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_unwritable_profiles(tmp_path: Path) -> None:
    with pytest.raises(StaridError, match=r"none\.toml: no such file"):
        load_camera(tmp_path / "none.toml")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StaridError, match="cannot be written"):
        save_camera(tmp_path / "file" / "camera.toml", WIDE)


def detected(sky: StarCatalog, camera: Camera, count: int, seed: int) -> tuple[list[Stars], list[Attitude]]:
    """Unidentified detections to V 5.5 with noise, false and missing stars."""
    rng = np.random.default_rng(seed)
    frames, truths = [], []
    bright = sky.brighter_than(5.5)
    for _ in range(count):
        truth = random_attitude(rng)
        near = bright.in_cone(truth.boresight, camera.field_radius_rad)
        xy, inside = camera.project(truth.to_sensor(bright.vectors[near]))
        kept = inside & (rng.random(len(near)) > 0.05)
        positions = xy[kept] + SIGMA_PX * rng.standard_normal((int(kept.sum()), 2))
        flux = 10.0 ** (-0.4 * (bright.v[near][kept] + 0.05 * rng.standard_normal(int(kept.sum()))))
        positions = np.concatenate([positions, rng.uniform(0, 936, (4, 2))])
        flux = np.concatenate([flux, rng.choice(flux, 4)])
        order = np.argsort(-flux)
        frames.append(Stars(positions[order], flux[order], np.full(len(flux), SIGMA_PX)))
        truths.append(truth)
    return frames, truths


def test_self_calibration_from_a_rough_field_of_view(sky: StarCatalog) -> None:
    start = Camera.from_fov(42.0 * 1.04)
    frames, truths = detected(sky, WIDE, 4, 21)
    empty = Stars(np.array([[10.0, 10.0], [500.0, 600.0]]), np.array([2.0, 1.0]))
    result = self_calibrate([*frames, empty], start, fov_tolerance=0.1)
    assert result.frame_index == (0, 1, 2, 3)
    assert result.unidentified == {4: "too_few_stars"}
    assert mapping_error_px(WIDE, start) > 10.0
    assert mapping_error_px(WIDE, result.calibration.camera) < 0.15
    assert result.calibration.sigma_px == pytest.approx(SIGMA_PX, rel=0.2)
    for attitude, truth in zip(result.calibration.attitudes, truths, strict=True):
        assert attitude.error_to(truth).roll_arcsec < 90.0


def test_a_perfect_lens_gets_no_more_parameters_than_it_needs(sky: StarCatalog) -> None:
    frames, _ = detected(sky, DEFAULT_CAMERA, 4, 22)
    result = self_calibrate(frames, DEFAULT_CAMERA, fov_tolerance=0.1)
    assert len(result.calibration.estimated) <= 3
    assert mapping_error_px(DEFAULT_CAMERA, result.calibration.camera) < 0.1


def test_frames_of_random_points_are_rejected() -> None:
    rng = np.random.default_rng(23)
    noise = [Stars(rng.uniform(0, 936, (12, 2)), rng.uniform(1, 9, 12)) for _ in range(2)]
    with pytest.raises(StaridError, match="none of 2 frames could be identified"):
        self_calibrate(noise, DEFAULT_CAMERA, fov_tolerance=0.01)
    with pytest.raises(StaridError, match="no frames"):
        self_calibrate([], DEFAULT_CAMERA)
