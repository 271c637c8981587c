"""Conformance of parameters: a telemetry row reports those that a telecommand sets."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

from starhil.hil_tests.conformance.case import Case, CaseSkipped, case_in, check, check_equal
from starhil.hil_tests.conformance.link_probe import LinkProbe
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

OF_LINKS: Final = frozenset({
    "can_address", "host_address", "serial_dialect", "serial_baud", "canopen_node", "unsolicited_rate", "unsolicited_selection",
})  # fmt: skip
"""Parameters that change how a unit is reached, or what it sends unasked: no values are tried."""
TIGHT: Final = frozenset({"delay_time", "orbit_eccentricity"})
"""Parameters that may only have the present value, because all others contradict the exposure, the update rate or the orbit."""


def parameter_cases(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield a case for each telecommand and each telemetry row that reports all parameters set by it in the same layout."""
    for command in unit.telecommands.values():
        fields = {_quantity(item): name for name, item in command.named.items() if item.parameter is not None}
        if command.action != "set_parameters" or not fields or OF_LINKS & {item[0] for item in fields}:
            continue
        for row in unit.telemetry.values():
            places = {
                fields[_quantity(item)]: name for name, item in row.named.items() if _quantity(item) in fields
            }
            if len(places) == len(fields):
                title = f"{row.name} reports the parameters set by {command.name}"
                run = partial(_set_and_read, command, row, places)
                yield case_in("settings", f"{row.name}.{command.name}", title, run, row, intrusive=True)


def _quantity(item: Field) -> tuple[object, ...]:
    return item.parameter, item.unit, item.kind, item.type, item.width, item.scale, item.bias


def _set_and_read(command: Row, row: Row, places: Mapping[str, str], probe: LinkProbe) -> None:
    """Change one field after the other; a refusal is no failure, because values may contradict each other."""
    if not probe.answers(command):
        raise CaseSkipped(f"{command.name} is not answered")
    seen = probe.values(row)
    before = {name: seen[place] for name, place in places.items()}
    rng = random.Random(command.id)  # noqa: S311 -- data, not a secret
    try:
        for name in places:
            item, taken = command.named[name], 0
            tried = {command.encode(before | {name: value}) for value in _tried(item, before[name], rng)}
            for data in sorted(tried):
                answer = probe.ask(command, data)
                check(answer.kind in ("ack", "nack"), f"an answer to telecommand {command.name}", answer)
                if answer.kind == "ack":
                    taken += 1
                    sent, seen = command.decode(data), probe.values(row)
                    read = {name: seen[place] for name, place in places.items()}
                    check_equal(
                        read, {name: sent[name] for name in places}, f"{row.name} after {command.name}"
                    )
            wanted = 1 if item.parameter in TIGHT else min(2, len(tried))
            check(taken >= wanted, f"{wanted} or more values of {command.name}.{name} accepted", taken)
    finally:
        probe.ask(command, command.encode(before))


def _tried(item: Field, now: Value, rng: random.Random) -> Iterator[Value]:
    """Yield the present value and others within the limits: both limits, the next ones, and any."""
    yield now
    if item.kind == "flag":
        yield not now
    elif item.enum is not None:
        yield from item.enum
    elif item.kind in ("integer", "float", "bits"):
        low, high = item.limits
        step = max(1.0, abs(item.scale))
        yield from (low, high, *(min(max(round(float(now)) + turn, low), high) for turn in (-step, step)))
        yield item.any_value(b"", 2, rng)
