"""The profiles with a real lens have the errors of a real unit, and the calibration makes most of them."""

import numpy as np
import pytest

from starhil.emulator.device.cycle import as_quaternion
from starhil.emulator.device.device import profile_defaults
from starhil.emulator.device.parameters import Parameters
from starhil.emulator.emulation import camera_constants, pipeline_setup
from starhil.emulator.pipeline.messages import FrameRequest, PipelineReady, SolverSettings
from starhil.emulator.pipeline.pipeline import Pipeline
from starhil.emulator.profile import CALIBRATION, load_profile
from starhil.protocol.icd import load_unit
from starid.attitude import Attitude, random_attitude

DATA_SHEET_ARCSEC = 55.44 * 2**0.5
"""About x and y together."""
FIELDS = 4


def errors_arcsec(pipeline, parameters) -> list[float]:
    """Errors across the boresight in a few random fields."""
    settings = SolverSettings(**{name: parameters[name] for name in SolverSettings.__dataclass_fields__})
    rng = np.random.default_rng(7)
    errors = []
    for index in range(FIELDS):
        truth = random_attitude(rng)
        exposure_s = parameters["exposure"] / 1000.0
        request = FrameRequest(
            index, as_quaternion(truth), (0.0, 0.0, 0.0), exposure_s, 1.0, settings=settings
        )
        result = pipeline.handle(request)
        assert result.valid, result
        measured = Attitude(np.array(result.quaternion_xyzw))
        errors.append(measured.error_to(truth).cross_boresight_arcsec)
    return errors


@pytest.mark.parametrize(("name", "noise_arcsec"), [("real_lens", 2.0), ("cubestar", 25.0)])
def test_a_slightly_wrong_calibration_stays_within_the_data_sheet(name, noise_arcsec):
    profile, icd = load_profile(name, ["run.clock=stepped"]), load_unit()
    pipeline = Pipeline(pipeline_setup(profile))
    constants = camera_constants(PipelineReady(pipeline.camera.to_dict(), len(pipeline.catalog), 0.0))
    parameters = Parameters(icd, profile_defaults(profile, icd))
    assert constants.keys() == CALIBRATION <= profile.parameters.keys()
    wrong = errors_arcsec(pipeline, parameters)
    assert 5.0 < np.median(wrong) < DATA_SHEET_ARCSEC
    assert max(wrong) < DATA_SHEET_ARCSEC
    parameters.set(constants)
    assert max(errors_arcsec(pipeline, parameters)) < noise_arcsec


@pytest.mark.parametrize("name", ["ideal", "demo"])
def test_accurate_profiles_know_their_lens(name):
    assert not load_profile(name).parameters.keys() & CALIBRATION
