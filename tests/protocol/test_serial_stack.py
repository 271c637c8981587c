"""The serial link that a definition describes: the CubeSpace family keeps its codec."""

from __future__ import annotations

from starhil.protocol.cubespace_serial import CubeSpaceStack
from starhil.protocol.link_schema import SerialLinkModel
from starhil.protocol.messages import Reply, ReplyKind, Request
from starhil.protocol.serial_interface import Dialect, SerialStack
from starhil.protocol.serial_stack import build_stack


def test_cubespace_keeps_its_codec_and_dialects() -> None:
    stack: SerialStack = build_stack(SerialLinkModel.model_validate({"framing": {"kind": "cubespace"}}))
    assert isinstance(stack, CubeSpaceStack)
    assert stack.encode_request(Request.of(128)).hex().upper() == "1F7F801FFF"
    reply = Reply(ReplyKind.TELEMETRY, 128, b"\x01")
    assert [stack.encode_reply(reply, dialect).hex() for dialect in Dialect] == [
        "1f7f80011fff",
        "1f7f011fff",
        "1f0780011fff",
    ]
    assert stack.supports_unsolicited(Dialect.C)
    assert not stack.supports_unsolicited(Dialect.A)
