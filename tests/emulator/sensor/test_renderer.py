"""Frames show the right stars at the right places and brightness."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.fixed_pattern import make_fixed_pattern
from starhil.emulator.sensor.renderer import Renderer, SensorModel, render
from starhil.emulator.sensor.sky.ephemeris import Observer
from starhil.emulator.sensor.sky.objects import SkyObjects
from starid.attitude import Attitude, random_attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.imaging.detection import detect

pytestmark = pytest.mark.lowest("numba")

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
CLEAN = SensorModel(bits=16, hot_pixels=0, dead_pixels=0, prnu=0.0, dsnu=0.0, read_noise_e=2.0)
BETA1_CAPRICORNI, BETA2_CAPRICORNI = 100345, 100325
BETELGEUSE, RIGEL, BELLATRIX, SAIPH, SIRIUS, ALDEBARAN = 27989, 24436, 25336, 27366, 32349, 21421


@pytest.fixture(scope="module")
def catalog() -> StarCatalog:
    return load_catalog()


@pytest.fixture(scope="module")
def renderer(catalog: StarCatalog) -> Renderer:
    return Renderer(DEFAULT_CAMERA, catalog, CLEAN, seed=1)


def place_of(frame_stars: object, hip: int) -> np.ndarray:
    return np.asarray(frame_stars.xy_px[frame_stars.hip == hip][0])  # type: ignore[attr-defined]


def test_orion_appears_as_in_the_sky(renderer: Renderer) -> None:
    """North up and east left: Betelgeuse upper left, Rigel lower right, Sirius low left, Aldebaran high right."""
    stars = renderer.render(ORION).stars
    centre = np.array(DEFAULT_CAMERA.centre_px)
    for hip, side in (
        (BETELGEUSE, (-1, -1)),
        (BELLATRIX, (1, -1)),
        (RIGEL, (1, 1)),
        (SAIPH, (-1, 1)),
        (SIRIUS, (-1, 1)),
        (ALDEBARAN, (1, -1)),
    ):
        assert tuple(np.sign(place_of(stars, hip) - centre)) == side, hip


def test_roll_turns_north_counter_clockwise(renderer: Renderer) -> None:
    turned = renderer.render(Attitude.from_radec_roll(83.8, -1.2, 90.0)).stars
    centre = np.array(DEFAULT_CAMERA.centre_px)
    upright = place_of(renderer.render(ORION).stars, BETELGEUSE) - centre
    assert place_of(turned, BETELGEUSE) - centre == pytest.approx([upright[1], -upright[0]], abs=1e-6)


def test_noise_of_the_stars_displaces_and_changes_them_as_stated(renderer: Renderer) -> None:
    sky = SkyObjects(star_position_noise_px=2.0, star_magnitude_noise=0.2)
    plain, noisy = renderer.render(ORION), renderer.render(ORION, objects=sky)
    assert np.array_equal(plain.stars.xy_px, noisy.stars.xy_px)  # the truth is that of the catalogue
    detections = [detect(frame.image) for frame in (plain, noisy)]
    gaps = np.hypot(*(detections[0].xy_px[:, None] - detections[0].xy_px[None]).T)
    np.fill_diagonal(gaps, np.inf)
    alone = np.flatnonzero(gaps.min(axis=1) > 40.0)
    distance = np.hypot(*(detections[0].xy_px[alone, None] - detections[1].xy_px[None]).transpose(2, 0, 1))
    partner = distance.argmin(axis=1)
    moved = detections[1].xy_px[partner] - detections[0].xy_px[alone]
    paired = np.hypot(*moved.T) < 12.0
    change = -2.5 * np.log10(detections[1].flux[partner] / detections[0].flux[alone])[paired]
    count = np.count_nonzero(paired)
    assert count >= 20
    assert np.std(moved[paired]) == pytest.approx(2.0, rel=4.0 / np.sqrt(4.0 * count))  # four standard errors
    assert np.std(change) == pytest.approx(0.2, rel=4.0 / np.sqrt(2.0 * count))


def test_light_lies_at_the_true_places_with_the_true_amount(renderer: Renderer) -> None:
    frame = renderer.render(ORION)
    sensor = renderer.sensor
    level = sensor.offset_dn + frame.exposure_s / sensor.gain_e_per_dn * (
        sensor.dark_e_s + sensor.sky_e_s(DEFAULT_CAMERA.pixel_scale_rad)
    )
    stars = frame.stars
    gaps = np.linalg.norm(stars.xy_px[:, None] - stars.xy_px[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    lonely = (gaps.min(axis=1) > 15.0) & (stars.electrons < 15000.0)
    inner = np.all((stars.xy_px > 10.0) & (stars.xy_px < 926.0), axis=1)
    chosen = np.flatnonzero(lonely & inner)[:40]
    assert len(chosen) == 40
    for k in chosen:
        x, y = np.rint(stars.xy_px[k]).astype(int)
        box = frame.image[y - 5 : y + 6, x - 5 : x + 6].astype(np.float64) - level
        light = box.sum() * sensor.gain_e_per_dn
        noise = np.sqrt(stars.electrons[k] + box.size * (sensor.read_noise_e**2 + 20.0))
        assert light == pytest.approx(stars.electrons[k], abs=5.0 * noise)
        offsets = np.arange(-5, 6)
        weights = np.clip(box, 0.0, None)[2:9, 2:9]
        found = x + (weights.sum(axis=0) * offsets[2:9]).sum() / weights.sum()
        assert found == pytest.approx(stars.xy_px[k, 0], abs=0.25)


def test_electrons_follow_magnitude_exposure_and_aperture() -> None:
    base = SensorModel()
    assert base.electrons(1.0) / base.electrons(6.0) == pytest.approx(100.0)
    assert base.electrons(3.0, 0.4) == pytest.approx(2.0 * base.electrons(3.0, 0.2))
    assert base.with_(aperture_m=0.024).electrons(3.0) == pytest.approx(4.0 * base.electrons(3.0))
    assert base.electrons(6.0) == pytest.approx(1400.0, rel=0.02)


def test_only_stars_to_the_limit_are_drawn(catalog: StarCatalog) -> None:
    for limit in (3.0, 5.0, 7.0):
        frame = Renderer(DEFAULT_CAMERA, catalog, CLEAN.with_(limiting_magnitude=limit)).render(ORION)
        xy, inside = DEFAULT_CAMERA.project(ORION.to_sensor(catalog.vectors))
        expected = catalog.hip[inside & (catalog.v <= limit)]
        drawn = frame.stars.hip[frame.stars.magnitude <= limit]
        assert set(drawn.tolist()) == set(expected.tolist())
        faint = frame.stars.xy_px[frame.stars.magnitude > limit]
        gaps = np.linalg.norm(faint[:, None] - xy[catalog.v <= limit], axis=2)
        assert np.nanmin(gaps, axis=1, initial=np.inf).max(initial=0.0) < 2.7, "two pixels on the axis"
        assert np.isfinite(xy[inside]).all()
        assert np.all(np.diff(frame.stars.electrons) <= 0.0)


def test_a_companion_beyond_the_limit_adds_its_light(catalog: StarCatalog) -> None:
    """The two stars of beta Capricorni, V 3.1 and 6.1, 3.4' apart, are 1.3 pixels from each other."""
    bright, faint = catalog.index_of([BETA1_CAPRICORNI, BETA2_CAPRICORNI])
    attitude = Attitude.from_radec_roll(*np.degrees([catalog.ra_rad[bright], catalog.dec_rad[bright]]), 0.0)
    sensor = CLEAN.with_(limiting_magnitude=6.0)
    both = Renderer(DEFAULT_CAMERA, catalog, sensor).render(attitude)
    single = Renderer(DEFAULT_CAMERA, catalog.subset(catalog.hip != BETA2_CAPRICORNI), sensor).render(
        attitude
    )
    assert set(both.stars.hip.tolist()) - set(single.stars.hip.tolist()) == {BETA2_CAPRICORNI}
    centre = 468
    box = (slice(centre - 8, centre + 9), slice(centre - 8, centre + 9))
    added = (both.image[box].astype(np.float64) - single.image[box]).sum() * sensor.gain_e_per_dn
    electrons = sensor.electrons(float(catalog.v[faint]))
    noise = np.sqrt(
        2.0 * (sensor.electrons(float(catalog.v[bright])) + 289 * (sensor.read_noise_e**2 + 20.0))
    )
    assert added == pytest.approx(electrons, abs=4.0 * noise)


def test_truth_is_the_middle_of_the_trail(renderer: Renderer) -> None:
    rate = np.radians([2.5, -1.5, 3.0])
    frame = renderer.render(ORION, rate)
    still = renderer.render(ORION)
    np.testing.assert_allclose(
        frame.stars.xy_px[np.argsort(frame.stars.hip)],
        still.stars.xy_px[np.argsort(still.stars.hip)],
        atol=1e-9,
    )
    trails = renderer.trails(frame)
    place = place_of(frame.stars, RIGEL)
    trail = trails[frame.stars.hip == RIGEL][0]
    middle = frame.image[tuple(np.rint(place).astype(int)[::-1])]
    inside = frame.image[tuple(np.rint(place + 0.3 * trail).astype(int)[::-1])]
    outside = frame.image[tuple(np.rint(place + trail).astype(int)[::-1])]
    assert inside > 0.5 * middle
    assert outside < 0.2 * middle


def test_trail_has_the_length_of_the_rate(renderer: Renderer) -> None:
    frame = renderer.render(ORION, np.radians([0.0, 1.0, 0.0]))
    trails = renderer.trails(frame)
    centre = np.linalg.norm(frame.stars.xy_px - DEFAULT_CAMERA.centre_px, axis=1) < 60.0
    expected = np.radians(1.0) * frame.exposure_s / DEFAULT_CAMERA.pixel_scale_rad
    assert np.hypot(*trails[centre].T) == pytest.approx(np.full(centre.sum(), expected), rel=0.01)


def test_the_same_seed_gives_the_same_bytes_after_any_history(catalog: StarCatalog) -> None:
    first = Renderer(DEFAULT_CAMERA, catalog, SensorModel(), seed=4)
    second = Renderer(DEFAULT_CAMERA, catalog, SensorModel(), seed=4)
    first.render(random_attitude(np.random.default_rng(0)), (0.01, 0.0, 0.0), 8, exposure_s=0.05)
    a, b = first.render(ORION, frame_index=3), second.render(ORION, frame_index=3)
    assert a.image.tobytes() == b.image.tobytes()
    assert a.image.tobytes() != first.render(ORION, frame_index=4).image.tobytes()
    other = render(DEFAULT_CAMERA, catalog, ORION, seed=5, frame_index=3)
    assert a.image.tobytes() != other.image.tobytes()


@pytest.mark.parametrize(
    ("bits", "dtype", "top"), [(8, np.uint8, 255), (12, np.uint16, 4095), (16, np.uint16, 65535)]
)
def test_digitisation(catalog: StarCatalog, bits: int, dtype: type, top: int) -> None:
    frame = Renderer(DEFAULT_CAMERA, catalog, SensorModel(bits=bits)).render(ORION)
    assert frame.image.dtype == dtype
    assert frame.image.max() == top, "Sirius saturates"
    assert frame.image.shape == (937, 937)


def test_gain_brightens_and_exposure_too(renderer: Renderer) -> None:
    louder = renderer.with_sensor(renderer.sensor.with_(gain=4.0)).render(ORION)
    plain = renderer.render(ORION)
    offset = renderer.sensor.offset_dn
    ratio = (np.median(louder.image) - offset) / (np.median(plain.image) - offset)
    assert ratio == pytest.approx(4.0, rel=0.05)
    longer = renderer.render(ORION, exposure_s=1.0)
    assert longer.stars.electrons[0] == pytest.approx(5.0 * plain.stars.electrons[0])


def test_hot_and_dead_pixels_appear_in_every_frame(catalog: StarCatalog) -> None:
    sensor = SensorModel(bits=16, hot_pixels=50, dead_pixels=60, sky_mag_arcsec2=17.0, read_noise_e=2.0)
    pattern = make_fixed_pattern(sensor, 937, 937)
    assert (len(pattern.hot), len(pattern.dead)) == (50, 60)
    renderer = Renderer(DEFAULT_CAMERA, catalog, sensor, seed=2)
    frames = [renderer.render(ORION, frame_index=index).image.astype(np.int64) for index in range(2)]
    sky = np.median(frames[0])
    for frame in frames:
        hot = frame[tuple(pattern.hot.T)] - sky
        dead = frame[tuple(pattern.dead.T)] - sky
        assert np.median(hot) * sensor.gain_e_per_dn == pytest.approx(2000.0, rel=0.5)
        assert np.all(dead < -300)
    other = make_fixed_pattern(sensor.with_(pattern_seed=1), 937, 937)
    assert not np.array_equal(other.hot, pattern.hot)


def test_fixed_pattern_has_the_spreads_asked_for() -> None:
    sensor = SensorModel(hot_pixels=0, dead_pixels=0, prnu=0.02, dsnu=0.4, dark_e_s=50.0)
    pattern = make_fixed_pattern(sensor, 400, 500)
    assert pattern.sensitivity.mean() == pytest.approx(1.0, abs=1e-3)
    assert pattern.sensitivity.std() == pytest.approx(0.02, rel=0.02)
    assert pattern.dark_e_s.mean() == pytest.approx(50.0, rel=0.01)
    assert pattern.dark_e_s.std() == pytest.approx(20.0, rel=0.02)
    assert pattern.dark_e_s.min() >= 0.0


def test_other_cameras_render(catalog: StarCatalog) -> None:
    for camera in (
        Camera.from_fov(11.0, 320, 240),
        Camera.from_fov(90.0, 300, 300, "equidistant"),
        Camera.from_fov(60.0, 200, 100, "pinhole", (-0.05, 0.01)),
    ):
        frame = Renderer(camera, catalog, SensorModel(limiting_magnitude=7.0)).render(ORION)
        assert frame.image.shape == (camera.height, camera.width)
        assert len(frame.stars.hip) > 5


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("exposure_s", 0.0),
        ("exposure_s", float("nan")),
        ("exposure_s", "long"),
        ("bits", 10),
        ("bits", True),
        ("gain", -1.0),
        ("psf_sigma_px", 0.0),
        ("hot_pixels", 1.5),
        ("hot_pixels", -1),
        ("read_noise_e", -0.1),
        ("quantum_efficiency", 1.2),
        ("full_well_e", float("inf")),
    ],
)
def test_bad_sensors_are_rejected_in_one_line(field: str, value: object) -> None:
    given = json.dumps(value).replace("Infinity", "inf").replace("NaN", "nan")
    with pytest.raises(EmulatorError, match=rf"sensor\.{field}: must be .* \(given: ") as caught:
        load_profile("ideal", [f"sensor.{field}={given}"])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("exposure_s", 0.0, "must be at least 1e-06 (given: 0.0)"),
        ("exposure_s", np.nan, "must be at least 1e-06 (given: nan)"),
        ("gain", 1e4, "must be at most 1000 (given: 10000.0)"),
        ("temperature_c", np.inf, "must be at most 150 (given: inf)"),
        ("bits", 10, "must be one of 8, 12, 16 (given: 10)"),
    ],
)
def test_limits_also_hold_for_what_changes_during_a_run(field: str, value: float, said: str) -> None:
    with pytest.raises(EmulatorError) as caught:
        SensorModel().with_(**{field: value})
    assert str(caught.value) == f"sensor.{field}: {said}"


def test_limits_have_the_same_text_in_a_profile_and_during_a_run() -> None:
    with pytest.raises(EmulatorError) as during_a_run:
        SensorModel().with_(gain=-1.0)
    with pytest.raises(EmulatorError) as in_a_profile:
        load_profile("ideal", ["sensor.gain=-1.0"])
    assert str(in_a_profile.value).endswith(str(during_a_run.value))


@pytest.mark.parametrize("rate", [(0.0, 0.0), (np.nan, 0.0, 0.0), (100.0, 0.0, 0.0)])
def test_bad_rates_are_rejected(renderer: Renderer, rate: tuple[float, ...]) -> None:
    with pytest.raises(EmulatorError, match="body rate"):
        renderer.render(ORION, rate)


def test_bad_seed_and_index_are_rejected(renderer: Renderer, catalog: StarCatalog) -> None:
    with pytest.raises(EmulatorError, match="seed"):
        Renderer(DEFAULT_CAMERA, catalog, CLEAN, seed=-1)
    with pytest.raises(EmulatorError, match="frame_index"):
        renderer.render(ORION, frame_index=-3)


def test_frames_are_frozen(renderer: Renderer) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        renderer.render(ORION).seed = 3  # type: ignore[misc]


def test_variable_stars_have_the_light_of_the_date(catalog: StarCatalog) -> None:
    """Algol out of eclipse and in its middle, by the elements of the GCVS; without a date it has the light of the catalogue."""
    perseus, algol = Attitude.from_radec_roll(47.0, 41.0, 0.0), 14576
    renderer = Renderer(DEFAULT_CAMERA, catalog, seed=3)
    middle_s = (2_445_641.5135 + 5420 * 2.8673043 - 2_440_587.5) * 86_400.0
    light = {}
    for name, observer in {
        "none": None,
        "eclipsed": Observer(middle_s),
        "clear": Observer(middle_s + 86_400.0),
    }.items():
        stars = renderer.render(perseus, observer=observer).stars
        light[name] = float(stars.electrons[stars.hip == algol][0])
    assert -2.5 * np.log10(light["eclipsed"] / light["clear"]) == pytest.approx(3.39 - 2.12, abs=1e-3)
    assert light["none"] == pytest.approx(
        renderer.sensor.electrons(float(catalog.v[catalog.hip == algol][0])), rel=1e-6
    )


def test_mira_is_there_only_near_its_maximum(catalog: StarCatalog) -> None:
    cetus, mira = Attitude.from_radec_roll(34.8, -3.0, 0.0), 10826
    renderer = Renderer(DEFAULT_CAMERA, catalog, seed=3)
    maximum_s = (2_444_839.0 + 49 * 331.96 - 2_440_587.5) * 86_400.0
    bright = renderer.render(cetus, observer=Observer(maximum_s)).stars
    assert float(bright.electrons[bright.hip == mira][0]) == pytest.approx(
        renderer.sensor.electrons(2.0), rel=1e-3
    )
    assert mira not in renderer.render(cetus).stars.hip
