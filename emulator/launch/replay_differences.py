"""How a replay differs from its recording: the first byte or frame sent on each link, the first row of the truth log."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from starhil.emulator.errors import explained
from starhil.emulator.links.traffic import Decoder, WireItem, canopen_text
from starhil.emulator.run.truth_log import WALL_TIMES, equal_cells
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.user_file import open_user_file
from starhil.protocol.messages import Reply, ReplyKind


def difference_sent(
    recorded: list[WireItem], passed: list[WireItem], new_decoder: Callable[[], Decoder], *, to_the_end: bool
) -> str:
    """Compare what was sent on one link, if not to the end then as far as it was recorded; return the difference, empty for none."""
    before, now = list(units_sent(recorded)), list(units_sent(passed))
    if not to_the_end:
        now = now[: len(before)]
    if before == now:
        return ""
    return _message_difference(recorded, passed, before, now, new_decoder) or _unit_difference(before, now)


def units_sent(items: Iterable[WireItem]) -> Iterator[Any]:
    """Yield what was sent, bytes or CAN frames.

    On a serial line only the bytes matter, not how they are divided into items.
    """
    for each in items:
        if each.outgoing:
            yield from (each.item if isinstance(each.item, bytes) else (each.item,))


@dataclass
class _Message:
    name: str
    """Row or frame."""
    data: bytes
    begin: int
    end: int
    """Its bytes or frames among those that were sent on the link: from `begin` to before `end`."""


def _message_at(items: Iterable[WireItem], at: int, decoder: Decoder) -> _Message | None:
    """Return the first message that ends with or after a sent byte or frame, counted from 0."""
    begin = end = 0
    for each in items:
        if not each.outgoing:
            decoder.events(each)
            continue
        for part in _parts(each, at - end):
            events = decoder.events(part)
            end += len(part.item) if isinstance(part.item, bytes) else 1
            named = [_named(event, decoder) for event in events if isinstance(event, Reply)]
            if isinstance(part.item, CanFrame) and not part.item.extended:
                named.append((canopen_text(part.item), part.item.data))
            if named and end > at:
                name, data = named[0]
                return _Message(name, data, begin, end)
            if events:
                begin = end
    return None


def _parts(item: WireItem, whole: int) -> Iterator[WireItem]:
    """Yield the item, byte by byte if it has more than `whole` bytes."""
    if isinstance(item.item, CanFrame) or len(item.item) <= whole:
        yield item
    else:
        yield from (replace(item, item=bytes([byte])) for byte in item.item)


def _named(reply: Reply, decoder: Decoder) -> tuple[str, bytes]:
    row = decoder.row_of(reply)
    name = reply.kind.value if row is None else row.name
    if reply.kind in {ReplyKind.ACK, ReplyKind.NACK}:
        name += f" answered with {int(reply.code)}"
    return name, reply.data


def _message_difference(
    recording: list[WireItem],
    passed: list[WireItem],
    before: list[Any],
    now: list[Any],
    new_decoder: Callable[[], Decoder],
) -> str:
    """Return the message and its byte at which what was sent differs first; empty if one run sent only more.

    The message is the one sent now, because the recorded bytes may no longer decode.
    """
    at = _first_difference(before, now)
    if at == min(len(before), len(now)):
        return ""
    changed = _message_at(passed, at, new_decoder())
    if changed is None:
        return ""
    where = f"at {_time_of(recording, at):.3f} s"
    recorded = _message_at(recording, at, new_decoder())
    tail = slice(changed.end, None if recorded is None else recorded.end)
    damaged = recorded is None or (recorded.end > changed.end and before[tail] == now[tail])
    if recorded is not None and not damaged:
        if recorded.name != changed.name:
            return f"{where}: recorded {recorded.name}, now {changed.name}"
        if len(recorded.data) != len(changed.data):
            return f"{where}, {changed.name}: {len(recorded.data)} bytes recorded, {len(changed.data)} now"
        number = _first_difference(recorded.data, changed.data)
        if number < len(changed.data):
            old, new = recorded.data[number], changed.data[number]
            return f"{where}, {changed.name}, byte {number}: recorded {old:02x}, now {new:02x}"
    if not isinstance(now[at], int):
        return f"{where}, {changed.name}: recorded frame {before[at]}, now {now[at]}"
    number = at - changed.begin
    place = f"byte {number} of the message"
    wire = bytes(now[changed.begin : changed.end])
    offset = wire.find(changed.data)
    if wire.count(changed.data) == 1 and 0 <= number - offset < len(changed.data):
        place = f"byte {number - offset}"
    return f"{where}, {changed.name}, {place}: recorded {before[at]:02x}, now {now[at]:02x}"


def _first_difference(before: Sequence[Any], now: Sequence[Any]) -> int:
    """Return the index of the first difference, or the length of the shorter one."""
    pairs = enumerate(zip(before, now, strict=False))
    return next((n for n, (old, new) in pairs if old != new), min(len(before), len(now)))


def _time_of(items: Iterable[WireItem], at: int) -> float:
    """Return when a byte or frame was sent, counted from 0, s."""
    sent = 0
    for each in items:
        if each.outgoing:
            sent += len(each.item) if isinstance(each.item, bytes) else 1
            if sent > at:
                return each.at_s
    raise IndexError(at)


def _unit_difference(before: list[Any], now: list[Any]) -> str:
    """Return where bytes or frames differ first."""
    at = _first_difference(before, now)
    what = "frame" if isinstance((before or now)[0], CanFrame) else "byte"
    return f"differs from {what} {at + 1} on: {len(before)} recorded, {len(now)} now"


def difference_of_truth(recorded: Path, now: Path, *, to_the_end: bool) -> str:
    """Compare truth logs to their resolution, except for wall times; return the difference, empty for none."""
    if not recorded.exists():
        return f"{recorded}: missing"
    before, after = (_rows(path) for path in (recorded, now))
    for number, (one, other) in enumerate(zip(before, after, strict=False), start=1):
        for name in one:
            if name not in WALL_TIMES and not equal_cells(name, one[name], other.get(name, "")):
                was, is_now = one[name], other.get(name, "")
                return f"truth log: row {number} differs in {name}: recorded {was!r}, now {is_now!r}"
    if to_the_end and len(before) != len(after):
        return f"truth log: {len(before)} rows recorded, {len(after)} now"
    return ""


def _rows(path: Path) -> list[dict[str, str]]:
    unreadable = explained(f"replay {path}: cannot be read", errors=(OSError, UnicodeDecodeError, csv.Error))
    with unreadable, TextIOWrapper(open_user_file(path), encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return rows  # noqa: RET504 (mypy expects that the block may be left without a result)
