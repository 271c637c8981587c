"""CAN conformance: CAN IDs, lengths, segments, and frames not addressed to the device, with the rows of any unit."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from typing import Any, Final

from starhil.hil_tests.conformance.can_probe import CanProbe
from starhil.hil_tests.conformance.case import Case, case_in, rule
from starhil.hil_tests.conformance.case_file import CUBESPACE_CASES, text_cases
from starhil.hil_tests.conformance.ports import CanFrame
from starhil.hil_tests.conformance.row_cases import row_cases, sent_cases
from starhil.hil_tests.judge.can import can_id_of, segments
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.messages import PUBLISHED
from starhil.hil_tests.judge.rows import Row

OTHER_HOST: Final = "4D"
LONGEST: Final = 56
"""Maximum size of telemetry whose segments are checked: 8 segments."""


def can_cases(unit: Unit) -> Iterator[Case[Any]]:
    """Yield the cases for a unit with a CAN link."""
    if not unit.readable:
        yield from sent_cases(unit)
        return
    yield from text_cases(CUBESPACE_CASES, "can", can_names(unit))
    yield from row_cases(unit)
    # frames of message types that the definition does not use may mean something to a real unit
    title = "after noise the next valid request is answered"
    yield case_in("recovery", "noise", title, noise, rule(9), intrusive=True)


def can_names(unit: Unit) -> dict[str, str]:
    """Return the texts for names in braces; a row that the unit lacks has none.

    IDs in hexadecimal: of telemetry `single` (in one frame), `small` (of less than 8 bytes) and `long` (in segments, if
    possible with a last one that is not full); of telecommands `empty` (may be sent at any time), `short`, `longest`,
    `refused` and `eight` (with a value that must be refused, the second of 8 bytes); without a row `unknown`,
    `unknown_telemetry`. `single_size`, `single_data`: size and data, which for telemetry are any. `m0` to `m4`: segments of
    a message that is answered by `refusal`, and `t0` to `t4` from another host. Each error has its code; `host` and
    `device` stay in braces until the probe replaces them.
    """
    telemetry = [row for row in unit.readable.values() if row.answers == ("reply",)]
    commands = [row for row in unit.telecommands.values() if row.answers == ("reply",)]
    shown = [row for row in telemetry if 8 < row.size <= LONGEST]
    faulty = {row.id: data for row in commands for data in _bad_data(row)[:1] if row.size <= 8}
    rows: dict[str, Iterable[Row]] = {
        "single": (row for row in telemetry if row.size <= 8),
        "small": (row for row in telemetry if row.size < 8),
        "long": sorted(shown, key=lambda row: (row.size % 7 == 0, -row.size)),
        "empty": (row for row in commands if not row.size and row.action != "reset"),
        "short": (row for row in commands if 2 <= row.size <= 8),
        "longest": sorted((row for row in commands if row.size > 8), key=lambda row: -row.size),
        "refused": (row for row in commands if row.id in faulty),
        "eight": (row for row in commands if row.id in faulty and row.size == 8),
    }
    names = {name: f"{unit.code(name):02X}" for name in PUBLISHED}
    names |= {name: f"{{{name}}}" for name in ("host", "device")}
    for name, choices in rows.items():
        for row in list(choices)[:1]:
            data = ".." * row.size if row.is_telemetry else faulty.get(row.id, b"").hex().upper()
            names |= {name: f"{row.id:02X}", f"{name}_size": str(row.size), f"{name}_data": data}
    if "long" in names:
        count, rest = divmod(int(names["long_size"]) - 1, 7)
        names |= {"long_count": str(count + 1), "long_first": str(count), "long_rest": str(rest + 1)}
        names["long_segments"] = _answer(names["long"], int(names["long_size"]))
    if "longest" in names:
        names["longest_of_500_bytes"] = " ".join(_message(names["longest"], bytes(500)))
    if "eight" in names:
        names["eight_in_segments"] = " ".join(_message(names["eight"], bytes.fromhex(names["eight_data"])))
    unused = set(range(256)) - {row.id for row in unit.rows}
    for name, numbers in (("unknown", range(128)), ("unknown_telemetry", range(128, 256))):
        for number in sorted(unused.intersection(numbers))[:1]:
            names[name] = f"{number:02X}"
    if "unknown" in names:
        parts = _message(names["unknown"], bytes(range(30)))
        names |= {f"m{number}": part for number, part in enumerate(parts)}
        names |= {f"t{number}": part.replace("{host}", OTHER_HOST) for number, part in enumerate(parts)}
        names |= {"m": " ".join(parts), "m_of_1750_bytes": " ".join(_message(names["unknown"], bytes(1750)))}
        names["refusal"] = f"03{names['unknown']}{{device}}{{host}}#{names['invalid_id']}"
    answers = ((f"{row.id:02X}", row.size) for row in telemetry)
    names["each_row"] = "; ".join(
        f"04{number}{{host}}{{device}}# > {_answer(number, size)}" for number, size in answers
    )
    return names


def _bad_data(row: Row) -> list[bytes]:
    return [data for item in row.named.values() for _, data in row.bad_values(item)]


def _message(number: str, data: bytes) -> list[str]:
    return [f"07{number}{{host}}{{device}}#{part.hex().upper()}" for part in segments(data)]


def _answer(number: str, size: int) -> str:
    """Return the pattern of telemetry, in one frame or in segments."""
    if size <= 8:
        return f"05{number}{{device}}{{host}}#{'..' * size}"
    parts = segments(bytes(size))
    return " ".join(f"08{number}{{device}}{{host}}#{'..' * (len(part) - 1)}{part[-1]:02X}" for part in parts)


def noise(probe: CanProbe) -> None:
    rng = random.Random(7)  # noqa: S311 -- noise, not a secret
    for _ in range(400):
        kind = rng.choice((0, 2, 3, 5, 6, 9, 13, 20, 31))
        can_id = can_id_of(kind, rng.randrange(256), probe.host, probe.device)
        probe.send(CanFrame(can_id, rng.randbytes(rng.randrange(9))))
    probe.sleep(probe.times.quiet_s)
    probe.drain()
    probe.expect_alive()
