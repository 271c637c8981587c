"""Both ends of the serial link that a unit defines, sans-I/O: bytes in, requests, replies and faults out.

::

    start   header: fields by role   data of the row   check   end
            └──────────────── body ─────────────────────────┘

A link is composed of a framing, which marks where a body begins and ends (`framings`), a check (`checks`), a header of
requests and one or several of replies (`envelope`). In most units all replies have one header, whose roles give what
they are. In the dialects of CubeSpace each kind of reply has its own (`cubespace`), and the kind follows from the
start byte, the row, and the size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Final

from starhil.protocol import cubespace
from starhil.protocol.checks import Check, CheckFunction, build_check
from starhil.protocol.codec import Row
from starhil.protocol.conventions import Order
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.envelope import Envelope, Header, HeaderError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.framings import (
    CUBESPACE,
    Deframer,
    Escaped,
    Framing,
    Receiving,
    build_framing,
)
from starhil.protocol.link_schema import (
    CubeSpaceFraming,
    FormatModel,
    HeaderFieldModel,
    MessageClass,
    SerialLinkModel,
)
from starhil.protocol.message_format import Formats, MessageFormat
from starhil.protocol.messages import (
    BURST_ID,
    DEFAULT_MAX_SIZE,
    FIRST_TELEMETRY_ID,
    ErrorCode,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)
from starhil.protocol.serial_interface import Dialect
from starhil.protocol.text_messages import TextReplies, words
from starhil.protocol.values import IcdError


@dataclass(frozen=True, slots=True)
class RowShape:
    """The properties of a row on which a link depends: kind, sizes and answers."""

    klass: str
    id: int
    kind: RequestKind
    request_size: int = 0
    """Number of data bytes in the request."""
    reply_size: int = 0
    """Number of data bytes in the reply."""
    answers: tuple[str, ...] = ("reply",)
    """`echo` and `reply`, in the order in which the device sends them."""
    request: str = ""
    """Text that requests the row; empty: its header does."""


@dataclass
class _Classes:
    """The classes of a unit by code and by name."""

    classes: Sequence[MessageClass]
    by_name: dict[str, MessageClass] = field(init=False)
    requests: dict[int, str] = field(init=False)
    replies: dict[int, str] = field(init=False)
    _unsolicited: set[int] = field(init=False)

    def __post_init__(self) -> None:
        self.by_name = {item.name: item for item in self.classes}
        coded = [item for item in self.classes if item.code is not None]
        self.requests = {item.code: item.name for item in coded if item.code is not None}
        self.replies = {}
        self._unsolicited = set()
        for item in coded:
            self.replies[self.reply_code(item.name, unsolicited=False)] = item.name
            if item.unsolicited is not None:
                self.replies[item.unsolicited] = item.name
                self._unsolicited.add(item.unsolicited)

    def unsolicited(self, code: int | None) -> bool:
        return code in self._unsolicited

    def request_code(self, name: str) -> int:
        return self._coded(name).code or 0

    def reply_code(self, name: str, *, unsolicited: bool) -> int:
        item = self._coded(name)
        reply = item.code if item.reply is None else item.reply
        return (item.unsolicited if unsolicited and item.unsolicited is not None else reply) or 0

    def _coded(self, name: str) -> MessageClass:
        item = self.by_name.get(name)
        if item is None or item.code is None:
            raise ProtocolError(f"class {name!r} has no code on this link")
        return item


@dataclass
class ReplyFormat:
    """The framing of the replies of a link or of one of its dialects, and the header of each kind of reply.

    In a dialect, all replies to a request with the same start byte have the ID in the same place.
    """

    framing: Framing
    headers: Mapping[ReplyKind, Header]

    @cached_property
    def starts(self) -> Mapping[int | None, list[ReplyKind]]:
        """First byte of a header, None if any → kinds of replies to a request."""
        found: dict[int | None, list[ReplyKind]] = {}
        for kind, header in self.headers.items():
            if kind is not ReplyKind.BURST:
                start = header.fields[0].const if header.fields else None
                found.setdefault(start, []).append(kind)
        return found

    @cached_property
    def ids(self) -> Mapping[ReplyKind, int]:
        """Kind → place of the ID in the header, if it has one."""
        roles = {kind: [item.role for item in header.fields] for kind, header in self.headers.items()}
        return {kind: found.index("id") for kind, found in roles.items() if "id" in found}

    @cached_property
    def sizes(self) -> Mapping[ReplyKind, int]:
        """Kind → size of the header."""
        return {kind: header.size("") for kind, header in self.headers.items()}

    @cached_property
    def coded(self) -> frozenset[ReplyKind]:
        """Kinds whose header has an error code."""
        return frozenset(kind for kind, header in self.headers.items() if "status" in header.roles)


class SerialStack:
    """The serial link of a unit.

    Parameters
    ----------
    link
        `[link.serial]`.
    classes
        Classes of the rows.
    rows
        Kind, sizes and answers of the rows.
    byte_order
        Byte order of the unit.
    framings, checks
        Framings, as classes, and checks defined by the unit's plugin, by name.

    Attributes
    ----------
    dialects
        The dialects of replies; empty if the unit has only one format. A dialect that is not given is the
        unit's only one, otherwise b.
    """

    def __init__(
        self,
        link: SerialLinkModel,
        classes: Sequence[MessageClass] = (),
        rows: Sequence[RowShape] = (),
        byte_order: Order = "little",
        *,
        framings: Mapping[str, Callable[[], object]] | None = None,
        checks: Mapping[str, CheckFunction] | None = None,
    ) -> None:
        self.baud: Final = link.baud
        self.link: Final = link
        self.classes: Final = _Classes(classes)
        self.rows: Final = tuple(rows)
        self.byte_order: Final = byte_order
        self.dialects: Final = dialects_of(link)
        self._plugin = framings, checks
        self._silent = {row.id for row in rows if not row.answers}
        self._rows = {(row.klass, row.id): row for row in rows}
        self._rows_by_id: dict[int, RowShape] = {}
        for row in rows:
            self._rows_by_id.setdefault(row.id, row)
        self._by_text = {words(row.request): row for row in rows if row.request}
        self._unknown_id = max((row.id for row in rows), default=0) + 1
        """ID of a request with an unknown text."""
        self.texts: Final = TextReplies(link)
        self.request_formats: Final = self._formats_of(
            "request", cubespace.REQUEST_HEADER if self.dialects else link.request_header
        )
        self.reply_formats: Final = self._formats_of("reply", link.reply_header)
        self.text_formats: Final = [
            form
            for form in self.request_formats.all
            if any(row.request for row in rows if self.request_formats.of(row.klass) is form)
        ]
        """Formats of requests that are texts."""
        self.requests: Final = self.request_formats.other
        """Format of requests without a class."""
        self.replies: Final = self.reply_formats.other
        """Format of replies without a class, and of texts."""
        self._formats: Final = {dialect: self._dialect(dialect) for dialect in self.dialects}
        default = default_dialect(self.dialects)
        self._default_format: Final = self._one_format() if default is None else self._formats[default]
        self._check_headers()
        longest = max((max(row.request_size, row.reply_size) for row in rows), default=0)
        overhead = max(
            head.size(name) + form.check.size
            for head in (self.request_header, self.reply_header)
            for name in ("", *self.classes.by_name)
            for form in (*self.request_formats.all, *self.reply_formats.all)
        )
        self.max_size: Final = link.max_size or max(DEFAULT_MAX_SIZE, longest + overhead)

    def _formats_of(self, direction: str, models: Sequence[HeaderFieldModel]) -> Formats:
        found = []
        for number, item in enumerate(self.link.format, 1):
            self._check_format(item, f"link.serial.format {number}")
            if item.direction in (None, direction):
                found.append(self._format(f"{direction}_header", models, item))
        if all(form.classes for form in found):
            found.append(self._format(f"{direction}_header", models))
        return Formats(found, direction)

    def _check_format(self, item: FormatModel, where: str) -> None:
        if item.framing is None and item.check is None:
            raise IcdError(f"{where}: needs `framing` or `check`")
        if self.dialects or isinstance(item.framing, CubeSpaceFraming):
            raise IcdError(
                f"{where}: framing cubespace has its own formats; it cannot be combined with others"
            )
        for name in item.classes or ():
            if name not in self.classes.by_name:
                known = ", ".join(self.classes.by_name) or "none"
                raise IcdError(f"{where}: no class named {name!r} (known: {known})")

    def _format(
        self, name: str, models: Sequence[HeaderFieldModel], item: FormatModel | None = None
    ) -> MessageFormat:
        framings, checks = self._plugin
        framing, check, classes = self.link.framing, self.link.check, list[str]()
        if item is not None:
            framing, check, classes = item.framing or framing, item.check or check, item.classes or []
        return MessageFormat(
            build_framing(framing, framings),
            framing,
            build_check(check, self.byte_order, checks),
            models,
            self.byte_order,
            self.classes.requests if name == "request_header" else self.classes.replies,
            f"link.serial.{name}",
            classes,
        )

    @property
    def framing(self) -> Framing:
        """The framing of requests."""
        return self.requests.framing

    @property
    def check(self) -> Check:
        """The check of requests."""
        return self.requests.check

    @property
    def request_header(self) -> Header:
        """The header of requests."""
        return self.requests.header

    @property
    def reply_header(self) -> Header:
        """The header of replies; of those of a dialect, that of a refusal."""
        return self.format().headers[ReplyKind.NACK]

    def _one_format(self) -> ReplyFormat:
        headers = dict.fromkeys(set(ReplyKind) - {ReplyKind.ECHO}, self.replies.header)
        return ReplyFormat(self.replies.framing, headers)

    def _dialect(self, dialect: Dialect) -> ReplyFormat:
        headers = {
            kind: self._format(kind.value, models).header
            for kind, models in cubespace.REPLIES[dialect].items()
        }
        constants = (field.const for header in headers.values() for field in header.fields)
        starts = frozenset(constant for constant in constants if constant is not None)
        has_id = "id" in headers[ReplyKind.TELEMETRY].roles
        return ReplyFormat(Escaped(CUBESPACE, starts, first_is_id=has_id), headers)

    def format(self, dialect: Dialect | None = None) -> ReplyFormat:
        """Return the format of the replies."""
        return self._default_format if dialect is None else self._formats.get(dialect, self._default_format)

    def _check_headers(self) -> None:
        for where, header in (("request", self.request_header), ("reply", self.reply_header)):
            for name in (name for item in header.fields for name in item.classes or ()):
                if name not in self.classes.by_name:
                    known = ", ".join(self.classes.by_name) or "none"
                    raise IcdError(f"link.serial.{where}_header: no class named {name!r} (known: {known})")
            formats = self.request_formats if where == "request" else self.reply_formats
            if any(form.kind == "length" for form in formats.all) and "length" not in header.roles:
                raise IcdError(f"link.serial.{where}_header: framing length needs a field with role length")
        if self.request_header.counts:
            raise IcdError("link.serial.request_header: `counts` belongs to the reply header")
        texts = list(self.text_formats)
        if self.texts.acknowledge is not None or self.texts.refusal is not None:
            texts.append(self.replies)
        for form in texts:
            if form.kind in ("length", "fixed"):
                raise IcdError(
                    f"link.serial: texts need a framing with an end, such as delimited, not {form.kind}"
                )
        if "id" not in self.request_header.roles and len(self.text_formats) < len(self.request_formats.all):
            raise IcdError("link.serial.request_header: needs a field with role id")
        for role in ("source", "destination"):
            header, other = (
                (self.reply_header, "reply") if role == "source" else (self.request_header, "request")
            )
            if role in header.roles:
                raise IcdError(f"link.serial.{other}_header: role {role} belongs to the other direction")

    def row(self, klass: str, row_id: int) -> RowShape | None:
        """Return the row of a message; the class matters only if the link carries one."""
        if "class" in self.request_header.roles:
            return self._rows.get((klass, row_id))
        return self._rows.get((klass, row_id)) or self._rows_by_id.get(row_id)

    def supports_unsolicited(self, dialect: Dialect | None = None) -> bool:
        """Return whether this dialect has unsolicited telemetry."""
        return ReplyKind.UNSOLICITED in self.format(dialect).headers

    def counts(self, kind: ReplyKind) -> bool:
        """Return whether the device numbers messages of this kind itself."""
        unsolicited = kind in (ReplyKind.UNSOLICITED, ReplyKind.EVENT)
        return (
            kind is not ReplyKind.ECHO
            and ("unsolicited" if unsolicited else "reply") in self.reply_header.counts
        )

    def device(self) -> Deframer[Request]:
        """Return a receiver for the device's end."""
        return self.request_formats.deframer(
            self._request_of, self._request_size, self.max_size, self.link.timeout
        )

    def host(self, dialect: Dialect | None = None) -> HostReceiver:
        """Return a receiver for the OBC's end."""
        return HostReceiver(self, self.format(dialect))

    def encode_request(self, request: Request) -> bytes:
        """Return a request as bytes on the line.

        Raises ProtocolError for data or an unknown ID if requests are texts.
        """
        return self.request_formats.of(request.klass).framing.encode(self.request_body(request))

    def request_body(self, request: Request) -> bytes:
        """Return header, data and check of a request."""
        form = self.request_formats.of(request.klass)
        if form in self.text_formats:
            row = self.row(request.klass, request.id)
            if row is None or not row.request or request.data:
                what = f"no text requests ID {request.id}" if row is None else "a text has no data"
                raise ProtocolError(f"link.serial: {what}")
            return form.close(b"", row.request.encode("ascii"))
        values = {"id": request.id, "sequence": request.sequence}
        if request.source:
            values["source"] = request.source
        if request.flags:
            values["flags"] = request.flags
        if "class" in self.request_header.roles:
            values["class"] = self.classes.request_code(request.klass)
        return form.close(form.header.pack(values, request.klass, len(request.data)), request.data)

    def encode_reply(self, reply: Reply, dialect: Dialect | None = None) -> bytes:
        """Return a reply as bytes on the line; empty for a refusal that the unit's header cannot express.

        Raises ProtocolError for a kind of reply that the dialect does not have.
        """
        form = self.format(dialect)
        header = form.headers.get(reply.kind)
        if header is None:
            if self.dialects:
                chosen = dialect if dialect in self.dialects else default_dialect(self.dialects)
                raise ProtocolError(_no_such_reply(reply.kind, chosen))
            echo = Request(
                RequestKind.TELECOMMAND, reply.id or 0, reply.data, reply.destination, reply.klass, reply.sequence,
                reply.flags,
            )  # fmt: skip
            return self.encode_request(echo)
        text = self.texts.encode(reply)
        if text is not None:
            return self.replies.framing.encode(self.replies.close(b"", text))
        refused = reply.kind is ReplyKind.NACK
        accepted = reply.kind is ReplyKind.ACK
        if self.dialects and (refused or accepted) and reply.id in self._silent:
            return b""
        if refused and not header.roles_in(reply.klass) & {"status", "ack"}:
            return b""
        values = {
            "id": reply.id or 0,
            "destination": reply.destination,
            "sequence": reply.sequence,
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
            values["class"] = self.classes.reply_code(
                reply.klass, unsolicited=reply.kind is ReplyKind.UNSOLICITED
            )
        data = b"" if refused or (self.dialects and accepted) else reply.data
        if self.dialects:
            return form.framing.encode(header.pack(values, reply.klass, len(data)) + data)
        own = self.reply_formats.of(reply.klass)
        return own.framing.encode(own.close(own.header.pack(values, reply.klass, len(data)), data))

    def _request_of(self, form: MessageFormat, body: bytes) -> Request | LinkFault:
        if form in self.text_formats:
            text = form.text(body)
            if isinstance(text, LinkFault):
                return text
            row = self._by_text.get(words(text.decode("latin-1")))
            if row is None:
                return Request(RequestKind.TELECOMMAND, self._unknown_id)
            return Request(row.kind, row.id, klass=row.klass)
        opened = form.open(body)
        if isinstance(opened, LinkFault):
            return opened
        envelope, data = opened
        values = envelope.values
        row_id, klass = values["id"], envelope.klass
        if not klass:
            row = self.row(klass, row_id)
            klass = row.klass if row is not None else ""
        return Request(
            self.kind_of(row_id, klass) or RequestKind.TELECOMMAND,
            row_id,
            data,
            values.get("source", 0),
            klass,
            values.get("sequence", 0),
            values.get("flags", 0),
        )

    def kind_of(self, row_id: int, klass: str = "") -> RequestKind | None:
        """Return the kind of a row, which need not exist; None if it is unknown."""
        if self.dialects:
            return RequestKind.TELEMETRY if row_id >= FIRST_TELEMETRY_ID else RequestKind.TELECOMMAND
        item = self.classes.by_name.get(klass)
        row = self.row(klass, row_id)
        return item.kind if item is not None else row.kind if row is not None else None

    def _request_size(self, form: MessageFormat, body: bytes) -> int | None:
        """Return the size of a request that begins with these bytes, or None if more are needed."""
        if form.request_size is not None:
            return form.request_size
        return form.measure(body, self._request_data_size)

    def _request_data_size(self, envelope: Envelope) -> int:
        row = self.row(envelope.klass, envelope.values["id"])
        if row is None:
            raise HeaderError(f"no row with id {envelope.values['id']}")
        return row.request_size


class HostReceiver:
    """The OBC's end: bytes in, replies and faults out.

    Call `expect` before each request: some units' replies can be interpreted only with it. An echo of the request is
    verified and consumed. For a telecommand without another answer it is reported as the ACK.
    """

    def __init__(self, stack: SerialStack, replies: ReplyFormat) -> None:
        self._stack = stack
        self._format = replies
        limits = stack.max_size, stack.link.timeout
        self._deframer: Deframer[Reply] = (
            replies.framing.deframer(Receiving(self._reply_in_dialect, lambda _body: None, *limits))
            if stack.dialects
            else stack.reply_formats.deframer(self._reply_of, self._size, *limits)
        )
        self._pending: Request | None = None
        self._reply_size: int | None = None
        self._echo: bytes | None = None
        self._only_echo = False

    @property
    def busy(self) -> bool:
        """Whether a message is incomplete, so that `flush` may become due."""
        return self._deframer.busy

    def feed(self, data: bytes, now: float) -> list[Reply | LinkFault]:
        """Return the messages and faults that these bytes complete; `now` is the time of arrival, s."""
        return self._deframer.feed(data, now)

    def flush(self, now: float) -> list[LinkFault]:
        """Abandon an incomplete message after a silence of the timeout."""
        return self._deframer.flush(now)

    def expect(self, request: Request, reply_size: int) -> None:
        """Set the next request, and the data size of its telemetry in bytes (0 for a telecommand)."""
        row = self._stack.row(request.klass, request.id)
        answers = row.answers if row is not None else ("reply",)
        self._pending = request
        self._reply_size = reply_size
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
            pending if pending is not None and self._stack.reply_formats.of(pending.klass) is form else None
        )

    def _data_size(self, form: MessageFormat, envelope: Envelope) -> int:
        values = envelope.values
        if values.get("status", 0) or not values.get("ack", 1):
            return 0
        row = self._stack.row(envelope.klass, values["id"]) if "id" in values else None
        if row is not None:
            return row.reply_size
        if self._awaited(form) is None or self._reply_size is None:
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
        klass = envelope.klass
        if not klass and pending is not None and pending.id == row_id:
            klass = pending.klass
        kind = self._kind(envelope, klass, row_id)
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
            klass=klass,
            sequence=values.get("sequence", 0),
            flags=values.get("flags", 0),
            final=bool(values.get("final", 1)),
            uptime_ns=values["ticks"] * stack.reply_header.count_ns("ticks") if "ticks" in values else 0,
            time_ns=values["time"] * stack.reply_header.count_ns("time") if "time" in values else 0,
        )

    def _text_reply(self, kind: ReplyKind, code: int) -> Reply | LinkFault:
        pending = self._pending
        if pending is None or (kind is ReplyKind.ACK and pending.kind is not RequestKind.TELECOMMAND):
            return LinkFault(FaultKind.UART_PROTOCOL, f"{kind.value} without a request")
        self._pending = None
        return Reply(kind, pending.id, code=error_code(code), klass=pending.klass)

    def _check_echo(self, body: bytes) -> Reply | LinkFault | None:
        expected, self._echo = self._echo, None
        pending = self._pending
        if body != expected or pending is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"echo {body.hex().upper()} differs from the request")
        if not self._only_echo:
            return None
        self._pending = None
        return Reply(ReplyKind.ACK, pending.id, klass=pending.klass)

    def _kind(self, envelope: Envelope, klass: str, row_id: int) -> ReplyKind:
        values, stack = envelope.values, self._stack
        if values.get("status", 0) or not values.get("ack", 1):
            return ReplyKind.NACK
        if stack.classes.unsolicited(values.get("class")):
            return ReplyKind.UNSOLICITED
        telecommand = stack.kind_of(row_id, klass) is RequestKind.TELECOMMAND
        return ReplyKind.ACK if telecommand else ReplyKind.TELEMETRY

    def _reply_in_dialect(self, body: bytes) -> Reply | LinkFault:
        """Return the reply in a body, whose kind follows from its start byte, row and size."""
        form, pending = self._format, self._pending
        if len(body) == form.sizes[ReplyKind.BURST] + cubespace.BURST_SIZE and self._is_burst(body):
            return Reply(ReplyKind.BURST, BURST_ID, body[form.sizes[ReplyKind.BURST] :])
        kinds = form.starts.get(body[0]) or form.starts.get(None)
        if kinds is None:
            text = f"message {body[1]} with the start byte of a request"
            return LinkFault(FaultKind.UART_PROTOCOL, text)
        known = pending is not None
        if kinds[0] in form.ids:
            row_id = body[form.ids[kinds[0]]]
            known = pending is not None and pending.id == row_id
        elif pending is not None:
            row_id = pending.id
        else:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        if ReplyKind.ACK not in kinds:
            (kind,) = kinds  # given by the start byte
        elif row_id < FIRST_TELEMETRY_ID:
            kind = ReplyKind.ACK
        else:
            coded = ReplyKind.NACK in kinds and len(body) == form.sizes[ReplyKind.NACK]
            kind = ReplyKind.NACK if coded and known and self._reply_size != 1 else ReplyKind.TELEMETRY
        data = body[form.sizes[kind] :]
        code: ErrorCode | int = ErrorCode.OK
        if kind in form.coded:
            codes = len(body) - form.sizes[kind] + 1
            if codes != 1:
                name = "ACK of telecommand" if kind is ReplyKind.ACK else "NACK of"
                return LinkFault(FaultKind.UART_PROTOCOL, f"{name} {row_id} has {codes} bytes, must be 1")
            code = error_code(body[-1])
            kind = ReplyKind.NACK if code else kind
        if kind not in (ReplyKind.UNSOLICITED, ReplyKind.EVENT):
            self._pending = None
        return Reply(kind, row_id, data, code, klass=pending.klass if known and pending is not None else "")

    def _is_burst(self, body: bytes) -> bool:
        """Return whether a body with the size of a burst packet is one."""
        form, pending = self._format, self._pending
        start = form.headers[ReplyKind.BURST].fields[0].const
        if start not in (None, body[0]) or body[form.ids[ReplyKind.BURST]] != BURST_ID:
            return False
        if ReplyKind.TELEMETRY in form.ids or pending is None:
            return True
        return pending.kind is RequestKind.TELECOMMAND or self._reply_size != len(body)


def _no_such_reply(kind: ReplyKind, dialect: Dialect | None) -> str:
    others = [other for other, replies in cubespace.REPLIES.items() if kind in replies]
    remedy = f"; use dialect {' or '.join(others)}" if others else ""
    return f"serial dialect {dialect} has no {kind.value} messages{remedy}"


def dialects_of(link: SerialLinkModel | None) -> tuple[Dialect, ...]:
    """Return the dialects of replies of a link."""
    if link is None or not isinstance(link.framing, CubeSpaceFraming):
        return ()
    return tuple(Dialect) if link.framing.dialect is None else (Dialect(link.framing.dialect),)


def default_dialect(dialects: Sequence[Dialect]) -> Dialect | None:
    """Return the dialect that is used if none is selected."""
    return dialects[0] if len(dialects) == 1 else Dialect.B if dialects else None


def chosen_dialect(icd: InterfaceDefinition, wanted: str | None) -> Dialect | None:
    """Return the dialect of serial replies of a unit; None if it has no dialects.

    Parameters
    ----------
    icd
        Definition of the unit.
    wanted
        The user's choice; None for the default: the only dialect of the unit, otherwise b.

    Raises IcdError: the unit does not have this dialect.
    """
    dialects = dialects_of(icd.link.serial)
    if not dialects and wanted is not None:
        raise IcdError(f"unit {icd.name} has no reply dialects; do not select one")
    if len(dialects) == 1 and wanted not in (None, dialects[0]):
        raise IcdError(f"unit {icd.name} has only dialect {dialects[0]}; do not select another")
    return default_dialect(dialects) if wanted is None else Dialect(wanted)


def serial_answers(icd: InterfaceDefinition, row: Row) -> tuple[str, ...]:
    """Return the answers of a row on the serial line, of which there may be fewer than on other links."""
    framing = None if icd.link.serial is None else icd.link.serial.framing
    silent = isinstance(framing, CubeSpaceFraming) and row.name in framing.unanswered
    return () if silent else row.answers


def build_serial_stack(icd: InterfaceDefinition) -> SerialStack:
    """Return the serial link of a definition.

    Raises IcdError: the unit has none, or parts of it are incompatible.
    """
    link = icd.link.serial
    if link is None:
        raise IcdError(f"unit {icd.name}: has no serial link")
    shapes = [
        RowShape(
            row.klass,
            row.id,
            RequestKind(row.kind),
            row.size if row.kind == "telecommand" else 0,
            row.size if row.kind == "telemetry" else 0,
            serial_answers(icd, row),
            row.request,
        )
        for row in icd.rows
    ]
    return SerialStack(
        link,
        icd.classes,
        shapes,
        icd.conventions.byte_order,
        framings=icd.plugin.framings,
        checks=icd.plugin.checks,
    )
