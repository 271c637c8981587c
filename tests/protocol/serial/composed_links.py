"""Serial links composed from data: star trackers whose links are public, and one of each other kind of framing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.conventions import Conventions
from starhil.protocol.icd.definition import Names
from starhil.protocol.icd.link_schema import LinkModel, MessageClass, SerialLinkModel
from starhil.protocol.messages import (
    ErrorCode,
    FaultKind,
    LinkFault,
    Reply,
    ReplyKind,
    Request,
    RequestKind,
)
from starhil.protocol.plugin import Plugin
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit

TC, TLM = RequestKind.TELECOMMAND, RequestKind.TELEMETRY


def shape(
    message_class: str,
    identifier: int,
    kind: RequestKind,
    request_size: int = 0,
    reply_size: int = 0,
    answers: tuple[str, ...] = ("reply",),
) -> Row:
    """Return what a link needs of a row; the requests of telemetry may have data here."""
    keys = {
        "name": "",
        "message_class": message_class,
        "id": identifier,
        "kind": kind,
        "request": "",
        "answers": answers,
        "only_sent": False,
    }
    sizes = {
        "request_size": request_size,
        "reply_size": reply_size,
        "size": max(request_size, reply_size),
        "min_size": max(request_size, reply_size),
    }
    return cast("Row", SimpleNamespace(**keys, **sizes))


def stack_of(
    link: dict[str, Any],
    classes: tuple[MessageClass, ...] = (),
    rows: tuple[Row, ...] = (),
    order: Any = "little",
) -> SerialStack:
    return SerialStack(definition(link, classes, rows, order))


def definition(
    link: dict[str, Any],
    classes: tuple[MessageClass, ...] = (),
    rows: tuple[Row, ...] = (),
    order: Any = "little",
    plugin: Plugin | None = None,
) -> InterfaceDefinition:
    """Return a unit that has only a serial link, with the rows in the order of their IDs."""
    named = [(f"{row.message_class} {row.id}", row) for row in rows]
    telecommands = [(name, row) for name, row in named if row.kind is TC]
    return InterfaceDefinition(
        "test", "1", "", Names("telecommand", telecommands),
        Names("telemetry", [item for item in named if item not in telecommands]),
        Names("enum", ()), Names("parameter", ()), Names("parameter", ()),
        link=LinkModel(serial=SerialLinkModel.model_validate(link)), conventions=Conventions(byte_order=order),
        classes=classes, plugin=plugin or Plugin(),
        first_telemetry_id=128 if link["framing"]["kind"] == "cubespace" else None,
    )  # fmt: skip


CUBESPACE = stack_of({"framing": {"kind": "cubespace"}})
CUBESTAR = SerialStack(load_unit("cubestar"))

SAGITTA = stack_of(
    {
        "framing": {"kind": "slip"},
        "check": {"kind": "xxh32", "seed": 1425},
        "request_header": [
            {"role": "address", "type": "u8", "const": 0x21},
            {"role": "class", "type": "u8"},
            {"role": "id", "type": "u8"},
        ],
        "reply_header": [
            {"role": "address", "type": "u8", "const": 0x21},
            {"role": "class", "type": "u8"},
            {"role": "id", "type": "u8"},
            {"role": "status", "type": "u8", "classes": ["set", "telemetry", "action"]},
            {"role": "ticks", "type": "u32", "scale": 1e-3, "classes": ["telemetry"]},
            {"role": "time", "type": "u64", "scale": 1e-6, "classes": ["telemetry"]},
        ],
    },
    (
        MessageClass(name="set", kind=TC, code=0, reply=128),
        MessageClass(name="get", kind=TLM, code=1, reply=129),
        MessageClass(name="telemetry", kind=TLM, code=2, reply=130, unsolicited=132),
        MessageClass(name="action", kind=TC, code=3, reply=131),
    ),
    (
        shape("set", 6, TC, 16),
        shape("get", 6, TLM, 0, 16),
        shape("telemetry", 24, TLM, 0, 67),
        shape("action", 14, TC, 8),
    ),
)

NOS3 = stack_of(
    {
        "framing": {"kind": "fixed", "start": [0xDE, 0xAD], "end": [0xBE, 0xEF], "request_size": 5},
        "request_header": [{"role": "id", "type": "u8"}],
    },
    (MessageClass(name="command", kind=TC), MessageClass(name="telemetry", kind=TLM)),
    (
        shape("command", 0, TC, 4, 0, ("echo",)),
        shape("telemetry", 1, TLM, 4, 4, ("echo", "reply")),
        shape("telemetry", 2, TLM, 4, 9, ("echo", "reply")),
    ),
    "big",
)

NSP = stack_of(
    {
        "framing": {"kind": "slip"},
        "check": {"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0xFFFF, "reflect": True},
        "request_header": [
            {"role": "address", "type": "u8", "default": 0x0E},
            {"role": "source", "type": "u8", "default": 0x11},
            {"type": "bits8", "bits": [{"role": "id", "width": 5}, {"width": 2}, {"default": 1}]},
        ],
        "reply_header": [
            {"role": "destination", "type": "u8", "default": 0x11},
            {"role": "address", "type": "u8", "default": 0x0E},
            {
                "type": "bits8",
                "bits": [{"role": "id", "width": 5}, {"role": "ack"}, {"width": 1}, {"role": "final"}],
            },
        ],
    },
    rows=(shape("", 0, TLM, 0, 8), shape("", 1, TC, 4), shape("", 18, TLM, 4, 20)),
)

LENGTH = stack_of(
    {
        "framing": {"kind": "length", "start": [0xAA, 0x55]},
        "check": {"kind": "sum", "complement": "twos", "covers": ["header", "data"]},
        "request_header": [
            {"role": "length", "type": "u16", "includes": ["header", "data", "check"], "offset": -1},
            {"role": "id", "type": "u8"},
            {"role": "sequence", "type": "u8"},
        ],
        "reply_header": [
            {"role": "length", "type": "u16", "includes": ["header", "data", "check"], "offset": -1},
            {"role": "id", "type": "u8"},
            {"role": "sequence", "type": "u8"},
            {"role": "status", "type": "u8"},
        ],
    },
    rows=(shape("", 3, TC, 2), shape("", 200, TLM, 0, 6)),
    order="big",
)

DLE = stack_of(
    {
        "framing": {"kind": "escaped"},
        "check": {"kind": "crc", "type": "u16", "poly": 0x1021, "init": 0xFFFF},
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(shape("", 3, TC, 2), shape("", 16, TLM, 0, 6)),
)

HDLC = stack_of(
    {
        "framing": {"kind": "slip", "end": 0x7E, "escape": 0x7D, "xor": 0x20},
        "check": {
            "kind": "crc",
            "type": "u16",
            "poly": 0x1021,
            "init": 0xFFFF,
            "reflect": True,
            "xor": 0xFFFF,
        },
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(shape("", 3, TC, 2), shape("", 126, TLM, 0, 6)),
)

TEXT = stack_of(
    {
        "framing": {"kind": "delimited", "start": [0x24], "end": [0x0D, 0x0A], "encoding": "hex"},
        "check": {"kind": "xor"},
        "request_header": [{"role": "id", "type": "u8"}],
        "reply_header": [{"role": "id", "type": "u8"}, {"role": "status", "type": "u8"}],
    },
    rows=(shape("", 3, TC, 2), shape("", 200, TLM, 0, 6)),
)


def _length_framed(check: dict[str, Any]) -> SerialStack:
    header = [{"role": "id", "type": "u8"}, {"role": "length", "type": "u16"}]
    link = {
        "framing": {"kind": "length", "start": [0x5A]},
        "check": {"covers": ["start", "header", "data"]} | check,
        "request_header": header,
        "reply_header": [*header, {"role": "status", "type": "u8"}],
    }
    return stack_of(link, rows=(shape("", 3, TC, 2), shape("", 200, TLM, 0, 6)))


XOR16 = _length_framed({"kind": "xor", "type": "u16", "init": 0x1234})
FLETCHER = _length_framed({"kind": "fletcher16", "order": "big"})
UBX = _length_framed({"kind": "fletcher16", "modulus": 256, "covers": ["header", "data"]})

STACKS = {
    "sagitta": SAGITTA,
    "nos3": NOS3,
    "nsp": NSP,
    "length": LENGTH,
    "dle": DLE,
    "hdlc": HDLC,
    "text": TEXT,
    "xor16": XOR16,
    "fletcher": FLETCHER,
    "ubx": UBX,
}

REQUESTS: dict[str, list[Request]] = {
    "sagitta": [
        Request(TC, 6, bytes(range(16)), message_class="set"),
        Request(TLM, 6, message_class="get"),
        Request(TLM, 24, message_class="telemetry"),
        Request(TC, 14, b"\xc0\xdb\xdc\xdd\xc0\xc0\xdb\xdb", message_class="action"),
    ],
    "nos3": [
        Request(TC, 0, b"\xde\xad\xbe\xef", message_class="command"),
        Request(TLM, 1, bytes(4), message_class="telemetry"),
        Request(TLM, 2, b"\0\0\0\x07", message_class="telemetry"),
    ],
    "nsp": [Request(TLM, 0, source=0x11), Request(TC, 1, b"\0\x20\0\0", source=0x12)],
    "length": [Request(TC, 3, b"\xaa\x55", sequence=7), Request(TLM, 200, sequence=255)],
    "dle": [Request(TC, 3, b"\x10\x10"), Request(TLM, 16)],
    "hdlc": [Request(TC, 3, b"\x7e\x7d"), Request(TLM, 126)],
    "text": [Request(TC, 3, b"\r\n"), Request(TLM, 200)],
    **{name: [Request(TC, 3, b"\xfe\x01"), Request(TLM, 200)] for name in ("xor16", "fletcher", "ubx")},
}

REPLIES: dict[str, list[Reply]] = {
    "sagitta": [
        Reply(ReplyKind.ACK, 6, message_class="set"),
        Reply(ReplyKind.NACK, 6, code=ErrorCode.INVALID_PARAMETER, message_class="set"),
        Reply(ReplyKind.TELEMETRY, 6, b"\xc0" * 16, message_class="get"),
        Reply(
            ReplyKind.TELEMETRY,
            24,
            b"\xdb" * 67,
            message_class="telemetry",
            uptime_ns=12_000_000,
            time_ns=1_700_000_000_123_456_000,
        ),
        Reply(ReplyKind.UNSOLICITED, 24, bytes(67), message_class="telemetry", time_ns=1_000),
    ],
    "nsp": [
        Reply(ReplyKind.TELEMETRY, 0, b"ST-16\xc0\xdb!", destination=0x11),
        Reply(ReplyKind.ACK, 1, destination=0x11),
        Reply(ReplyKind.NACK, 1, destination=0x11),
        Reply(ReplyKind.TELEMETRY, 18, bytes(9), destination=0x11, final=False),
    ],
    "length": [Reply(ReplyKind.ACK, 3, sequence=7), Reply(ReplyKind.TELEMETRY, 200, b"\xaa\x55" * 3)],
    "dle": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 16, b"\x10\x03" * 3)],
    "hdlc": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 126, b"\x7e\x7d" * 3)],
    "text": [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 200, b"\r\n$$\r\n")],
    **{
        name: [Reply(ReplyKind.ACK, 3), Reply(ReplyKind.TELEMETRY, 200, b"\xff\x01\x02\xfe\x80\xff")]
        for name in ("xor16", "fletcher", "ubx")
    },
}

ALL_REQUESTS = [(name, request) for name, requests in REQUESTS.items() for request in requests]
ALL_REPLIES = [(name, reply) for name, replies in REPLIES.items() for reply in replies]


def faults(events: list[Any]) -> list[FaultKind]:
    assert all(isinstance(event, LinkFault) for event in events), events
    return [event.kind for event in events]


def counted(includes: list[str], covers: list[str], start: list[int]) -> SerialStack:
    header = [{"role": "length", "type": "u8", "includes": includes}, {"role": "id", "type": "u8"}]
    return stack_of(
        {
            "framing": {"kind": "length", "start": start, "end": [0x0A]},
            "check": {"kind": "xor", "covers": covers},
            "request_header": header,
            "reply_header": header,
        }
    )
