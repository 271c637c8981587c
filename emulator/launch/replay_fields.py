"""How the messages of a replay differ from the recorded ones, field by field.

The nth message of a row on a link is compared with the nth recorded one.
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

from starhil.emulator.links.traffic import Decoder, WireItem, canopen_text
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd.values import Value
from starhil.protocol.messages import Reply, ReplyKind

Messages: TypeAlias = Mapping[str, list[tuple[float, Mapping[str, Value]]]]
"""Row or kind of frame → its messages in order, each with the time of its last byte, s, and its values by field."""

ANSWER: Final = "answer"
"""Field of the answer to a telecommand: 0, or the error code."""
NUMBER: Final = "number of messages"
"""Field that differs if one run sent more messages of a row."""


@dataclass(frozen=True)
class FieldDifference:
    """A field whose values differ in some messages."""

    link: str
    row: str
    field: str
    unit: str
    messages: int
    """Number of messages that were compared."""
    differ: int
    largest: float | None
    """Largest difference of numbers, in the unit of the field; None for values of another kind."""
    first_s: float
    """Time of the first message that differs, s; 0 if the messages of one run are missing."""
    recorded: Value
    now: Value
    """Values in that message."""


def differing_fields(
    link: str,
    recorded: Iterable[WireItem],
    passed: Iterable[WireItem],
    new_decoder: Callable[[], Decoder],
    *,
    to_the_end: bool,
) -> list[FieldDifference]:
    """Return the fields that differ in what was sent on one link.

    If the replay did not reach the end, messages that only the recording has are no difference.
    """
    before, now = _messages(recorded, new_decoder()), _messages(passed, new_decoder())
    decoder = new_decoder()
    differences: list[FieldDifference] = []
    for name in sorted({*before, *now}):
        old, new = before.get(name, []), now.get(name, [])
        row = decoder.row_named(name)
        for field in dict.fromkeys(key for _, values in [*old, *new] for key in values):
            pairs = [
                (at_s, one.get(field, ""), other.get(field, ""))
                for (at_s, one), (_, other) in zip(old, new, strict=False)
            ]
            differing = [(at_s, one, other) for at_s, one, other in pairs if not _same(one, other)]
            if differing:
                unit = row.named_fields[field].unit if row is not None and field in row.named_fields else ""
                sizes = [
                    abs(float(other) - float(one)) for _, one, other in differing if _are_numbers(one, other)
                ]
                largest = max(sizes) if sizes else None
                differences.append(
                    FieldDifference(
                        link, name, field, unit, len(pairs), len(differing), largest, *differing[0]
                    )
                )
        if len(old) != len(new) and (to_the_end or len(new) > len(old)):
            compared, more = min(len(old), len(new)), abs(len(old) - len(new))
            first_s = max(old, new, key=len)[compared][0]
            differences.append(
                FieldDifference(
                    link, name, NUMBER, "", compared, more, float(more), first_s, len(old), len(new)
                )
            )
    return differences


def as_csv(differences: Iterable[FieldDifference]) -> str:
    """Return the differences as CSV, with the names of their attributes as the first row."""
    names = [item.name for item in dataclasses.fields(FieldDifference)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for difference in differences:
        cells = (getattr(difference, name) for name in names)
        writer.writerow(cell.hex() if isinstance(cell, bytes) else cell for cell in cells)
    return text.getvalue()


def _same(one: Value, other: Value) -> bool:
    return one == other or (one != one and other != other)  # both NaN


def _are_numbers(one: Value, other: Value) -> bool:
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (one, other))


def _messages(items: Iterable[WireItem], decoder: Decoder) -> Messages:
    by_row: defaultdict[str, list[tuple[float, Mapping[str, Value]]]] = defaultdict(list)
    for item in items:
        if not item.outgoing:
            decoder.events(item)
            continue
        for event in decoder.events(item):
            if isinstance(event, Reply):
                row = decoder.row_of(event)
                name = event.kind.value if row is None else row.name
                by_row[name].append((item.at_s, _values(event, decoder)))
        if isinstance(item.item, CanFrame) and not item.item.extended:
            by_row[canopen_text(item.item)].append((item.at_s, {"data": item.item.data}))
    return by_row


def _values(reply: Reply, decoder: Decoder) -> Mapping[str, Value]:
    if reply.kind in {ReplyKind.ACK, ReplyKind.NACK}:
        return {ANSWER: int(reply.code)}
    row = decoder.row_of(reply)
    if row is None:
        return {"data": reply.data}
    try:
        return row.decode(reply.data, check=False)
    except ProtocolError:
        return {"data": reply.data}
