"""Check of a unit, and its example exchanges: the request for each row and its answers on each link, as bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

from starhil.protocol.can.cubespace import encode_reply_frames, encode_request_frames
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.files.bundled import find_unit
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.link_schema import CustomFraming
from starhil.protocol.icd.values import Located, Value
from starhil.protocol.messages import ErrorCode, LinkFault, Reply, ReplyKind, Request
from starhil.protocol.plugin import guarded
from starhil.protocol.serial.headers import HeaderError
from starhil.protocol.serial.stack import SerialStack, chosen_dialect
from starhil.protocol.unit.bindings import unbound
from starhil.protocol.unit.reader import read_definition

HOST_ADDRESS, DEVICE_ADDRESS = 1, 4
"""CAN addresses in the examples."""


@dataclass(frozen=True)
class Exchange:
    """A request for a row and its answers on a link, as hexadecimal bytes, on CAN with CAN IDs."""

    row: Row
    link: str
    request: tuple[str, ...]
    answers: tuple[str, ...]
    values: Mapping[str, Value]
    """Values of the row in the request or, of telemetry, in the answer."""


_Example: TypeAlias = Callable[[InterfaceDefinition, Row], Exchange | None]


def exchanges(icd: InterfaceDefinition) -> Iterator[Exchange]:
    """Yield an exchange for each row on each link, with values that show how the row is packed.

    If the framing cannot carry these, they are the default values. Raises ProtocolError for a row that a link
    cannot carry, or whose defaults contradict its limits.
    """
    for row, _, example in _examples(icd):
        exchange = example(icd, row)
        if exchange is not None:
            yield exchange


def served(icd: InterfaceDefinition) -> tuple[list[str], list[Exchange]]:
    """Return what keeps a device from serving a valid definition, and an exchange of each row on each link.

    A unit is emulated only if there are no errors. One that concerns several rows is returned once.
    """
    errors = _unserved_rows(icd)
    if errors:
        return errors, []
    exchanges: list[Exchange] = []
    failed: dict[str, list[Row]] = {}
    for row, link, example in _examples(icd):
        try:
            with Located(link):
                exchange = example(icd, row)
        except ProtocolError as error:
            for text in error.args:
                failed.setdefault(text, []).append(row)
        else:
            exchanges += [] if exchange is None else [exchange]
    for text, rows in failed.items():
        more = len(rows) - 1
        errors.append(
            _of_row(icd, rows[0], text + (f" (and {more} more row{'s'[: more - 1]})" if more else ""))
        )
    if icd.canopen is not None:
        try:
            build_eds(DeviceDictionary(icd))
        except ProtocolError as error:
            errors += error.args
    return errors, exchanges


def _unserved_rows(icd: InterfaceDefinition) -> list[str]:
    """Return an error message for each row that the device cannot serve on any link."""
    errors = unbound(icd)
    for row in icd.rows:
        try:
            row.encode(row.example(), saturate=row.kind == "telemetry")
        except ProtocolError as error:
            errors += [_of_row(icd, row, f"example: {text}") for text in error.args]
    return errors


def _of_row(icd: InterfaceDefinition, row: Row, text: str) -> str:
    return f"{icd.files[row.name]}: {row.kind} {row.name}: {text}"


def _examples(icd: InterfaceDefinition) -> Iterator[tuple[Row, str, _Example]]:
    """Yield each row with each link, and what makes its exchange."""
    stack = None if icd.link.serial is None or icd.link_is_unknown else SerialStack(icd)
    for row in icd.rows:
        if stack is not None:
            yield row, "link.serial", partial(_on_serial, stack)
        if icd.link.can is not None:
            yield row, "link.can", _on_can


def _on_serial(stack: SerialStack, icd: InterfaceDefinition, row: Row) -> Exchange | None:
    try:
        return _serial_exchange(stack, icd, row, row.sample())
    except ProtocolError:
        return _serial_exchange(stack, icd, row, row.example())


def _serial_exchange(
    stack: SerialStack, icd: InterfaceDefinition, row: Row, values: Mapping[str, Value]
) -> Exchange | None:
    """Return the exchange of a row; None for one that is only sent, which the dialect cannot do."""
    if row.only_sent and not stack.supports_unsolicited():
        return None
    request, replies = _messages(icd, row, values, stack.answers(row))
    sent: tuple[str, ...] = ()
    if request is not None:
        with _Part(
            "request", "or set `request = false` if the row is only sent" if row.kind == "telemetry" else ""
        ):
            line = stack.encode_request(request)
            _check_framing(stack, row, request, line)
        sent = (_hex(line),)
    dialect = chosen_dialect(icd, None)
    link = "serial" if dialect is None else f"serial, dialect {dialect}"
    with _Part("answer", "or set `answer = []` if it is not answered" if row.kind == "telecommand" else ""):
        answers = tuple(_hex(data) for reply in replies if (data := stack.encode_reply(reply)))
    if request is not None and "reply" in stack.answers(row):
        with _Part("refusal"):
            stack.encode_reply(
                Reply(ReplyKind.NACK, row.id, code=ErrorCode.INVALID_ID, message_class=row.message_class)
            )
    return Exchange(row, link, sent, answers, values)


class _Part(Located):
    """A message of an exchange; what its header cannot hold is an error with a remedy."""

    def __init__(self, where: str, remedy: str = "") -> None:
        super().__init__(where)
        self._remedy = f", {remedy}" if remedy else ""

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if isinstance(error, HeaderError):
            error.args = tuple(f"{text}; correct that field{self._remedy}" for text in error.args)
        super().__exit__(kind, error, traceback)


def _on_can(icd: InterfaceDefinition, row: Row) -> Exchange:
    values = row.sample()
    request, replies = _messages(icd, row, values, row.answers)
    sent = [] if request is None else encode_request_frames(request, HOST_ADDRESS, DEVICE_ADDRESS)
    received = [
        frame
        for reply in replies
        for frame in encode_reply_frames(replace(reply, destination=HOST_ADDRESS), DEVICE_ADDRESS)
    ]
    return Exchange(row, "CAN", _frames(sent), _frames(received), values)


def _frames(frames: Iterable[CanFrame]) -> tuple[str, ...]:
    return tuple(f"{frame.id:08X}#{_hex(frame.data)}" for frame in frames)


def _messages(
    icd: InterfaceDefinition, row: Row, values: Mapping[str, Value], answers: Iterable[str]
) -> tuple[Request | None, list[Reply]]:
    """Return the request for a row and its answers; of a row that is only sent, no request and the message."""
    if row.only_sent:
        data = row.encode(values, saturate=True)
        return None, [Reply(ReplyKind.UNSOLICITED, row.id, data, message_class=row.message_class)]
    request = icd.request(row, row.encode(values) if row.kind == "telecommand" else b"")
    replies = []
    for answer in answers:
        named = icd.telemetry[answer.partition(":")[2]] if answer.startswith("row:") else row
        if answer == "echo":
            replies.append(Reply.echo(request))
        elif named.kind == "telecommand":
            replies.append(Reply(ReplyKind.ACK, row.id, message_class=row.message_class))
        else:
            data = named.encode(values if named is row else named.sample(), saturate=True)
            replies.append(Reply(ReplyKind.TELEMETRY, named.id, data, message_class=named.message_class))
    return request, replies


def examine(
    name_or_folder: str | Path, *, run_plugin: bool = True
) -> tuple[InterfaceDefinition, list[str], list[Exchange]]:
    """Return what is valid of a unit, all errors, and an exchange of each row on each link that has none."""
    definition, errors = read_definition(find_unit(name_or_folder), run_plugin=run_plugin)
    if errors:
        return definition, errors + _unserved_rows(definition), []
    return definition, *served(definition)


def _check_framing(stack: SerialStack, row: Row, request: Request, line: bytes) -> None:
    """Raise IcdError if the device's end does not receive the request that the OBC's end sends."""
    form = stack.request_formats.of(row.message_class)
    size = len(stack.request_body(request))
    if form.request_size not in (None, size):
        raise IcdError(
            f"{size} bytes between start and end, but link.serial.framing.request_size is {form.request_size}; "
            "correct it, or the fields of the row"
        )
    own = isinstance(form.model, CustomFraming)
    name = f"framing {form.model.name if isinstance(form.model, CustomFraming) else form.model.kind}"
    received = guarded(name, stack.device().feed)(line, 0.0)
    requests = [(item.message_class, item.id, item.data) for item in received if isinstance(item, Request)]
    if requests != [(row.message_class, row.id, request.data)]:
        returned = [item.detail for item in received if isinstance(item, LinkFault)]
        returned += [
            f"a request for {message_class} {row_id}".replace("  ", " ")
            for message_class, row_id, _ in requests
        ]
        instead = "" if own else f"; it returns: {'; '.join(returned) or 'nothing'}"
        raise IcdError(f"{name} does not return the request that it encoded{instead}")


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()
