"""Both ends of a serial link composed of a framing, a check and headers, sans-I/O."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar, assert_never

from starhil.protocol.checks import CheckFunction, build_check
from starhil.protocol.conventions import Order
from starhil.protocol.envelope import Envelope, Header, HeaderError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.framings import (
    BodySizeError,
    Counted,
    Deframer,
    Delimited,
    Escaped,
    Framing,
    Receiving,
    Slip,
)
from starhil.protocol.link_schema import (
    CubeSpaceFraming,
    CustomFraming,
    DelimitedFraming,
    EscapedFraming,
    FixedFraming,
    LengthFraming,
    MessageClass,
    SerialLinkModel,
    SlipFraming,
)
from starhil.protocol.messages import (
    DEFAULT_MAX_SIZE,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
    error_code,
)
from starhil.protocol.plugin import guarded
from starhil.protocol.serial_interface import Dialect, RowShape, SerialStack
from starhil.protocol.values import IcdError

_Message = TypeVar("_Message")


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


class ComposedStack(SerialStack):
    """A serial link composed of a framing, a check and headers.

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
        self.baud = link.baud
        self.link: Final = link
        self.framing: Final = _build_framing(link, framings or {})
        self.check: Final = build_check(link.check, byte_order, checks)
        self.classes: Final = _Classes(classes)
        self.rows: Final = tuple(rows)
        self.byte_order: Final = byte_order
        self._rows = {(row.klass, row.id): row for row in rows}
        self._rows_by_id: dict[int, RowShape] = {}
        for row in rows:
            self._rows_by_id.setdefault(row.id, row)
        overhead = {"start": len(self.framing.start), "check": self.check.size, "end": len(self.framing.end)}
        self.request_header: Final = Header(
            link.request_header, byte_order, self.classes.requests, overhead, "link.serial.request_header"
        )
        self.reply_header: Final = Header(
            link.reply_header, byte_order, self.classes.replies, overhead, "link.serial.reply_header"
        )
        self._check_headers()
        longest = max((max(row.request_size, row.reply_size) for row in rows), default=0)
        header = max(
            head.size(name)
            for head in (self.request_header, self.reply_header)
            for name in ("", *self.classes.by_name)
        )
        self.max_size: Final = link.max_size or max(DEFAULT_MAX_SIZE, longest + header + self.check.size)

    def _check_headers(self) -> None:
        for where, header in (("request", self.request_header), ("reply", self.reply_header)):
            for name in {name for item in header.fields for name in item.classes or ()}:
                if name not in self.classes.by_name:
                    known = ", ".join(self.classes.by_name) or "none"
                    raise IcdError(f"link.serial.{where}_header: no class named {name!r} (known: {known})")
            if isinstance(self.link.framing, LengthFraming) and "length" not in header.roles:
                raise IcdError(f"link.serial.{where}_header: framing length needs a field with role length")
        if "id" not in self.request_header.roles:
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

    def device(self) -> Deframer[Request]:
        """Return a receiver for the device's end."""
        return self.deframer(self._request_of, self._request_size)

    def host(self, style: Dialect | None = None) -> ComposedHostReceiver:  # noqa: ARG002 -- one style
        """Return a receiver for the OBC's end."""
        return ComposedHostReceiver(self)

    def deframer(
        self,
        interpret: Callable[[bytes], _Message | LinkFault | None],
        measure: Callable[[bytes], int | None],
    ) -> Deframer[_Message]:
        """Return a deframer that calls `measure` for the size of a body and `interpret` for its message."""
        return self.framing.deframer(Receiving(interpret, measure, self.max_size, self.link.timeout))

    def encode_request(self, request: Request) -> bytes:
        """Return a request as bytes on the line."""
        return self.framing.encode(self.request_body(request))

    def request_body(self, request: Request) -> bytes:
        """Return header, data and check of a request."""
        values = {"id": request.id, "sequence": request.sequence}
        if request.source:
            values["source"] = request.source
        if request.flags:
            values["flags"] = request.flags
        if "class" in self.request_header.roles:
            values["class"] = self.classes.request_code(request.klass)
        return self.close(self.request_header.pack(values, request.klass, len(request.data)), request.data)

    def encode_reply(self, reply: Reply, style: Dialect | None = None) -> bytes:  # noqa: ARG002 -- one style
        """Return a reply as bytes on the line; empty for a refusal that the unit's header cannot express."""
        if reply.kind is ReplyKind.ECHO:
            echo = Request(
                RequestKind.TELECOMMAND, reply.id or 0, reply.data, reply.destination, reply.klass, reply.sequence,
                reply.flags,
            )  # fmt: skip
            return self.encode_request(echo)
        refused = reply.kind is ReplyKind.NACK
        header = self.reply_header
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
        for role, nanoseconds in (("ticks", reply.uptime_ns), ("time", reply.time_ns)):
            if role in header.roles:
                values[role] = nanoseconds // header.count_ns(role)
        if "class" in header.roles:
            values["class"] = self.classes.reply_code(
                reply.klass, unsolicited=reply.kind is ReplyKind.UNSOLICITED
            )
        data = b"" if refused else reply.data
        return self.framing.encode(self.close(header.pack(values, reply.klass, len(data)), data))

    def close(self, header: bytes, data: bytes) -> bytes:
        """Return header, data and check of a message."""
        return header + data + self.check.compute(self._covered(header, data))

    def _covered(self, header: bytes, data: bytes) -> bytes:
        covers = self.check.covers
        return (
            (self.framing.start if "start" in covers else b"")
            + (header if "header" in covers else b"")
            + (data if "data" in covers else b"")
        )

    def open(self, header: Header, body: bytes) -> tuple[Envelope, bytes] | LinkFault:
        """Return header and data of a body, or its fault."""
        end = len(body) - self.check.size
        try:
            envelope = header.unpack(body[: max(end, 0)])
        except HeaderError as error:
            if {"header", "data"} <= self.check.covers and not self._checks(body, 0, end):
                return self._bad_check(body[end:])
            return LinkFault(FaultKind.UART_PROTOCOL, str(error))
        if envelope is None:
            return LinkFault(
                FaultKind.UART_PROTOCOL, f"message of {len(body)} bytes is shorter than its header"
            )
        if not self._checks(body, envelope.size, end):
            return self._bad_check(body[end:])
        address = envelope.values.get("address")
        own = header.defaults.get("address")
        if address is not None and address != own:
            return LinkFault(FaultKind.UART_ADDRESS, f"message to address {address:#04x}, not {own:#04x}")
        found = end - envelope.size
        if "length" in header.roles and envelope.values["length"] != header.length(envelope.size, found):
            text = f"{found} bytes of data, but length {envelope.values['length']}"
            return LinkFault(FaultKind.UART_PROTOCOL, text)
        return envelope, body[envelope.size : end]

    def _checks(self, body: bytes, header_size: int, end: int) -> bool:
        covered = self._covered(body[:header_size], body[header_size:end])
        return self.check.compute(covered) == body[end:]

    @staticmethod
    def _bad_check(check: bytes) -> LinkFault:
        return LinkFault(FaultKind.UART_CHECK, f"check {check.hex().upper()} is wrong")

    def _request_of(self, body: bytes) -> Request | LinkFault:
        opened = self.open(self.request_header, body)
        if isinstance(opened, LinkFault):
            return opened
        envelope, data = opened
        values = envelope.values
        row = self.row(envelope.klass, values["id"])
        klass = envelope.klass or (row.klass if row is not None else "")
        item = self.classes.by_name.get(klass)
        kind = item.kind if item is not None else row.kind if row is not None else RequestKind.TELECOMMAND
        return Request(
            kind,
            values["id"],
            data,
            values.get("source", 0),
            klass,
            values.get("sequence", 0),
            values.get("flags", 0),
        )

    def _request_size(self, body: bytes) -> int | None:
        """Return the size of a request that begins with these bytes, or None if more are needed."""
        framing = self.link.framing
        if isinstance(framing, FixedFraming) and framing.request_size is not None:
            return framing.request_size
        return self.measure(self.request_header, body, self._request_data_size)

    def _request_data_size(self, envelope: Envelope) -> int:
        row = self.row(envelope.klass, envelope.values["id"])
        if row is None:
            raise HeaderError(f"no row with id {envelope.values['id']}")
        return row.request_size

    def measure(self, header: Header, body: bytes, data_size: Callable[[Envelope], int]) -> int | None:
        """Return the size of the body that begins with these bytes, or None if more are needed.

        `data_size` returns the size of the data if the header carries no length. Raises BodySizeError.
        """
        try:
            envelope = header.unpack(body)
            if envelope is None:
                return None
            data = header.data_size(envelope) if "length" in header.roles else data_size(envelope)
        except HeaderError as error:
            raise BodySizeError(str(error)) from None
        return envelope.size + data + self.check.size


class ComposedHostReceiver:
    """The OBC's end of a composed link.

    An echo of the request is verified and consumed. For a telecommand without another answer it is reported
    as the ACK.
    """

    def __init__(self, stack: ComposedStack) -> None:
        self._stack = stack
        self._deframer: Deframer[Reply] = stack.deframer(self._reply_of, self._size)
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

    def _size(self, body: bytes) -> int | None:
        """Return the size of the echo or reply that begins with these bytes, or None if more are needed."""
        if self._echo is not None:
            return len(self._echo)
        return self._stack.measure(self._stack.reply_header, body, self._data_size)

    def _data_size(self, envelope: Envelope) -> int:
        values = envelope.values
        if values.get("status", 0) or not values.get("ack", 1):
            return 0
        row = self._stack.row(envelope.klass, values["id"]) if "id" in values else None
        if row is not None:
            return row.reply_size
        if self._pending is None or self._reply_size is None:
            raise HeaderError("reply without a request")
        return self._reply_size

    def _reply_of(self, body: bytes) -> Reply | LinkFault | None:
        if self._echo is not None:
            return self._check_echo(body)
        stack = self._stack
        opened = stack.open(stack.reply_header, body)
        if isinstance(opened, LinkFault):
            return opened
        envelope, data = opened
        values = envelope.values
        pending = self._pending
        row_id = values.get("id", None if pending is None else pending.id)
        if row_id is None:
            return LinkFault(FaultKind.UART_PROTOCOL, f"reply of {len(body)} bytes without a request")
        klass = envelope.klass
        if not klass and pending is not None and pending.id == row_id:
            klass = pending.klass
        kind = self._kind(envelope, klass, row_id)
        if values.get("final", 1) and kind is not ReplyKind.UNSOLICITED:
            self._pending = None
        return Reply(
            kind,
            row_id,
            data,
            error_code(values.get("status", 0)) if kind is ReplyKind.NACK else 0,
            source=values.get("address", 0),
            destination=values.get("destination", 0),
            klass=klass,
            sequence=values.get("sequence", 0),
            flags=values.get("flags", 0),
            final=bool(values.get("final", 1)),
            uptime_ns=self._nanoseconds("ticks", values),
            time_ns=self._nanoseconds("time", values),
        )

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
        row = stack.row(klass, row_id)
        item = stack.classes.by_name.get(klass)
        kind = row.kind if row is not None else item.kind if item is not None else None
        return ReplyKind.ACK if kind is RequestKind.TELECOMMAND else ReplyKind.TELEMETRY

    def _nanoseconds(self, role: str, values: Mapping[str, int]) -> int:
        return values[role] * self._stack.reply_header.count_ns(role) if role in values else 0


class _PluginFraming(Framing):
    """A framing of a plugin, whose failures are raised as an IcdError of one line."""

    def __init__(self, name: str, framing: object) -> None:
        if not isinstance(framing, Framing):
            raise IcdError(f"framing {name} must be a class derived from starhil.protocol.framings.Framing")
        self._name = name
        self._framing = framing
        self.start, self.end = framing.start, framing.end

    def encode(self, body: bytes) -> bytes:
        line: object = guarded(f"framing {self._name}", self._framing.encode)(body)
        if not isinstance(line, bytes):
            raise IcdError(f"framing {self._name} must encode to bytes, not {type(line).__name__}")
        return line

    def deframer(self, receiving: Receiving[_Message]) -> Deframer[_Message]:
        made: object = guarded(f"framing {self._name}", self._framing.deframer)(receiving)
        if not isinstance(made, Deframer):
            raise IcdError(f"framing {self._name} must make a Deframer, not {type(made).__name__}")
        return made


def _build_framing(link: SerialLinkModel, custom: Mapping[str, Callable[[], object]]) -> Framing:
    model = link.framing
    match model:
        case EscapedFraming():
            return Escaped(model)
        case SlipFraming():
            return Slip(model)
        case LengthFraming() | FixedFraming():
            return Counted(model.start, model.end)
        case DelimitedFraming():
            return Delimited(model)
        case CustomFraming():
            if model.name not in custom:
                raise IcdError(f"link.serial.framing: the plugin has no framing named {model.name!r}")
            return _PluginFraming(model.name, custom[model.name]())
        case CubeSpaceFraming():
            raise IcdError("link.serial.framing: cubespace has its own codec")
        case _:
            assert_never(model)
