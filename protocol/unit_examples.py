"""Check of a unit, and its example exchanges: the request for each row and its answers on each link, as bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from starhil.protocol.can_framing import encode_reply_frames, encode_request_frames
from starhil.protocol.canopen.device_dictionary import build_dictionary
from starhil.protocol.canopen.layout import layout_errors
from starhil.protocol.codec import Row
from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd_bindings import unbound
from starhil.protocol.icd_builder import read_definition
from starhil.protocol.link_schema import CustomFraming
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.plugin import guarded
from starhil.protocol.serial_stack import CubeSpaceStack, build_serial_stack, serial_answers
from starhil.protocol.unit_folders import find_unit
from starhil.protocol.values import IcdError

HOST_ADDRESS, DEVICE_ADDRESS = 1, 4
"""CAN addresses in the examples."""


@dataclass(frozen=True)
class Exchange:
    """A request for a row and its answers on a link, as hexadecimal bytes, on CAN with CAN IDs."""

    row: Row
    link: str
    request: tuple[str, ...]
    answers: tuple[str, ...]


def exchanges(icd: InterfaceDefinition) -> Iterator[Exchange]:
    """Yield an exchange for each row on each link, with the default values of the fields.

    Raises ProtocolError for a row whose defaults contradict its limits.
    """
    serial = icd.link.serial
    custom = serial is not None and "custom" in (serial.framing.kind, serial.check.kind)
    unknown = custom and icd.plugin.skipped is not None
    stack = None if serial is None or unknown else build_serial_stack(icd)
    for row in icd.rows:
        data = row.encode(row.example(), saturate=row.kind == "telemetry")
        request = icd.request(row, data if row.kind == "telecommand" else b"")
        if stack is not None:
            if isinstance(stack, ComposedStack):
                _check_framing(stack, row, request)
            replies = [_reply(icd, row, answer, request) for answer in serial_answers(icd, row)]
            link = "serial, dialect b" if isinstance(stack, CubeSpaceStack) else "serial"
            encoded = [stack.encode_reply(reply) for reply in replies]
            yield Exchange(
                row,
                link,
                (_hex(stack.encode_request(request)),),
                tuple(_hex(item) for item in encoded if item),
            )
        if icd.link.can is not None and icd.link.can.kind == "cubespace":
            replies = [_reply(icd, row, answer, request) for answer in row.answers]
            sent = encode_request_frames(request, HOST_ADDRESS, DEVICE_ADDRESS)
            came = [
                frame
                for reply in replies
                for frame in encode_reply_frames(replace(reply, destination=HOST_ADDRESS), DEVICE_ADDRESS)
            ]
            yield Exchange(
                row,
                "CAN",
                tuple(f"{frame.id:08X}#{_hex(frame.data)}" for frame in sent),
                tuple(f"{frame.id:08X}#{_hex(frame.data)}" for frame in came),
            )


def examine(
    name_or_folder: str | Path, *, run_plugin: bool = True
) -> tuple[InterfaceDefinition, list[str], list[Exchange]]:
    """Return what is valid of a unit, all errors, and if there are none an exchange of each row on each link."""
    definition, errors = read_definition(find_unit(name_or_folder), run_plugin=run_plugin)
    errors += unbound(definition)
    for row in definition.rows:
        try:
            row.encode(row.example(), saturate=row.kind == "telemetry")
        except ProtocolError as error:
            errors.append(f"unit {definition.name}: {row.kind} {row.name}: example: {error}")
    table = definition.canopen
    if table is not None:
        errors += layout_errors(table)
    examples: list[Exchange] = []
    if not errors:
        try:
            if table is not None:
                build_dictionary(definition)
            examples += exchanges(definition)
        except ProtocolError as error:
            errors.append(f"unit {definition.name}: {error}")
    return definition, errors, examples


def _reply(icd: InterfaceDefinition, row: Row, answer: str, request: Request) -> Reply:
    if answer == "echo":
        return Reply.echo(request)
    named = icd.telemetry[answer.partition(":")[2]] if answer.startswith("row:") else row
    if named.kind == "telecommand":
        return Reply(ReplyKind.ACK, row.id, klass=row.klass)
    data = named.encode(named.example(), saturate=True)
    return Reply(ReplyKind.TELEMETRY, named.id, data, klass=named.klass)


def _check_framing(stack: ComposedStack, row: Row, request: Request) -> None:
    """Raise IcdError if the device's end does not receive the request that the OBC's end sends."""
    framing = stack.link.framing
    name = f"framing {framing.name if isinstance(framing, CustomFraming) else framing.kind}"
    received = guarded(name, stack.device().feed)(stack.encode_request(request), 0.0)
    if [(item.id, item.data) for item in received if isinstance(item, Request)] != [(row.id, request.data)]:
        raise IcdError(f"{name} does not return the request for {row.name} that it encoded")


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()
