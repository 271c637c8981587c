"""Tracking with three quarters of the field hidden: fewer stars than lost in space, and fainter ones, are enough."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from starhil.emulator.benchmarks.campaign import WRONG_DEG, block_side
from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.sensor.pipeline.messages import FrameRequest, FrameResult
from starhil.emulator.sensor.pipeline.pipeline import STARS_SENT, Pipeline
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude
from starid.identification.geometric.refinement import PRIOR_FREEDOM

pytestmark = pytest.mark.long

PREDICTION_ARCSEC = np.array([20.0, 20.0, 35.0])
"""Error of a prediction that is good to 0.12 px."""

COVARIANCE = np.diag((np.array([45.0, 45.0, 75.0]) / ARCSEC_PER_RAD) ** 2)
"""As the device states it after two images."""
FREEDOM = 57.0
"""Its degrees of freedom, from two images of 16 stars each."""
FRAMES = 20


def error_arcsec(result: FrameResult, truth: Attitude) -> float:
    """The larger of the errors of boresight and roll."""
    off = Attitude(np.array(result.quaternion_xyzw)).error_to(truth)
    return max(off.cross_boresight_arcsec, off.roll_arcsec)


_hidden: dict[tuple[int, bytes], object] = {}
"""Images by the number and the attitude of their requests; the devices compared here differ behind the detector."""


@pytest.fixture
def three_quarters_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide three quarters of each image by a dark body."""
    expose = Pipeline._expose

    def hidden(self: Pipeline, request: FrameRequest):
        taken = request.index, request.truth.attitude.quaternion_xyzw.tobytes()
        if taken not in _hidden:
            exposure = expose(self, request)
            dark = block_side(exposure.image, 0.75, np.random.default_rng((9, request.index)))
            _hidden[taken] = replace(exposure, image=dark)
        return _hidden[taken]

    monkeypatch.setattr(Pipeline, "_expose", hidden)


@pytest.mark.usefixtures("three_quarters_hidden")
def test_an_attitude_that_may_be_off_by_more_than_the_limit_is_invalid() -> None:
    """Four stars in a corner state 267″ about the boresight, and one such answer in six is off by more than 360″."""
    limit_rad = math.radians(WRONG_DEG)
    bare, open_ended = (
        EcssDevice(EcssPlan("cubestar", ("device.tracking_stars=0", f"device.largest_error_deg={largest}")))
        for largest in (WRONG_DEG, 10.0)
    )
    risky = 0
    for number in range(FRAMES):
        truth = random_attitude(np.random.default_rng((5, number)))
        request = FrameRequest(
            number, TruthState(truth, ZERO_RATE), bare.exposure_s, bare.gain, bare.settings
        )
        all_of_them, result = open_ended.pipeline.handle(request), bare.pipeline.handle(request)
        assert isinstance(all_of_them, FrameResult)
        assert isinstance(result, FrameResult)
        if not all_of_them.valid:
            assert not result.valid
            continue
        freedom = 2 * all_of_them.matched - 3 + PRIOR_FREEDOM
        scale = math.sqrt(all_of_them.covariance_rad2[2][2] * (freedom - 2.0) / freedom)
        risk = 2.0 * stats.t.sf(limit_rad / scale, freedom)
        risky += risk > 1e-4
        assert not (result.valid and risk > 1e-4)
        assert result.valid or (result.reason == "uncertain" and risk > 1e-5)
    assert risky > 0


@pytest.mark.usefixtures("three_quarters_hidden")
@pytest.mark.parametrize(("largest_deg", "share"), [(WRONG_DEG, 0.95), (0.4, 0.95)])
def test_a_hidden_field_is_tracked(largest_deg: float, share: float) -> None:
    """None is off by more than the largest error, however it was found, also if the prediction is wrong."""
    device, as_lost = (
        EcssDevice(EcssPlan("cubestar", (f"device.largest_error_deg={largest_deg}",))),
        EcssDevice(EcssPlan("cubestar", ("device.tracking_stars=0",))),
    )
    lost = tracked = 0
    for number in range(FRAMES):
        rng = np.random.default_rng((5, number))
        truth = random_attitude(rng)
        error = PREDICTION_ARCSEC / ARCSEC_PER_RAD * rng.standard_normal(3)
        request = FrameRequest(
            number, TruthState(truth, ZERO_RATE), device.exposure_s, device.gain, device.settings
        )
        guided = replace(
            request,
            predicted=truth.rotated(error),
            prediction_covariance=COVARIANCE,
            prediction_freedom=FREEDOM,
        )
        without = as_lost.pipeline.handle(guided)
        result = device.pipeline.handle(guided)
        assert isinstance(without, FrameResult)
        assert isinstance(result, FrameResult)
        lost, tracked = lost + without.valid, tracked + result.valid
        if result.valid:
            assert error_arcsec(result, truth) < 3600.0 * largest_deg
        if result.valid:
            assert result.tracked
            assert len(result.stars) == min(result.matched, STARS_SENT)
        far = replace(guided, predicted=truth.rotated(np.radians(rng.uniform(-3.0, 3.0, 3))))
        answer = device.pipeline.handle(far)
        assert isinstance(answer, FrameResult)
        assert not answer.valid or error_arcsec(answer, truth) < 3600.0 * largest_deg
    assert lost < 0.7 * FRAMES
    assert tracked > FRAMES * share - 3.0 * math.sqrt(FRAMES * share * (1.0 - share))


@pytest.mark.parametrize("rate_deg_s", [0.0, 2.0])
def test_windows_find_the_attitude_of_the_whole_image(rate_deg_s: float) -> None:
    """With trails, the whole image is searched."""
    whole, windows = (
        EcssDevice(EcssPlan("cubestar", (f"device.tracking_windows={on}",))) for on in ("false", "true")
    )
    rng = np.random.default_rng(6)
    for number in range(5):
        truth, rate = random_attitude(rng), np.radians([rate_deg_s, 0.0, 0.0])
        request = FrameRequest(
            number, TruthState(truth, rate), whole.exposure_s, whole.gain, whole.settings,
            predicted=truth.rotated(PREDICTION_ARCSEC / ARCSEC_PER_RAD * rng.standard_normal(3)),
            prediction_covariance=COVARIANCE, predicted_rate_rad_s=(float(rate[0]), 0.0, 0.0),
        )  # fmt: skip
        one, other = whole.pipeline.handle(request), windows.pipeline.handle(request)
        assert isinstance(one, FrameResult)
        assert isinstance(other, FrameResult)
        assert one.valid == other.valid
        if rate_deg_s > 0.0:
            assert other.quaternion_xyzw == one.quaternion_xyzw
        elif one.valid:
            assert other.detected <= one.detected
            off = Attitude(np.array(other.quaternion_xyzw)).error_to(Attitude(np.array(one.quaternion_xyzw)))
            assert off.cross_boresight_arcsec < 2.0 * one.sigma_cross_arcsec
