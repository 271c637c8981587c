"""Signals: the order of their observers."""

from __future__ import annotations

from starhil.emulator.simulation.signal import Signal


def test_the_first_observer_is_called_before_those_that_were_connected_earlier():
    signal: Signal[int] = Signal("test")
    order: list[str] = []
    signal.connect(lambda _number: order.append("other"))
    signal.connect(lambda _number: order.append("first"), first=True)
    signal.emit(1)
    assert order == ["first", "other"]
