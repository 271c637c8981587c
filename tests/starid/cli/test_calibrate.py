"""`starid calibrate` on rendered frames, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.sensor.renderer import render
from starid.attitude import Attitude
from starid.camera import Camera
from starid.camera.file import load_camera
from starid.catalog import load_catalog
from starid.cli.app import main
from starid.imaging.image_io import write_image

pytestmark = pytest.mark.long

LENS = Camera(640, 512, (850.0, 850.0), (322.0, 250.0), "pinhole", (-0.08, 0.02, 0.0, 0.0, 0.0))
POINTINGS = [(83.8, -1.2, 30.0), (283.0, 35.0, 200.0), (190.0, -60.0, 100.0), (170.0, 55.0, 300.0)]

NOISE = np.random.default_rng(1).normal(100, 3, (512, 640)).clip(0, 255).astype(np.uint8)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["starid", "calibrate", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("frames")
    catalog = load_catalog()
    for i, pointing in enumerate(POINTINGS):
        frame = render(LENS, catalog, Attitude.from_radec_roll(*pointing), seed=i)
        write_image(folder / f"{i}.png", frame.image)
    return [str(folder / f"{i}.png") for i in range(len(POINTINGS))]


def test_camera_is_found_and_saved(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, images: list[str]
) -> None:
    profile = tmp_path / "camera.toml"
    rough = str(LENS.fov_deg * 1.05)
    assert run(monkeypatch, *images, "--fov", rough, "-o", str(profile), "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["refused"] == {}
    assert report["fov_deg"] == pytest.approx(LENS.fov_deg, abs=0.02)
    assert report["rms_px"] < 0.5
    camera = load_camera(profile)
    assert camera.to_dict() == report["camera"]
    grid = LENS.border(9) * 0.96 + 10.0
    moved = camera.project(LENS.back_project(grid))[0] - grid
    assert np.abs(moved - moved.mean(axis=0)).max() < 0.6
    for frame, (ra, dec, _) in zip(report["frames"], POINTINGS, strict=True):
        assert frame["ra_deg"] == pytest.approx(ra, abs=0.5)
        assert frame["dec_deg"] == pytest.approx(dec, abs=0.2)


def test_frames_that_show_no_sky_end_in_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, images: list[str]
) -> None:
    write_image(tmp_path / "noise.png", NOISE)
    output = tmp_path / "camera.toml"
    assert run(monkeypatch, images[0], str(tmp_path / "noise.png"), "--fov", "41", "-o", str(output)) == 1
    out = capsys.readouterr().out
    assert "not identified" in out
    assert "noise.png" in out
    assert load_camera(output).width == 640


def test_bad_input_ends_in_one_line_and_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, images: list[str]
) -> None:
    write_image(tmp_path / "noise.png", NOISE)
    write_image(tmp_path / "small.png", np.arange(64 * 64, dtype=np.uint16).reshape(64, 64))
    output = tmp_path / "camera.toml"
    for arguments, words in (
        ([*images, str(tmp_path / "small.png"), "--fov", "41"], "64×64 pixels, the first image has 640×512"),
        ([str(tmp_path / "none.png"), "--fov", "41"], "no such file"),
        ([images[0], "--fov", "0"], "fov_deg"),
        ([images[0], "--fov", "41", "--model", "mirror"], "'mirror'"),
        ([images[0], "--fov", "41", "--estimate", "colour"], "'colour'"),
        ([str(tmp_path / "noise.png"), "--fov", "41"], "none of 1 frames could be identified"),
    ):
        assert run(monkeypatch, *arguments, "-o", str(output)) == 2, arguments
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("starid: ")
        assert captured.err.count("\n") == 1
        assert words in captured.err
    assert not output.exists()
