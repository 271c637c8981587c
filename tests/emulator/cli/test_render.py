"""`starhil render` as a user calls it, and the way from its image back to the attitude."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from starhil.emulator.cli.app import main
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA
from starid.imaging.detection import detect
from starid.imaging.image_io import read_image

pytestmark = pytest.mark.long


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["starhil", "render", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


def test_the_same_command_makes_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ("--ra", "83.8", "--dec", "-1.2", "--roll", "30", "--seed", "1")
    for name in ("a.png", "b.png"):
        assert run(monkeypatch, *options, "-o", str(tmp_path / name)) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    image = read_image(tmp_path / "a.png")
    assert (image.shape, image.dtype) == ((937, 937), np.uint8)


def test_truth_as_json_is_where_the_stars_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "orion.png"
    options = ("--ra", "83.8", "--dec", "-1.2", "--roll", "30", "--seed", "1", "-o", str(target), "--json")
    assert run(monkeypatch, *options) == 0
    truth = json.loads(capsys.readouterr().out)
    assert truth["exposure_s"] == 0.2
    attitude = Attitude.from_quaternion(truth["quaternion_xyzw"])
    assert (attitude.ra_deg, attitude.dec_deg, attitude.roll_deg) == pytest.approx((83.8, -1.2, 30.0))
    stars = np.array([[star["x_px"], star["y_px"]] for star in truth["stars"]])
    detections = detect(read_image(target))
    gaps = np.linalg.norm(detections.xy_px[:, None] - stars[None], axis=2)
    off = detections.xy_px - stars[gaps.argmin(axis=1)]
    near = gaps.min(axis=1) < 1.5
    assert near.sum() > 300
    seen = DEFAULT_CAMERA.back_project(detections.xy_px[near])
    true = DEFAULT_CAMERA.back_project(stars[gaps.argmin(axis=1)][near])
    turn = np.linalg.svd(seen.T @ true)
    rotation = turn.U @ np.diag([1.0, 1.0, np.linalg.det(turn.U @ turn.Vh)]) @ turn.Vh
    angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))
    assert angle < 0.01
    assert np.median(np.hypot(*off[near].T)) < 0.06


@pytest.mark.parametrize(("bits", "dtype"), [("8", np.uint8), ("12", np.uint16), ("16", np.uint16)])
def test_bits_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bits: str, dtype: type) -> None:
    target = tmp_path / "small.png"
    options = (
        "--ra",
        "10",
        "--dec",
        "60",
        "--bits",
        bits,
        "--size",
        "320x200",
        "--fov",
        "20",
        "-o",
        str(target),
    )
    assert run(monkeypatch, *options) == 0
    image = read_image(target)
    assert (image.shape, image.dtype) == ((200, 320), dtype)


def test_an_annotated_image_has_colour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "marked.png"
    rate = ("--rate", "0.5", "0", "1", "--exposure", "0.4", "--limit", "5")
    assert run(monkeypatch, "--ra", "83.8", "--dec", "-1.2", *rate, "--annotate", "-o", str(target)) == 0
    image = cv2.imread(str(target), cv2.IMREAD_UNCHANGED)
    assert image.shape == (937, 937, 3)
    green = (image[:, :, 1].astype(int) - image[:, :, 2]) > 60
    assert green.sum() > 1000


def test_a_profile_gives_camera_and_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "profile.png"
    assert run(monkeypatch, "--profile", "cubestar", "--ra", "0", "--dec", "90", "-o", str(target)) == 0
    assert read_image(target).shape == (937, 937)


def test_a_profile_gives_exposure_gain_and_what_is_in_the_sky(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    profile = tmp_path / "mine.toml"

    def rendered(text: str, *options: str) -> tuple[np.ndarray, float]:
        profile.write_text(text, encoding="utf-8")
        target = tmp_path / "x.png"
        arguments = ("--profile", str(profile), "--ra", "0", "--dec", "40", "-o", str(target), "--json")
        assert run(monkeypatch, *arguments, *options) == 0
        return read_image(target), json.loads(capsys.readouterr().out)["exposure_s"]

    plain, exposure = rendered('extends = "ideal"\n')
    assert exposure == 0.1
    dark, _ = rendered('extends = "ideal"\nsky = { blank = true }\n')
    assert np.count_nonzero(dark > 30) < np.count_nonzero(plain > 30) / 4  # hot pixels stay
    longer, exposure = rendered('extends = "ideal"\nparameters = { exposure = 400, analog_gain = 2.0 }\n')
    assert exposure == 0.4
    assert np.median(longer) > np.median(plain)
    _, exposure = rendered('extends = "ideal"\n', "--exposure", "0.3")
    assert exposure == 0.3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--dec", "95"), "--dec 95.0: must be between -90 and 90"),
        (("--ra", "361"), "--ra 361: must be between -360 and 360"),
        (("--ra", "nan"), "'--ra': must be finite"),
        (("--bits", "9"), "sensor.bits: must be one of 8, 12, 16 (given: 9)"),
        (("--exposure", "-1"), "sensor.exposure_s: must be at least 1e-06 (given: -1.0)"),
        (("--size", "3"), "--size 3: must be 16 to 8192"),
        (("--size", "axb"), "--size axb: must be WIDTH or WIDTHxHEIGHT"),
        (("--fov", "200"), "fov_deg: must be degrees in (0, 170] for pinhole, not 200.0"),
        (("--limit", "99"), "sensor.limiting_magnitude: must be at most 20 (given: 99.0)"),
        (("--seed", "-3"), "seed: must be a whole number from 0, not -3"),
        (("--rate", "0", "0", "99999"), "--rate 0 0 99999: must be at most 1000 degrees/s"),
        (("--model", "fish"), "camera model: must be one of"),
        (("-o", "image.foo"), "not '.foo'"),
        (("--profile", "nowhere"), "nowhere"),
    ],
)
def test_bad_values_are_rejected_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    text: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "--ra", "83.8", "--dec", "-1.2", "-o", "x.png", *arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert text in output.err
    assert output.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


def test_an_orbit_moves_the_stars_by_aberration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At most 20.5 arcseconds by the Earth's orbit, 0.3 by its eccentricity, 5.2 by the satellite's, besides parallax up to 0.8."""
    places = []
    for orbit in ((), ("--orbit", "leo")):
        options = (
            "--profile",
            "ideal",
            "--ra",
            "200",
            "--dec",
            "60",
            "-o",
            str(tmp_path / "sky.png"),
            "--json",
            *orbit,
        )
        assert run(monkeypatch, *options) == 0
        stars = json.loads(capsys.readouterr().out)["stars"]
        places.append({star["hip"]: (star["x_px"], star["y_px"]) for star in stars})
    both = sorted(places[0].keys() & places[1].keys())
    before, after = (DEFAULT_CAMERA.back_project(np.array([each[hip] for hip in both])) for each in places)
    shifts = np.linalg.norm(after - before, axis=1) * 206_265.0
    assert len(both) > 50
    assert np.median(shifts) > 1.0
    assert shifts.max() < 20.5 + 0.35 + 5.2 + 0.8


def test_an_orbit_needs_a_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--ra", "200", "--dec", "60", "-o", str(tmp_path / "sky.png"), "--orbit", "leo")
    assert run(monkeypatch, *options) != 0
    assert "--profile" in capsys.readouterr().err
