"""Satellites against geometry of their own: places by rotations, a numerical integral of a lit sphere, trails, and what they cost."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starhil.emulator.sensor.sky.objects import Constellation, SkyObjects
from starhil.emulator.sensor.sky.satellites import Satellites
from starhil.emulator.sensor.sky.view import Sky
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.identification.star_identifier import make_identifier
from starid.imaging.detection import detect

GM_KM3_S2, EARTH_KM = 398_600.4418, 6371.0
SHELL = Constellation(count=300, planes=20, altitude_km=600.0, inclination_deg=70.0, magnitude=4.0)
UNIX_S = 1_780_000_123.25
SUN = np.array([0.6, -0.64, 0.48])


def places_km(shell: Constellation, unix_s: float) -> np.ndarray:
    """Places (n, 3) of the satellites, each by two rotations: of the node about z, of the plane about the node."""
    radius = EARTH_KM + shell.altitude_km
    angle = math.sqrt(GM_KM3_S2 / radius**3) * unix_s
    per_plane = math.ceil(shell.count / shell.planes)
    positions = []
    for number in range(shell.count):
        along, plane = divmod(number, shell.planes)
        node = Rotation.from_euler("z", 360.0 * plane / shell.planes, degrees=True)
        tilt = Rotation.from_euler("x", shell.inclination_deg, degrees=True)
        turn = Rotation.from_euler("z", angle + 2.0 * math.pi * (along / per_plane + plane / shell.count))
        positions.append((node * tilt * turn).apply([radius, 0.0, 0.0]))
    return np.array(positions)


def observer(altitude_km: float = 550.0) -> tuple[np.ndarray, np.ndarray]:
    """Place and velocity of an observer on a polar orbit, m and m/s."""
    radius = (EARTH_KM + altitude_km) * 1e3
    speed = math.sqrt(GM_KM3_S2 * 1e9 / radius)
    return np.array([0.8, 0.0, 0.6]) * radius, np.array([-0.6, 0.0, 0.8]) * speed


def seen() -> Satellites:
    return Satellites(SHELL, UNIX_S, *observer(), SUN)


def everything(satellites: Satellites, exposure_s: float = 0.0):
    return satellites.crossing(np.array([0.0, 0.0, 1.0]), -1.0, exposure_s)


def test_the_sun_lights_them_and_the_earth_does_not_hide_them() -> None:
    """A satellite is in a cylinder of shadow, or a point of the line of sight is within the Earth, on 4000 steps."""
    place = observer()[0] / 1e3
    expected = []
    for satellite in places_km(SHELL, UNIX_S):
        behind = satellite @ SUN < 0.0 and np.linalg.norm(np.cross(satellite, SUN)) < EARTH_KM
        line = place + np.linspace(0.0, 1.0, 4000)[:, None] * (satellite - place)
        if not behind and np.linalg.norm(line, axis=1).min() > EARTH_KM:
            expected.append((satellite - place) / np.linalg.norm(satellite - place))
    directions = everything(seen()).directions[1]
    assert len(expected) == len(directions) > 5
    gaps = np.linalg.norm(directions[:, None] - np.array(expected)[None], axis=2)
    assert gaps.min(axis=1).max() < 1e-6


def test_their_light_is_that_of_a_diffuse_sphere_at_its_distance() -> None:
    """The sphere integrated on a grid of its surface; at 1000 km and half lit it has the stated magnitude."""
    u, v = np.meshgrid(
        (np.arange(400) + 0.5) / 200.0 - 1.0, 2.0 * math.pi * (np.arange(800) + 0.5) / 800.0, indexing="ij"
    )
    normals = np.stack([np.sqrt(1 - u**2) * np.cos(v), np.sqrt(1 - u**2) * np.sin(v), u], axis=-1)

    def light(to_sun: np.ndarray, to_observer: np.ndarray) -> float:
        return float(np.mean(np.maximum(normals @ to_sun, 0.0) * np.maximum(normals @ to_observer, 0.0)))

    half = light(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    place, found = observer()[0] / 1e3, everything(seen())
    satellites = places_km(SHELL, UNIX_S)
    for direction, magnitude in zip(found.directions[1], found.magnitudes, strict=True):
        gaps = satellites - place
        distances = np.linalg.norm(gaps, axis=1)
        distance = distances[np.argmin(np.linalg.norm(gaps / distances[:, None] - direction, axis=1))]
        share = light(SUN, -direction) / half * (1000.0 / distance) ** 2
        assert magnitude == pytest.approx(SHELL.magnitude - 2.5 * math.log10(share), abs=0.02)


def test_a_trail_is_as_long_as_the_angle_that_the_satellite_moves_and_holds_its_light() -> None:
    camera = Camera.from_fov(20.0, width=500, height=500)
    sensor = SensorModel(
        hot_pixels=0, dead_pixels=0, prnu=0.0, limiting_magnitude=6.0, bits=16, adc_range_e=15_000.0
    )
    renderer = Renderer(camera, load_catalog(), sensor, 1)
    satellites, exposure_s = seen(), 0.3
    light = everything(satellites, exposure_s)
    number = int(np.argmin(np.where(light.magnitudes < 3.5, np.abs(light.magnitudes - 2.5), np.inf)))
    begin, middle, end = light.directions[:, number]
    place, velocity = observer()
    at = [
        everything(Satellites(SHELL, UNIX_S + t, place + t * velocity, velocity, SUN)).directions[1]
        for t in (-0.5 * exposure_s, 0.5 * exposure_s)
    ]
    nearest = [int(np.argmin(np.linalg.norm(each - middle, axis=1))) for each in at]
    angle = np.linalg.norm(at[1][nearest[1]] - at[0][nearest[0]])
    assert np.linalg.norm(end - begin) == pytest.approx(angle, rel=1e-3)
    x, y, z = middle
    attitude = Attitude.from_radec_roll(math.degrees(math.atan2(y, x)), math.degrees(math.asin(z)), 20.0)
    still = renderer.render(attitude, exposure_s=exposure_s)
    frame = renderer.render(attitude, exposure_s=exposure_s, objects=SkyObjects(), satellites=satellites)
    (ends,) = [
        each
        for each in frame.objects.satellites_px
        if np.hypot(*(each[:2] + each[2:]) / 2.0 - camera.centre_px) < 1.0
    ]
    length_px = np.hypot(*(ends[2:] - ends[:2]))
    assert length_px == pytest.approx(angle * camera.focal_px[0], rel=0.01)
    extra_e = (frame.image.astype(float) - still.image).sum() * sensor.gain_e_per_dn
    inside = [
        magnitude
        for direction, magnitude in zip(light.directions[1], light.magnitudes, strict=True)
        if camera.project(attitude.to_sensor(direction[None]))[1][0] and magnitude <= 6.0
    ]
    expected_e = sum(sensor.electrons(magnitude, exposure_s) for magnitude in inside)
    assert extra_e == pytest.approx(expected_e, rel=0.05)


def test_they_are_seen_only_from_an_orbit() -> None:
    place, velocity = observer()
    sky = Sky({"satellites": {"count": 40, "planes": 4}})
    assert sky.view(UNIX_S).satellites is None
    assert sky.view(UNIX_S, place, velocity).satellites is not None
    assert Sky({}).view(UNIX_S, place, velocity).satellites is None
    with pytest.raises(EmulatorError, match=r"sky.satellites: they are seen from an orbit"):
        load_profile("ideal", ["sky.satellites.count=40"])
    assert load_profile("ideal", ["orbit=leo", "sky.satellites.count=40"]).sky["satellites"]["count"] == 40


@pytest.mark.long
def test_many_bright_ones_cost_stars_and_no_attitude_is_wrong() -> None:
    """Six thousand at 1500 km, 250 times as bright as Starlink, in 40 images of the field of `ideal`."""
    profile = load_profile("ideal")
    camera = Camera.from_dict(profile.camera_values)
    sensor = SensorModel().with_(**profile.sensor)
    renderer, identifier = Renderer(camera, load_catalog(), sensor, 2), make_identifier("geometric", camera)
    swarm = Constellation(count=6000, planes=60, altitude_km=1500.0, inclination_deg=80.0, magnitude=-0.1)
    rng = np.random.default_rng(11)
    trails, matched = 0, {True: 0, False: 0}
    for index in range(40):
        place, velocity = observer()
        satellites = Satellites(swarm, UNIX_S + 60.0 * index, place, velocity, SUN)
        x, y, z = place / np.linalg.norm(place) + 0.3 * rng.normal(size=3)
        attitude = Attitude.from_radec_roll(
            math.degrees(math.atan2(y, x)),
            math.degrees(math.atan2(z, math.hypot(x, y))),
            360.0 * rng.random(),
        )
        for crossed in (False, True):
            frame = renderer.render(
                attitude, frame_index=index, objects=SkyObjects(), satellites=satellites if crossed else None
            )
            trails += len(frame.objects.satellites_px)
            found = detect(frame.image, sensor.detection_settings())
            solution = identifier.identify(found.xy_px, found.flux, found.position_errors)
            assert solution.valid
            assert solution.attitude.error_to(attitude).total_arcsec < 60.0
            matched[crossed] += solution.star_count
    assert trails > 150
    assert 0.9 * matched[False] < matched[True] < matched[False]
