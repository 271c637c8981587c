from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from starhil.emulator.cli import app as emulator
from starid.attitude import Attitude
from starid.camera import Camera
from starid.cli import identify
from starid.cli.app import build_app
from starid.errors import StaridError
from starid.identification.solution import Reason, Solution
from starid.identification.star_identifier import make_identifier
from starid.imaging.detection import detect
from starid.photograph import solver

pytestmark = pytest.mark.long

RUNNER = CliRunner()
DEGREE_LIMIT = 0.01


def starid(*arguments: str):
    return RUNNER.invoke(build_app(arguments), list(arguments), catch_exceptions=True)


def starhil(*arguments: str):
    return RUNNER.invoke(emulator.build_app(arguments), list(arguments), catch_exceptions=True)


def answer(path, *options: str) -> dict:
    result = starid("identify", str(path), "--json", *options)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.parametrize(
    ("ra", "dec", "roll"), [(83.8, -1.2, 30), (0, 0, 180), (359.99, 89.9, -75), (120, -90, 10)]
)
def test_identify_finds_the_attitude_of_a_rendered_image(tmp_path, ra, dec, roll):
    image = tmp_path / "sky.png"
    options = ["--ra", str(ra), "--dec", str(dec), "--roll", str(roll), "--seed", "1"]
    assert starhil("render", *options, "-o", str(image)).exit_code == 0
    fields = answer(image)
    error = Attitude.from_quaternion(fields["quaternion_xyzw"]).error_to(
        Attitude.from_radec_roll(ra, dec, roll)
    )
    assert fields["valid"]
    assert fields["reason"] == "ok"
    assert error.total_arcsec < 3600 * DEGREE_LIMIT
    again = Attitude.from_radec_roll(fields["ra_deg"], fields["dec_deg"], fields["roll_deg"])
    assert again.error_to(Attitude.from_quaternion(fields["quaternion_xyzw"])).total_arcsec < 1e-6


def test_an_unknown_camera_is_measured_from_its_image(tmp_path):
    image = tmp_path / "narrow.png"
    options = [
        "--ra",
        "314.7",
        "--dec",
        "64.2",
        "--roll",
        "89",
        "--fov",
        "12",
        "--size",
        "1024x768",
        "--limit",
        "9",
    ]
    assert starhil("render", *options, "--exposure", "1", "--bits", "16", "-o", str(image)).exit_code == 0
    found = answer(image, "--fov", "11.2")
    assert found["fov_deg"] == pytest.approx(12, abs=0.01)
    error = Attitude.from_quaternion(found["quaternion_xyzw"]).error_to(
        Attitude.from_radec_roll(314.7, 64.2, 89)
    )
    assert error.cross_boresight_arcsec < 10


def test_the_stars_are_where_the_truth_has_them(tmp_path):
    image = tmp_path / "sky.png"
    drawn = starhil("render", "--ra", "83.8", "--dec", "-1.2", "-o", str(image), "--json")
    truth = {star["hip"]: (star["x_px"], star["y_px"]) for star in json.loads(drawn.stdout)["stars"]}
    stars = answer(image)["stars"]
    distances = [
        np.hypot(star["x_px"] - truth[star["hip"]][0], star["y_px"] - truth[star["hip"]][1]) for star in stars
    ]
    assert len(stars) > 50
    assert np.median(distances) < 0.1
    rigel = next(star for star in stars if star["hip"] == 24436)
    assert (rigel["name"], rigel["v"]) == ("Rigel", pytest.approx(0.18, abs=0.1))
    text = starid("identify", str(image)).stdout
    assert re.search(r"HIP +name +V +x px", text)
    assert re.search(r"24436 +Rigel +0\.\d\d ", text)


def test_the_annotated_image_is_written_in_colour(tmp_path):
    image, marked = tmp_path / "sky.png", tmp_path / "marked.png"
    starhil("render", "--ra", "10", "--dec", "20", "-o", str(image))
    answer(image, "-o", str(marked))
    image = cv2.imread(str(marked), cv2.IMREAD_UNCHANGED)
    assert image.shape == (937, 937, 3)
    assert (image[..., 0] != image[..., 1]).any()


@pytest.mark.parametrize(
    "command", [("annotate",), ("identify", "--fov", "42"), ("calibrate", "--fov", "42")]
)
def test_the_image_itself_is_not_written_over(tmp_path, command):
    """`starid annotate` replaced a photograph by its annotated copy."""
    image = tmp_path / "photo.png"
    cv2.imwrite(str(image), np.zeros((64, 64), np.uint8))
    before = image.read_bytes()
    done = starid(*command, str(image), "-o", str(image))
    assert isinstance(done.exception, StaridError)
    assert "is a file that is read; name another one with -o" in str(done.exception)
    assert image.read_bytes() == before


def test_noise_alone_gives_no_attitude(tmp_path):
    image = tmp_path / "noise.png"
    cv2.imwrite(str(image), np.random.default_rng(1).normal(60, 4, (937, 937)).astype(np.uint8))
    result = starid("identify", str(image), "--json")
    fields = json.loads(result.stdout)
    assert result.exit_code == 1
    assert not fields["valid"]
    assert fields["reason"] == "too_few_stars"
    assert fields["ra_deg"] is None


def test_a_hopeless_image_is_given_up_in_time_and_progress_is_shown(tmp_path, monkeypatch):
    image = tmp_path / "lamps.bmp"
    random = np.random.default_rng(2)
    lamps = np.full((480, 640), 20.0)
    lamps[random.integers(5, 475, 80), random.integers(5, 635, 80)] = 20000.0
    cv2.imwrite(
        str(image),
        (cv2.GaussianBlur(lamps, (0, 0), 1.2) + random.normal(0, 2, lamps.shape))
        .clip(0, 255)
        .astype(np.uint8),
    )
    monkeypatch.setattr(identify, "_PROGRESS_EVERY_S", 0.0)
    result = starid("identify", str(image), "--json", "--fov", "20", "--time-limit", "0.001")
    found = json.loads(result.stdout)
    assert result.exit_code == 1
    assert found["reason"] == "no_match"
    assert found["advice"].startswith("given up after 0.001 s (--time-limit); check that")
    assert re.fullmatch(r"searching for \d+ s: round 1 of 5, view 1, field 20° wide\n", result.stderr)


def test_an_image_of_another_size_is_rejected(tmp_path):
    image = tmp_path / "small.png"
    cv2.imwrite(str(image), np.random.default_rng(1).integers(0, 25, (480, 640)).astype(np.uint8))
    result = starid("identify", str(image))
    assert isinstance(result.exception, StaridError)
    assert "640×480" in str(result.exception)
    assert "937×937" in str(result.exception)
    assert "--fov auto" in str(result.exception)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--fov", "wide"], "'wide'"),
        (["--fov", "400"], "identify --fov: must be degrees in (0, 170]"),
        (["--fov", "11", "--profile", "cubestar"], "give one of them"),
        (["--fov", "11", "--model", "fisheye"], "pinhole or equidistant"),
    ],
)
def test_options_without_a_camera_are_rejected(tmp_path, options, named):
    image = tmp_path / "dark.png"
    cv2.imwrite(str(image), np.random.default_rng(1).integers(0, 25, (64, 64)).astype(np.uint8))
    result = starid("identify", str(image), *options)
    assert result.exit_code != 0
    assert named in str(result.exception)


def test_colour_is_rejected_but_where_the_image_may_come_from_any_camera(tmp_path):
    image = tmp_path / "colour.png"
    noise = np.random.default_rng(2).normal(60, 4, (100, 120, 3)).astype(np.uint8)
    cv2.imwrite(str(image), noise)
    refused = starid("identify", str(image))
    assert "3 channels" in str(refused.exception)
    assert "--fov" in str(refused.exception)
    looked_at = starid("identify", str(image), "--fov", "11", "--json")
    assert looked_at.exit_code == 1
    found = json.loads(looked_at.stdout)
    assert found["reason"] == "too_few_stars"
    assert "expose longer" in found["advice"]
    assert "channels" in str(starid("identify", str(image), "--fov", "11", "--refuse-colour").exception)


def test_a_tolerance_of_the_automatic_field_is_rejected(tmp_path):
    image = tmp_path / "sky.png"
    cv2.imwrite(str(image), np.arange(64 * 64, dtype=np.uint16).reshape(64, 64))
    result = starid("identify", str(image), "--fov", "auto", "--fov-tolerance", "0")
    assert "--fov-tolerance has no effect with --fov auto" in str(result.exception)


def test_the_aberration_of_a_dated_image_is_corrected(tmp_path):
    profile, image = tmp_path / "dated.toml", tmp_path / "sky.png"
    orbit = "[orbit]\nkind = 'state'\nposition_m = [7e6, 0.0, 0.0]\nvelocity_m_s = [0.0, 0.0, 7500.0]\n"
    profile.write_text(f"extends = 'ideal'\n[sky]\ndate = 2026-12-20T12:00:00Z\n{orbit}")
    where = ["--ra", "83.8", "--dec", "-1.2", "--roll", "30"]
    assert (
        starhil("render", "--profile", str(profile), *where, "--bits", "16", "-o", str(image)).exit_code == 0
    )
    truth = Attitude.from_radec_roll(83.8, -1.2, 30.0)

    def error_arcsec(*options: str) -> float:
        found = Attitude.from_quaternion(answer(image, *options)["quaternion_xyzw"])
        return found.error_to(truth).cross_boresight_arcsec

    dated = ["--date", "2026-12-20T12:00"]
    assert error_arcsec() > 10.0
    assert error_arcsec(*dated) == pytest.approx(5.2, abs=2.0)
    assert error_arcsec(*dated, "--observer-velocity", "0,0,7500") < 1.5
    assert error_arcsec(*dated, "--observer-velocity", "0,0,7500", "--fov", "41") < 3.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--date", "yesterday"], "--date: must be a date from 1970 to 2100"),
        (["--observer-velocity", "1,2"], "three numbers in m/s as X,Y,Z"),
        (["--observer-velocity", "fast"], "three numbers in m/s as X,Y,Z"),
        (["--observer-velocity", "0,0,3e8"], "at most 1e+06"),
    ],
)
def test_a_bad_date_or_velocity_is_rejected(tmp_path, options, message):
    image = tmp_path / "dark.png"
    cv2.imwrite(str(image), np.random.default_rng(1).integers(0, 25, (937, 937)).astype(np.uint8))
    result = starid("identify", str(image), *options)
    assert result.exit_code != 0
    assert message in str(result.exception)


def test_with_a_dark_frame_the_stars_of_a_hot_sensor_are_found_and_no_more(tmp_path):
    rng = np.random.default_rng(3)
    sky, dark, hot = (tmp_path / name for name in ("sky.png", "dark.png", "hot.png"))
    assert starhil("render", "--ra", "83.8", "--dec", "-1.2", "--seed", "1", "-o", str(sky)).exit_code == 0
    pixels = cv2.imread(str(sky), cv2.IMREAD_UNCHANGED)
    signal = np.zeros(pixels.shape)
    where = rng.integers(4, 930, (2, 700))
    for rows, columns, part in ((0, 0, 1.0), (0, 1, 0.6), (1, 0, 0.6), (1, 1, 0.4)):
        signal[where[0] + rows, where[1] + columns] = part * rng.uniform(40.0, 110.0, 700)
    cv2.imwrite(str(hot), np.clip(pixels + np.rint(signal), 0, 255).astype(np.uint8))
    cv2.imwrite(str(dark), np.rint(8.0 + signal).astype(np.uint8))
    without = json.loads(starid("identify", str(hot), "--json").stdout)
    fields = answer(hot, "--dark", str(dark))
    plain = answer(sky)
    assert without["stars_detected"] > 1.4 * plain["stars_detected"]
    assert abs(fields["stars_detected"] - plain["stars_detected"]) < 0.2 * plain["stars_detected"]
    assert fields["ra_deg"] == pytest.approx(plain["ra_deg"], abs=1e-3)


def test_the_centre_of_the_image_is_named_where_the_optical_axis_misses_it(tmp_path):
    image, camera = tmp_path / "sky.png", tmp_path / "lens.toml"
    lens = "width = 937\nheight = 937\nfocal_px = [1200.0, 1200.0]\ncentre_px = [468.0, 588.0]\n"
    camera.write_text(f"[camera]\n{lens}", encoding="utf-8")
    place = ["--profile", str(camera), "--ra", "83.8", "--dec", "-1.2"]
    assert starhil("render", *place, "-o", str(image)).exit_code == 0
    shown = starid("identify", str(image), "--profile", str(camera)).output
    off_deg = np.degrees(np.arctan2(120.0, 1200.0))
    assert f"that is the optical axis, {60.0 * off_deg:.1f}′ from the centre of the image" in shown
    centre = answer(image, "--profile", str(camera))["centre"]
    assert centre["off_axis_arcsec"] == pytest.approx(3600.0 * off_deg)
    assert (centre["ra_deg"], centre["dec_deg"]) == pytest.approx((83.8, -1.2 + off_deg), abs=0.01)


def test_a_bright_light_that_is_not_identified_is_explained(tmp_path):
    image = tmp_path / "sky.png"
    assert starhil("render", "--ra", "12", "--dec", "0", "-o", str(image)).exit_code == 0
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    rows, columns = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    planet = 200.0 * np.exp(-((columns - 600.0) ** 2 + (rows - 300.0) ** 2) / (2.0 * 0.9**2))
    cv2.imwrite(str(image), np.clip(pixels + planet, 0, 255).astype(np.uint8))
    (light,) = answer(image)["unidentified"]
    assert (light["x_px"], light["y_px"]) == pytest.approx((600.0, 300.0), abs=0.2)
    assert "a planet" in light["why"]
    assert "bright at (600, 300) px, not identified" in starid("identify", str(image)).output


def test_the_advice_for_an_uncertain_attitude_is_not_about_the_field(tmp_path, monkeypatch):
    image = tmp_path / "sky.png"
    assert (
        starhil(
            "render", "--ra", "84", "--dec", "-5", "--fov", "20", "--size", "640x480", "-o", str(image)
        ).exit_code
        == 0
    )
    monkeypatch.setattr(solver, "LARGEST_ERROR_DEG", 1e-9)
    fields = json.loads(starid("identify", str(image), "--json", "--fov", "20").stdout)
    assert fields["reason"] == "uncertain"
    assert fields["advice"].startswith("the identified stars do not exclude an error above 0.1°")


def test_stars_of_the_catalogue_in_one_spot_are_not_called_a_planet(tmp_path):
    image = tmp_path / "sky.png"
    orion = [
        "--ra",
        "84",
        "--dec",
        "-5",
        "--fov",
        "20",
        "--size",
        "640x480",
    ]  # with theta Orionis: four stars in two pixels
    assert starhil("render", *orion, "-o", str(image)).exit_code == 0
    (light,) = answer(image, "--fov", "20")["unidentified"]
    assert light["why"] == "4 stars of the catalogue in one spot, so its place is that of none"


def test_a_solution_prints_as_five_lines(tmp_path):
    image = tmp_path / "sky.png"
    assert starhil("render", "--ra", "83.8", "--dec", "-1.2", "-o", str(image)).exit_code == 0
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    camera = Camera.from_fov()
    stars = detect(pixels)
    lines = repr(make_identifier("geometric", camera).identify(stars.xy_px, stars.flux)).splitlines()
    assert len(lines) == 5
    assert lines[0].startswith("RA 83.8")
    assert "″ across and " in lines[2]
    assert repr(Solution.invalid(Reason.NO_MATCH)).startswith("no attitude: no_match")
