"""Observers of a device's signals are called in any order, except those that connect as `first`: nothing that is sent depends on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest

from starhil.emulator.simulation.signal import Signal
from starhil.hil_tests.conformance.runner import Outcome
from tests.conformance.simulated import healthy_outcomes, outcomes

pytestmark = pytest.mark.long

STREAMING = (("sagitta", "serial"), ("oresat", "canopen"))
"""Units that report each frame as it is published."""


def traffic(outcome: Outcome) -> list[str]:
    """Return what passed in a case, without times."""
    return [f"{outcome.id} {outcome.status}", *(line.partition(" ")[2] for line in outcome.log)]


def first_difference(unit: str, link: str, usual: Iterable[Outcome]) -> tuple[list[str], list[str]] | None:
    """Return what passes in the first case in which it is not the usual, and the usual."""
    pairs = zip(map(traffic, outcomes(link, unit)), map(traffic, usual), strict=True)
    return next((pair for pair in pairs if pair[0] != pair[1]), None)


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
    usual = healthy_outcomes(link, unit)
    monkeypatch.setattr(Signal, "connect", in_reverse)
    assert first_difference(unit, link, usual) is None


@pytest.mark.parametrize(("unit", "link"), STREAMING)
def test_a_device_that_does_not_observe_first_reports_the_frame_before(
    unit: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = healthy_outcomes(link, unit)
    monkeypatch.setattr(Signal, "connect", first_as_last)
    assert first_difference(unit, link, usual) is not None
