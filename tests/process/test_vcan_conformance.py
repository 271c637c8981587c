"""Every conformance case of CAN and CANopen on a kernel vcan0 (on machines without one: in a guest)."""

from __future__ import annotations

import pytest

from protocol.transports.can import kernel_can_is_up
from tests.process.test_conformance import conform

pytestmark = [
    pytest.mark.process,
    pytest.mark.socketcan,
    pytest.mark.skipif(
        not kernel_can_is_up("vcan0"),
        reason="no vcan0 here; tools/test_on_vcan runs this test in a guest that has one",
    ),
]


SPEED = 0.5
"""Run time in a second: the guest has one slow processor, and time-outs are rules that stay."""


def test_every_case_passes_on_the_kernel_bus():
    outcomes = conform("--start", "--can", "auto", "--canopen", "44", "--speed", str(SPEED))
    passed = [item["id"] for item in outcomes if item["status"] == "passed"]
    assert len(passed) == len(outcomes)
    assert sum(identifier.startswith("can.") for identifier in passed) >= 380
    assert sum(identifier.startswith("canopen.") for identifier in passed) >= 140
