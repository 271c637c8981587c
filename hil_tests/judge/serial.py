"""Messages on the serial line: a header and a check, or a CubeSpace dialect, within a framing.

    request ──► body ──► framing ──► line          line ──► framing ──► body ──► answer

    composed   | header by roles | data | check |       or a text                 `Headed`
    dialect a  | ID | data or error |           CubeComputer (AlbertaSat)         `Dialect`
    dialect b  | data or error |                CubeSense node (RADSAT)
    dialect c  | ID | data or error |           generation 2; 7F 07 0F 4F 2F name the kind (libCubeObc)

An answer without an ID belongs to the oldest request that has not been answered, so requests are noted in order.

One line may have several formats (`[[link.serial.format]]`), distinguished by the first byte of an answer, and requests and
answers that are texts (libgs hyp_st200.c, whose driver looks for READY in what it reads, and for F1 in a record):

    OBC  ► show record CR                      text (`request`)
         ◄ F1 … 51 bytes, stuffed … CRC-8      first byte F1: format of the class
    OBC  ► set keep-alive off CR
         ◄ READY CR LF                         any other first byte: `acknowledge`, `refusal`
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

from starhil.hil_tests.judge.checks import check_function, described
from starhil.hil_tests.judge.definition import PluginFraming, Unit
from starhil.hil_tests.judge.framings import Framing, Taken
from starhil.hil_tests.judge.framings.counted import Counted
from starhil.hil_tests.judge.framings.delimited import Delimited
from starhil.hil_tests.judge.framings.escaped import Escaped
from starhil.hil_tests.judge.framings.slip import Slip
from starhil.hil_tests.judge.headers import Header, Opened
from starhil.hil_tests.judge.messages import (
    BURST_ID,
    BURST_SIZE,
    FIRST_TELEMETRY,
    Answer,
    AnswerKind,
    Request,
)

CODE: Final = "{code}"
"""Where a refusal that is a text has its code."""
MIXING: Final = 0x9E3779B1
"""Odd, so that numbers do not repeat, and with bits in every byte."""
CUBESPACE: Final = (0x1F, 0x7F, 0xFF)
"""Escape, start of a request, and end."""
KINDS: Final[dict[int, AnswerKind]] = {0x07: "ack", 0x0F: "nack", 0x2F: "unsolicited", 0x4F: "unsolicited"}
"""Start bytes of generation 2: acknowledge, refusal, event, unsolicited telemetry."""
TELEMETRY: Final = 0x07
"""Start byte of telemetry in generation 2, which is an acknowledge with data."""


class Format(NamedTuple):
    """Framing and envelope of the messages of some classes; of all others without classes."""

    classes: tuple[str, ...]
    framing: Framing
    envelope: Envelope


class SerialLine:
    """The host's end of a unit's serial line.

    `dialect` is that of the answers, of a unit that has several; b by default.
    """

    def __init__(self, unit: Unit, dialect: str | None = None) -> None:
        link = unit.serial
        self._unit = unit
        self._requests_in: list[Format]
        self._answers_in: list[Format]
        self.dialect: str | None = None
        self._requests = 0
        if link.framing.kind == "cubespace":
            self.dialect = link.framing.dialect or dialect or "b"
            escape, start, end = CUBESPACE
            starts = (start, *KINDS) if self.dialect == "c" else (start,)
            self._requests_in = [Format((), Escaped(escape, starts, end), Dialect(unit, self.dialect))]
            self._answers_in = self._requests_in
        else:
            self._requests_in = list(_formats(unit, "request"))
            self._answers_in = list(_formats(unit, "reply"))
        self.envelope = self._answers_in[-1].envelope
        self.streamed = {
            (row.message_class, row.id) for row in unit.telemetry.values() if row.unsolicited is not None
        }
        """Class and ID of the rows that may come without a request, though nothing in their messages says so."""
        self._left = 0
        """Number of answers to the oldest request that have not come."""
        self.clear()

    def request_format(self, message_class: str) -> tuple[Framing, Envelope]:
        return _of_class(self._requests_in, message_class)[1:]

    def clear(self) -> None:
        """Forget everything received and pending."""
        self.received = bytearray()
        self._pending: deque[Request] = deque()
        self._begin()

    def numbered(self, request: Request) -> Request:
        """Return a request with the next sequence number; successive ones differ in every bit."""
        self._requests += 1
        return replace(request, sequence=self._requests * MIXING % (1 << self.envelope.sequence_bits))

    def encode(self, request: Request) -> bytes:
        framing, envelope = self.request_format(request.message_class)
        return framing.encode(envelope.body(request))

    def post(self, request: Request, *, answered: bool = True) -> bytes:
        """Return a request as bytes on the line, with the next sequence number; its answer is expected, if it has one."""
        request = self.numbered(request)
        line = self.encode(request)
        row = self._unit.row(request)
        if answered and (row is None or self._unit.serial_answers(row)):
            self.expect(request)
        return line

    def telemetry_frame(self, body: bytes, message_class: str) -> bytes:
        framing = _of_class(self._answers_in, message_class).framing
        if isinstance(framing, Escaped) and self.dialect == "c":
            return framing.encode(body, TELEMETRY)
        return framing.encode(body)

    def expect(self, request: Request) -> None:
        """Note a request, in order."""
        self._pending.append(request)
        if len(self._pending) == 1:
            self._begin()

    def feed(self, data: bytes) -> list[Answer]:
        """Return the answers that these bytes complete."""
        self.received += data
        answers = []
        while self.received:
            pending = self._pending[0] if self._pending else None
            _, framing, envelope = self._answer_format(self.received[:1])
            echo = (
                None
                if pending is None or self._echoed or not self._answers(pending, "echo")
                else envelope.body(pending)
            )
            measure = (
                partial(envelope.size, pending=pending) if echo is None else partial(_size_of_echo, len(echo))
            )
            try:
                taken = framing.take(self.received, measure)
            except ValueError:
                taken = Taken(bytes(self.received), junk=True)
                self.received.clear()
            if taken is None:
                break
            answer = self._answer(envelope, taken, pending, echo)
            if answer is not None:
                answers.append(answer)
        return answers

    def _answer_format(self, begun: bytearray) -> Format:
        """Return the format of an answer that begins with a byte: one that always does, or one that may."""
        for wanted in (bytes(begun), b""):
            for item in self._answers_in:
                if item.framing.start[:1] == wanted:
                    return item
        return self._answers_in[-1]

    def _answer(
        self, envelope: Envelope, taken: Taken, pending: Request | None, echo: bytes | None
    ) -> Answer | None:
        if taken.junk or (echo is not None and taken.body != echo):
            answer = Answer("malformed", data=taken.body)
        elif pending is not None and echo is not None:
            if self._left:
                self._echoed = True
                return None
            answer = Answer("ack", row_id=pending.id, message_class=pending.message_class)
        else:
            answer = envelope.answer(taken, pending)
        awaited = pending is not None and (
            answer.row_id in (None, pending.id)
            or self._follows(pending, answer)
            or answer.kind == "malformed"
        )
        streamed = (answer.message_class, answer.row_id) in self.streamed
        if (
            streamed
            and not awaited
            and answer.kind == "telemetry"
            and not envelope.marks_unsolicited(answer.message_class)
        ):
            return replace(answer, kind="unsolicited")
        if awaited and answer.final and answer.kind not in ("unsolicited", "burst"):
            self._left -= 1
            if self._left <= 0 or answer.kind in ("nack", "malformed") or self.envelope.has_final:
                self._pending.popleft()
                self._begin()
        return answer

    def _begin(self) -> None:
        """Begin to await the answers of the oldest request."""
        self._echoed = False
        row = self._unit.row(self._pending[0]) if self._pending else None
        answers = () if row is None else self._unit.serial_answers(row)
        self._left = sum(answer != "echo" for answer in answers)

    def _follows(self, pending: Request, answer: Answer) -> bool:
        """Return whether an answer is another row that answers a request."""
        row, other = (
            self._unit.row(pending),
            self._unit.row(Request(answer.row_id or 0, message_class=answer.message_class)),
        )
        return row is not None and other is not None and f"row:{other.name}" in row.answers

    def _answers(self, request: Request, kind: str) -> bool:
        row = self._unit.row(request)
        return kind in (row.answers if row is not None else ("reply",))


def _size_of_echo(size: int, _begun: bytes) -> int:
    return size


def _of_class(formats: list[Format], message_class: str) -> Format:
    return next((item for item in formats if message_class in item.classes), formats[-1])


def _formats(unit: Unit, direction: str) -> Iterator[Format]:
    """Yield the formats of a direction in the order in which they apply; the last is that of all other messages."""
    link = unit.serial
    elsewhere: tuple[str, ...] = ()
    silent = {item.name for item in unit.classes if not _has_messages(unit, item.name, direction)}
    for model in link.format:
        if model.direction not in (None, direction) or (model.classes and silent.issuperset(model.classes)):
            continue
        classes = tuple(model.classes or ())
        framing = _framing(unit, model.framing or link.framing)
        yield Format(classes, framing, Headed(unit, framing, model.check or link.check, classes, elsewhere))
        if not classes:
            return
        elsewhere += classes
    if elsewhere and {item.name for item in unit.classes} <= silent.union(elsewhere):
        return
    framing = _framing(unit, link.framing)
    yield Format((), framing, Headed(unit, framing, link.check, (), elsewhere))


def _has_messages(unit: Unit, message_class: str, direction: str) -> bool:
    """Return whether there are requests, or answers, of a class; a class without rows has both."""
    rows = [row for row in unit.rows if row.message_class == message_class]
    if direction == "request":
        return not rows or any(not row.only_sent for row in rows)
    models = [
        item for item in unit.serial.reply_header if item.classes is None or message_class in item.classes
    ]
    roles = {part.role for item in models for part in (item, *item.bits)}
    refused = not roles.isdisjoint(("status", "ack")) or unit.serial.refusal is not None
    return refused or not rows or any(row.answers or row.is_telemetry for row in rows)


def _framing(unit: Unit, model: Any) -> Framing:
    match model.kind:
        case "escaped":
            return Escaped(model.escape, (model.start,), model.end)
        case "slip":
            return Slip(model)
        case "length" | "fixed":
            return Counted(model)
        case "delimited":
            return Delimited(model)
        case _:
            return PluginFraming(unit)


class Headed:
    """A header by roles, and a check; or a text, which needs no header.

    `classes` are those whose messages have this check, empty for all others; `elsewhere` those with another format.
    """

    has_unsolicited = True

    def __init__(
        self,
        unit: Unit,
        framing: Framing,
        check: Any,
        classes: tuple[str, ...],
        elsewhere: tuple[str, ...],
    ) -> None:
        link, order = unit.serial, unit.conventions.byte_order
        self._unit = unit
        self._message_class = classes[0] if len(classes) == 1 else ""
        self._classes, self._elsewhere = classes, elsewhere
        self._start = framing.start
        self._check = described(check)
        self._compute = check_function(check, order, unit.plugin)
        self.covers = getattr(check, "covers", [])
        self.check_size = len(self._compute(b""))
        sizes = {"start": len(self._start), "check": self.check_size, "end": len(framing.end)}
        coded = [item for item in unit.classes if item.code is not None]
        requests = [(item.name, item.code) for item in coded]
        replies = [(item.name, item.code if item.reply is None else item.reply) for item in coded]
        self._marked = {
            item.name for item in coded if item.unsolicited not in (None, dict(replies)[item.name])
        }
        self._unsolicited = {item.unsolicited for item in coded if item.unsolicited is not None}
        replies += [(item.name, item.unsolicited) for item in coded if item.unsolicited is not None]
        self.requests = Header(link.request_header, order, requests, sizes)
        self.replies = Header(link.reply_header, order, replies, sizes)
        self._codes = dict(requests)
        self.has_codes = "status" in self.replies.roles() or CODE in (link.refusal or "")
        self.has_final = "final" in self.replies.roles()
        self.names_rows = "id" in self.replies.roles()
        self.sequence_bits = self.requests.width("sequence")
        self.numbers = 1 << self.replies.width("sequence")
        self._numbered = self.replies.counted()

    def body(self, request: Request) -> bytes:
        """Return header, data and check of a request, or its text and check.

        Raises ValueError for a request that no text expresses.
        """
        row = self._unit.row(request)
        if row is not None and row.request and not request.data:
            return self.closed(b"", row.request.encode())
        if (row is not None and row.request) or not self.requests.roles():
            raise ValueError(f"no text requests {request} with {len(request.data)} bytes")
        values = {
            "id": request.id,
            "class": self._codes.get(request.message_class, 0),
            "sequence": request.sequence,
        }
        return self.closed(
            self.requests.write(values, request.message_class, len(request.data)), request.data
        )

    def data_sizes(self, message_class: str) -> range:
        """Return the numbers of bytes of data that requests of a class can have."""
        return self.requests.data_sizes(message_class)

    def closed(self, header: bytes, data: bytes) -> bytes:
        """Return header, data and check."""
        parts = {"start": self._start, "header": header, "data": data}
        covered = b"".join(part for name, part in parts.items() if name in self.covers)
        return header + data + self._compute(covered)

    def size(self, begun: bytes, pending: Request | None) -> int | None:
        """Return the size of header, data and check."""
        opened = self.replies.read(begun, self._message_class)
        if opened is None:
            return None
        data = self.replies.data_size(opened)
        if data is None:
            row = self._unit.row(self._request(opened, pending))
            data = row.size if row is not None and row.is_telemetry and not _refused(opened) else 0
        return opened.size + data + self.check_size

    def _request(self, opened: Opened, pending: Request | None) -> Request:
        """Return the request that an answer names, or the one that was asked if it names none."""
        if "id" not in opened.values:
            if pending is None or pending.message_class in self._elsewhere:
                raise ValueError("an answer without a request")
            if self._classes and pending.message_class not in self._classes:
                raise ValueError("an answer in the format of another class")
            return pending
        message_class = opened.message_class or (
            pending.message_class if pending is not None and pending.id == opened.values["id"] else ""
        )
        return Request(opened.values["id"], message_class=message_class)

    def answer(self, taken: Taken, pending: Request | None) -> Answer:
        """Return the answer in header, data and check, all of which must be right."""
        end = len(taken.body) - self.check_size
        text = taken.body[: max(end, 0)]
        if not self._classes and self.closed(b"", text) == taken.body:
            found = self._text_answer(text, pending, taken.body)
            if found is not None:
                return found
        malformed = partial(Answer, "malformed", data=taken.body)
        try:
            opened = self.replies.read(text, self._message_class)
            request = None if opened is None else self._request(opened, pending)
        except ValueError as error:
            return malformed(fault=str(error))
        if opened is None or request is None:
            return malformed()
        header, data = taken.body[: opened.size], taken.body[opened.size : end]
        computed = self.closed(header, data)[len(header) + len(data) :]
        if computed != taken.body[end:]:
            received = taken.body[end:].hex(" ")
            return malformed(fault=f"check {self._check}: computed {computed.hex(' ')}, received {received}")
        size = self.replies.data_size(opened)
        if size not in (None, len(data)):
            return malformed(fault=f"length for {size} bytes of data, received {len(data)}")
        values = opened.values
        asynchronous = values.get("class") in self._unsolicited
        numbered = ("unsolicited" if asynchronous else "reply") in self._numbered
        named = pending is not None and opened.values.get("id", pending.id) == pending.id
        if pending is not None and named and not asynchronous and not numbered:
            sequence = values.get("sequence", pending.sequence)
            if sequence != pending.sequence:
                return malformed(fault=f"sequence {sequence}, must be {pending.sequence}")
        row = self._unit.row(request)
        message_class = request.message_class or (row.message_class if row is not None else "")
        telemetry = (
            row.is_telemetry if row is not None else self._unit.is_telemetry(message_class, request.id)
        )
        if not telemetry and not values and self._unit.serial.acknowledge is not None:
            return Answer("malformed", data=taken.body)  # a text, but not the acknowledge
        kind: AnswerKind = "telemetry" if telemetry else "ack"
        if _refused(opened):
            kind = "nack"
        elif asynchronous:
            kind = "unsolicited"
        time_s = self.replies.seconds("time", values["time"]) if "time" in values else 0.0
        final = bool(values.get("final", 1))
        code = values.get("status", 0)
        number = values["sequence"] if numbered else None
        return Answer(kind, code, data, request.id, message_class, 0, final, time_s, taken.body, number)

    def _text_answer(self, text: bytes, pending: Request | None, body: bytes) -> Answer | None:
        """Return an acknowledge or refusal that is a text, exactly as in the definition; None if it is neither."""
        link, words = self._unit.serial, text.decode("latin-1")
        row_id, message_class = (None, "") if pending is None else (pending.id, pending.message_class)
        if words == link.acknowledge:
            kind: AnswerKind = "malformed" if pending is None or pending.telemetry else "ack"
            return Answer(kind, data=text, row_id=row_id, message_class=message_class, body=body)
        if link.refusal is None:
            return None
        before, marked, after = link.refusal.partition(CODE)
        number = words[len(before) : len(words) - len(after)] if marked else ""
        if words != before + number + after or (marked and not (number.isascii() and number.isdigit())):
            return None
        return Answer(
            "malformed" if pending is None else "nack",
            int(number or 0),
            text,
            row_id,
            message_class,
            body=body,
        )

    def marks_unsolicited(self, message_class: str) -> bool:
        """Return whether unsolicited telemetry of a class has another code than an answer."""
        return message_class in self._marked

    def can_refuse(self, message_class: str) -> bool:
        """Return whether there is a text for refusals, or the header of a class has a status or an acknowledge bit."""
        refusal = self._unit.serial.refusal
        return refusal is not None or bool(self.replies.roles(message_class) & {"status", "ack"})


def _refused(opened: Opened) -> bool:
    return bool(opened.values.get("status", 0)) or not opened.values.get("ack", 1)


class Dialect:
    """The CubeSpace dialects of the answers; requests are the same in all: ID and data."""

    has_codes = True
    has_final = False
    sequence_bits = 0
    numbers = 0

    def __init__(self, unit: Unit, dialect: str) -> None:
        self._unit, self._dialect = unit, dialect
        self.has_unsolicited = dialect == "c"
        self.names_rows = dialect != "b"

    def body(self, request: Request) -> bytes:
        return bytes((request.id,)) + request.data

    def data_sizes(self, message_class: str) -> range:  # noqa: ARG002 -- of all
        """Return any number: the end of a message is marked."""
        return range(1 << 16)

    def size(self, begun: bytes, pending: Request | None) -> int | None:  # noqa: ARG002 -- the framing marks the end
        """Return None: the end of a message is marked."""
        return None

    def can_refuse(self, message_class: str) -> bool:  # noqa: ARG002 -- in all
        return True

    def marks_unsolicited(self, message_class: str) -> bool:  # noqa: ARG002 -- in all that have it
        return True

    def answer(self, taken: Taken, pending: Request | None) -> Answer:
        body = taken.body
        row = None if pending is None else self._unit.row(pending)
        as_requested = self._dialect == "b" and row is not None and row.is_telemetry and row.size == len(body)
        if (
            taken.start == CUBESPACE[1]
            and body[:1] == bytes((BURST_ID,))
            and len(body) == 1 + BURST_SIZE
            and not as_requested
        ):
            return Answer("burst", data=body[1:], row_id=BURST_ID, body=body)
        if self._dialect == "b":
            if pending is None:
                return Answer("malformed", data=body)
            return self._generation_1(pending.id, body, body, named=False)
        if not body:
            return Answer("malformed")
        if self._dialect == "a":
            return self._generation_1(body[0], body[1:], body, named=True)
        return self._generation_2(taken.start, body[0], body[1:], body)

    def _generation_1(self, number: int, data: bytes, body: bytes, *, named: bool) -> Answer:
        """Read telemetry, or one byte: 0 for an acknowledge, otherwise the code of a refusal."""
        row_id = number if named else None
        row = self._unit.row(Request(number))
        if number >= FIRST_TELEMETRY and (len(data) != 1 or (row is not None and row.size == 1)):
            return Answer("telemetry", data=data, row_id=row_id, body=body)
        if len(data) == 1 and data[0]:
            return Answer("nack", data[0], row_id=row_id, body=body)
        acknowledged = data == b"\0" and number < FIRST_TELEMETRY
        return Answer("ack" if acknowledged else "malformed", data=data, row_id=row_id, body=body)

    def _generation_2(self, start: int, number: int, data: bytes, body: bytes) -> Answer:
        kind = KINDS.get(start)
        if kind == "ack" and number >= FIRST_TELEMETRY:
            return Answer("telemetry", data=data, row_id=number, body=body)
        if kind == "ack" and not data:
            return Answer("ack", row_id=number, body=body)
        if kind == "nack" and len(data) == 1 and data[0]:
            return Answer("nack", data[0], row_id=number, body=body)
        if kind == "unsolicited":
            return Answer("unsolicited", data=data, row_id=number, body=body)
        return Answer("malformed", data=body, body=body)


Envelope = Headed | Dialect
"""What surrounds the data of a message within its framing.

`sequence_bits` is the width of the number of a request, 0 without one; `numbers` is how many numbers an answer may have;
`has_codes` is whether a refusal carries a code, `has_final` whether a message says that it is the last of an answer,
`names_rows` whether an answer has the ID of its row.
"""
