"""Conformance of any unit on CANopen, derived from its definition: entries, telecommands, default PDOs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

from starhil.hil_tests.conformance.attitude_cases import (
    ATTITUDE_S,
    AttitudeRow,
    identifying_stars,
    reported_mode,
)
from starhil.hil_tests.conformance.canopen_probe import (
    NO_RTR,
    PDO_OFF,
    PRE_OPERATIONAL,
    START,
    VALUE_ABORTS,
    CanopenProbe,
)
from starhil.hil_tests.conformance.case import Case, case_in, check, check_equal
from starhil.hil_tests.conformance.clock_cases import PAUSE_S, Time, check_times, passage_of, times_of
from starhil.hil_tests.conformance.row_cases import CLOCK_S
from starhil.hil_tests.conformance.unjudged_cases import stated, unjudged_cases
from starhil.hil_tests.judge.canopen import (
    EXPEDITED,
    SYNC,
    Entry,
    entries,
    is_text,
    pdo_can_id,
    slots,
    written,
)
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import Field, Row

BOOT_S: Final = 15.0
"""Maximum time from a reset to the end of booting."""
CHANGING_QUANTITIES: Final = ("attitude.", "rate.", "frame.", "stars.", "stars[")
"""Prefixes of the names of quantities that change with each exposure."""
UNUSED_ID: Final = 0x3E0
"""CAN ID for a PDO that has none."""
CLAUSE: Final = "[canopen]"

Run = Callable[[CanopenProbe], None]


def canopen_unit_cases(unit: Unit) -> list[Case[CanopenProbe]]:
    layout = unit.canopen
    found = list(entries(unit, layout))
    cases = [*_rows(unit, found), *_commands(found), *_records(found), *_limits(found), *_pdos(layout, found)]
    return [*cases, *unjudged_cases(unit, _unjudged(unit, found))]


def _case(
    area: str, name: str, title: str, run: Run, clause: str | Row = CLAUSE, *, safe: bool = False
) -> Case[CanopenProbe]:
    return case_in(area, name, title, run, clause, intrusive=not safe)


def _argument(entry: Entry, name: str) -> Field | None:
    fields = entry.command.named.values() if entry.command is not None else ()
    return next((field for field in fields if field.argument == name), None)


# --- telemetry ---


def _rows(unit: Unit, entries: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    for row in unit.telemetry.values():
        if not any(entry.row is row for entry in entries):
            continue
        read = {slot.offset for _, slot in slots(row, entries)}
        fields = [item for item in row.named.values() if item.offset in read]
        attitude = AttitudeRow.of(row, unit.conventions, fields)
        title = f"the entries of {row.name} have the right sizes, and values within the limits"
        yield _case("rows", row.name, title, partial(_values, row, attitude), row, safe=True)
        if attitude is not None:
            yield _case("attitude", row.name, attitude.title, attitude.becomes_valid, row)
        times = _times(row, fields)
        if times:
            title = f"times in the entries of {row.name} advance as the tester's clock does"
            yield _case(
                "clocks",
                row.name,
                title,
                partial(_clocks, row, times, unit.conventions.epoch),
                row,
                safe=True,
            )


def _times(row: Row, fields: list[Field]) -> list[Time]:
    """Return the times that are one entry each: two are not read at one moment."""
    found = [time for time in times_of(row) if not time.of_frame and len(time.fields) == 1]
    return [time for time in found if time.fields[0] in fields]


def _clocks(row: Row, times: list[Time], epoch: str, probe: CanopenProbe) -> None:
    check_times(row, times, passage_of(probe, row, partial(probe.sleep, PAUSE_S)), epoch)


def _unjudged(unit: Unit, found: list[Entry]) -> Iterator[tuple[Row, Field]]:
    """Yield the fields of entries that no case judges."""
    for row in unit.telemetry.values():
        read = {slot.offset for _, slot in slots(row, found)}
        fields = [item for item in row.named.values() if item.offset in read]
        judged = [*stated(unit, row), *(item for time in _times(row, fields) for item in time.fields)]
        yield from ((row, item) for item in fields if item not in judged)


def _values(row: Row, attitude: AttitudeRow | None, probe: CanopenProbe) -> None:
    seen = probe.values(row)
    if attitude is not None:
        attitude.check(probe, seen)


def _accepted(command: Row, probe: CanopenProbe) -> None:
    probe.command(command.name, **command.example())


# --- telecommands ---


def _commands(found: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    for entry in found:
        command = entry.command
        if command is None or entry.part is not None or entry.size > EXPEDITED:
            continue
        if command.action == "reset":
            title = f"{command.name} restarts the node"
            run = partial(_restarts, command)
        elif entry.row is not None and entry.slot is not None:
            title = f"{entry.name}h reports each written value of {command.name}"
            run = partial(_reported, entry, command)
        elif command.action in (None, "nothing"):
            title, run = f"{command.name} is accepted", partial(_accepted, command)
        else:
            continue
        yield _case("commands", command.name, title, run, command)


def _restarts(command: Row, probe: CanopenProbe) -> None:
    """Restart the unit, and wait until the mode reported by an entry is no longer the boot mode."""
    probe.drain()
    _accepted(command, probe)
    probe.expect_boot_up()
    end = probe.now() + BOOT_S
    while reported_mode(probe) == "boot":
        check(probe.now() < end, f"the end of booting within {BOOT_S:g} s", "boot")
        probe.sleep(0.1)


def _fields(entry: Entry) -> list[Field]:
    fields = () if entry.row is None else entry.row.named.values()
    return [field for field in fields if entry.slot is not None and field.offset == entry.slot.offset]


def _reports(entry: Entry, *quantities: str) -> bool:
    """Return whether an entry reads a quantity whose name has one of these prefixes."""
    return any(field.value is not None and field.value.startswith(quantities) for field in _fields(entry))


def _reported(entry: Entry, command: Row, probe: CanopenProbe) -> None:
    """Write all values of an enumeration, or else both limits; restore the previous value."""
    (name, field), *_ = command.named.items()
    values: list[Value] = (
        ["s", "star"] if is_text(command) else list(field.limits if field.enum is None else field.enum)
    )
    before = probe.value(entry)
    for value in values:
        data = written(entry, command, command.encode({name: value}))
        probe.put(entry, data)
        check_equal(probe.value(entry), data, f"{entry.name}h after writing {value!s}:")
    probe.put(entry, before or b"\0")


def _records(entries: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    """Yield the cases for records whose entries together set one telecommand."""
    for command in {
        entry.command.name: entry.command for entry in entries if entry.command and entry.part
    }.values():
        members = [entry for entry in entries if entry.command is command and entry.size <= EXPEDITED]
        title = f"each entry of {command.name} keeps its written value when other entries are written"
        yield _case("records", command.name, title, partial(_keeps_values, command, members), command)


def _keeps_values(command: Row, members: list[Entry], probe: CanopenProbe) -> None:
    before = [probe.value(entry) for entry in members]
    for end in (1, 0):
        for entry in members:
            probe.put(entry, _limit(command, entry, end))
        for entry in members:
            seen = probe.value(entry)
            check_equal(seen, _limit(command, entry, end), f"{entry.name}h after all were written:")
    for entry, data in zip(members, before, strict=True):
        probe.put(entry, data)


def _limit(command: Row, entry: Entry, end: int) -> bytes:
    """Encode the lowest (0) or highest (1) values of the fields of an entry."""
    values = command.example()
    for name, field in command.named.items():
        if field.kind in ("integer", "float", "bits") and entry.part is not None:
            values[name] = field.limits[end]
    return written(entry, command, command.encode(values))


def _limits(found: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    for entry in found:
        command = entry.command
        if command is None or entry.size > EXPEDITED:
            continue
        for name, field in command.named.items():
            if entry.part is not None and entry.part.offset != field.offset:
                continue
            for why, data in command.bad_values(field):
                title = f"{entry.name}h with {name} {why} is refused"
                run = partial(_refused, entry, written(entry, command, data))
                yield _case("limits", f"{command.name}.{name}.{why}", title, run, command)


def _refused(entry: Entry, data: bytes, probe: CanopenProbe) -> None:
    before = probe.value(entry) if entry.row is not None else b""
    probe.expect_refusal(entry.index, entry.subindex, data, *VALUE_ABORTS)
    if entry.row is not None:
        check_equal(probe.value(entry), before, f"{entry.name}h, unchanged:")


# --- PDOs ---


def _pdos(layout: Any, entries: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    by_name = {entry.name.lower(): entry for entry in entries}
    for first, models in ((0x1400, layout.rpdo), (0x1800, layout.tpdo)):
        kind = "tpdos" if first == 0x1800 else "rpdos"
        for number, model in enumerate(models):
            mapped = [by_name[name.lower()] for name in model.objects]
            index, label = first + number, f"{kind[:4].upper()} {number + 1} ({model.name})"
            title = f"{label} has the CAN ID, transmission type, timers and mapping of the definition"
            yield _case(
                kind, f"{number + 1}.default", title, partial(_default, index, model, mapped), safe=True
            )
            if not mapped:
                continue
            if first == 0x1800:
                title = f"{label} carries the values of its objects"
                yield _case(kind, f"{number + 1}.data", title, partial(_carries_values, index, mapped))
            if (
                first == 0x1800
                and model.enabled
                and not model.event_ms
                and any(
                    _reports(entry, *CHANGING_QUANTITIES) and not _fields(entry)[0].width for entry in mapped
                )
            ):
                title = f"{label} is sent when frames are taken"
                yield _case(kind, f"{number + 1}.frames", title, partial(_sent_with_frames, index, model))
            if first == 0x1400 and model.enabled:
                yield from _clock(index, model, mapped, entries)


def _default(index: int, model: Any, mapped: list[Entry], probe: CanopenProbe) -> None:
    at = f"{index:04X}h"
    flags = 0 if model.enabled else PDO_OFF
    cob_id = probe.number(index, 1) & ~NO_RTR
    check_equal(f"{cob_id:08X}", f"{flags | pdo_can_id(probe.node, index, model):08X}", f"{at}:01h")
    check_equal(probe.number(index, 2), model.transmission_type, f"{at}:02h, transmission type")
    if index >= 0x1800:
        check_equal(probe.number(index, 3), round(model.inhibit_ms * 10), f"{at}:03h, inhibit time")
    check_equal(probe.number(index, 5), model.event_ms, f"{at}:05h, event timer")
    count = probe.number(index + 0x200, 0)
    seen = [f"{probe.number(index + 0x200, number):08X}" for number in range(1, count + 1)]
    check_equal(seen, [f"{entry.mapping:08X}" for entry in mapped], f"{index + 0x200:04X}h")


def _carries_values(index: int, mapped: list[Entry], probe: CanopenProbe) -> None:
    probe.quiet()
    can_id = probe.number(index, 1) & 0x7FF or UNUSED_ID
    probe.set(index, 2, 1, 1)
    probe.set(index, 1, NO_RTR | can_id)
    probe.nmt(START)

    def read() -> bytes:
        return b"".join(probe.value(entry) for entry in mapped)

    for _ in range(10):  # until nothing has changed between the readings
        before = read()
        probe.drain()
        probe.send(SYNC)
        data, after = probe.expect(can_id, "TPDO after a SYNC"), read()
        if before == after:
            break
    check_equal(data, after, "data")


def _sent_with_frames(index: int, model: Any, probe: CanopenProbe) -> None:
    with identifying_stars(probe):
        probe.nmt(START)
        can_id = pdo_can_id(probe.node, index, model)
        times = [probe.expect(can_id, "TPDO of a frame", ATTITUDE_S) for _ in range(3)]
    probe.nmt(PRE_OPERATIONAL)
    check_equal(len(times), 3, "TPDOs")


def _clock(index: int, model: Any, mapped: list[Entry], found: list[Entry]) -> Iterator[Case[CanopenProbe]]:
    """Yield the case for an RPDO that sets the clock, if an entry reads it."""
    numbers = (item for item in found if item.slot is not None and item.slot.kind == "integer")
    clock = next((item for item in numbers if _reports(item, "clock.seconds")), None)
    (entry, *others) = mapped
    seconds = _argument(entry, "seconds")
    if (
        clock is None
        or others
        or entry.command is None
        or seconds is None
        or entry.command.action != "set_clock"
    ):
        return
    command, name, reading = entry.command, seconds.name, clock

    def run(probe: CanopenProbe) -> None:
        def read() -> int:
            return probe.number(reading.index, reading.subindex)

        def send(value: int) -> None:
            probe.send(
                pdo_can_id(probe.node, index, model), command.encode({**command.example(), name: value})
            )

        before, began = read(), probe.now()
        probe.nmt(START)
        send(CLOCK_S)
        seen = read()
        send(before + round(probe.now() - began))
        check(0 <= seen - CLOCK_S <= 1, f"a time just after {CLOCK_S} s", seen)

    title = f"RPDO {(index & 0x1FF) + 1} ({model.name}) sets the clock"
    yield _case("rpdos", f"{(index & 0x1FF) + 1}.clock", title, run, command)
