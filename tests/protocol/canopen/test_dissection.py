"""All that our slave sends in the conformance cases is well-formed CANopen to Wireshark."""

from __future__ import annotations

import pytest

from starhil.hil_tests.conformance.canopen_suite import CANOPEN_CASES
from starhil.hil_tests.conformance.runner import run_case
from tests.protocol.export.dissection import dissect

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def recorded(simulated_probe, tmp_path_factory):
    """Who sent each frame of a run of all cases ("->" the tester, "<-" the slave), and how it was dissected."""
    probe = simulated_probe()
    lines = [line.split(" ", 2) for case in CANOPEN_CASES for line in run_case(probe, case).log]
    path = tmp_path_factory.mktemp("recording") / "can.log"
    path.write_text("".join(f"({float(time):017.6f}) vcan0 {frame}\n" for time, _, frame in lines))
    frames = dissect(path)
    assert len(frames) == len(lines)
    return list(zip((way for _, way, _ in lines), frames, strict=True))


def test_nothing_that_the_slave_sends_is_malformed(recorded):
    ours = [frame for way, frame in recorded if way == "<-"]
    assert len(ours) > 10_000
    assert [frame for frame in ours if frame.malformed or frame.protocols[-1] != "canopen"] == []


def test_the_dissector_reports_frames_that_the_tester_malforms_on_purpose(recorded):
    malformed = [frame.identifier for way, frame in recorded if way == "->" and frame.malformed]
    assert {0x000, 0x100, 0x62C} <= set(malformed)


@pytest.mark.parametrize(
    "words",
    [
        "Boot-up", "Pre-operational", "Operational", "Stopped", "EMCY", "PDO1 (tx)", "PDO4 (tx)", "Abort transfer",
        "Initiate upload response", "Upload segment response", "Initiate download response", "Download segment response",
        "Block upload", "Block download", "Identify slave protocol", "Configure node-ID protocol",
    ],
)  # fmt: skip
def test_the_slave_speaks_every_service(recorded, words):
    assert any(words in frame.words for way, frame in recorded if way == "<-")
