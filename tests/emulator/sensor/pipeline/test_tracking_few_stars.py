"""Tracking with three quarters of the field hidden: fewer stars than lost in space, and fainter ones, are enough."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from starhil.emulator.benchmarks.campaign import WRONG_DEG, block_side
from starhil.emulator.benchmarks.ecss_campaign import EcssDevice, EcssPlan
from starhil.emulator.sensor.pipeline.messages import FrameRequest, FrameResult
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import ARCSEC_PER_RAD, Attitude, random_attitude

PREDICTION_ARCSEC = np.array([45.0, 45.0, 75.0])
"""Error of a prediction from two images of the default device."""

COVARIANCE = np.diag((PREDICTION_ARCSEC / ARCSEC_PER_RAD) ** 2)
FRAMES = 60


def test_a_hidden_field_is_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    expose = Pipeline._expose

    def hidden(self: Pipeline, request: FrameRequest):
        exposure = expose(self, request)
        dark = block_side(exposure.image, 0.75, np.random.default_rng((9, request.index)))
        return replace(exposure, image=dark)

    monkeypatch.setattr(Pipeline, "_expose", hidden)
    device = EcssDevice(EcssPlan("cubestar"))
    lost = tracked = 0
    for number in range(FRAMES):
        rng = np.random.default_rng((5, number))
        truth = random_attitude(rng)
        error = PREDICTION_ARCSEC / ARCSEC_PER_RAD * rng.standard_normal(3)
        request = FrameRequest(
            number, TruthState(truth, ZERO_RATE), device.exposure_s, device.gain, device.settings
        )
        without = device.pipeline.handle(request)
        guided = replace(request, predicted=truth.rotated(error), prediction_covariance=COVARIANCE)
        result = device.pipeline.handle(guided)
        assert isinstance(without, FrameResult)
        assert isinstance(result, FrameResult)
        lost, tracked = lost + without.valid, tracked + result.valid
        if result.valid:
            off = Attitude(np.array(result.quaternion_xyzw)).error_to(truth)
            assert max(off.cross_boresight_arcsec, off.roll_arcsec) < 3600.0 * WRONG_DEG
            assert result.tracked
            assert result.matched == len(result.stars)
        far = replace(guided, predicted=truth.rotated(np.radians(rng.uniform(-3.0, 3.0, 3))))
        answer = device.pipeline.handle(far)
        assert isinstance(answer, FrameResult)
        assert not answer.valid
    assert lost < 0.7 * FRAMES
    assert tracked > FRAMES * 0.9 - 4.0 * math.sqrt(FRAMES * 0.9 * 0.1)
