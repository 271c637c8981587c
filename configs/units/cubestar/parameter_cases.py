"""CubeStar's own cases for each of its parameters, on any link."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from starhil.configs.units.cubestar.controls import (
    parameter,
    parameters_kept,
    set_parameter,
    value_of,
)
from starhil.hil_tests.conformance.case import Case, check, check_equal, rule
from starhil.hil_tests.conformance.link_probe import INVALID_PARAMETER, LinkProbe
from starhil.hil_tests.judge.definition import Parameter, Unit

PARTNERS: Final = {
    "max_star_pixels": ("min_star_pixels", 1.0),
    "min_star_pixels": ("max_star_pixels", 255.0),
    "update_rate": ("exposure", 1.0),
    "exposure": ("update_rate", 0.01),
    "delay_time": ("update_rate", 0.01),
}
"""Parameters that limit each other → the other parameter, and its value that allows the full range."""
F32_ROUNDING: Final = 1e-6
UNSET: Final = frozenset({"unsolicited_rate"})
"""Parameters whose largest value would flood the line."""


def generated(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield the cases for each parameter of the unit."""
    for item in unit.parameters.values():
        yield from _parameter_cases(item)


def _parameter_cases(item: Parameter) -> Iterator[Case[LinkProbe]]:
    clause = f"configs/units/cubestar parameter {item.name}; {rule(19)}"

    def limits(probe: LinkProbe) -> None:
        reply = parameter(probe, item.name)
        check_equal(reply["parameter"], item.id, "number")
        for key, wanted in (("minimum", item.minimum), ("maximum", item.maximum)):
            check_equal(reply[key], float(wanted), key)
        value = float(reply["value"])
        check(item.value_of(value) is not None, f"a value within {item.minimum:g} to {item.maximum:g}", value)

    def refusals(probe: LinkProbe) -> None:
        before = value_of(probe, item.name)
        row = probe.unit.telecommands["set_parameter"]
        for bad in _outside(item):
            data = row.encode({"parameter": item.id, "value": bad})
            answer = probe.ask(row, data)
            if answer.kind == "ack":
                set_parameter(probe, item.name, before)
            refused = answer.kind == "nack" and answer.code == probe.unit.code(INVALID_PARAMETER)
            check(refused, f"{bad:g} refused with code 3", answer)
            check_equal(value_of(probe, item.name), before, "unchanged value")

    def values(probe: LinkProbe) -> None:
        partner, room = PARTNERS.get(item.name, (item.name, None))
        with parameters_kept(probe, item.name, partner):
            if room is not None:
                set_parameter(probe, partner, room)
            for good in _inside(item, value_of(probe, item.name)):
                set_parameter(probe, item.name, good)
                seen = float(probe.telemetry("parameter")["value"])
                same = abs(seen - good) <= F32_ROUNDING * max(abs(good), 1e-30)
                check(same, f"{item.name} {good!r}", f"{seen!r}")

    name = item.name
    for check_name, title, run in (
        ("limits", f"{name} reports its ID and limits", limits),
        ("refusals", f"{name} outside its limits is refused and unchanged", refusals),
        ("values", f"{name} accepts its smallest and largest value", values),
    ):
        yield Case(f"parameters.{name}.{check_name}", "parameters", title, clause, run, intrusive=True)


def _whole(parameter: Parameter) -> bool:
    return parameter.type not in ("f32", "f64")


def _outside(parameter: Parameter) -> list[float]:
    """Yield values that a parameter must refuse."""
    step = 1.0 if _whole(parameter) else max(1.0, abs(parameter.maximum)) * 0.01
    bad = [parameter.minimum - step, parameter.maximum + step, math.nan, math.inf, -math.inf]
    if _whole(parameter):
        bad.append(parameter.minimum + 0.5)
    if parameter.enum is not None:
        numbers = range(int(parameter.minimum), int(parameter.maximum))
        bad += [float(gap) for gap in sorted(set(numbers) - set(parameter.enum.values()))]
    return bad


def _inside(parameter: Parameter, present: float) -> list[float]:
    """Yield values that a parameter must accept."""
    if parameter.of_link:
        return [present]
    if parameter.enum is not None:
        return [float(number) for number in parameter.enum.values()]
    greatest = [] if parameter.name in UNSET else [parameter.maximum]
    return [parameter.minimum, *greatest, parameter.default_number]
