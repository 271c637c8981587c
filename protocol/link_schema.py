"""Schema of `[link.serial]` in a unit's definition: framing, check and header of a serial link, as data.

A message on the line is `header data check`, put between bytes by the framing. The header is a list of fields by role;
the check covers the header and the data unless `covers` says otherwise.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from starhil.protocol.messages import DEFAULT_TIMEOUT_S

Byte = Annotated[int, Field(ge=0, le=0xFF)]
Order = Literal["little", "big"]
CheckType = Literal["u8", "u16", "u32", "u64"]
HeaderType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "bits8", "bits16", "bits32"]
CoveredPart = Literal["start", "header", "data"]
SizedPart = Literal["start", "header", "data", "check", "end"]
Role = Literal[
    "address", "source", "destination", "class", "id", "sequence", "length",
    "status", "ack", "final", "flags", "ticks", "time",
]  # fmt: skip
"""Meaning of a header field.

`address` is that of the device, in both directions; `source` (of a request) and `destination` (of a reply) are that of
the OBC. `ack` is 1 unless the request is refused, `final` is 1 in the last reply to a request.
"""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class CubeSpaceFraming(_Model):
    """Framing of the CubeSpace family with its three reply dialects; it has no header and no check."""

    kind: Literal["cubespace"]
    """Selects this framing."""
    dialect: Literal["a", "b", "c"] | None = None
    """The only dialect of the unit; that of the parameter `serial_dialect` unless given."""


class EscapedFraming(_Model):
    """`escape start … escape end`, with every escape byte within doubled (DLE framing)."""

    kind: Literal["escaped"]
    """Selects this framing."""
    escape: Byte = 0x10
    """Byte that marks start and end; doubled where it occurs within."""
    start: Byte = 0x02
    """Byte after the escape byte that begins a message."""
    end: Byte = 0x03
    """Byte after the escape byte that ends a message."""


class SlipFraming(_Model):
    """Frames between `end` bytes, in which `end` and `escape` are substituted (RFC 1055)."""

    kind: Literal["slip"]
    """Selects this framing."""
    end: Byte = 0xC0
    """Byte before and after a frame."""
    escape: Byte = 0xDB
    """Byte before a substituted one."""
    substitutes: tuple[Byte, Byte] | None = None
    """Bytes that stand for `end` and `escape` after an escape byte; DC and DD unless `xor` is given."""
    xor: Byte | None = None
    """After an escape byte follows the substituted byte XOR this (asynchronous HDLC: end 7E, escape 7D, xor 20)."""
    leading_end: bool = True
    """Whether an `end` byte is sent before each frame too."""

    @property
    def escaped(self) -> tuple[int, int]:
        """Bytes that follow an escape byte in place of `end` and `escape`."""
        if self.xor is not None:
            return self.end ^ self.xor, self.escape ^ self.xor
        return self.substitutes or (0xDC, 0xDD)


class LengthFraming(_Model):
    """`start`, then as many bytes as the header's `length` field says, then `end`."""

    kind: Literal["length"]
    """Selects this framing."""
    start: list[Byte] = []
    """Bytes before the header."""
    end: list[Byte] = []
    """Bytes after the check."""


class FixedFraming(_Model):
    """`start`, then a message whose size follows from its row, then `end`."""

    kind: Literal["fixed"]
    """Selects this framing."""
    start: list[Byte] = []
    """Bytes before the header."""
    end: list[Byte] = []
    """Bytes after the check."""
    request_size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Bytes of every request between `start` and `end`, where they are all alike."""


class DelimitedFraming(_Model):
    """`start`, then the message up to `end`, which cannot occur in it; in `hex` each byte is two digits."""

    kind: Literal["delimited"]
    """Selects this framing."""
    start: list[Byte] = []
    """Bytes before the header."""
    end: Annotated[list[Byte], Field(min_length=1)]
    """Bytes after the check."""
    encoding: Literal["binary", "hex"] = "binary"
    """Bytes as they are, or two hexadecimal digits for each."""


class CustomFraming(_Model):
    """A framing from the unit's plugin."""

    kind: Literal["custom"]
    """Selects this framing."""
    name: str
    """Name in `@framing`."""


FramingModel = Annotated[
    CubeSpaceFraming
    | EscapedFraming
    | SlipFraming
    | LengthFraming
    | FixedFraming
    | DelimitedFraming
    | CustomFraming,
    Field(discriminator="kind"),
]


class _CheckModel(_Model):
    order: Order | None = None
    """Byte order of the check; that of the unit unless given."""
    covers: Annotated[list[CoveredPart], Field(min_length=1)] = ["header", "data"]
    """Parts over which the check is computed: `start`, `header`, `data`."""


class NoCheck(_Model):
    """No check."""

    kind: Literal["none"]
    """Selects this check."""


class SumCheck(_CheckModel):
    """Sum of the bytes, or its ones' or two's complement."""

    kind: Literal["sum"]
    """Selects this check."""
    type: CheckType = "u8"
    """Width of the sum."""
    complement: Literal["none", "ones", "twos"] = "none"
    """What is sent instead of the sum itself."""


class XorCheck(_CheckModel):
    """XOR of the bytes."""

    kind: Literal["xor"]
    """Selects this check."""
    init: Byte = 0
    """Value before the first byte."""


class CrcCheck(_CheckModel):
    """Cyclic redundancy check in the parameters of the CRC catalogue (`poly` in normal notation)."""

    kind: Literal["crc"]
    """Selects this check."""
    type: CheckType
    """Width of the register."""
    poly: Annotated[int, Field(ge=1)]
    """Polynomial, without its highest term."""
    init: Annotated[int, Field(ge=0)] = 0
    """Register before the first byte."""
    reflect: bool = False
    """Whether bytes enter and the register leaves lowest bit first."""
    xor: Annotated[int, Field(ge=0)] = 0
    """What the register is combined with at the end."""


class XxHashCheck(_CheckModel):
    """XXH32 with a seed."""

    kind: Literal["xxh32"]
    """Selects this check."""
    seed: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] = 0
    """Seed of the hash."""


class CustomCheck(_CheckModel):
    """A check from the unit's plugin."""

    kind: Literal["custom"]
    """Selects this check."""
    name: str
    """Name in `@check`."""


CheckModel = Annotated[
    NoCheck | SumCheck | XorCheck | CrcCheck | XxHashCheck | CustomCheck, Field(discriminator="kind")
]


class HeaderBitModel(_Model):
    """One bit or a group of bits of a header field, lowest first."""

    role: Role | None = None
    """Meaning, as of a field."""
    width: Annotated[int, Field(ge=1, le=32)] = 1
    """Bits."""
    const: Annotated[int, Field(ge=0)] | None = None
    """Value that is sent and required."""
    default: Annotated[int, Field(ge=0)] | None = None
    """Value that is sent where the message has none, and not required."""


class HeaderFieldModel(_Model):
    """One field of a header.

    `address` is that of the device, in both directions; `source` (of a request) and `destination` (of a reply) are that of the
    OBC. `ack` is 1 unless the request is refused, `final` is 1 in the last reply to a request; `flags` and `sequence` are
    repeated in the reply.
    """

    role: Role | None = None
    """Meaning; none for a constant."""
    type: HeaderType
    """Type; `bits8` … have `bits`."""
    const: int | None = None
    """Value that is sent and required."""
    default: int | None = None
    """Value that is sent where the message has none (an address, a flag), and not required."""
    order: Order | None = None
    """Byte order; that of the unit unless given."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Seconds a count, of `ticks` and `time`."""
    includes: list[SizedPart] = ["data"]
    """What a `length` counts: `start`, `header`, `data`, `check`, `end`."""
    classes: list[str] | None = None
    """Classes whose messages have the field; all unless given."""
    bits: list[HeaderBitModel] = []
    """Bits, the lowest first."""


class SerialLinkModel(_Model):
    """The serial line: a message is `header data check`, put between bytes by the framing."""

    baud: Annotated[int, Field(ge=300)] = 115200
    """Bit rate."""
    framing: FramingModel
    """Where a message begins and ends."""
    check: CheckModel = NoCheck(kind="none")
    """What protects a message."""
    request_header: list[HeaderFieldModel] = []
    """Fields before the data of a request."""
    reply_header: list[HeaderFieldModel] = []
    """Fields before the data of a reply."""
    max_size: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Longest message in bytes that a receiver accepts; 512, or the longest row, unless given."""
    timeout: Annotated[float, Field(gt=0)] = DEFAULT_TIMEOUT_S
    """Silence within a message after which it is abandoned, seconds."""


class CubeSpaceCanModel(_Model):
    """CAN with the CAN IDs and segments of the CubeSpace family."""

    kind: Literal["cubespace"]
    """Layout of CAN IDs and segments."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """Bit rate of the bus."""


class LinkModel(_Model):
    """`[link]`: the links that a unit has."""

    serial: SerialLinkModel | None = None
    can: CubeSpaceCanModel | None = None
