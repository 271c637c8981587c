"""Sun, Moon, Earth and planets by date and orbit, against JPL's DE421, published values and plain geometry."""

from __future__ import annotations

import math
from pathlib import Path

import erfa
import numpy as np
import pytest
from pydantic import ValidationError

from starhil.emulator.sensor.renderer import Renderer, SensorModel
from starhil.emulator.sensor.sky.ephemeris import Observer
from starhil.emulator.sensor.sky.light import through_baffle
from starhil.emulator.sensor.sky.objects import SkyObjects, icrs_vector
from starhil.emulator.sensor.sky.tables import SKY
from starhil.emulator.sensor.sky.view import Sky
from starhil.emulator.truth.orbit import KeplerOrbit
from starhil.protocol.files.validation import problems
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import load_catalog
from starid.catalog.aberration import aberrated
from starid.catalog.earth import earth_and_sun, earth_velocity, in_metres, terrestrial_time, unix_time

pytestmark = pytest.mark.lowest("pyerfa")

NEW_YEAR = unix_time("2026-01-01")
BY_DATE = Sky({"bodies": "ephemeris"})
ARCSEC = math.radians(1.0 / 3600.0)
ORBIT_S = 95 * 60
EARTH_RADIUS_KM = 6371.0


def de421() -> list[tuple[str, list[float]]]:
    text = (Path(__file__).parent / "de421_directions.txt").read_text()
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return [(row[0], [float(value) for value in row[1:]]) for row in rows]


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def differences(date: str, values: list[float]) -> list[float]:
    """Of Sun, Moon and the planets, arcseconds, and of the Earth's velocity, m/s."""
    objects = BY_DATE.view(unix_time(date)).objects
    bodies = (objects.sun, objects.moon, *objects.planets)
    places = [icrs_vector(*values[2 * k : 2 * k + 2]) for k in range(len(bodies))]
    seen = [icrs_vector(body.ra_deg, body.dec_deg) for body in bodies]
    velocity = float(np.linalg.norm(np.subtract(earth_velocity(unix_time(date)), values[18:])))
    return [*(angle(a, b) / ARCSEC for a, b in zip(seen, places, strict=True)), velocity]


def test_bodies_are_where_jpl_has_them_to_the_accuracy_on_the_page():
    largest = np.max([differences(date, values) for date, values in de421()], axis=0)
    sun, moon, mercury, venus, mars, jupiter, saturn, uranus, neptune, velocity = largest
    page = (Path(__file__).parents[4] / "docs" / "sky.md").read_text(encoding="utf-8")
    rows = {
        row.split(" | ")[0]: row.rsplit(" | ", 1)[-1] for row in page.splitlines() if row.startswith("| ")
    }
    assert rows["| Sun"] == f"{sun:.2f}″ |"
    assert rows["| Moon"] == f"{moon:.0f}″ |"
    assert rows["| planets"] == f"{saturn:.0f}″ (Saturn), {uranus:.0f}″ (Uranus), {mars:.0f}″ (Mars) |"
    assert rows["| Earth's velocity"] == f"{1e3 * velocity:.0f} mm/s |"
    assert max(mercury, venus, jupiter, neptune) < mars


@pytest.mark.parametrize(
    "date", ["2016-12-31T23:59:59.5", "2017-01-01", "2026-03-01T00:05", "2031-07-09T12:07:31.7"]
)
def test_interpolated_positions_match_the_series(date):
    """Within 1 m and 20 µm/s for the Earth and the Sun, and 0.001″ for the Moon, in the middle of a slot and at a leap second."""
    unix_s = unix_time(date)
    observer = Observer(unix_s)
    earth, velocity, sun = earth_and_sun(unix_s)
    np.testing.assert_allclose(observer.position_m, earth, atol=1.0, rtol=0.0)
    np.testing.assert_allclose(observer.velocity_m_s, velocity, atol=2e-5, rtol=0.0)
    np.testing.assert_allclose(observer.sun, sun, atol=1.0, rtol=0.0)
    offset, motion = in_metres(erfa.moon98(*terrestrial_time(unix_s)))
    seen = earth + offset - np.linalg.norm(offset) / 299_792_458.0 * (velocity + motion)
    assert np.linalg.norm(observer.moon - seen) < 0.001 * ARCSEC * np.linalg.norm(offset)


@pytest.mark.parametrize(
    ("date", "name", "magnitude"),
    [
        ("2025-02-16", "Venus", -4.9),  # greatest brilliancy
        ("2024-12-07T21:00", "Jupiter", -2.8),  # oppositions
        ("2020-10-13T23:00", "Mars", -2.6),
        ("2017-06-15", "Saturn", 0.0),  # rings open
        ("2025-09-21", "Saturn", 0.6),  # rings nearly edge-on
        ("2024-11-17", "Uranus", 5.6),
    ],
)
def test_planets_are_as_bright_as_published(date, name, magnitude):
    planets = {planet.name: planet for planet in BY_DATE.view(unix_time(date)).objects.planets}
    assert planets[name].magnitude == pytest.approx(magnitude, abs=0.12)


@pytest.mark.parametrize(
    ("date", "share"),
    [
        ("2024-03-25T07:00", 1.0),
        ("2024-04-08T18:20", 0.0),
        ("2024-04-15T19:13", 0.5),
        ("2026-01-03T10:03", 1.0),
    ],
)
def test_the_moon_has_its_phase_and_its_lit_side_faces_the_sun(date, share):
    objects = BY_DATE.view(unix_time(date)).objects
    moon = objects.moon
    assert moon.illuminated == pytest.approx(share, abs=0.01)
    assert 0.48 < moon.diameter_deg < 0.57
    if share == 0.5:
        assert moon.magnitude == pytest.approx(-10.0, abs=0.4)
        here, sun = (icrs_vector(body.ra_deg, body.dec_deg) for body in (moon, objects.sun))
        pole = np.array([0.0, 0.0, 1.0])
        north = pole - (pole @ here) * here
        north /= np.linalg.norm(north)
        towards = math.radians(moon.bright_limb_deg)
        limb = math.cos(towards) * north + math.sin(towards) * np.cross(pole, here) / math.hypot(*here[:2])
        assert angle(limb, sun - (sun @ here) * here) < 1e-3


def test_the_moon_is_displaced_for_an_observer_in_orbit():
    place = 7e6 * np.array([0.0, 0.0, 1.0])
    geocentric, apparent = (
        BY_DATE.view(NEW_YEAR, position, np.zeros(3)).objects.moon for position in (None, place)
    )
    shift = angle(*(icrs_vector(moon.ra_deg, moon.dec_deg) for moon in (geocentric, apparent)))
    expected = 7e6 * math.cos(math.radians(geocentric.dec_deg)) / 3.62e8
    assert shift == pytest.approx(expected, rel=0.03)
    assert apparent.dec_deg < geocentric.dec_deg


def test_stars_have_parallax_and_aberration():
    catalog = load_catalog()
    vectors, parallax = catalog.vectors[:50], np.radians(catalog.parallax_mas[:50] / 3.6e6)
    observer = Observer(NEW_YEAR)
    still = aberrated(vectors, observer.velocity_m_s)
    np.testing.assert_allclose(observer.apparent_stars(vectors, np.zeros(50)), still, rtol=0.0, atol=1e-15)
    shifted = observer.apparent_stars(vectors, parallax)
    for seen, without, size in zip(shifted, still, parallax, strict=True):
        assert np.linalg.norm(seen - without) <= 1.02 * size + 1e-12
        assert (seen - without) @ (observer.sun - observer.position_m) >= 0.0 or size < 1e-12


def test_the_renderer_shows_stars_where_a_moving_observer_sees_them():
    catalog = load_catalog()
    renderer = Renderer(DEFAULT_CAMERA, catalog, SensorModel())
    at = Attitude.from_radec_roll(83.8, -1.2, 0.0)
    observer = Observer(NEW_YEAR, np.array([7e6, 0.0, 0.0]), np.array([0.0, 7500.0, 0.0]))
    stars = renderer.render(at, observer=observer).stars
    vectors = catalog.vectors[stars.catalog_index]
    parallax = np.radians(np.maximum(catalog.parallax_mas[stars.catalog_index], 0.0) / 3.6e6)
    seen, _ = DEFAULT_CAMERA.project(at.to_sensor(observer.apparent_stars(vectors, parallax)))
    assert stars.xy_px == pytest.approx(seen, abs=1e-6)
    plain, _ = DEFAULT_CAMERA.project(at.to_sensor(vectors))
    assert np.linalg.norm(seen - plain, axis=1).max() > 0.05
    assert np.array_equal(renderer.render(at).image, renderer.render(at, observer=None).image)


def test_the_earth_fills_its_angle_and_hides_sun_and_moon():
    sun = BY_DATE.view(NEW_YEAR).objects.sun
    behind = -7e6 * icrs_vector(sun.ra_deg, sun.dec_deg)
    objects = BY_DATE.view(NEW_YEAR, behind, np.zeros(3)).objects
    assert objects.sun is None
    assert objects.earth.radius_deg == pytest.approx(math.degrees(math.asin(6371.0 / 7000.0)), abs=0.01)
    assert BY_DATE.view(NEW_YEAR, -behind, np.zeros(3)).objects.sun is not None
    moon = BY_DATE.view(NEW_YEAR).objects.moon
    assert BY_DATE.view(NEW_YEAR, -7e6 * icrs_vector(moon.ra_deg, moon.dec_deg)).objects.moon is None
    assert BY_DATE.view(NEW_YEAR).objects.earth is None


def test_the_sun_fades_while_its_disc_sets_behind_the_earth():
    sun = BY_DATE.view(NEW_YEAR).objects.sun
    towards = icrs_vector(sun.ra_deg, sun.dec_deg)
    side = np.cross(towards, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    radius = math.asin(6371.0 / 7000.0)
    shares = []
    for above in (-0.30, -0.15, 0.0, 0.15, 0.30):
        off = radius + math.radians(above)
        place = -7e6 * (math.cos(off) * towards + math.sin(off) * side)
        seen = BY_DATE.view(NEW_YEAR, place, np.zeros(3)).objects.sun
        shares.append(0.0 if seen is None else seen.stray_share / sun.stray_share)
    assert shares[0] == 0.0
    assert shares[2] == pytest.approx(0.5, abs=0.02)
    assert shares[4] == pytest.approx(1.0)
    assert shares == sorted(shares)


def test_half_of_the_earth_is_lit():
    """Seen from above the terminator, with the Sun to one side."""
    camera = Camera.from_fov(120.0, 256, 256)
    renderer = Renderer(camera, load_catalog(), SensorModel(bits=12))
    place = np.array([0.0, 0.0, 4.0e7])
    objects = BY_DATE.view(unix_time("2026-03-20T14:46"), place, np.zeros(3)).objects
    down = Attitude.from_radec_roll(0.0, -90.0, 0.0)
    image = renderer.render(down, objects=SkyObjects(earth=objects.earth)).image
    sun, _ = camera.project(
        down.to_sensor(icrs_vector(objects.sun.ra_deg, objects.sun.dec_deg - 60.0)[None, :])
    )
    towards = sun[0] - 127.5
    towards /= np.linalg.norm(towards)
    radius_px = camera.focal_px[0] * math.tan(math.radians(objects.earth.radius_deg))
    lit, dark = (
        image[tuple(np.rint(127.5 + sign * 0.5 * radius_px * towards).astype(int)[::-1])] for sign in (1, -1)
    )
    assert lit == renderer.sensor.max_dn
    assert dark < 0.1 * renderer.sensor.max_dn


# --- one orbit, against an independent calculation ---


def sun_of_meeus(unix_s: float) -> np.ndarray:
    """Direction of the Sun to 0.01° (Meeus 1998, ch. 25), turned from the equinox of date to J2000 in longitude."""
    days = (unix_s - 946_728_000.0) / 86400.0
    mean, anomaly = math.radians(280.460 + 0.9856474 * days), math.radians(357.528 + 0.9856003 * days)
    longitude = mean + math.radians(1.915) * math.sin(anomaly) + math.radians(0.020) * math.sin(2 * anomaly)
    longitude -= math.radians(1.39697 * days / 36525.0)
    tilt = math.radians(23.4393)
    return np.array(
        [math.cos(longitude), math.sin(longitude) * math.cos(tilt), math.sin(longitude) * math.sin(tilt)]
    )


def circular_place(unix_s: float, radius_km: float, inclination: float, node: float) -> np.ndarray:
    """Place on a circular orbit, km, by its own formula."""
    phase = math.sqrt(398_600.4418 / radius_km**3) * (unix_s - NEW_YEAR)
    u = np.array([math.cos(node), math.sin(node), 0.0])
    w = np.array(
        [
            math.sin(inclination) * math.sin(node),
            -math.sin(inclination) * math.cos(node),
            math.cos(inclination),
        ]
    )
    return radius_km * (math.cos(phase) * u + math.sin(phase) * np.cross(w, u))


def blinded_by_geometry(
    unix_s: float, place_km: np.ndarray, boresight: np.ndarray, sun_deg: float, earth_deg: float
):
    """Whether the Sun's disc is visible within its exclusion angle, or the nearest point of the Earth in it and lit."""
    sun, distance = sun_of_meeus(unix_s), float(np.linalg.norm(place_km))
    nadir = -place_km / distance
    radius = math.asin(EARTH_RADIUS_KM / distance)
    sun_up = angle(sun, nadir) > radius - math.radians(0.2666)
    if sun_up and angle(sun, boresight) < math.radians(sun_deg):
        return True
    off = angle(boresight, nadir)
    if off - radius >= math.radians(earth_deg):
        return False
    # the point of the sphere that the line of sight meets, or touches
    if off < radius:
        along = distance * math.cos(off) - math.sqrt(EARTH_RADIUS_KM**2 - (distance * math.sin(off)) ** 2)
        point = place_km + along * boresight
    else:
        sideways = boresight - (boresight @ nadir) * nadir
        sideways /= np.linalg.norm(sideways)
        point = EARTH_RADIUS_KM * (-math.sin(radius) * nadir + math.cos(radius) * sideways)
    return float(point @ sun) > 0.0


def switches(blinded, step_s: int = 20) -> list[int]:
    """Whole seconds of an orbit from which a condition is another, searched in steps that are then halved."""
    angles = []
    for start in range(0, ORBIT_S, step_s):
        low, high = start, start + step_s
        if blinded(low) == blinded(high):
            continue
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if blinded(middle) == blinded(low) else (low, middle)
        angles.append(high)
    return angles


@pytest.mark.long
@pytest.mark.parametrize(("off_sun_deg", "earth_deg"), [(25.0, 20.0), (70.0, 25.0), (150.0, 10.0)])
def test_a_sensor_is_blinded_along_its_orbit_where_geometry_predicts(off_sun_deg, earth_deg):
    sky = Sky({"bodies": "ephemeris", "sun": {"exclusion_deg": 35.0}, "earth": {"exclusion_deg": earth_deg}})
    radius_km, inclination, node = 6896.0, 1.0, 0.4
    orbit = KeplerOrbit(NEW_YEAR, 1e3 * radius_km, 0.0, inclination, node, j2=False)
    start = sky.view(NEW_YEAR).objects.sun
    attitude = Attitude.from_radec_roll(start.ra_deg + off_sun_deg, start.dec_deg, 0.0)

    def by_emulator(second: int) -> bool:
        state = orbit.state(NEW_YEAR + second)
        objects = sky.view(NEW_YEAR + second, state.position_m, state.velocity_m_s).objects
        return bool(through_baffle(objects, attitude))

    def by_geometry(second: int) -> bool:
        at = NEW_YEAR + second
        place = circular_place(at, radius_km, inclination, node)
        return blinded_by_geometry(at, place, attitude.boresight, 35.0, earth_deg)

    expected = switches(by_geometry)
    assert expected
    assert switches(by_emulator) == pytest.approx(expected, abs=1)
    assert by_emulator(0) == by_geometry(0)


def test_light_that_passes_the_baffle_saturates_the_image():
    sky = Sky({"bodies": "ephemeris"})
    objects = sky.view(NEW_YEAR).objects
    renderer = Renderer(Camera.from_fov(42.0, 128, 128), load_catalog(), SensorModel())
    inside, outside = (
        renderer.render(
            Attitude.from_radec_roll(objects.sun.ra_deg, objects.sun.dec_deg + off, 0.0),
            exposure_s=0.02,
            objects=objects,
        ).image
        for off in (29.0, 31.0)
    )
    assert np.mean(inside == renderer.sensor.max_dn) > 0.99  # the rest are dead
    assert np.mean(outside == renderer.sensor.max_dn) < 0.5


# --- the table [sky] ---


def test_without_a_date_the_sky_has_only_given_bodies():
    typed = {"moon": {"ra_deg": 1.0, "dec_deg": 2.0}, "false_stars": 3}
    view = Sky(typed).view(NEW_YEAR, np.array([7e6, 0.0, 0.0]), np.zeros(3))
    assert view.objects == SkyObjects.from_dict(typed)
    assert view.observer is None


def test_a_date_alone_moves_the_stars_and_shows_no_bodies():
    view = Sky({"date": NEW_YEAR}).view(NEW_YEAR)
    assert view.objects == SkyObjects()
    assert view.observer is not None
    assert Sky({"date": NEW_YEAR, "aberration": False}).view(NEW_YEAR).observer is None


def test_given_bodies_replace_or_change_those_of_the_date():
    sky = Sky(
        {
            "bodies": "ephemeris",
            "sun": {"ra_deg": 10.0, "dec_deg": 20.0},
            "moon": {"glare_share": 0.01},
            "planets": [{"ra_deg": 1.0, "dec_deg": 2.0, "magnitude": 3.0}],
            "false_stars": 5,
        }
    )
    objects = sky.view(NEW_YEAR, faults={"false_stars": 7}).objects
    assert (objects.sun.ra_deg, objects.moon.glare_share, objects.false_stars) == (10.0, 0.01, 7)
    assert [planet.name for planet in objects.planets][:3] == ["", "Mercury", "Venus"]
    assert objects.moon.ra_deg == BY_DATE.view(NEW_YEAR).objects.moon.ra_deg


@pytest.mark.parametrize("bodies", ["typed", "ephemeris"])
def test_a_body_that_a_fault_places_looks_as_in_the_profile(bodies):
    sky = Sky({"bodies": bodies, "sun": {"exclusion_deg": 40.0, "stray_share": 7e-5}})
    if bodies == "typed":
        assert sky.view(NEW_YEAR).objects.sun is None
    sun = sky.view(NEW_YEAR, faults={"sun": {"ra_deg": 1.0, "dec_deg": 2.0, "stray_share": 8e-5}}).objects.sun
    assert (sun.ra_deg, sun.dec_deg, sun.exclusion_deg, sun.stray_share) == (1.0, 2.0, 40.0, 8e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"bodies": "all"}, "bodies: must be one of 'typed', 'ephemeris' (given: 'all')"),
        ({"aberration": 1}, "aberration: must be true or false (given: 1)"),
        ({"date": "soon"}, "date: must be a date from 1970 to 2100"),
        ({"bodies": "ephemeris", "sun": {"colour": 1}}, "sun.colour: unknown key"),
        (
            {"bodies": "ephemeris", "moon": {"magnitude": -1.0}},
            "as a whole: moon.magnitude follows from the date",
        ),
        ({"bodies": "ephemeris", "sun": {"exclusion_deg": 200.0}}, "sun.exclusion_deg: must be at most 180"),
        ({"sun": {"ra_deg": 20.0}}, "sun: dec_deg is missing; a direction is ra_deg and dec_deg"),
        ({"sun": {"colour": 1}}, "sun.colour: unknown key; known: dec_deg"),
        (
            {"earth": {"ra_deg": 0.0, "dec_deg": 0.0, "sun_ra_deg": 1.0}},
            "earth: sun_ra_deg and sun_dec_deg belong",
        ),
    ],
)
def test_a_bad_sky_is_named(values, message):
    with pytest.raises(ValidationError) as caught:
        SKY.model_validate(values)
    (problem,) = map(str, problems(caught.value, SKY, values))
    assert problem.startswith(message)
