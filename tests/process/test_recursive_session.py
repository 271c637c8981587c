"""The emulator with the thesis's recursive algorithm tracks a slew over a bus."""

from __future__ import annotations

import json

import pytest

from tests.process.test_sessions import starhil

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    "session", ["recursive", "recursive_features", "thesis_recognition", "thesis_recursion"]
)
def test_a_session_with_the_recursive_algorithm_passes(tmp_path, session):
    done = starhil("session", session, "--start", "--can", "auto", "--log", tmp_path, "--json")
    result = json.loads(done.stdout)
    failed = [(item["step"], item["detail"]) for item in result["results"] if item["status"] == "failed"]
    assert (done.returncode, failed) == (0, [])
