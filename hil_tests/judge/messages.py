"""What the tester sends and what it understands of an answer, on any link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Value = bool | int | float | str | bytes
"""A physical value: a flag, a number in its unit, the name of a member of an enumeration, or raw bytes."""

PUBLISHED: Final = (
    "ok", "invalid_id", "invalid_length", "invalid_parameter", "crc", "not_implemented", "busy", "sequence", "internal",
    "passthrough_timeout", "passthrough_target",
)  # fmt: skip
"""Names of the published error codes 0 to 10 (AlbertaSat adcs_types.h; from 5 on libCubeObc)."""

FIRST_TELEMETRY: Final = 128
"""On CubeSpace links, IDs from this one on are telemetry (bit 7 of the ID, CTS adcs_types.h)."""
BURST_ID: Final = 119
"""ID of the packets of a file download (CubeComputer TC 119)."""
BURST_SIZE: Final = 22
"""Bytes of a packet: its number (u16) and 20 bytes of the file."""

AnswerKind = Literal["ack", "nack", "telemetry", "burst", "unsolicited", "malformed", "none"]


@dataclass(frozen=True)
class Request:
    """A telecommand with its data, or a request for telemetry; it need not belong to a row.

    `sequence` is its number where headers have one, which the answer repeats.
    """

    id: int
    data: bytes = b""
    message_class: str = ""
    telemetry: bool = False
    sequence: int = 0

    def __str__(self) -> str:
        return f"{self.message_class} {self.id}".strip()


@dataclass(frozen=True)
class Answer:
    """An answer of the unit.

    Attributes
    ----------
    kind
        Kind of answer: `none` if there was no answer in time, `malformed` if it could not be decoded.
    code
        Error code of a refusal.
    data
        Telemetry, or the malformed bytes.
    row_id, message_class
        Row in the answer; None and empty if the link does not name it.
    other
        CAN address to which it was sent; 0 on serial.
    final
        Whether it is the last message of the answer.
    time_s
        Time of the unit's clock in the header, s.
    body
        Header, data and check, without framing (serial).
    number
        Number that the unit gives its messages; None if it does not number such a message.
    fault
        What is wrong with a malformed answer, if its header can be read; of `none`, the answer that came too late.
    """

    kind: AnswerKind
    code: int = 0
    data: bytes = b""
    row_id: int | None = None
    message_class: str = ""
    other: int = 0
    final: bool = True
    time_s: float = 0.0
    body: bytes = b""
    number: int | None = None
    fault: str = ""

    def __str__(self) -> str:
        where = "" if self.row_id is None else f" of {self.message_class} {self.row_id}".replace("  ", " ")
        match self.kind:
            case "nack":
                return f"refusal{where} with code {self.code}"
            case "telemetry" | "burst" | "unsolicited":
                return f"{self.kind}{where}, {len(self.data)} bytes: {self.data[:24].hex(' ')}"
            case "malformed":
                what = f"malformed ({self.fault})" if self.fault else "malformed"
                return f"{what}, {len(self.data)} bytes: {self.data[:24].hex(' ')}"
            case _:
                return f"acknowledge{where}" if self.kind == "ack" else self.fault or "nothing"
