"""Messages of one serial line in several formats: requests that are texts, answers of a class in another framing.

    OBC  ► show record CR                      text (`request`)
         ◄ F1 … 51 bytes, stuffed … CRC-8      first byte F1: format of the class (`[[link.serial.format]]`)
    OBC  ► set keep-alive off CR
         ◄ READY CR LF                         any other first byte: `acknowledge`, `refusal`

Source: libgs hyp_st200.c (Hyperion ST200), whose driver looks for READY in what it reads, and for F1 in a record.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from starhil.hil_tests.judge.framings import Framing
from starhil.hil_tests.judge.messages import Answer, AnswerKind, Request

CODE = "{code}"


@dataclass(frozen=True)
class FormatModel:
    """Framing and check of the messages of some classes, as in the definition; of all others without classes."""

    classes: tuple[str, ...]
    framing: Any
    check: Any


def format_models(link: Any, direction: str) -> list[FormatModel]:
    """Return the formats of a direction in the order in which they apply; the last is that of other messages."""
    found = []
    for item in link.format:
        if item.direction not in (None, direction):
            continue
        found.append(
            FormatModel(tuple(item.classes or ()), item.framing or link.framing, item.check or link.check)
        )
        if not item.classes:
            return found
    return [*found, FormatModel((), link.framing, link.check)]


def first_byte_of(framings: Iterable[Framing], byte: int) -> int:
    """Return the number of the framing of a message that begins with a byte."""
    starts = [framing.start[:1] for framing in framings]
    for wanted in (bytes((byte,)), b""):
        if wanted in starts:
            return starts.index(wanted)
    return len(starts) - 1


def text_answer(link: Any, text: bytes, asked: Request | None, body: bytes) -> Answer | None:
    """Return an acknowledge or refusal that is a text, exactly as in the definition; None if it is neither."""
    words = text.decode("latin-1")
    row_id, klass = (None, "") if asked is None else (asked.id, asked.klass)
    if words == link.acknowledge:
        kind: AnswerKind = "malformed" if asked is None or asked.telemetry else "ack"
        return Answer(kind, data=text, row_id=row_id, klass=klass, body=body)
    if link.refusal is None:
        return None
    before, marked, after = link.refusal.partition(CODE)
    number = words[len(before) : len(words) - len(after)] if marked else ""
    if words != before + number + after or (marked and not (number.isascii() and number.isdigit())):
        return None
    return Answer("malformed" if asked is None else "nack", int(number or 0), text, row_id, klass, body=body)
