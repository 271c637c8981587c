"""Stray light of an Earth outside the field: that of its parts, each dimmed by the baffle as the Sun is; and the stars it costs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starhil.emulator.sensor.sky.area_light import Backdrop
from starhil.emulator.sensor.sky.light import AreaPainter
from starhil.emulator.sensor.sky.objects import EarthLimb, SkyObjects, SunGlare
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.detection import detect

CAMERA = Camera.from_fov(20.0, width=101, height=101)
AT = Attitude.from_radec_roll(0.0, 0.0, 0.0)
SHARE = 1e-4


def glow_e_s(objects: SkyObjects, at: Attitude = AT) -> float:
    """Light of bodies in the central pixel, electrons/s."""
    none = np.zeros((101, 101), dtype=np.float32)
    mean = none.copy()
    area = AreaPainter(CAMERA, 1e6, 0.8).paint(objects, at)
    area.draw(mean, Backdrop(none, none + 1.0, 0.0, 1.0))
    return float(mean[50, 50])


@pytest.mark.parametrize("away_deg", [25.0, 40.0, 70.0])
def test_a_small_earth_is_a_sun_as_bright_as_its_disc(away_deg):
    earth = EarthLimb(away_deg, 0.0, radius_deg=0.5, albedo=0.4, stray_share=SHARE)
    sun = SunGlare(away_deg, 0.0, stray_share=SHARE)
    solid_angle = 2.0 * math.pi * (1.0 - math.cos(math.radians(0.5)))
    expected = glow_e_s(SkyObjects(sun=sun)) * 0.4 / math.pi * solid_angle
    assert glow_e_s(SkyObjects(earth=earth)) == pytest.approx(expected, rel=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("sun_deg", [(180.0, 0.0), (60.0, 30.0), (10.0, -70.0)])
def test_a_wide_earth_gives_the_sum_over_its_parts(sun_deg):
    """140 000 random lines of sight to a sphere of radius 1, each as bright as the cosine of the Sun's zenith distance."""
    nadir_deg, radius_deg = 100.0, 64.0
    sun = Attitude.from_radec_roll(*sun_deg, 0.0).boresight
    earth = EarthLimb(
        nadir_deg,
        0.0,
        radius_deg=radius_deg,
        stray_share=SHARE,
        sun_ra_deg=sun_deg[0],
        sun_dec_deg=sun_deg[1],
    )
    nadir = Attitude.from_radec_roll(nadir_deg, 0.0, 0.0).boresight
    rng = np.random.default_rng(1)
    lines = rng.normal(size=(500_000, 3))
    lines /= np.linalg.norm(lines, axis=1)[:, None]
    lines = lines[lines @ nadir > math.cos(math.radians(radius_deg))]
    distance = 1.0 / math.sin(math.radians(radius_deg))
    middle = distance * (lines @ nadir)
    along = middle - np.sqrt(middle**2 - distance**2 + 1.0)
    normals = along[:, None] * lines - distance * nadir
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    lit = np.maximum(normals @ sun, 0.0)
    chord = np.linalg.norm(lines - AT.boresight, axis=1)
    soft = 2.0 * math.sin(math.radians(1.5))
    weight = lit * 0.3 / math.pi * 4.0 * math.pi / 500_000 * (chord < math.sqrt(2.0))
    by_distance = float(np.sum(weight / (chord**2 + soft**2) ** 1.5))
    away = 2.0 * math.sin(math.radians(20.0))
    sun_40 = glow_e_s(SkyObjects(sun=SunGlare(40.0, 0.0, stray_share=SHARE)))
    expected = sun_40 * (away**2 + soft**2) ** 1.5 * by_distance
    assert glow_e_s(SkyObjects(earth=earth)) == pytest.approx(expected, rel=0.03)


def test_it_is_off_by_default_and_a_dark_earth_or_one_behind_the_lens_gives_none():
    assert glow_e_s(SkyObjects(earth=EarthLimb(80.0, 0.0, radius_deg=60.0))) == 0.0
    for earth in (
        EarthLimb(80.0, 0.0, radius_deg=60.0, stray_share=SHARE, albedo=0.0),
        EarthLimb(180.0, 0.0, radius_deg=60.0, stray_share=SHARE),
    ):
        assert glow_e_s(SkyObjects(earth=earth)) == 0.0


def test_it_costs_stars():
    camera, sensor = Camera.from_fov(42.0, width=400, height=400), SensorModel()
    renderer, at = Renderer(camera, load_catalog(), sensor, 3), Attitude.from_radec_roll(83.8, -1.2, 0.0)
    levels = []
    for share in (0.0, 1e-3, 3e-3):
        earth = EarthLimb(83.8 + 105.0, 0.0, radius_deg=64.0, stray_share=share)
        frame = renderer.render(at, objects=SkyObjects(earth=earth))
        levels.append(len(detect(frame.image, sensor.detection_settings())))
    assert levels[0] > levels[1] > levels[2]
