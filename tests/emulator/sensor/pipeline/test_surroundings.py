"""What the surroundings do to a frame: bodies in the field, particles, heat, upsets in the catalogue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.bodies import bodies_in_field, with_bodies
from starhil.emulator.sensor.pipeline.messages import CatalogUpset, FrameRequest, FrameResult
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.sensor.sky.objects import EarthLimb, Moon, SkyObjects, SunGlare
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA
from starid.catalog import load_catalog

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)
BETELGEUSE = 27989
REQUEST = FrameRequest(0, TruthState(ORION, ZERO_RATE), 0.1, 1.0, pipeline_setup(Profile()).settings)
SIGN_BIT, EXPONENT_BIT = 31, 30


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline(pipeline_setup(Profile.model_validate({"run": {"clock": "stepped"}})))


def error_arcsec(result: FrameResult) -> float:
    return Attitude(np.array(result.quaternion_xyzw)).error_to(ORION).total_arcsec


@pytest.mark.parametrize(
    ("sky", "expected"),
    [
        (SkyObjects(), ()),
        (SkyObjects(sun=SunGlare(90.0, 5.0)), ("sun",)),
        (SkyObjects(sun=SunGlare(150.0, 0.0)), ()),
        (SkyObjects(moon=Moon(105.0, -1.2)), ("moon",)),
        (SkyObjects(moon=Moon(106.0, -1.2)), ()),
        (SkyObjects(moon=Moon(90.0, -1.2), blank=True), ()),
        (SkyObjects(earth=EarthLimb(83.8, 84.0, radius_deg=64.5)), ("earth",)),
        (SkyObjects(earth=EarthLimb(83.8, 86.0, radius_deg=64.0)), ()),
        (SkyObjects(sun=SunGlare(90.0, 5.0), earth=EarthLimb(83.8, -1.2)), ("sun", "earth")),
    ],
)
def test_a_body_is_in_the_field_if_any_part_of_it_is(sky, expected):
    assert bodies_in_field(sky, ORION, DEFAULT_CAMERA) == expected


@pytest.mark.parametrize("reason", ["too_few_stars", "no_match", "residual", "prediction_lost"])
def test_a_body_in_the_field_is_the_reason_where_stars_are_missing(reason):
    lost = FrameResult(1, reason=reason)
    assert with_bodies(lost, ("moon",), enough_stars=False).reason == "blinded"
    assert with_bodies(lost, ("moon",), enough_stars=True).reason == reason
    assert with_bodies(lost, (), enough_stars=False).reason == reason
    found = with_bodies(FrameResult(1, valid=True, reason="ok"), ("moon",), enough_stars=False)
    assert (found.reason, found.in_field) == ("ok", ("moon",))


@pytest.mark.long
def test_a_jump_with_a_moon_in_the_corner_loses_the_prediction_and_is_not_blinded(pipeline):
    moon = {"ra_deg": 93.5, "dec_deg": -10.0}
    elsewhere = Attitude.from_radec_roll(110.0, 30.0, 0.0)
    seen = pipeline.handle(replace(REQUEST, index=20, faults={"moon": moon}))
    assert (seen.valid, seen.in_field) == (True, ("moon",))
    jumped = pipeline.handle(replace(REQUEST, index=21, predicted=elsewhere, faults={"moon": moon}))
    assert (jumped.valid, jumped.reason, jumped.in_field) == (False, "prediction_lost", ("moon",))


def test_the_earth_across_the_field_blinds_the_sensor(pipeline):
    earth = {"ra_deg": 83.8, "dec_deg": -1.2}
    result = pipeline.handle(replace(REQUEST, faults={"earth": earth}))
    assert (result.valid, result.reason, result.in_field) == (False, "blinded", ("earth",))


@pytest.mark.parametrize("off_deg", [0.0, 2.0, 20.5])
def test_the_sun_in_the_field_blinds_the_sensor(pipeline, off_deg):
    sun = {"ra_deg": 83.8, "dec_deg": -1.2 + off_deg}
    result = pipeline.handle(replace(REQUEST, faults={"sun": sun}))
    assert (result.valid, result.reason, result.in_field) == (False, "blinded", ("sun",))


def test_the_sun_within_its_exclusion_angle_blinds_the_sensor_unless_the_lens_is_covered(pipeline):
    def seen(off_deg, **others):
        sun = {"ra_deg": 83.8, "dec_deg": -1.2 + off_deg, "exclusion_deg": 40.0, "stray_share": 1e-6}
        return pipeline.handle(replace(REQUEST, faults={"sun": sun, **others}))

    assert (seen(39.0).valid, seen(39.0).reason, seen(39.0).in_field) == (False, "blinded", ("sun",))
    assert (seen(41.0).valid, seen(41.0).in_field) == (True, ())
    covered = seen(10.0, blank=True)
    assert (covered.reason, covered.in_field) == ("too_few_stars", ())


def test_the_moon_within_its_exclusion_angle_blinds_the_sensor(pipeline):
    def seen(off_deg):
        moon = {"ra_deg": 83.8, "dec_deg": -1.2 + off_deg, "exclusion_deg": 25.0}
        return pipeline.handle(replace(REQUEST, faults={"moon": moon}))

    assert (seen(24.0).valid, seen(24.0).reason, seen(24.0).in_field) == (False, "blinded", ("moon",))
    assert (seen(26.0).valid, seen(26.0).in_field) == (True, ())


def test_a_covered_lens_leaves_too_few_stars_lost_in_space_and_tracking(pipeline):
    for index, predicted in ((10, None), (11, ORION), (12, None), (13, ORION)):
        for cover in ({"blank": True}, {"blocked_share": 1.0}):
            request = replace(REQUEST, index=index, predicted=predicted, faults=cover)
            result = pipeline.handle(request)
            assert (result.valid, result.reason, result.matched) == (False, "too_few_stars", 0), cover


def test_the_modelled_direction_of_a_star_is_that_of_the_catalogue_not_the_measured_one(pipeline):
    catalog = load_catalog(epoch=Profile().epoch)
    vector_of = {int(hip): vector for hip, vector in zip(catalog.hip, catalog.vectors, strict=True)}
    moved = replace(REQUEST, index=30, observer_velocity=np.array((20_000.0, -20_000.0, 5_000.0)))
    for request in (replace(REQUEST, index=31), moved):
        result = pipeline.handle(request)
        measured = np.array([star.vector for star in result.stars])
        measured = measured @ Attitude(np.array(result.quaternion_xyzw)).matrix
        modelled = np.array([star.icrs for star in result.stars])
        assert len(modelled) > 10
        assert modelled == pytest.approx(np.array([vector_of[star.hip] for star in result.stars]), abs=1e-12)
        assert np.abs(measured - modelled).max() > 1e-6


def test_an_image_that_is_saturated_all_over_cannot_be_searched(pipeline):
    glare = {"sun": {"ra_deg": 150.0, "dec_deg": 0.0, "stray_share": 1.0}}
    result = pipeline.handle(replace(REQUEST, index=14, faults=glare))
    assert (result.valid, result.reason, result.detected) == (False, "detection_failed", 0)


def test_particles_of_the_orbit_are_added_to_the_sky(pipeline):
    quiet = pipeline.handle(replace(REQUEST, index=3))
    anomaly = pipeline.handle(replace(REQUEST, index=3, particles_s=3000.0))
    assert anomaly.refused + anomaly.detected > quiet.refused + quiet.detected + 50
    assert error_arcsec(anomaly) < 20.0


def test_heat_raises_background_and_noise(pipeline):
    cold, hot = (pipeline.handle(replace(REQUEST, temperature_c=degrees)) for degrees in (-20.0, 60.0))
    assert hot.background_dn > cold.background_dn + 5.0
    assert hot.noise_dn > cold.noise_dn
    assert hot.valid


@pytest.mark.parametrize("bit", [SIGN_BIT, EXPONENT_BIT, 22])
def test_a_star_with_a_flipped_direction_is_lost_and_the_attitude_holds(pipeline, bit):
    before = pipeline.handle(REQUEST)
    assert BETELGEUSE in {star.hip for star in before.stars}
    after = pipeline.handle(replace(REQUEST, upsets=(CatalogUpset(BETELGEUSE, 1, bit),)))
    assert after.valid
    assert BETELGEUSE not in {star.hip for star in after.stars}
    assert after.matched >= before.matched - 2
    assert error_arcsec(after) < 5.0
    restored = pipeline.handle(REQUEST)
    assert restored.quaternion_xyzw == before.quaternion_xyzw
