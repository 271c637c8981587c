"""Typed signals, with which one part of a run reports something to all parts that have connected to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from starhil.emulator.simulation.guard import call_guarded

Message = TypeVar("Message")


class Signal(Generic[Message]):
    """Passes each message to its observers: to those that are connected as `first`, and then to the others, both in any order.

    An observer that fails is logged, and stops neither the sender nor the other observers.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.observers: list[Callable[[Message], object]] = []

    def connect(self, observer: Callable[[Message], object], *, first: bool = False) -> None:
        """Call a function with each further message; `first`: before those that rely on what it does."""
        self.observers.insert(0 if first else len(self.observers), observer)

    def disconnect(self, observer: Callable[[Message], object]) -> None:
        """Call a function no more, if it is connected."""
        if observer in self.observers:
            self.observers.remove(observer)

    def emit(self, message: Message) -> None:
        for observer in self.observers:
            call_guarded(self.name, observer, message)
