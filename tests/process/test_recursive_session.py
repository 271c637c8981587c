"""The emulator with the thesis's recursive algorithm tracks a slew over a bus."""

from __future__ import annotations

import json
import re
import tomllib

import pytest

from starhil.protocol.files.bundled import bundled
from tests.emulator.sensor.pipeline.known_photometry import known_photometry
from tests.process.test_sessions import starhil

pytestmark = pytest.mark.process

LONGEST_SAMPLE_S = 1.5
"""The figures of docs/reproduction.md need longer samples; what a session expects holds for some of the 15 of this time as well."""


@pytest.mark.parametrize(
    "session", ["recursive", "recursive_features", "thesis_recognition", "thesis_recursion"]
)
@pytest.mark.usefixtures("emulators_in_threads")
def test_a_session_with_the_recursive_algorithm_passes(tmp_path, session):
    text = bundled("session")[session].read_text(encoding="utf-8")
    short, samples = re.subn(r"(?<=\bfor_s = )\d+", str(LONGEST_SAMPLE_S), text)
    assert samples == text.count("sample = {") > 0
    short = short.replace(
        "clock=scaled:4", "clock=scaled:2"
    )  # a busy machine does not solve four images a second
    short = re.sub(r"min_samples = \d+", "min_samples = 3", short)  # of a tenth of the time
    if session != "recursive":  # which alone measures the limit of its detector
        profile = tomllib.loads(text)["emulator"]["profile"]
        known = ", ".join(f'"{setting}"' for setting in known_photometry(profile))
        short, lists = re.subn(r"^set = \[", rf"\g<0>{known}, ", short, flags=re.MULTILINE)
        assert lists == 1
    script = tmp_path / f"{session}.toml"
    script.write_text(short, encoding="utf-8")
    done = starhil("session", script, "--start", "--can", "auto", "--log", tmp_path, "--json")
    result = json.loads(done.stdout)
    failed = [(item["step"], item["detail"]) for item in result["results"] if item["status"] == "failed"]
    assert (done.returncode, failed) == (0, [])
