"""Observers of the device's signals are called in any order, except those that connect as `first`: what is sent does not depend on it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from starhil.emulator.simulation.signal import Signal
from starhil.hil_tests.conformance.canopen_suite import canopen_suite
from starhil.hil_tests.conformance.runner import run_case
from starhil.hil_tests.conformance.suites import can_suite, serial_suite
from starhil.hil_tests.judge.definition import read_unit
from tests.conformance.simulated import SimulatedUnit

SUITES = {"serial": serial_suite, "can": can_suite, "canopen": canopen_suite}
AREAS = (
    "modes",
    "reset",
    "store",
    "unsolicited",
    "counters",
    "parameters",
    "tpdo",
    "emcy",
    "nmt",
    "telemetry",
)


def traffic(link: str) -> list[str]:
    """Return what passes in the cases of these areas, without times."""
    cases = [case for case in SUITES[link](read_unit("cubestar")) if case.area.endswith(AREAS)]
    lines = []
    with SimulatedUnit(link) as simulated:
        for case in cases:
            outcome = run_case(simulated.probe, case)
            assert outcome.status in ("passed", "skipped"), outcome
            lines += [case.id, *(line.partition(" ")[2] for line in outcome.log)]
    return lines


def connect_in_front(self: Signal, observer: Callable[..., object], *, first: bool = False) -> None:
    """Connect as `Signal.connect` does, but before all observers that are not `first`."""
    count = vars(self).setdefault("count_of_first", 0)
    self.observers.insert(0 if first else count, observer)
    vars(self)["count_of_first"] += first


@pytest.mark.parametrize("link", SUITES)
def test_the_order_in_which_observers_connect_makes_no_difference(
    link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = traffic(link)
    monkeypatch.setattr(Signal, "connect", connect_in_front)
    assert traffic(link) == usual
    assert len(usual) > 1000
