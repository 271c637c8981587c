"""The CAN and CANopen conformance cases that a bus can change, on a kernel vcan0 (if need be, in a guest)."""

from __future__ import annotations

import pytest

from tests.process.conftest import NO_IMAGES_OPTIONS, needs_vcan0
from tests.process.test_conformance import conform

pytestmark = [pytest.mark.process, pytest.mark.socketcan, needs_vcan0]

CAN = ("frames", "segments", "bursts", "errors", "recovery", "unsolicited")
CANOPEN = ("nmt", "error-control", "sdo", "sdo-block", "sync", "tpdo", "rpdo")
"""Areas about IDs, kinds, order and loss of frames; what rows and objects hold is the same on every bus."""

SPEED = 0.25
"""Simulation time per second: the guest has one slow processor, and time-outs are rules that stay."""


def test_cases_about_frames_pass_on_the_kernel_bus():
    areas = [*(f"can.{area}" for area in CAN), *(f"canopen.{area}" for area in CANOPEN)]
    how = ("--start", "--can", "auto", "--canopen", "44", "--speed", str(SPEED), *NO_IMAGES_OPTIONS)
    outcomes = conform(*areas, *how)
    assert {item["status"] for item in outcomes} == {"passed"}
    assert {item["id"].rpartition(".")[0] for item in outcomes} == set(areas)
