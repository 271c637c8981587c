"""Example exchanges of a unit: the request for each row and its answers on each link, as bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from starhil.protocol.can_framing import encode_reply_frames, encode_request_frames
from starhil.protocol.codec import Row
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.serial_stack import CubeSpaceStack, build_serial_stack, serial_answers

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
    for row in icd.rows:
        data = row.encode(row.example())
        request = icd.request(row, data if row.kind == "telecommand" else b"")
        if icd.link.serial is not None:
            replies = [_reply(icd, row, answer, request) for answer in serial_answers(icd, row)]
            stack = build_serial_stack(icd)
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


def _reply(icd: InterfaceDefinition, row: Row, answer: str, request: Request) -> Reply:
    if answer == "echo":
        return Reply.echo(request)
    named = icd.telemetry[answer.partition(":")[2]] if answer.startswith("row:") else row
    if named.kind == "telecommand":
        return Reply(ReplyKind.ACK, row.id, klass=row.klass)
    data = named.encode(named.example(), saturate=True)
    return Reply(ReplyKind.TELEMETRY, named.id, data, klass=named.klass)


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()
