"""What else is in the field: it shows where it should, hides what it should, and is written in the truth."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.sensor.sky.area_light import Backdrop
from starhil.emulator.sensor.sky.light import AreaPainter
from starhil.emulator.sensor.sky.objects import (
    EarthLimb,
    Moon,
    Obstruction,
    PointSource,
    SkyObjects,
    SunGlare,
    icrs_vector,
)
from starhil.emulator.sensor.sky.tables import OPTICAL_FAULT
from starhil.protocol.files.validation import problems
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import load_catalog
from starid.imaging.detection import detect

pytestmark = pytest.mark.lowest("pyerfa")

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(DEFAULT_CAMERA, load_catalog(), SensorModel(bits=12), seed=1)


def place(ra_deg: float, dec_deg: float) -> np.ndarray:
    xy, _ = DEFAULT_CAMERA.project(ORION.to_sensor(icrs_vector(ra_deg, dec_deg)[None, :]))
    return xy[0]


def mean_around(image: np.ndarray, xy: np.ndarray, half: int = 2) -> float:
    x, y = np.rint(xy).astype(int)
    return float(np.median(image[y - half : y + half + 1, x - half : x + half + 1]))


def test_the_moon_saturates_hides_and_glares(renderer: Renderer) -> None:
    plain = renderer.render(ORION)
    rigel = plain.stars.hip == 24436
    frame = renderer.render(ORION, objects=SkyObjects(moon=Moon(78.63, -8.2)))
    assert mean_around(frame.image, plain.stars.xy_px[rigel][0]) == renderer.sensor.max_dn
    assert not frame.stars.visible[frame.stars.hip == 24436][0]
    near, far = place(80.6, -8.2), place(95.0, -8.2)
    glare = [mean_around(frame.image, xy) - mean_around(plain.image, xy) for xy in (near, far)]
    assert glare[0] > 10.0 * max(glare[1], 1.0)
    radius_px = 0.26 / np.degrees(DEFAULT_CAMERA.pixel_scale_rad)
    disc = renderer.render(ORION, objects=SkyObjects(moon=Moon(70.0, -12.0, glare_share=0.0))).image
    x, y = np.rint(place(70.0, -12.0)).astype(int)
    full = np.count_nonzero(disc[y - 15 : y + 16, x - 15 : x + 16] == renderer.sensor.max_dn)
    # the spot's wings saturate as well, some 2 to 4 pixels beyond the limb
    assert np.pi * (radius_px + 1.0) ** 2 < full < np.pi * (radius_px + 5.0) ** 2


def test_the_lit_limb_points_in_the_given_direction(renderer: Renderer) -> None:
    """North is up and east is left: a limb at position angle 90° (east) lights the left half."""
    objects = SkyObjects(
        moon=Moon(83.8, -1.2, diameter_deg=4.0, magnitude=-6.5, illuminated=0.5, glare_share=0.0)
    )
    image = renderer.render(ORION, objects=objects).image.astype(np.float64)
    x, y = np.rint(place(83.8, -1.2)).astype(int)
    left, right = image[y - 20 : y + 21, x - 20].mean(), image[y - 20 : y + 21, x + 20].mean()
    assert left > right + 20.0


def test_the_sun_brightens_the_side_where_it_is(renderer: Renderer) -> None:
    image = renderer.render(ORION, objects=SkyObjects(sun=SunGlare(83.8, 40.0, 2e-5))).image
    top, bottom = np.median(image[:50]), np.median(image[-50:])
    offset = renderer.sensor.offset_dn
    assert top - offset > 4.0 * (bottom - offset)


@pytest.mark.parametrize("off_deg", [2.0, 20.0])
def test_the_sun_in_the_field_saturates_the_image(renderer: Renderer, off_deg: float) -> None:
    frame = renderer.render(ORION, objects=SkyObjects(sun=SunGlare(83.8, -1.2 + off_deg)))
    assert np.mean(frame.image == renderer.sensor.max_dn) > 0.999  # the rest are dead


def test_a_short_exposure_shows_the_disc_of_the_sun(renderer: Renderer) -> None:
    sun = SunGlare(83.8, -1.2)
    short = renderer.with_sensor(renderer.sensor.with_(aperture_m=1e-4, transmission=1e-3))
    image = short.render(ORION, objects=SkyObjects(sun=sun), exposure_s=5e-5).image.astype(np.float64)
    light = image - short.sensor.offset_dn
    half_px = np.sqrt(np.count_nonzero(light > 0.5 * np.median(light[466:471, 466:471])) / np.pi)
    assert half_px == pytest.approx(0.2665 / np.degrees(DEFAULT_CAMERA.pixel_scale_rad), abs=0.5)


@pytest.mark.parametrize("albedo", [0.0, 0.3])
def test_the_earth_covers_stars_behind_it(renderer: Renderer, albedo: float) -> None:
    earth = EarthLimb(83.8, -70.0, radius_deg=64.0, albedo=albedo)
    frame = renderer.render(ORION, objects=SkyObjects(earth=earth))
    vectors = DEFAULT_CAMERA.back_project(frame.stars.xy_px)
    distance = np.degrees(np.arccos(vectors @ ORION.to_sensor(icrs_vector(83.8, -70.0))))
    assert not np.any(frame.stars.visible[distance < 63.9])
    assert np.all(frame.stars.visible[distance > 64.4])
    assert frame.objects is not None
    assert 0.2 < frame.objects.covered_share < 0.6
    below = np.median(frame.image[-40:])
    assert below == renderer.sensor.max_dn if albedo else below <= np.median(frame.image[:40])


def sunlit_sphere(
    directions: np.ndarray, nadir: np.ndarray, sun: np.ndarray, radius_rad: float
) -> np.ndarray:
    """Brightness (n,) of a sphere in directions (n, 3) that meet it, relative to the Sun in the zenith: Lambert's law."""
    distance = 1.0 / np.sin(radius_rad)
    along = directions @ nadir * distance
    length = along - np.sqrt(np.maximum(1.0 - distance**2 + along**2, 0.0))
    return np.clip((length[:, None] * directions - distance * nadir) @ sun, 0.0, 1.0)


@pytest.mark.parametrize("sun", [None, (60.0, 20.0), (150.0, -40.0)])
@pytest.mark.parametrize("radius_deg", [64.0, 20.0, 4.0])
def test_the_earth_is_a_sphere_with_an_atmosphere(radius_deg: float, sun: tuple[float, float] | None) -> None:
    """Within 0.2 % of full daylight; the stars' light fades in proportion to the height above the limb."""
    camera = Camera.from_fov(20.0, width=440, height=440)
    lit = {} if sun is None else {"sun_ra_deg": sun[0], "sun_dec_deg": sun[1]}
    earth = EarthLimb(83.8, -1.0 - radius_deg, radius_deg=radius_deg, atmosphere_deg=0.2, **lit)
    light = AreaPainter(camera, 1.8e6, 0.8).paint(SkyObjects(earth=earth), ORION)
    flat = np.ones((camera.height, camera.width), dtype=np.float32)
    mean = np.zeros_like(flat)
    light.draw(mean, Backdrop(flat, flat, sky_e_s=1.0, exposure_s=1.0))
    pixels = np.argwhere(flat)[::97, ::-1]
    rays, nadir = camera.back_project(pixels.astype(np.float64)), ORION.to_sensor(earth.direction)
    height = (np.degrees(np.arccos(rays @ nadir)) - radius_deg) / 0.2
    passed = np.clip(height, 0.0, 1.0)
    daylight = 1.8e6 * 10.0 ** (0.4 * 26.74) * 0.3 / np.pi * camera.pixel_scale_rad**2
    shade = (
        np.ones(len(rays))
        if sun is None
        else sunlit_sphere(rays, nadir, ORION.to_sensor(icrs_vector(*sun)), earth.radius_rad)
    )
    glow = np.where(height < 20.0, np.exp(-np.maximum(height, 0.0)), 0.0)
    expected = passed + daylight * shade * glow
    np.testing.assert_allclose(mean[pixels[:, 1], pixels[:, 0]], expected, rtol=0.0, atol=0.002 * daylight)
    np.testing.assert_allclose(light.seen_at(pixels.astype(np.float64)), passed, atol=0.008)
    assert light.covered_share == pytest.approx(np.mean(passed < 0.5), abs=0.01)
    assert np.count_nonzero((height > 0.0) & (height < 1.0)) > 10


def test_glare_around_a_source_in_the_field_matches_a_computation_per_pixel(renderer: Renderer) -> None:
    """Within 0.1 % of strength/(chord² + softness²) in every pixel."""
    camera, moon = DEFAULT_CAMERA, Moon(80.0, 2.0, magnitude=-12.7)
    light = AreaPainter(camera, renderer.sensor.zero_magnitude_e_s, 0.8).paint(SkyObjects(moon=moon), ORION)
    zero = np.zeros((camera.height, camera.width), dtype=np.float32)
    mean = zero.copy()
    light.draw(mean, Backdrop(zero, np.ones_like(zero), sky_e_s=0.0, exposure_s=0.2))
    x, y = np.meshgrid(np.arange(0, 937, 3), np.arange(0, 937, 3))
    seen = camera.back_project(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
    chord2 = np.sum((seen - ORION.to_sensor(icrs_vector(80.0, 2.0))) ** 2, axis=1)
    total = renderer.sensor.electrons(-12.7, 0.2) * moon.glare_share * camera.pixel_scale_rad**2
    expected = total / (2.0 * np.pi * np.log(100.0)) / (chord2 + np.radians(0.3) ** 2)
    outside = chord2 > np.radians(0.8) ** 2
    np.testing.assert_allclose(mean[y.ravel(), x.ravel()][outside], expected[outside], rtol=1e-3)


def test_a_straight_edge_covers_the_share_asked_for(renderer: Renderer) -> None:
    frame = renderer.render(ORION, objects=SkyObjects(obstructions=(Obstruction(0.3, 180.0),)))
    assert frame.objects is not None
    assert frame.objects.covered_share == pytest.approx(0.3, abs=0.01)
    edge = 0.3 * 937
    assert not np.any(frame.stars.visible[frame.stars.xy_px[:, 0] < edge - 10.0])
    assert np.all(frame.stars.visible[frame.stars.xy_px[:, 0] > edge + 10.0])


def test_a_polygon_covers_its_inside(renderer: Renderer) -> None:
    corners = ((100.0, 100.0), (600.0, 100.0), (600.0, 500.0), (100.0, 500.0))
    frame = renderer.render(ORION, objects=SkyObjects(obstructions=(Obstruction(polygon_px=corners),)))
    xy = frame.stars.xy_px
    inside = np.all((xy > [110.0, 110.0]) & (xy < [590.0, 490.0]), axis=1)
    outside = np.any((xy < [90.0, 90.0]) | (xy > [610.0, 510.0]), axis=1)
    assert not np.any(frame.stars.visible[inside])
    assert np.all(frame.stars.visible[outside])


def test_false_stars_move_and_fixed_ones_stay(renderer: Renderer) -> None:
    objects = SkyObjects(false_stars=20, fixed_false_stars=10)
    frames = [renderer.render(ORION, frame_index=index, objects=objects) for index in range(2)]
    first, second = (frame.objects.false_xy_px for frame in frames if frame.objects is not None)
    np.testing.assert_array_equal(first[:10], second[:10])
    assert np.abs(first[10:] - second[10:]).min() > 1e-6
    found = detect(frames[0].image, renderer.sensor.detection_settings())
    gaps = np.linalg.norm(first[:, None] - found.xy_px[None], axis=2).min(axis=1)
    assert np.count_nonzero(gaps < 0.3) >= 28


def test_missing_stars_are_the_brightest(renderer: Renderer) -> None:
    frame = renderer.render(ORION, objects=SkyObjects(missing_stars=3))
    assert not np.any(frame.stars.visible[:3])
    assert np.all(frame.stars.visible[3:])
    sky = np.median(frame.image)
    for xy in frame.stars.xy_px[:3]:
        assert mean_around(frame.image, xy) < sky + 15.0


def test_planets_are_points_at_their_directions(renderer: Renderer) -> None:
    planets = (PointSource(83.0, 3.0, -2.0, "Jupiter"), PointSource(270.0, 60.0, 1.0, "Saturn"))
    frame = renderer.render(ORION, objects=SkyObjects(planets=planets))
    assert frame.objects is not None
    assert frame.objects.planet_xy_px[0] == pytest.approx(place(83.0, 3.0))
    assert np.all(np.isnan(frame.objects.planet_xy_px[1]))
    found = detect(frame.image, renderer.sensor.detection_settings())
    assert np.linalg.norm(found.xy_px - place(83.0, 3.0), axis=1).min() < 0.1


def test_particles_leave_charge_at_their_true_positions(renderer: Renderer) -> None:
    frame = renderer.render(ORION, objects=SkyObjects(cosmic_rays_s=200.0))
    plain = renderer.render(ORION)
    assert frame.objects is not None
    tracks = frame.objects.cosmic_rays_px
    assert 15 <= len(tracks) <= 70
    middles = 0.5 * (tracks[:, :2] + tracks[:, 2:])
    middles = middles[np.all((middles > 5.0) & (middles < 930.0), axis=1)]
    brighter = [mean_around(frame.image, xy, 0) > mean_around(plain.image, xy, 0) + 50.0 for xy in middles]
    assert np.mean(brighter) > 0.9


def test_a_blank_sky_has_no_light(renderer: Renderer) -> None:
    frame = renderer.render(ORION, objects=SkyObjects(blank=True))
    assert not np.any(frame.stars.visible)
    found = detect(frame.image, renderer.sensor.detection_settings())
    assert len(found) == 0
    assert found.reason


def test_an_obstruction_of_the_whole_image_lets_no_light_in(renderer: Renderer) -> None:
    covered = renderer.render(ORION, objects=SkyObjects(obstructions=(Obstruction(1.0),)))
    assert covered.image.tobytes() == renderer.render(ORION, objects=SkyObjects(blank=True)).image.tobytes()


def test_objects_do_not_change_the_noise_stream(renderer: Renderer) -> None:
    plain = renderer.render(ORION)
    nothing = renderer.render(ORION, objects=SkyObjects())
    assert plain.image.tobytes() == nothing.image.tobytes()


def test_plain_values_make_the_same_objects() -> None:
    made = SkyObjects.from_dict(
        {
            "moon": {"ra_deg": 10, "dec_deg": 5.0},
            "planets": [{"ra_deg": 1.0, "dec_deg": 2.0, "magnitude": -1.0}],
            "obstructions": [{"polygon_px": [[0, 0], [10, 0], [0, 10]]}],
            "blocked_share": 0.5,
            "false_star_magnitudes": [2, 4],
            "missing_stars": 3,
        }
    )
    assert made == SkyObjects(
        moon=Moon(10, 5.0),
        planets=(PointSource(1.0, 2.0, -1.0),),
        obstructions=(Obstruction(polygon_px=((0, 0), (10, 0), (0, 10))), Obstruction(0.5)),
        false_star_magnitudes=(2, 4),
        missing_stars=3,
    )


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"comet": {}}, "comet: unknown key; known: blank"),
        ({"blocked_shar": 1.0}, "blocked_shar: unknown key; did you mean blocked_share?"),
        ({"moon": {"ra_deg": 1.0}}, "moon.dec_deg: missing"),
        ({"moon": {"ra_deg": 1.0, "dec_deg": 95.0}}, "moon.dec_deg: must be at most 90 (given: 95.0)"),
        (
            {"moon": {"ra_deg": 1.0, "dec_deg": 9.0, "colour": 1}},
            "moon.colour: unknown key; known: bright_limb",
        ),
        ({"moon": 3}, "moon: must be a table (given: 3)"),
        ({"planets": 4}, "planets: must be a list (given: 4)"),
        ({"planets": [{"ra_deg": 1.0, "dec_deg": 2.0}]}, "planets.0.magnitude: missing"),
        ({"false_stars": 1.5}, "false_stars: must be a whole number (given: 1.5)"),
        ({"false_stars": -1}, "false_stars: must be at least 0 (given: -1)"),
        ({"false_star_magnitudes": [5, 1]}, "false_star_magnitudes: 5 to 1; put the brighter one first"),
        ({"false_star_magnitudes": "bright"}, "false_star_magnitudes: must be a list (given: 'bright')"),
        ({"false_star_magnitudes": [1]}, "false_star_magnitudes: must have at least 2 items, not 1"),
        ({"blocked_share": 1.5}, "blocked_share: must be at most 1 (given: 1.5)"),
        ({"blocked_share": ""}, "blocked_share: must be a number (given: '')"),
        ({"blank": "no"}, "blank: must be true or false (given: 'no')"),
        (
            {"obstructions": [{"polygon_px": [1, [2, 3]]}]},
            "obstructions.0.polygon_px.0: must be a list (given: 1)",
        ),
        ({"moon": {"ra_deg": 10**400, "dec_deg": 0.0}}, "moon.ra_deg: must be a"),
        (
            {"moon": {"ra_deg": float("inf"), "dec_deg": 0.0}},
            "moon.ra_deg: must be a finite number (given: inf)",
        ),
        (
            {"earth": {"ra_deg": 0.0, "dec_deg": 0.0, "sun_ra_deg": 1.0}},
            "earth: sun_ra_deg and sun_dec_deg belong together; give both or neither",
        ),
        (
            {"planets": [{"ra_deg": 1.0, "dec_deg": 2.0, "magnitude": 1.0, "name": 3}]},
            "planets.0.name: must be a text (given: 3)",
        ),
        *(
            (
                {"obstructions": [{"polygon_px": [[1, 2], [3, corner]]}]},
                f"obstructions.0.polygon_px.1.1: {said}",
            )
            for corner, said in (
                ("a", "must be a number (given: 'a')"),
                (True, "must be a number (given: True)"),
                (float("nan"), "must be a finite number (given: nan)"),
                (1e200, "must be at most 100000 (given: 1e+200)"),
            )
        ),
    ],
)
def test_bad_objects_are_rejected_in_one_line(values: dict[str, object], text: str) -> None:
    with pytest.raises(ValidationError) as caught:
        OPTICAL_FAULT.model_validate(values)
    (problem,) = map(str, problems(caught.value, OPTICAL_FAULT, values))
    assert problem.startswith(text) or f": {text}" in problem
    assert "\n" not in problem
