"""Check of a unit, and its example exchanges: the request for each row and its answers on each link, as bytes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from starhil.protocol.can_framing import CanFrame, encode_reply_frames, encode_request_frames
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.codec import Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.icd import read_definition
from starhil.protocol.icd_bindings import unbound
from starhil.protocol.link_schema import CustomFraming
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.names import find_unit
from starhil.protocol.plugin import guarded
from starhil.protocol.serial_stack import SerialStack, chosen_dialect
from starhil.protocol.values import Value

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


def exchanges(icd: InterfaceDefinition) -> Iterator[Exchange]:
    """Yield an exchange for each row on each link, with values that show how the row is packed.

    If the framing cannot carry these, they are the default values. Raises ProtocolError for a row whose defaults
    contradict its limits.
    """
    stack = None if icd.link.serial is None or icd.link_is_unknown else SerialStack(icd)
    for row in icd.rows:
        if stack is not None:
            try:
                yield _on_serial(icd, stack, row, row.sample())
            except ProtocolError:
                yield _on_serial(icd, stack, row, row.example())
        if icd.link.can is not None:
            yield _on_can(icd, row, row.sample())


def _on_serial(
    icd: InterfaceDefinition, stack: SerialStack, row: Row, values: Mapping[str, Value]
) -> Exchange:
    request, replies = _messages(icd, row, values, stack.answers(row))
    _check_framing(stack, row, request)
    dialect = chosen_dialect(icd, None)
    link = "serial" if dialect is None else f"serial, dialect {dialect}"
    answers = tuple(_hex(data) for reply in replies if (data := stack.encode_reply(reply)))
    return Exchange(row, link, (_hex(stack.encode_request(request)),), answers, values)


def _on_can(icd: InterfaceDefinition, row: Row, values: Mapping[str, Value]) -> Exchange:
    request, replies = _messages(icd, row, values, row.answers)
    sent = encode_request_frames(request, HOST_ADDRESS, DEVICE_ADDRESS)
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
) -> tuple[Request, list[Reply]]:
    """Return the request for a row and its answers."""
    request = icd.request(row, row.encode(values) if row.kind == "telecommand" else b"")
    replies = []
    for answer in answers:
        named = icd.telemetry[answer.partition(":")[2]] if answer.startswith("row:") else row
        if answer == "echo":
            replies.append(Reply.echo(request))
        elif named.kind == "telecommand":
            replies.append(Reply(ReplyKind.ACK, row.id, klass=row.klass))
        else:
            data = named.encode(values if named is row else named.sample(), saturate=True)
            replies.append(Reply(ReplyKind.TELEMETRY, named.id, data, klass=named.klass))
    return request, replies


def examine(
    name_or_folder: str | Path, *, run_plugin: bool = True
) -> tuple[InterfaceDefinition, list[str], list[Exchange]]:
    """Return what is valid of a unit, all errors, and if there are none an exchange of each row on each link."""
    path = find_unit(name_or_folder)
    definition, errors = read_definition(path, run_plugin=run_plugin)
    errors += unbound(definition)
    for row in definition.rows:
        try:
            row.encode(row.example(), saturate=row.kind == "telemetry")
        except ProtocolError as error:
            errors.append(f"{definition.files[row.name]}: {row.kind} {row.name}: example: {error}")
    examples: list[Exchange] = []
    if not errors:
        try:
            if definition.canopen is not None:
                build_eds(DeviceDictionary(definition))
            examples += exchanges(definition)
        except ProtocolError as error:
            errors.append(f"{path}: {error}")
    return definition, errors, examples


def _check_framing(stack: SerialStack, row: Row, request: Request) -> None:
    """Raise IcdError if the device's end does not receive the request that the OBC's end sends."""
    framing = stack.link.framing
    name = f"framing {framing.name if isinstance(framing, CustomFraming) else framing.kind}"
    received = guarded(name, stack.device().feed)(stack.encode_request(request), 0.0)
    if [(item.id, item.data) for item in received if isinstance(item, Request)] != [(row.id, request.data)]:
        raise IcdError(f"{name} does not return the request for {row.name} that it encoded")


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()
