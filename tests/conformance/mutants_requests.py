"""Mutants in how requests are handled."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from starhil.emulator.device.device import Device
from starhil.protocol.messages import ErrorCode, Reply, ReplyKind, Request, RequestKind
from tests.conformance.mutant_seams import (
    Damage,
    enter,
    handling,
    only_acknowledged,
)


def _counted(device: Device, **changes: Any) -> None:
    """Change what the device has counted."""
    device.counters = dataclasses.replace(device.counters, **changes)


def _acknowledged(device: Device, **changes: Any) -> None:
    """Change the outcome of the last telecommand."""
    device.acknowledge = dataclasses.replace(device.acknowledge, **changes)


def _recoded(old: ErrorCode, new: ErrorCode) -> Damage:
    return handling(
        lambda _device, request, handle: [
            dataclasses.replace(reply, code=new) if reply.code is old else reply for reply in handle(request)
        ]
    )


enter(
    "unknown identifiers get the code of a wrong length",
    "both",
    "identifiers.telemetry",
    _recoded(ErrorCode.INVALID_ID, ErrorCode.INVALID_LENGTH),
)
enter(
    "a wrong length gets the code of a wrong parameter",
    "both",
    "lengths.set_unix_time.short",
    _recoded(ErrorCode.INVALID_LENGTH, ErrorCode.INVALID_PARAMETER),
)
enter(
    "a wrong parameter gets code 5",
    "both",
    "fields.set_mode.mode.unknown",
    _recoded(ErrorCode.INVALID_PARAMETER, ErrorCode.NOT_IMPLEMENTED),
)
enter("a wrong state gets code 6", "both", "modes.no-tracking", _recoded(ErrorCode.SEQUENCE, ErrorCode.BUSY))
enter(
    "unknown telecommands are accepted",
    "both",
    "identifiers.telecommands",
    handling(
        lambda _d, r, h: [
            Reply(ReplyKind.ACK, r.id, destination=r.source)
            if a.code is ErrorCode.INVALID_ID and r.id < 128
            else a
            for a in h(r)
        ]
    ),
)
enter(
    "unknown identifiers are not answered",
    "both",
    "identifiers.telemetry",
    handling(lambda _d, r, h: [a for a in h(r) if a.code is not ErrorCode.INVALID_ID]),
)
enter(
    "telecommands that are too long are cut",
    "both",
    "lengths.set_mode.long",
    handling(
        lambda d, r, h: (
            h(dataclasses.replace(r, data=r.data[: d.icd.row(r.id).size]))
            if r.kind is RequestKind.TELECOMMAND and d.icd.row(r.id)
            else h(r)
        )
    ),
)
enter(
    "telecommands that are too short are filled up",
    "both",
    "lengths.set_unix_time.short",
    handling(
        lambda d, r, h: (
            h(dataclasses.replace(r, data=r.data.ljust(d.icd.row(r.id).size, b"\0")))
            if r.kind is RequestKind.TELECOMMAND and d.icd.row(r.id)
            else h(r)
        )
    ),
)
enter(
    "telemetry requests with data are answered",
    "both",
    "identifiers.telemetry-with-data",
    handling(lambda _d, r, h: h(dataclasses.replace(r, data=b"") if r.id >= 128 else r)),
)
enter(
    "telemetry is one byte short",
    "both",
    "telemetry.identification",
    handling(
        lambda _d, r, h: [
            dataclasses.replace(a, data=a.data[:-1]) if a.kind is ReplyKind.TELEMETRY else a for a in h(r)
        ]
    ),
)
enter(
    "telemetry is big-endian",
    "both",
    "telemetry.boot_status",
    handling(
        lambda _d, r, h: [
            dataclasses.replace(a, data=bytes([0xFF, *a.data[1:]])) if r.id == 129 else a for a in h(r)
        ]
    ),
)
enter(
    "telecommands are counted twice",
    "both",
    "counters.telecommands",
    handling(lambda d, r, h: (_counted(d, telecommands=d.counters.telecommands + (r.id < 128)), h(r))[1]),
)
enter(
    "telemetry is not counted",
    "both",
    "counters.telemetry",
    handling(lambda d, r, h: (_counted(d, telemetry=d.counters.telemetry - (r.id >= 128)), h(r))[1]),
)
enter(
    "telemetry counts as telecommands",
    "both",
    "counters.telemetry",
    handling(lambda d, r, h: (_counted(d, telecommands=d.counters.telecommands + (r.id >= 128)), h(r))[1]),
)
enter(
    "refused telecommands are not counted",
    "both",
    "counters.telecommands",
    handling(
        lambda d, r, h: [
            (
                _counted(d, telecommands=d.counters.telecommands - (a.kind is ReplyKind.NACK and r.id < 128)),
                a,
            )[1]
            for a in h(r)
        ]
    ),
)
enter(
    "every fifth telemetry request is not answered",
    "both",
    "recovery.flood",
    handling(lambda d, r, h: [] if r.id >= 128 and d.counters.telemetry % 5 == 4 and h(r) else h(r)),
)


def _after(name: str, act: Callable[[Device, Request], None]) -> Damage:
    """Do something after a telecommand of a name was accepted."""

    def change(device: Device, request: Request, handle: Callable[[Request], list[Reply]]) -> list[Reply]:
        replies = handle(request)
        row = device.icd.row(request.id)
        if row is not None and row.name == name and replies and replies[0].kind is ReplyKind.ACK:
            act(device, request)
        return replies

    return handling(change)


enter(
    "clear_counters leaves the flags",
    "serial",
    "errors.none",
    _after("clear_counters", lambda d, _r: _counted(d, flags=d.counters.flags | {"uart_protocol_error"})),
)
enter(
    "clear_counters leaves the counts",
    "both",
    "counters.clear",
    _after("clear_counters", lambda d, _r: _counted(d, telecommands=7)),
)
enter(
    "the clock is set to whole seconds",
    "both",
    "time.set",
    _after("set_unix_time", lambda d, _r: d.time.set_unix_ns(d.time.unix_ns() // 10**9 * 10**9 - 10**8)),
)
enter(
    "the acknowledge keeps the last error",
    "both",
    "acknowledge.forgets",
    handling(
        lambda d, r, h: (
            h(r),
            _acknowledged(d, error=ErrorCode.INVALID_PARAMETER if r.id == 103 else d.acknowledge.error),
        )[0]
    ),
)
enter(
    "the acknowledge names another telecommand",
    "both",
    "acknowledge.accepted",
    handling(lambda d, r, h: (h(r), _acknowledged(d, last_telecommand=1) if r.id < 128 else None)[0]),
)
enter(
    "the acknowledge is never processed",
    "both",
    "acknowledge.accepted",
    handling(lambda d, r, h: (h(r), _acknowledged(d, processed=r.id >= 128 and d.acknowledge.processed))[0]),
)
enter(
    "the index of the refused field is missing",
    "both",
    "fields.set_unix_time.milliseconds.high",
    handling(lambda d, r, h: (h(r), _acknowledged(d, parameter_index=0))[0]),
)
enter(
    "save_parameters stores nothing",
    "both",
    "store.reset",
    _after(
        "save_parameters",
        lambda d, _r: (
            setattr(d, "_stored_parameters", {}),
            d.store.save({"boot_count": d.boot_count, "parameters": {}}),
        ),
    ),
)
enter(
    "default_parameters clears the store",
    "both",
    "store.defaults",
    _after("default_parameters", lambda d, _r: setattr(d, "_stored_parameters", {})),
)
enter(
    "default_parameters does nothing",
    "both",
    "store.defaults",
    only_acknowledged(102),
)
enter(
    "restore_parameters does nothing",
    "both",
    "store.restore",
    only_acknowledged(107),
)
enter(
    "reset needs no magic number",
    "both",
    "reset.magic",
    handling(lambda _d, r, h: h(Request.of(1, b"\x5a", r.source) if r.id == 1 and len(r.data) == 1 else r)),
)
enter(
    "reset is not acknowledged",
    "can",
    "reset.acknowledged",
    handling(lambda _d, r, h: (h(r), [])[1] if r.id == 1 and r.data == b"\x5a" else h(r)),
)
enter(
    "a wrong CRC of a telecommand is not noticed",
    "both",
    "acknowledge.crc",
    handling(
        lambda _d, r, h: h(Request.of(33, r.data[:-1], r.source) if r.id == 33 and len(r.data) == 2 else r)
    ),
)
enter(
    "a telecommand with a CRC is refused",
    "both",
    "acknowledge.crc",
    handling(lambda _d, r, h: h(Request.of(103, b"\0\0", r.source) if r.id == 103 and r.data else r)),
)
enter(
    "reset does nothing",
    "both",
    "reset.acknowledged",
    only_acknowledged(1, b"\x5a"),
)
enter(
    "tracking needs no attitude",
    "both",
    "modes.no-tracking",
    only_acknowledged(96, b"\x03"),
)
enter(
    "set_mode does nothing",
    "both",
    "modes.changes",
    only_acknowledged(96, b"\x02"),
)
enter(
    "standby goes on making frames", "both", "modes.frames", _after("set_mode", lambda d, _r: d.cycle.start())
)
enter(
    "the parts of the hole map are one",
    "both",
    "data.parts",
    handling(lambda _d, r, h: h(dataclasses.replace(r, id=120) if 120 <= r.id <= 127 else r)),
)
