"""What a run has compiled, or loaded, before its first frame."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.process

SCRIPT = """
import sys
from dataclasses import replace
import numpy as np
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.pipeline import make_pipeline
from starhil.emulator.profile import load_profile
from numba import njit
Kernel = type(njit(lambda: None))

def kernels():
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] in ("starid", "starhil")]
    return {
        f"{item.py_func.__module__}.{item.__name__}{signature}"
        for module in modules for item in list(vars(module).values()) if isinstance(item, Kernel)
        for signature in item.signatures
    }

requests = []
from starhil.emulator.sensor.pipeline import pipeline as module
frame = module.Pipeline._process_frame
module.Pipeline._process_frame = lambda self, request: (requests.append(request), frame(self, request))[1]
profile = load_profile(sys.argv[1])
pipeline, _ = make_pipeline(pipeline_setup(profile))
before = kernels()
exposure_s = profile.parameters["exposure"] / 1000.0
bright = sys.argv[1] == "ideal"
for rate in ((0.0, 0.0, 0.0), (0.0, 0.0052, 0.0), (0.01, 0.01, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 0.05)):
    for index in range(2):
        predicted = requests[0].truth.attitude if index % 2 else None
        truth = replace(requests[0].truth, rate_rad_s=np.array(rate))
        request = replace(requests[0], index=index, truth=truth, predicted=predicted, exposure_s=exposure_s)
        answer = pipeline.handle(request)
        assert answer.valid or not bright, answer
for faults in (
    {"moon": {"ra_deg": 3.0, "dec_deg": 2.0}, "sun": {"ra_deg": 80.0, "dec_deg": 0.0}, "false_stars": 30, "cosmic_rays_s": 50.0},
    {"earth": {"ra_deg": 0.0, "dec_deg": -70.0}, "obstructions": [{"share": 0.2}]},
    {"earth": {"ra_deg": 5.0, "dec_deg": 0.0, "radius_deg": 2.0}, "blank": False},
):
    for predicted in (None, requests[0].truth.attitude):
        answer = pipeline.handle(replace(requests[0], predicted=predicted, exposure_s=exposure_s, faults=faults))
        assert not hasattr(answer, "text"), answer
print(len(before), sorted(kernels() - before))
"""


@pytest.mark.parametrize("profile", ["ideal", "cubestar"])
def test_no_kernel_is_left_to_be_compiled_in_a_slew_or_for_an_optical_fault(profile):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, profile],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    count, _, late = done.stdout.strip().partition(" ")
    assert int(count) > 10
    assert late == "[]"
