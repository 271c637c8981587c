"""Both ends of the serial link that a unit defines, sans-I/O: bytes in, requests, replies and faults out.

::

    start   header: fields by role   data of the row   check   end
            └──────────────── body ─────────────────────────┘

A link is composed of a framing, which marks where a body begins and ends (`framings`), a check (`checks`), a header of
requests and one of replies (`headers`), whose roles give the kind of a reply. Only CubeSpace's replies have a separate
header for each kind, and dialects (`cubespace`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.link_schema import (
    CubeSpaceFraming,
    FormatModel,
    HeaderFieldModel,
    MessageClass,
    SerialLinkModel,
)
from starhil.protocol.messages import (
    DEFAULT_MAX_SIZE,
    ErrorCode,
    FaultKind,
    Flaw,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)
from starhil.protocol.serial import cubespace
from starhil.protocol.serial.checks import build_check
from starhil.protocol.serial.cubespace import Dialect, DialectReplies
from starhil.protocol.serial.formats import Formats, MessageFormat, TextReplies, words
from starhil.protocol.serial.framings import Deframer, Receiving, build_framing
from starhil.protocol.serial.headers import HeaderCodec, HeaderContent, HeaderError

LINK_FORMAT: Final = FormatModel()
"""The framing and check of the link itself."""


class SerialStack:
    """The serial link of a unit, with the unit's classes, rows, byte order and plugin.

    Attributes
    ----------
    dialects
        The dialects of replies; empty if the unit has only one format. A dialect that is not given is the
        unit's only one, otherwise b.

    Raises IcdError: the unit has no serial link, or parts of it are incompatible.
    """

    def __init__(self, icd: InterfaceDefinition) -> None:
        if icd.link.serial is None:
            raise IcdError(f"unit {icd.name}: has no serial link")
        link, rows = icd.link.serial, tuple(icd.rows)
        self.link: Final = link
        self.icd: Final = icd
        self.classes: Final = icd.classes_by_name
        self.unsolicited: Final = {item.unsolicited for item in icd.classes if item.code is not None} - {None}
        """Class codes of unsolicited telemetry."""
        self.rows: Final = rows
        self.byte_order: Final = icd.conventions.byte_order
        self.dialects: Final = dialects_of(link)
        self._plugin = icd.plugin
        self._unanswered = link.framing.unanswered if isinstance(link.framing, CubeSpaceFraming) else []
        self._silent = {row.id for row in rows if not self.answers(row)}
        self._by_text = {words(row.request): row for row in rows if row.request}
        self._unknown_id = max((row.id for row in rows), default=0) + 1
        """ID of a request with an unknown text."""
        self.texts: Final = TextReplies(link)
        self.request_formats: Final = self._formats_of(
            "request", cubespace.REQUEST_HEADER if self.dialects else link.request_header
        )
        self.reply_formats: Final = self._formats_of("reply", () if self.dialects else link.reply_header)
        self.text_formats: Final = [
            form
            for form in self.request_formats.all
            if any(row.request for row in rows if self.request_formats.of(row.message_class) is form)
        ]
        self.requests: Final = self.request_formats.other
        """Format of requests without a class."""
        self.replies: Final = self.reply_formats.other
        """Format of replies without a class, and of texts."""
        self._in_dialect: Final[dict[Dialect | None, DialectReplies]] = {
            dialect: DialectReplies(dialect) for dialect in self.dialects
        }
        self._in_default_dialect = self._in_dialect.get(default_dialect(self.dialects))
        self._check_headers()
        headers = [self.requests.header, self.replies.header]
        headers += [head for replies in self._in_dialect.values() for head in replies.headers.values()]
        longest = (
            max((row.size for row in rows), default=0)
            + max(head.size(name) for head in headers for name in ("", *self.classes))
            + max(form.check.size for form in (*self.request_formats.all, *self.reply_formats.all))
        )
        self.max_size: Final = link.max_size or max(DEFAULT_MAX_SIZE, longest)

    def _formats_of(self, direction: str, models: Sequence[HeaderFieldModel]) -> Formats:
        """Return the formats of a direction; one of classes that have no messages in it is left out."""
        formats = []
        names = {*self.classes} or {""}
        left = {name for name in names if self._has_messages(name, direction, models)}
        for number, item in enumerate(self.link.format, 1):
            self._check_format(item, f"link.serial.format {number}")
            used = item.classes is None or not left.isdisjoint(item.classes)
            if item.direction in (None, direction) and used:
                formats.append(self._format(f"{direction}_header", models, item))
                left.difference_update(item.classes or ())
        if not formats or (left and all(form.classes for form in formats)):
            formats.append(self._format(f"{direction}_header", models))
        return Formats(formats, direction)

    def _has_messages(self, message_class: str, direction: str, models: Sequence[HeaderFieldModel]) -> bool:
        """Return whether there are requests, or replies and refusals, of rows of a class."""
        rows = [row for row in self.rows if row.message_class == message_class]
        if direction == "request":
            return not rows or any(not row.only_sent for row in rows)
        roles = {role for model in models if model.in_class(message_class) for role in model.by_role}
        refused = bool(roles & {"status", "ack"}) or self.link.refusal is not None
        return refused or not rows or any(row.answers or row.kind is RequestKind.TELEMETRY for row in rows)

    def _check_format(self, item: FormatModel, where: str) -> None:
        if item.framing is None and item.check is None:
            raise IcdError(f"{where}: needs `framing` or `check`")
        if self.dialects or isinstance(item.framing, CubeSpaceFraming):
            raise IcdError(
                f"{where}: framing cubespace has its own formats; it cannot be combined with others"
            )
        self._check_classes(item.classes, where)

    def _check_classes(self, names: Sequence[str] | None, where: str) -> None:
        for name in names or ():
            if name not in self.classes:
                known = ", ".join(self.classes) or "none"
                raise IcdError(f"{where}: no class named {name!r} (known: {known})")

    def _format(
        self, name: str, models: Sequence[HeaderFieldModel], item: FormatModel = LINK_FORMAT
    ) -> MessageFormat:
        framing, check = item.framing or self.link.framing, item.check or self.link.check
        frames = build_framing(framing, self._plugin.framings)
        checks = build_check(check, self.byte_order, self._plugin.checks)
        overhead = {"start": len(frames.start), "check": checks.size, "end": len(frames.end)}
        codes = {
            code: message_class
            for message_class, coded in self.classes.items()
            if coded.code is not None
            for code in ((coded.code,) if name == "request_header" else (coded.reply_code, coded.unsolicited))
            if code is not None
        }
        header = HeaderCodec(models, self.byte_order, codes, overhead, f"link.serial.{name}")
        return MessageFormat(frames, framing, checks, header, item.classes or ())

    def in_dialect(self, dialect: Dialect | None) -> DialectReplies | None:
        """Return the replies in a dialect, None for the default; None if the unit has no dialects."""
        return self._in_dialect.get(dialect, self._in_default_dialect)

    def answers(self, row: Row) -> tuple[str, ...]:
        """Return the answers of a row on the line, of which there may be fewer than on other links."""
        return () if row.name in self._unanswered else row.answers

    def _check_headers(self) -> None:
        for where, header in (("request", self.requests.header), ("reply", self.replies.header)):
            for item in header.fields:
                self._check_classes(item.classes, f"link.serial.{where}_header")
            formats = self.request_formats if where == "request" else self.reply_formats
            if any(form.model.kind == "length" for form in formats.all) and "length" not in header.roles:
                raise IcdError(f"link.serial.{where}_header: framing length needs a field with role length")
        if self.requests.header.counts:
            raise IcdError("link.serial.request_header: `counts` belongs to the reply header")
        early = next((row.name for row in self.rows if row.min_size < row.size), None)
        if early is not None and any(form.model.kind == "fixed" for form in self.request_formats.all):
            raise IcdError(f"link.serial: data of {early} may end early, which framing fixed cannot show")
        text_replies = [self.replies] if self.link.acknowledge or self.link.refusal else []
        for form in (*self.text_formats, *text_replies):
            if form.model.kind in ("length", "fixed"):
                raise IcdError(
                    f"link.serial: texts need a framing with an end, such as delimited, not {form.model.kind}"
                )
        if "id" not in self.requests.header.roles and len(self.text_formats) < len(self.request_formats.all):
            raise IcdError("link.serial.request_header: needs a field with role id")
        directions = (
            ("source", "reply", self.replies.header),
            ("destination", "request", self.requests.header),
            ("poll", "reply", self.replies.header),
        )
        for role, where, header in directions:
            if role in header.roles:
                raise IcdError(f"link.serial.{where}_header: role {role} belongs to the other direction")

    def _coded(self, name: str) -> MessageClass:
        """Return a class; raise ProtocolError if the link has no code for it."""
        item = self.classes.get(name)
        if item is None or item.code is None:
            raise ProtocolError(f"class {name!r} has no code on this link")
        return item

    def supports_unsolicited(self, dialect: Dialect | None = None) -> bool:
        replies = self.in_dialect(dialect)
        return replies is None or ReplyKind.UNSOLICITED in replies.headers

    def marks_unsolicited(self, message_class: str) -> bool:
        """Return whether unsolicited telemetry of a class differs from an answer by more than that nothing requested it."""
        item = self.classes.get(message_class)
        codes = item is not None and item.code is not None and item.unsolicited_code != item.reply_code
        return bool(self.dialects) or codes

    @property
    def shown_in_replies(self) -> frozenset[str]:
        """What a reply carries besides its data, in some class or dialect: `id`, `sequence`, `check`."""
        headers = [self.replies.header, *(h for d in self._in_dialect.values() for h in d.headers.values())]
        roles = {role for header in headers for role in header.roles}
        checked = {"check"} if any(form.check.size for form in self.reply_formats.all) else set()
        return frozenset(roles & {"id", "sequence"} | checked)

    def counts(self, kind: ReplyKind) -> bool:
        """Return whether the device numbers messages of this kind itself."""
        unsolicited = kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT)
        return (
            kind is not ReplyKind.ECHO
            and ("unsolicited" if unsolicited else "reply") in self.replies.header.counts
        )

    def device(self) -> Deframer[Request]:
        return self.request_formats.deframer(
            self._request_of, self._request_size, self.max_size, self.link.timeout
        )

    def host(self, dialect: Dialect | None = None) -> HostReceiver:
        """Return a receiver for the OBC's end."""
        return HostReceiver(self, self.in_dialect(dialect))

    def encode_request(self, request: Request) -> bytes:
        """Return a request as bytes on the line.

        Raises ProtocolError for data or an unknown ID if requests are texts.
        """
        return self.request_formats.of(request.message_class).framing.encode(self.request_body(request))

    def request_body(self, request: Request) -> bytes:
        """Return header, data and check of a request."""
        form = self.request_formats.of(request.message_class)
        if form in self.text_formats:
            row = self.icd.row(request.id, request.message_class)
            if row is None or not row.request or request.data:
                what = f"no text requests ID {request.id}" if row is None else "a text has no data"
                raise ProtocolError(f"link.serial: {what}")
            return form.close(b"", row.request.encode("ascii"))
        values = {"id": request.id, "sequence": request.sequence}
        if request.source:
            values["source"] = request.source
        if request.flags:
            values["flags"] = request.flags
        if not request.polled:
            values["poll"] = 0
        if "class" in self.requests.header.roles:
            values["class"] = self._coded(request.message_class).code or 0
        return form.close(form.header.pack(values, request.message_class, len(request.data)), request.data)

    def encode_reply(self, reply: Reply, dialect: Dialect | None = None) -> bytes:
        """Return a reply as bytes on the line; empty for a refusal that the unit's header cannot express.

        Raises ProtocolError for a kind of reply that the dialect does not have.
        """
        refused = reply.kind is ReplyKind.NACK
        in_dialect = self.in_dialect(dialect)
        if in_dialect is not None:
            silent = reply.id in self._silent and (refused or reply.kind is ReplyKind.ACK)
            return b"" if silent else in_dialect.encode(reply)
        if reply.kind is ReplyKind.ECHO:
            echo = Request(
                RequestKind.TELECOMMAND, reply.id or 0, reply.data, reply.destination, reply.message_class, reply.sequence,
                reply.flags,
            )  # fmt: skip
            return self.encode_request(echo)
        wrong_check = Flaw.CHECK in reply.flaw
        text = self.texts.encode(reply)
        if text is not None:
            return self.replies.framing.encode(self.replies.close(b"", text, wrong_check=wrong_check))
        header = self.replies.header
        if refused and not header.roles_in(reply.message_class) & {"status", "ack"}:
            return b""
        values = {
            "id": reply.id or 0,
            "destination": reply.destination,
            "sequence": reply.sequence + (Flaw.SEQUENCE in reply.flaw),
            "status": int(reply.code),
            "ack": int(not refused),
            "final": int(reply.final),
        }
        if reply.flags:
            values["flags"] = reply.flags
        if "ticks" in header.roles:
            values["ticks"] = reply.uptime_ns // header.count_ns("ticks")
        if "time" in header.roles:
            values["time"] = reply.time_ns // header.count_ns("time")
        if "class" in header.roles:
            item = self._coded(reply.message_class)
            unsolicited = reply.kind is ReplyKind.UNSOLICITED
            values["class"] = (item.unsolicited_code if unsolicited else item.reply_code) or 0
        form = self.reply_formats.of(reply.message_class)
        header_bytes = form.header.pack(values, reply.message_class, len(reply.data))
        return form.framing.encode(form.close(header_bytes, reply.data, wrong_check=wrong_check))

    def _request_of(self, form: MessageFormat, body: bytes) -> Request | LinkFault:
        if form in self.text_formats:
            text = form.text(body)
            if isinstance(text, LinkFault):
                return text
            row = self._by_text.get(words(text.decode("latin-1")))
            if row is None:
                return Request(RequestKind.TELECOMMAND, self._unknown_id)
            return Request(row.kind, row.id, message_class=row.message_class)
        opened = form.open(body)
        if isinstance(opened, LinkFault):
            return opened
        envelope, data = opened
        values = envelope.values
        row_id, message_class = values["id"], envelope.message_class
        if not message_class:
            row = self.icd.row(row_id)
            message_class = row.message_class if row is not None else ""
        return Request(
            self.icd.kind_of(row_id, message_class),
            row_id,
            data,
            values.get("source", 0),
            message_class,
            values.get("sequence", 0),
            values.get("flags", 0),
            bool(values.get("poll", 1)),
        )

    def _request_size(self, form: MessageFormat, body: bytes) -> int | None:
        """Return the size of a request that begins with these bytes, or None if more are needed."""
        if form.request_size is not None:
            return form.request_size
        return form.measure(body, self._request_data_size)

    def _request_data_size(self, envelope: HeaderContent) -> int:
        row = self.icd.row(envelope.values["id"], envelope.message_class)
        if row is None:
            raise HeaderError(f"no row with id {envelope.values['id']}")
        return row.request_size


class HostReceiver:
    """The OBC's end: bytes in, replies and faults out.

    Requests are made by `request`, since some units' replies can be interpreted only with their request. An echo of the
    request is verified and consumed. For a telecommand without another answer it is reported as the ACK.
    """

    def __init__(self, stack: SerialStack, in_dialect: DialectReplies | None) -> None:
        self._stack = stack
        self._in_dialect = in_dialect
        limits = stack.max_size, stack.link.timeout
        self._deframer: Deframer[Reply] = (
            stack.reply_formats.deframer(self._reply_of, self._size, *limits)
            if in_dialect is None
            else in_dialect.framing.deframer(
                Receiving(partial(self._reply_in_dialect, in_dialect), lambda _body: None, *limits)
            )
        )
        self._pending: Request | None = None
        self._reply_size = 0
        """Bytes of data in the telemetry that answers the pending request."""
        self._echo: bytes | None = None
        self._only_echo = False

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete, so that `flush` may become due."""
        return self._deframer.busy

    def feed(self, data: bytes, now: float) -> Sequence[Reply | LinkFault]:
        """Return the messages and faults that these bytes complete; `now` is the time of arrival, s."""
        return self._deframer.feed(data, now)

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""
        return self._deframer.flush(now)

    def request(self, request: Request) -> bytes:
        """Return a request as bytes on the line; what arrives next is read as its answer.

        Raises ProtocolError as `SerialStack.encode_request`.
        """
        line = self._stack.encode_request(request)
        self.overhear(request)
        return line

    def overhear(self, request: Request) -> None:
        """Read what arrives next as the answer to a request that has been sent by another, or earlier."""
        row = self._stack.icd.row(request.id, request.message_class)
        answers = self._stack.answers(row) if row is not None else ("reply",)
        self._pending = request
        self._reply_size = row.reply_size if row is not None else 0
        self._echo = self._stack.request_body(request) if "echo" in answers else None
        self._only_echo = "reply" not in answers

    def _size(self, form: MessageFormat, body: bytes) -> int | None:
        """Return the size of the echo or reply that begins with these bytes, or None if more are needed."""
        if self._echo is not None:
            return len(self._echo)
        return form.measure(body, partial(self._data_size, form))

    def _awaited(self, form: MessageFormat) -> Request | None:
        """Return the request that a reply without an ID answers; None if its class has another format."""
        pending = self._pending
        return (
            pending
            if pending is not None and self._stack.reply_formats.of(pending.message_class) is form
            else None
        )

    def _data_size(self, form: MessageFormat, envelope: HeaderContent) -> int:
        values = envelope.values
        if values.get("status", 0) or not values.get("ack", 1):
            return 0
        pending = self._awaited(form)
        row_id = values.get("id")
        row = None if row_id is None else self._stack.icd.row(row_id, _class_of(envelope, row_id, pending))
        if row is not None:
            return row.reply_size
        if pending is None:
            raise HeaderError("reply without a request")
        return self._reply_size

    def _reply_of(self, form: MessageFormat, body: bytes) -> Reply | LinkFault | None:
        if self._echo is not None:
            return self._check_echo(body)
        stack = self._stack
        text = form.text(body) if form is stack.replies else None
        read = stack.texts.decode(text) if isinstance(text, bytes) else None
        if read is not None:
            return self._text_reply(*read)
        opened = form.open(body)
        if isinstance(opened, LinkFault):
            return opened
        envelope, data = opened
        values = envelope.values
        pending = self._awaited(form)
        row_id = values.get("id", None if pending is None else pending.id)
        if row_id is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        message_class = _class_of(envelope, row_id, pending)
        kind = self._kind(envelope, message_class, row_id)
        if kind is ReplyKind.ACK and not values and stack.texts.acknowledge is not None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"{body[:16]!r} is no acknowledge")
        if values.get("final", 1) and kind is not ReplyKind.UNSOLICITED:
            self._pending = None
        return Reply(
            kind,
            row_id,
            data,
            error_code(values.get("status", 0)) if kind is ReplyKind.NACK else ErrorCode.OK,
            source=values.get("address", 0),
            destination=values.get("destination", 0),
            message_class=message_class,
            sequence=values.get("sequence", 0),
            flags=values.get("flags", 0),
            final=bool(values.get("final", 1)),
            uptime_ns=values["ticks"] * stack.replies.header.count_ns("ticks") if "ticks" in values else 0,
            time_ns=values["time"] * stack.replies.header.count_ns("time") if "time" in values else 0,
        )

    def _text_reply(self, kind: ReplyKind, code: int) -> Reply | LinkFault:
        pending = self._pending
        if pending is None or (kind is ReplyKind.ACK and pending.kind is not RequestKind.TELECOMMAND):
            return LinkFault(FaultKind.UART_PROTOCOL, f"{kind.value} without a request")
        self._pending = None
        return Reply(kind, pending.id, code=error_code(code), message_class=pending.message_class)

    def _check_echo(self, body: bytes) -> Reply | LinkFault | None:
        expected, self._echo = self._echo, None
        pending = self._pending
        if body != expected or pending is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"echo {body.hex().upper()} differs from the request")
        if not self._only_echo:
            return None
        self._pending = None
        return Reply(ReplyKind.ACK, pending.id, message_class=pending.message_class)

    def _kind(self, envelope: HeaderContent, message_class: str, row_id: int) -> ReplyKind:
        values, stack = envelope.values, self._stack
        if values.get("status", 0) or not values.get("ack", 1):
            return ReplyKind.NACK
        if values.get("class") in stack.unsolicited:
            return ReplyKind.UNSOLICITED
        telecommand = stack.icd.kind_of(row_id, message_class) is RequestKind.TELECOMMAND
        return ReplyKind.ACK if telecommand else ReplyKind.TELEMETRY

    def _reply_in_dialect(self, in_dialect: DialectReplies, body: bytes) -> Reply | LinkFault:
        pending = self._pending
        reply = in_dialect.decode(body, pending, self._reply_size)
        answers = (ReplyKind.ACK, ReplyKind.NACK, ReplyKind.TELEMETRY)
        if (
            isinstance(reply, Reply)
            and reply.kind in answers
            and pending is not None
            and reply.id == pending.id
        ):
            self._pending = None  # a late reply to another request leaves this one pending
        return reply


def _class_of(envelope: HeaderContent, row_id: int, pending: Request | None) -> str:
    """Return the class of a reply, or of the request that it answers if its header has none."""
    if not envelope.message_class and pending is not None and pending.id == row_id:
        return pending.message_class
    return envelope.message_class


def dialects_of(link: SerialLinkModel | None) -> tuple[Dialect, ...]:
    if link is None or not isinstance(link.framing, CubeSpaceFraming):
        return ()
    return tuple(Dialect) if link.framing.dialect is None else (Dialect(link.framing.dialect),)


def default_dialect(dialects: Sequence[Dialect]) -> Dialect | None:
    return dialects[0] if len(dialects) == 1 else Dialect.B if dialects else None


def chosen_dialect(icd: InterfaceDefinition, name: str | None) -> Dialect | None:
    """Return the dialect of serial replies of a unit; None if it has no dialects.

    Parameters
    ----------
    icd
        Definition of the unit.
    name
        The user's choice; None for the default: the only dialect of the unit, otherwise b.

    Raises IcdError: the unit does not have this dialect.
    """
    dialects = dialects_of(icd.link.serial)
    if name is None:
        return default_dialect(dialects)
    if not dialects:
        raise IcdError(f"unit {icd.name} has no reply dialects; do not select one")
    if name not in dialects:
        raise IcdError(f"unit {icd.name} has only dialect {', '.join(dialects)}; do not select another")
    return Dialect(name)
