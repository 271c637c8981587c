"""Images from elsewhere: a folder, a video, and the device that answers with their attitudes."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from starhil.emulator.device.device import profile_defaults
from starhil.emulator.device.parameters import Parameters
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.image_source import CapturedImages, FolderImages, open_images, used_bits
from starhil.emulator.sensor.pipeline.messages import (
    Failure,
    FrameRequest,
    ImageRequest,
    JpgRequest,
    SolverSettings,
    camera_constants,
)
from starhil.emulator.sensor.pipeline.pipeline import Pipeline, make_pipeline
from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from starid.camera import Camera
from starid.camera.file import save_camera
from starid.catalog import load_catalog
from starid.imaging.image_io import write_image

CAMERA = dataclasses.replace(
    Camera.from_fov(30.0, 400, 320), centre_px=(203.0, 155.5), distortion=(-0.12, 0.0, 0.0, 0.0, 0.0)
)
FIELDS = (
    Attitude.from_radec_roll(83.8, -1.2, 20.0),
    Attitude.from_radec_roll(187.0, 12.0, -70.0),
    Attitude.from_radec_roll(310.0, 45.0, 160.0),
)
NOWHERE = TruthState(Attitude.identity(), ZERO_RATE)
ERROR_ARCSEC = 30.0


@pytest.fixture(scope="module")
def photographs():
    """Synthetic photographs of a camera with a distorted lens and 12 bits."""
    renderer = Renderer(
        CAMERA, load_catalog(), SensorModel(bits=12, exposure_s=0.5, psf_sigma_px=1.1), seed=9
    )
    return [renderer.render(attitude, frame_index=n).image for n, attitude in enumerate(FIELDS)]


@pytest.fixture
def profile(tmp_path, photographs):
    """A profile of a folder with the photographs and the camera as `starid calibrate` writes it."""
    (tmp_path / "night").mkdir()
    for number, image in enumerate(photographs):
        write_image(tmp_path / "night" / f"{number:03d}.png", image)
    (tmp_path / "night" / "notes.txt").write_text("clear sky")
    save_camera(tmp_path / "lens.toml", CAMERA)
    path = tmp_path / "rig.toml"
    path.write_text('extends = "lens.toml"\n[run]\nclock = "stepped"\n[images]\nfolder = "night"\n')
    return path


def request(pipeline: Pipeline, profile: Profile, index: int) -> FrameRequest:
    icd = load_unit()
    parameters = Parameters(icd, profile_defaults(profile, icd))
    parameters.adopt_defaults(camera_constants(pipeline.camera.to_dict()))
    settings = SolverSettings.of(parameters)
    return FrameRequest(index, NOWHERE, 0.5, 1.0, settings=settings)


def test_the_device_answers_with_the_attitudes_of_the_photographs_in_turn(profile, photographs):
    loaded = load_profile(str(profile))
    pipeline, ready = make_pipeline(pipeline_setup(loaded))
    assert ready.camera["distortion"][0] == CAMERA.distortion[0]
    for index in range(len(FIELDS) + 1):
        result = pipeline.handle(request(pipeline, loaded, index))
        assert result.valid, result
        measured = Attitude(np.array(result.quaternion_xyzw))
        assert measured.error_to(FIELDS[index % len(FIELDS)]).total_arcsec < ERROR_ARCSEC
    download = pipeline.handle(ImageRequest(0))
    assert (download.width, download.height) == (CAMERA.width, CAMERA.height)
    shift = used_bits(photographs[0]) - 8
    assert download.pixels == (photographs[0] >> shift).astype(np.uint8).tobytes()
    pixels = pipeline.handle(ImageRequest(64)).pixels
    jpg = pipeline.handle(JpgRequest(64, pixels, 100)).data
    again = cv2.imdecode(np.frombuffer(jpg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (
        np.abs(again.astype(int).ravel() - np.frombuffer(pixels, np.uint8)).max() <= 2
    )  # rounding, at quality 100


def test_without_repeat_the_images_are_used_up(profile):
    loaded = load_profile(str(profile), ["images.repeat=false"])
    pipeline, _ = make_pipeline(pipeline_setup(loaded))
    assert pipeline.handle(request(pipeline, loaded, 2)).valid
    failed = pipeline.handle(request(pipeline, loaded, 3))
    assert isinstance(failed, Failure)
    assert "the 3 images" in failed.text


def test_a_dark_frame_is_subtracted_from_each_image(profile, tmp_path, photographs, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dark = np.full(photographs[0].shape, 40, np.uint16)
    dark[100:110, 200:210] = 90
    write_image(tmp_path / "dark.png", dark)
    source = open_images(
        load_profile(str(profile), ["images.dark=dark.png"]).images.resolved(tmp_path), CAMERA
    )
    expected = photographs[1].astype(int)
    expected[100:110, 200:210] -= 50
    np.testing.assert_array_equal(source.image(1), np.maximum(expected, 0))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("images.folder=empty", "contains no PNG"),
        ("images.folder=missing", "missing cannot be read (No such file or directory); name a folder"),
        (f"images.folder={'a' * 300}", "cannot be read (File name too long); name a folder"),
        ("camera.width=512", "400×320 pixels, the camera of the profile has 512×320"),
        ("images.dark=other.png", "dark frame of 20×20"),
    ],
)
def test_images_that_cannot_serve_fail_the_start_in_one_line(
    profile, tmp_path, setting, message, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    write_image(tmp_path / "other.png", np.arange(400, dtype=np.uint16).reshape(20, 20))
    failed = make_pipeline(pipeline_setup(load_profile(str(profile), [setting])))
    assert isinstance(failed, Failure)
    assert message in failed.text
    assert "\n" not in failed.text


def test_a_video_delivers_its_images_and_then_none(tmp_path):
    path = tmp_path / "night.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 5, (64, 48))
    for level in (50, 150):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    source = CapturedImages(str(path))
    first, second = source.image(0), source.image(1)
    assert first.shape == second.shape == (48, 64)
    assert (np.median(first), np.median(second)) == (pytest.approx(50, abs=3), pytest.approx(150, abs=3))
    with pytest.raises(EmulatorError, match="no more images"):
        source.image(2)


def test_a_missing_camera_is_named(tmp_path):
    with pytest.raises(EmulatorError, match=r"none\.avi cannot be opened"):
        CapturedImages(str(tmp_path / "none.avi"))


def test_a_folder_is_taken_in_the_order_of_its_names(tmp_path, photographs):
    for name, image in zip(("b.png", "a.png", "c.tif"), photographs, strict=True):
        write_image(tmp_path / name, image)
    source = FolderImages(tmp_path, repeat=True)
    for index, which in enumerate((1, 0, 2, 1)):
        np.testing.assert_array_equal(source.image(index), photographs[which])


def test_folder_and_camera_exclude_each_other(profile):
    with pytest.raises(EmulatorError, match="exclude each other"):
        load_profile(str(profile), ["images.capture=0"])


def test_images_are_not_for_the_error_model(profile):
    with pytest.raises(EmulatorError, match="uses no images"):
        load_profile(str(profile), ["run.worker=error_model"])
