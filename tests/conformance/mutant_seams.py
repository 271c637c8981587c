"""Mutants of the device: what a mutant is, and the seams at which a defect is put in.

A defect is put at a seam of the healthy device, just before it is switched on: into what its links
receive, what they send, how requests are handled, or into one of its parts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from starhil.emulator.device.device import Device
from starhil.protocol.messages import FaultKind, Reply, ReplyKind, Request
from tests.conformance.simulated import SimulatedUnit

Damage = Callable[[SimulatedUnit], None]


@dataclass(frozen=True)
class Mutant:
    """A defect on a link, and the case that has to fail because of it."""

    name: str
    link: str
    caught_by: str
    damage: Damage


MUTANTS: list[Mutant] = []


def mutant(name: str, link: str, caught_by: str) -> Callable[[Damage], Damage]:
    """Enter a damage in the table; on `both` links it makes two mutants."""

    def enter(damage: Damage) -> Damage:
        links = ("serial", "can") if link == "both" else (link,)
        MUTANTS.extend(Mutant(name, kind, f"{kind}.{caught_by}", damage) for kind in links)
        return damage

    return enter


def outgoing(change: Callable[[Any], list[Any]]) -> Damage:
    """Replace each item that the device sends by others."""

    def damage(unit: SimulatedUnit) -> None:
        send = unit.link.wire.send

        def changed(item: Any) -> None:
            for other in change(item):
                send(other)

        unit.link.wire.send = changed

    return damage


def incoming(change: Callable[[Any], list[Any]]) -> Damage:
    """Replace each item that the device receives by others."""

    def damage(unit: SimulatedUnit) -> None:
        receive = unit.link._receive

        def changed(item: Any) -> None:
            for other in change(item):
                receive(other)

        unit.link._receive = changed

    return damage


def handling(change: Callable[[Device, Request, Callable[[Request], list[Reply]]], list[Reply]]) -> Damage:
    """Wrap the request handler; the change gets device, request and the healthy handler."""

    def damage(unit: SimulatedUnit) -> None:
        device, requests, handle = unit.device, unit.requests, unit.requests.handle
        requests.handle = lambda request, *, console=False: change(
            device, request, partial(handle, console=console)
        )

    return damage


def events(change: Callable[[Any], list[Any]]) -> Damage:
    """Replace each request or fault that the link's receiver finds."""

    def damage(unit: SimulatedUnit) -> None:
        link = unit.link
        take = link._dispatch

        def changed(event: Any) -> None:
            for other in change(event):
                take(other)

        link._dispatch = changed

    return damage


def enter(name: str, link: str, caught_by: str, damage: Damage) -> None:
    """Enter a damage that is made by one of the seams."""
    mutant(name, link, caught_by)(damage)


def without_faults(*kinds: FaultKind) -> Damage:
    """Hide some kinds of fault from the device."""

    def damage(unit: SimulatedUnit) -> None:
        requests, count_fault = unit.requests, unit.requests.count_fault
        requests.count_fault = lambda event: None if event.kind in kinds else count_fault(event)

    return damage


def only_acknowledged(row_id: int, data: bytes | None = None) -> Damage:
    """Acknowledge a telecommand, or only one with these parameters, without carrying it out."""

    def change(_device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
        if request.id == row_id and data in (None, request.data):
            return [Reply(ReplyKind.ACK, row_id, destination=request.source)]
        return handle(request)

    return handling(change)
