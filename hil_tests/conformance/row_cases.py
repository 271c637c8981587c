"""Conformance to the rows of a definition, on serial and CAN: IDs, lengths, values, limits, settings, the clock."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from typing import Final

from starhil.hil_tests.conformance.attitude_cases import (
    SEARCHING,
    STANDBY,
    AttitudeRow,
    changes_mode,
    identifying_stars,
    mode_command,
)
from starhil.hil_tests.conformance.case import Case, CaseSkipped, case_in, check, check_equal, rule
from starhil.hil_tests.conformance.clock_cases import clock_cases
from starhil.hil_tests.conformance.link_probe import (
    FRAME_S,
    INVALID_ID,
    INVALID_LENGTH,
    INVALID_PARAMETER,
    UNSOLICITED_PARAMETERS,
    LinkProbe,
    changes_link,
    checked_values,
)
from starhil.hil_tests.conformance.unjudged_cases import unjudged_cases, unjudged_fields
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Answer, Value
from starhil.hil_tests.judge.rows import Field, Row

FLOOD_REQUESTS: Final = 200
SUBSCRIBED_S: Final = 3.0
LEAST_MESSAGES: Final = 6
"""Number of messages from which a rate is computed, at least."""
RATE_TOLERANCE: Final = 0.2
MODE_EVENTS: Final = frozenset({"frame", "mode", "validity"})
"""Events that a telecommand of the mode causes."""
SETTLING_S: Final = 1.0
"""Time after which a unit that identifies stars has an attitude."""
PAIR_ATTEMPTS: Final = 5
"""Number of attempts to read two rows between two measurements."""
F32_ROUNDING: Final = 1e-6
CLOCK_S: Final = 1_700_000_000
CONSTRAINED_PARAMETERS: Final = frozenset({"delay_time", "orbit_eccentricity"})
"""Parameters that may only have the present value, because all others contradict the exposure, the update rate or the orbit."""
PUBLISHED_IDS: Final = "telemetry 128 to 255, telecommands 0 to 127 (libCubeObc, CTS)"

Run = Callable[[LinkProbe], None]


ANY_SIZE: Final = range(1 << 16)


def row_cases(
    unit: Unit,
    *,
    lengths: bool = True,
    numbers: bool = True,
    marks: bytes = b"",
    highest_id: int = 255,
    sizes: Callable[[str], range] = lambda _message_class: ANY_SIZE,
) -> Iterator[Case[LinkProbe]]:
    """Yield the cases for the rows of a unit.

    `lengths`: whether a message of a wrong length can be sent on the link. `numbers`: whether requests carry IDs.
    `marks`: bytes that are special on it, of which settings are made. `highest_id`: the highest that a message can
    carry. `sizes`: the numbers of bytes of data that a request of a class can have.
    """
    if numbers:
        yield from _identifiers(unit, highest_id, sizes)
    if lengths:
        yield from _lengths(unit, sizes)
    for row in unit.telemetry.values():
        if not row.only_sent or row.is_streamed:
            yield from _telemetry(unit, row)
    for row in unit.telecommands.values():
        for index, (name, item) in enumerate(row.named.items()):
            for why, data in row.bad_values(item):
                title = f"{row.name} with {name} {why} is refused, and the refused field named"
                run = partial(_refused, row, data, INVALID_PARAMETER, index)
                yield case_in("fields", f"{row.name}.{name}.{why}", title, run, row, intrusive=True)
    yield from _agreement(unit)
    yield from _settings(unit, marks)
    yield from clock_cases(unit)
    yield from _unsolicited(unit)
    yield from _subscriptions(unit)
    yield from unjudged_cases(unit, unjudged_fields(unit, _compared(unit)))
    yield case_in(
        "recovery", "flood", "a flood of requests is answered completely and in order", _flood, rule(10)
    )


def sent_cases(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield the cases for a unit whose telemetry cannot be requested: those of the rows that it sends unprompted."""
    for row in unit.telemetry.values():
        if row.is_streamed:
            yield from _telemetry(unit, row)
    yield from clock_cases(unit)
    yield from _unsolicited(unit)

    def requests(_probe: LinkProbe) -> None:
        raise CaseSkipped("no request reads a row, so that no case can see whether a request was taken")

    yield from unjudged_cases(unit, unjudged_fields(unit, ()))
    title = "framing, check, header, IDs, lengths and values of requests"
    yield case_in("unjudged", "requests", title, requests, "[[telemetry]]: `request = false` in all rows")


# --- row IDs ---


def _identifiers(unit: Unit, highest: int, sizes: Callable[[str], range]) -> Iterator[Case[LinkProbe]]:
    """Yield a case for each class, or for each kind where IDs tell them apart."""
    groups: dict[str, tuple[str, range]] = {
        item.name: (item.name, range(highest + 1)) for item in unit.classes if item.code is not None
    }
    if not groups and unit.first_telemetry_id is not None:
        first = unit.first_telemetry_id
        groups = {"telemetry": ("", range(first, highest + 1)), "telecommands": ("", range(first))}
    for name, (message_class, numbers) in (groups or {"unknown": ("", range(highest + 1))}).items():
        row_ids = {
            row.id
            for row in unit.rows
            if not row.only_sent and (row.message_class == message_class or not message_class)
        }
        unknown = [number for number in numbers if number not in row_ids]
        if message_class:  # every class has all numbers: those beside its rows, and both ends
            near = {row_id + step for row_id in row_ids for step in (-1, 1)} | {0, highest}
            unknown = sorted(near & set(unknown))

        def run(probe: LinkProbe, message_class: str = message_class, unknown: list[int] = unknown) -> None:
            for row_id in unknown:
                probe.expect_refusal(row_id, bytes(sizes(message_class)[0]), INVALID_ID, message_class)

        title = f"unknown {'IDs of class ' + message_class if message_class else 'IDs' if name == 'unknown' else name} are refused"
        yield case_in("identifiers", name, title, run, PUBLISHED_IDS, intrusive=name != "telemetry")


def _lengths(unit: Unit, sizes: Callable[[str], range]) -> Iterator[Case[LinkProbe]]:
    def with_data(probe: LinkProbe) -> None:
        for row in probe.unit.readable.values():
            if probe.distinguishes_refusal(row):
                probe.expect_refusal(row, b"\x00", INVALID_LENGTH)

    title = "a telemetry request with data is refused for its length"
    yield case_in("identifiers", "telemetry-with-data", title, with_data, rule(5))
    beyond = b"\0\0" if unit.conventions.telecommand_crc else b"\0"
    for row in unit.telecommands.values():
        whole = row.encode()
        tried = {
            "long": whole + beyond,
            "short": whole[: row.min_size - 1] if row.min_size else None,
            "empty": b"" if row.min_size > 1 else None,
        }
        for why, data in tried.items():
            if data is not None and len(data) in sizes(row.message_class):
                title = f"{row.name} with {len(data)} bytes ({why}) is refused for its length"
                run = partial(_refused, row, data, INVALID_LENGTH, None)
                yield case_in("lengths", f"{row.name}.{why}", title, run, row, intrusive=True)


def _refused(row: Row, data: bytes, error: str, index: int | None, probe: LinkProbe) -> None:
    probe.expect_refusal(row, data, error)
    probe.check_reported(row.id, error, index)


# --- telemetry ---


def _telemetry(unit: Unit, row: Row) -> Iterator[Case[LinkProbe]]:
    attitude = AttitudeRow.of(row, unit.conventions)

    def read_twice(probe: LinkProbe) -> None:
        for _ in range(2):
            seen = probe.values(row)
            if attitude is not None:
                attitude.check(probe, seen)

    title = f"{row.name} has {row.size} bytes and values within their limits"
    yield case_in("telemetry", row.name, title, read_twice, row)
    if attitude is not None:
        intrusive = changes_mode(unit.telecommands.values())
        yield case_in("attitude", row.name, attitude.title, attitude.becomes_valid, row, intrusive=intrusive)


# --- quantities in several rows ---


def _agreement(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield the case for numbers that several fields report: the layouts differ, the values must not."""
    shared = _shared(unit)
    if not shared:
        return

    def run(probe: LinkProbe) -> None:
        with identifying_stars(probe):
            probe.sleep(SETTLING_S)
            for quantity, (first, *others) in shared.items():
                for other in others:
                    _compare(probe, quantity, first, other)

    title = "numbers that several fields report agree within the resolution of the fields"
    yield case_in(
        "agreement", "rows", title, run, "[[telemetry]]: fields with the same `value`", intrusive=True
    )


def _shared(unit: Unit) -> dict[str, list[tuple[Row, str]]]:
    """Return the fields of each quantity that several layouts report in one unit of measure."""
    places: dict[tuple[str, str], list[tuple[Row, str]]] = {}
    for row in unit.readable.values():
        for name, item in row.named.items():
            if item.value is not None and item.kind in ("integer", "float", "bits") and item.enum is None:
                places.setdefault((item.value, item.unit), []).append((row, name))
    return {
        quantity: found
        for (quantity, _unit), found in places.items()
        if len({_layout(*place) for place in found}) > 1
    }


def _compared(unit: Unit) -> Iterator[tuple[Row, str]]:
    """Yield the fields that are compared with what was set, or with other fields."""
    for places in _shared(unit).values():
        yield from places
    for _, row, names in _read_back(unit):
        yield from ((row, name) for name in names.values())


def _layout(row: Row, name: str) -> tuple[object, ...]:
    item = row.named[name]
    return item.type, item.order, item.scale, item.bias, item.width


def _compare(probe: LinkProbe, quantity: str, one: tuple[Row, str], other: tuple[Row, str]) -> None:
    """Compare two fields between two readings of the first that agree; skip a quantity that never rests."""
    for _ in range(PAIR_ATTEMPTS):
        before, between, after = (probe.values(row)[name] for row, name in (one, other, one))
        if before == after:
            break
    else:
        return
    first, second = (row.named[name] for row, name in (one, other))
    whole = "float" not in (first.kind, second.kind)
    alike = whole and (first.scale, first.bias) == (second.scale, second.bias)
    numbers = (first, float(after)), (second, float(between))
    margin = 0.0 if alike else sum(_resolution(item, number) for item, number in numbers)
    what = f"{quantity} in {other[0].name}.{other[1]} and {one[0].name}.{one[1]} alike, to {margin:.2g}"
    # a number beyond the limits of one field is sent as the nearest limit, and known only from the other
    for (item, number), (against, reading) in (numbers, numbers[::-1]):
        low, high = item.limits
        if low < number < high:
            nearest = min(max(number, against.limits[0]), against.limits[1])
            check(abs(reading - nearest) <= margin, what, f"{float(between):.9g} and {float(after):.9g}")


def _resolution(item: Field, number: float) -> float:
    return F32_ROUNDING * abs(number) if item.kind == "float" else 0.51 * abs(item.scale)


# --- telecommands ---


def _settings(unit: Unit, marks: bytes) -> Iterator[Case[LinkProbe]]:
    own = unit.plugin.actions if unit.plugin is not None else ()
    for row in unit.telecommands.values():
        if row.action in (None, "nothing") or row.action in own:
            title = f"{row.name} is accepted"
            yield case_in("commands", row.name, title, partial(_accepted, row), row, intrusive=True)
    for command, row, places in _read_back(unit):
        run = partial(_set_and_read, command, row, places, marks)
        name = f"{row.name}.{command.name}"
        if command.action == "set_parameters":
            title = f"{row.name} reports the parameters set by {command.name}"
            yield case_in("settings", name, title, run, row, intrusive=True)
        else:
            title = f"{row.name} reports the bytes set by {command.name}"
            alone = sum(other is row for _, other, _ in unit.reported) == 1
            yield case_in("settings", row.name if alone else name, title, run, row, intrusive=True)


def _read_back(unit: Unit) -> Iterator[tuple[Row, Row, Mapping[str, str]]]:
    """Yield the telecommands whose values cases set and read, as `Unit.reported` has them."""
    for command, row, places in unit.reported:
        kept = command.action == "set_parameters" and not changes_link(unit, command)
        if kept or command.action in (None, "nothing"):
            yield command, row, places


def _accepted(row: Row, probe: LinkProbe) -> None:
    """Send plain values, and both limits of each number if the row has no effect."""
    probe.send_command(row, row.encode())
    for name, item in row.named.items() if row.action == "nothing" else ():
        for limit, bound in zip(
            item.limits if item.kind in ("integer", "float") else (),
            (item.minimum, item.maximum),
            strict=False,
        ):
            if bound is not None:
                probe.send_command(row, row.encode({name: limit}))


def _set_and_read(command: Row, row: Row, places: Mapping[str, str], marks: bytes, probe: LinkProbe) -> None:
    """Set values, and read each one that is accepted in its place in the row.

    Of a telecommand without effect, all fields change at once; parameters change one after the other, and a refusal is no
    failure, because their values may contradict each other.
    """
    if not probe.answers(command):
        raise CaseSkipped(f"{command.name} is not answered")

    def read() -> dict[str, Value]:
        seen = probe.values(row)
        return {name: seen[place] for name, place in places.items()}

    before = read()
    rng = random.Random(command.id)  # noqa: S311 -- data, not a secret
    tried = {name: list(_tried(command.named[name], before[name], marks, rng)) for name in places}
    if command.action == "set_parameters":
        attempts = [
            (
                f"{command.name}.{name}",
                [before | {name: value} for value in values],
                1 if command.named[name].parameter in CONSTRAINED_PARAMETERS else 2,
            )
            for name, values in tried.items()
        ]
    else:
        turns = range(max(map(len, tried.values())))
        whole = [{name: values[turn % len(values)] for name, values in tried.items()} for turn in turns]
        attempts = [(command.name, whole, len(whole))]
    try:
        for what, chosen, least in attempts:
            sent, taken = {command.encode(values) for values in chosen}, 0
            for data in sorted(sent):
                answer = probe.ask(command, data)
                check(answer.kind in ("ack", "nack"), f"an answer to telecommand {command.name}", answer)
                if answer.kind == "ack":
                    taken += 1
                    given = command.decode(data)
                    wanted = {name: given[name] for name in places}
                    check_equal(read(), wanted, f"{row.name} after {command.name}")
            needed = min(least, len(sent))
            check(taken >= needed, f"{needed} or more values of {what} accepted", taken)
    finally:
        probe.ask(command, command.encode(before))


def _tried(item: Field, now: Value, marks: bytes, rng: random.Random) -> Iterator[Value]:
    """Yield the present value and others within the limits: of special bytes, any, both limits, and the next ones."""
    yield now
    if item.kind == "flag":
        yield not now
    elif item.enum is not None:
        yield from item.enum
    else:
        yield from (item.any_value(marks, turn, rng) for turn in range(3))
        if item.minimum is not None and item.maximum is not None:
            low, high = item.limits
            step = max(1.0, abs(item.scale))
            yield from (low, high, *(min(max(round(float(now)) + turn, low), high) for turn in (-step, step)))


# --- unsolicited telemetry, subscriptions and floods ---


def _unsolicited(unit: Unit) -> Iterator[Case[LinkProbe]]:
    """Yield a case for each row that the unit sends without a request, if a request can cause its event."""
    reset = next((row for row in unit.telecommands.values() if row.action == "reset"), None)
    for row in unit.telemetry.values():
        if isinstance(row.unsolicited, float):
            title = f"{row.name} is sent {row.unsolicited:g} times a second without a request"
            yield case_in("unsolicited", row.name, title, partial(_streamed, row, row.unsolicited), row)
        elif row.unsolicited is not None and not MODE_EVENTS.isdisjoint(row.unsolicited):
            title = f"{row.name} is sent without a request after {' or '.join(row.unsolicited)}"
            yield case_in("unsolicited", row.name, title, partial(_reported, row), row, intrusive=True)
        elif row.unsolicited is not None and "start" in row.unsolicited and reset is not None:
            title = f"{row.name} is sent without a request after {reset.name}"
            run = partial(_reported_at_start, row, reset)
            yield case_in("unsolicited", row.name, title, run, row, intrusive=True)


def _of_row(row: Row, answers: list[Answer]) -> list[Answer]:
    """Return the messages of a row, whose values must be within their limits."""
    messages = [
        answer for answer in answers if (answer.row_id, answer.message_class) == (row.id, row.message_class)
    ]
    for answer in messages:
        check_equal(len(answer.data), row.size, f"bytes of {row.name}")
        checked_values(row, answer.data)
    return messages


def _streamed(row: Row, rate_hz: float, probe: LinkProbe) -> None:
    _check_carried(probe)
    seconds = max(SUBSCRIBED_S, LEAST_MESSAGES / rate_hz)
    answers = probe.receive_unsolicited(seconds)
    probe.check_numbers(answers)
    wanted, seen = rate_hz * seconds, len(_of_row(row, answers))
    check(abs(seen - wanted) <= 1 + RATE_TOLERANCE * wanted, f"about {wanted:.0f} messages", seen)


def _reported(row: Row, probe: LinkProbe) -> None:
    _check_carried(probe)
    rest, search = mode_command(probe, STANDBY), mode_command(probe, SEARCHING)
    if rest is None or search is None:
        if row.is_streamed and _of_row(row, probe.receive_unsolicited(FRAME_S)):
            return
        raise CaseSkipped("no telecommand starts and ends the identification of stars")
    with identifying_stars(probe):
        rest()
        probe.sleep(SETTLING_S)
        answers = probe.receive_unsolicited(SUBSCRIBED_S, search)
    probe.check_numbers(answers)
    messages = _of_row(row, answers)
    check(bool(messages), f"{row.name} within {SUBSCRIBED_S:g} s of a telecommand for {SEARCHING}", "none")
    modes = [name for name, item in row.named.items() if item.value == "mode"]
    if row.unsolicited == ["mode"] and modes and SEARCHING not in row.named[modes[0]].shared:
        modes_reported = [row.decode(answer.data)[modes[0]] for answer in messages]
        check_equal(modes_reported[0], SEARCHING, "mode in the first message")
        changes = all(one != other for one, other in pairwise(modes_reported))
        check(changes, "another mode in each message", modes_reported)


def _reported_at_start(row: Row, reset: Row, probe: LinkProbe) -> None:
    _check_carried(probe)
    end = probe.now() + probe.times.boot_s
    answers = probe.receive_unsolicited(SUBSCRIBED_S, partial(probe.send_command, reset, reset.encode()))
    while not (found := _of_row(row, answers)) and probe.now() < end:
        answers = probe.receive_unsolicited(SUBSCRIBED_S)
    check(bool(found), f"{row.name} within {probe.times.boot_s:g} s of {reset.name}", "none")


def _check_carried(probe: LinkProbe) -> None:
    if not probe.has_unsolicited:
        raise CaseSkipped("the line has no unsolicited telemetry")


def _subscriptions(unit: Unit) -> Iterator[Case[LinkProbe]]:
    for row in unit.telecommands.values():
        fields = [name for name, item in row.named.items() if (item.argument or "").startswith("telemetry[")]
        message_class = str(row.arguments.get("class", ""))
        offered = [
            item
            for item in unit.telemetry.values()
            if message_class in ("", item.message_class) and not _is_sent_always(item, unit)
        ][:2]
        if row.action == "subscribe" and fields and offered:
            title = f"{row.name} starts and stops unsolicited telemetry"
            yield case_in(
                "subscriptions",
                row.name,
                title,
                partial(_subscribed, row, fields, offered),
                row,
                intrusive=True,
            )


def _is_sent_always(row: Row, unit: Unit) -> bool:
    """Return whether a unit sends a row without a request in its default state: at a rate, at events, or selected by parameters."""
    defaults = {name: unit.device_parameters[name].default for name in UNSOLICITED_PARAMETERS}
    selected = bool(defaults["unsolicited_rate"]) and row.id == defaults["unsolicited_selection"]
    return row.unsolicited is not None or selected


def _subscribed(command: Row, fields: list[str], offered: list[Row], probe: LinkProbe) -> None:
    _check_carried(probe)
    with identifying_stars(probe), probe.streaming(offered):  # rows may be sent at each measurement only
        _subscribe(command, fields, offered, probe)


def _subscribe(command: Row, fields: list[str], offered: list[Row], probe: LinkProbe) -> None:
    none = dict.fromkeys(fields, 0)

    def of_list(seconds: float) -> list[Answer]:
        """Return the messages that the list has caused, not those that the unit always sends."""
        answers = probe.receive_unsolicited(seconds)
        probe.check_numbers(answers)
        rows = probe.unit.telemetry.values()
        always = {(row.id, row.message_class) for row in rows if _is_sent_always(row, probe.unit)}
        return [answer for answer in answers if (answer.row_id, answer.message_class) not in always]

    chosen = none | {name: row.id for name, row in zip(fields, offered, strict=False)}
    probe.send_command(command, command.encode(chosen))
    messages = of_list(SUBSCRIBED_S)
    probe.send_command(command, command.encode(none))
    probe.sleep(0.5)
    rows_and_sizes = {(row.id, row.size) for row in offered[: len(fields)]}
    check(
        len(messages) >= len(rows_and_sizes), "a message of each row within 3 s", f"{len(messages)} messages"
    )
    check_equal({(answer.row_id, len(answer.data)) for answer in messages}, rows_and_sizes, "rows and sizes")
    check_equal(
        {answer.message_class for answer in messages} - {""},
        {row.message_class for row in offered} - {""},
        "classes",
    )
    for answer in messages:
        checked_values(next(row for row in offered if row.id == answer.row_id), answer.data)
    check_equal(len(of_list(2.0)), 0, "messages after the end of the subscription")


def _flood(probe: LinkProbe) -> None:
    rows = sorted(probe.unit.readable.values(), key=lambda row: row.size)[:2]
    for number in range(FLOOD_REQUESTS):
        probe.post(rows[number % len(rows)])
    for number in range(FLOOD_REQUESTS):
        probe.expect_telemetry(rows[number % len(rows)], 2.0)
