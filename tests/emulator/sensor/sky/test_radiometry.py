"""Light of Sun, Moon and Earth from first principles: Planck's law, Lambert's law, and Harvey's law of scattering."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from scipy.integrate import trapezoid

from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.sensor.sky.area_light import Backdrop
from starhil.emulator.sensor.sky.light import AreaPainter
from starhil.emulator.sensor.sky.objects import LENS_SCATTER, EarthLimb, Moon, SkyObjects, SunGlare
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.imaging.detection import detect

pytestmark = pytest.mark.lowest("pyerfa")

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CAMERA = Camera.from_fov(42.0, width=937, height=937)
SENSOR = SensorModel()


def sunlight_photons_s_m2() -> float:
    """Photons from 400 to 900 nm of a black body of 5772 K (IAU 2015) with a radius of 959.63″."""
    planck, light, boltzmann = 6.62607015e-34, 299_792_458.0, 1.380649e-23
    wave = np.linspace(400e-9, 900e-9, 2001)
    radiance = 2.0 * light / wave**4 / np.expm1(planck * light / (wave * boltzmann * 5772.0))
    return math.pi * math.radians(959.63 / 3600.0) ** 2 * float(trapezoid(radiance, wave))


painter = lru_cache(2)(AreaPainter)
"""Which computes once where each pixel of a camera looks."""


def light(objects: SkyObjects, sensor: SensorModel = SENSOR, camera: Camera = CAMERA) -> np.ndarray:
    """Electrons/s in each pixel (h, w), without sky and dark current."""
    area = painter(camera, sensor.zero_magnitude_e_s, sensor.psf_sigma_px).paint(objects, ORION)
    zero = np.zeros((camera.height, camera.width), dtype=np.float32)
    mean = zero.copy()
    area.draw(mean, Backdrop(zero, np.ones_like(zero), sky_e_s=0.0, exposure_s=1.0))
    return mean


def electrons_s(sensor: SensorModel, photons_s_m2: float) -> float:
    pupil_m2 = math.pi * (0.5 * sensor.aperture_m) ** 2
    return photons_s_m2 * pupil_m2 * sensor.transmission * sensor.quantum_efficiency


@pytest.mark.parametrize("radius_deg", [64.0, 5.0])
def test_the_lit_earth_is_as_bright_as_a_white_disc_of_its_albedo_in_the_light_of_a_black_body(radius_deg):
    seen = light(SkyObjects(earth=EarthLimb(83.8, -1.2, radius_deg=radius_deg, albedo=0.3)))[468, 468]
    per_sr = electrons_s(SENSOR, 0.3 / math.pi * sunlight_photons_s_m2())
    assert seen == pytest.approx(per_sr / CAMERA.focal_px[0] ** 2, rel=0.12)


def test_a_lit_earth_saturates_at_once():
    renderer = Renderer(CAMERA, load_catalog(), SENSOR, seed=1)
    image = renderer.render(ORION, objects=SkyObjects(earth=EarthLimb(83.8, -1.2)), exposure_s=1e-3).image
    assert np.mean(image == SENSOR.max_dn) > 0.999  # the rest are dead


@pytest.mark.parametrize(
    "objects",
    [
        SkyObjects(earth=EarthLimb(83.8, -1.2)),
        SkyObjects(sun=SunGlare(83.8, 40.0)),
        SkyObjects(moon=Moon(90.0, 5.0)),
    ],
    ids=["earth", "sun", "moon"],
)
def test_light_of_bodies_scales_with_pupil_efficiency_and_pixel(objects):
    full, pixel = light(objects), (200, 300)
    small = SENSOR.with_(aperture_m=0.004, quantum_efficiency=0.15, transmission=0.5)
    factor = (0.004 / 0.012) ** 2 * (0.15 / 0.45) * (0.5 / 0.75)
    assert light(objects, small)[pixel] == pytest.approx(factor * full[pixel], rel=1e-3)
    coarse = Camera.from_fov(42.0, width=468, height=468)
    binned = light(objects, camera=coarse)[100, 150]
    assert binned == pytest.approx((937.0 / 468.0) ** 2 * full[pixel], rel=0.02)


def test_the_moons_glare_at_ten_degrees_is_that_of_ten_polished_surfaces():
    """BSDF of a polished surface by Harvey: b0 0.1/sr, knee 0.01 rad, slope −1.5 (FRED's values, Photon Engineering)."""
    sine = math.sin(math.radians(10.0))
    bsdf_sr = 10.0 * 0.1 * (1.0 + (sine / 0.01) ** 2) ** -0.75
    moon = Moon(83.8, 8.8, magnitude=-12.74)
    pixel_sr = (1.0 / CAMERA.focal_px[0]) ** 2
    full_moon = electrons_s(SENSOR, sunlight_photons_s_m2() * 10.0 ** (-0.4 * (26.74 - 12.74)))
    assert light(SkyObjects(moon=moon))[468, 468] == pytest.approx(full_moon * bsdf_sr * pixel_sr, rel=0.15)


def test_the_sun_off_the_axis_has_a_point_source_transmittance_of_a_baffled_star_tracker():
    """Irradiance on the detector over that at the pupil: 1e-9 to 1e-8 at the exclusion angle (Donati, SPIE 1165, 1990)."""
    focal_m = CAMERA.focal_px[0] * 12e-6
    received = light(SkyObjects(sun=SunGlare(83.8, 28.8)))[468, 468] / SENSOR.quantum_efficiency / 12e-6**2
    transmittance = received / sunlight_photons_s_m2()
    assert 1e-9 < transmittance < 1e-8
    bare = (
        0.012 / (2.0 * math.pi * math.log(100.0)) / (2.0 * math.sin(math.radians(15.0))) ** 2
    )  # scattered per sr
    bare *= SENSOR.transmission * math.pi * (0.5 * SENSOR.aperture_m / focal_m) ** 2
    assert transmittance == pytest.approx(1e-5 * bare, rel=0.15)


@pytest.mark.parametrize(("glare_share", "most"), [(LENS_SCATTER, 0.7), (0.0, 1.0)], ids=["lens", "no glare"])
def test_a_full_moon_ten_degrees_off_the_boresight_costs_the_stars_around_it(glare_share, most):
    sensor = SENSOR.with_(exposure_s=0.1)
    catalog = load_catalog()
    renderer = Renderer(CAMERA, catalog, sensor, seed=1)
    moon = Moon(83.8, 8.8, magnitude=-12.74, glare_share=glare_share)
    magnitudes = []
    for sky in (SkyObjects(), SkyObjects(moon=moon)):
        frame = renderer.render(ORION, objects=sky)
        off_deg = np.degrees(np.arccos(catalog.vectors[frame.stars.catalog_index] @ moon.direction))
        around = (off_deg > 1.5) & (off_deg < 6.0)
        xy = detect(frame.image, sensor.detection_settings()).xy_px
        gaps = np.linalg.norm(frame.stars.xy_px[around][:, None] - xy, axis=2).min(axis=1)
        magnitudes.append(np.count_nonzero(gaps < 2.0))
    assert magnitudes[0] >= 15
    assert most - 0.3 < magnitudes[1] / magnitudes[0] <= most


@pytest.mark.long
def test_a_baffle_leaves_tenfold_less_sunlight_for_each_decade_of_angle_outside_the_exclusion_angle():
    """From the light that a bare lens scatters, which is the same law without a baffle, to `stray_share` of it."""
    sun = {"ra_deg": 83.8, "exclusion_deg": 30.0}

    def lit(off_deg: float, **keys: float) -> float:
        return float(light(SkyObjects(sun=SunGlare(dec_deg=off_deg - 1.2, **sun, **keys)))[468, 468])

    for off_deg in (32.0, 35.0, 40.0):
        bare = lit(off_deg, stray_share=1.0)
        assert lit(off_deg, decade_deg=2.5) == pytest.approx(
            bare * 10.0 ** (-(off_deg - 30.0) / 2.5), rel=1e-3
        )
    assert lit(60.0, decade_deg=2.5) == pytest.approx(lit(60.0), rel=1e-6)
    assert lit(35.0) == pytest.approx(1e-5 * lit(35.0, stray_share=1.0), rel=1e-3)


def test_ghosts_lie_opposite_to_their_stars_with_their_share_of_the_light():
    renderer = Renderer(CAMERA, load_catalog(), SENSOR.with_(read_noise_e=0.0, bits=16, prnu=0.0), seed=1)
    share = 0.01
    clear, ghosted = (
        renderer.render(ORION, exposure_s=0.1, objects=SkyObjects(ghost_share=value))
        for value in (0.0, share)
    )
    more = ghosted.image.astype(float) - clear.image
    rigel = clear.stars.xy_px[clear.stars.hip == 24436][0]
    x, y = (2.0 * np.array(CAMERA.centre_px) - rigel).round().astype(int)
    around = more[y - 6 : y + 7, x - 6 : x + 7].sum() * ghosted_gain()
    electrons = float(clear.stars.electrons[clear.stars.hip == 24436][0])
    assert around == pytest.approx(share * electrons, abs=5.0 * math.sqrt(2.0 * 13**2 * 10.0))


def ghosted_gain() -> float:
    """Electrons per count with 16 bits."""
    return SENSOR.with_(bits=16).gain_e_per_dn


def test_the_moons_ghost_lies_opposite_to_it_and_hides_nothing():
    moon = Moon(83.8, 5.0, glare_share=0.0)
    plain, ghosted = (light(SkyObjects(moon=moon, ghost_share=share)) for share in (0.0, 1e-4))
    more = ghosted - plain
    rows, columns = np.nonzero(more > 0.5 * more.max())
    centre = CAMERA.project(ORION.to_sensor(moon.direction)[None, :])[0][0]
    assert (columns.mean(), rows.mean()) == pytest.approx(2.0 * np.array(CAMERA.centre_px) - centre, abs=0.5)
    assert more.sum() == pytest.approx(1e-4 * SENSOR.electrons(-12.7, 1.0), rel=0.05)
    assert more.min() > -1e-3 * more.max()
