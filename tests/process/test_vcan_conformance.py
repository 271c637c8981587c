"""Every CAN and CANopen conformance case on a kernel vcan0 (if need be, in a guest)."""

from __future__ import annotations

import pytest

from tests.process.conftest import needs_vcan0
from tests.process.test_conformance import conform

pytestmark = [pytest.mark.process, pytest.mark.socketcan, needs_vcan0]


SPEED = 0.5
"""Simulation time per second: the guest has one slow processor, and time-outs are rules that stay."""


def test_every_case_passes_on_the_kernel_bus():
    outcomes = conform("--start", "--can", "auto", "--canopen", "44", "--speed", str(SPEED))
    passed = [item["id"] for item in outcomes if item["status"] == "passed"]
    others = [item for item in outcomes if item["status"] != "passed"]
    assert {(item["status"], item["id"].split(".")[1]) for item in others} <= {("skipped", "unjudged")}
    assert sum(identifier.startswith("can.") for identifier in passed) >= 380
    assert sum(identifier.startswith("canopen.") for identifier in passed) >= 140
