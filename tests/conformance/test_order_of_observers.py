"""Observers of a device's signals are called in any order, except those that connect as `first`: nothing that is sent depends on it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from starhil.emulator.simulation.signal import Signal
from starhil.hil_tests.conformance.canopen_suite import canopen_suite
from starhil.hil_tests.conformance.runner import run_case
from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.judge.definition import read_unit
from tests.conformance.simulated import SimulatedUnit

pytestmark = pytest.mark.long

SUITES = {"serial": serial_suite, "can": can_suite, "canopen": canopen_suite}
STREAMING = (("sagitta", "serial"), ("oresat", "canopen"))
"""Units that report each frame as it is published."""


def traffic(unit: str, link: str) -> list[str]:
    """Return what passes in all cases of a link, without times."""
    lines = []
    with SimulatedUnit(link, unit=unit) as simulated:
        for case in SUITES[link](read_unit(unit)):
            outcome = run_case(simulated.probe, case)
            lines += [f"{case.id} {outcome.status}", *(line.partition(" ")[2] for line in outcome.log)]
    return lines


usual_traffic = cache(traffic)


def in_reverse(self: Signal, observer: Callable[..., object], *, first: bool = False) -> None:
    """Connect before all observers but the `first`."""
    count = vars(self).setdefault("count_of_first", 0)
    self.observers.insert(0 if first else count, observer)
    vars(self)["count_of_first"] += first


def first_as_last(self: Signal, observer: Callable[..., object], *, first: bool = False) -> None:
    """Connect the `first` observers behind all others."""
    self.observers.insert(len(self.observers) if first else 0, observer)


@pytest.mark.parametrize(("unit", "link"), [*STREAMING, ("cubestar", "can")])
def test_the_order_in_which_observers_connect_makes_no_difference(
    unit: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = usual_traffic(unit, link)
    monkeypatch.setattr(Signal, "connect", in_reverse)
    assert traffic(unit, link) == usual


@pytest.mark.parametrize(("unit", "link"), STREAMING)
def test_a_device_that_does_not_observe_first_reports_the_frame_before(
    unit: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = usual_traffic(unit, link)
    monkeypatch.setattr(Signal, "connect", first_as_last)
    assert traffic(unit, link) != usual
