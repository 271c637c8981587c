"""The vectors of the stars belong to the same calibration as the quaternion: a user may solve Wahba's problem from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.messages import FrameRequest, FrameResult, camera_constants
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba

ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)


def solved(focal_factor: float, shift_px: float, **identifier: float) -> tuple[FrameResult, Pipeline]:
    profile = Profile.model_validate({"run": {"clock": "stepped"}, "identifier": identifier})
    setup = pipeline_setup(profile)
    pipeline = Pipeline(setup)
    request = FrameRequest(0, TruthState(ORION, ZERO_RATE), 0.1, 1.0, setup.settings)
    optics = camera_constants(pipeline.camera.to_dict())
    calibrated = {
        **optics,
        "focal_length": optics["focal_length"] * focal_factor,
        "centroid_x": optics["centroid_x"] + shift_px,
    }
    result = pipeline.handle(replace(request, settings=replace(request.settings, **calibrated)))
    assert result.valid
    return result, pipeline


def from_vectors(result: FrameResult) -> Attitude:
    return solve_wahba([star.vector for star in result.stars], [star.icrs for star in result.stars])


def test_wahba_of_the_vectors_has_the_error_of_the_calibration_as_the_quaternion_has():
    result, pipeline = solved(1.001, 1.0)
    attitude = Attitude(np.array(result.quaternion_xyzw))
    assert attitude.error_to(ORION).cross_boresight_arcsec > 100.0
    assert from_vectors(result).error_to(attitude).cross_boresight_arcsec < 20.0
    (focal, _), (centre_x, centre_y) = pipeline.camera.focal_px, pipeline.camera.centre_px
    for star in result.stars:
        x, y = (star.x - centre_x - 1.0) / (1.001 * focal), (star.y - centre_y) / (1.001 * focal)
        assert star.vector == pytest.approx(np.array([x, y, 1.0]) / np.hypot(1.0, np.hypot(x, y)), abs=1e-12)


def test_where_the_solution_refines_the_focal_length_the_vectors_have_it():
    result, _ = solved(1.004, 0.0, fov_tolerance=0.01)
    measured, modelled = (
        np.array([getattr(star, name) for star in result.stars]) for name in ("vector", "icrs")
    )
    np.testing.assert_allclose(measured @ measured.T, modelled @ modelled.T, atol=1e-4)
