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
    dialect: Literal["a", "b", "c"] | None = None
    """The only dialect of the unit; that of the parameter `serial_dialect` unless given."""


class EscapedFraming(_Model):
    """`escape start … escape end`, with every escape byte within doubled (DLE framing)."""

    kind: Literal["escaped"]
    escape: Byte = 0x10
    start: Byte = 0x02
    end: Byte = 0x03


class SlipFraming(_Model):
    """Frames between `end` bytes, in which `end` and `escape` are substituted (RFC 1055)."""

    kind: Literal["slip"]
    end: Byte = 0xC0
    escape: Byte = 0xDB
    substitutes: tuple[Byte, Byte] | None = None
    """Bytes that stand for `end` and `escape` after an escape byte; DC and DD unless `xor` is given."""
    xor: Byte | None = None
    """After an escape byte follows the substituted byte XOR this (asynchronous HDLC: end 7E, escape 7D, xor 20)."""
    leading_end: bool = True
    """Whether an `end` byte is sent before each frame too."""


class LengthFraming(_Model):
    """`start`, then as many bytes as the header's `length` field says, then `end`."""

    kind: Literal["length"]
    start: list[Byte] = []
    end: list[Byte] = []


class FixedFraming(_Model):
    """`start`, then a message whose size follows from its row, then `end`."""

    kind: Literal["fixed"]
    start: list[Byte] = []
    end: list[Byte] = []
    request_size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Bytes of every request between `start` and `end`, where they are all alike."""


class DelimitedFraming(_Model):
    """`start`, then the message up to `end`, which cannot occur in it; in `hex` each byte is two digits."""

    kind: Literal["delimited"]
    start: list[Byte] = []
    end: Annotated[list[Byte], Field(min_length=1)]
    encoding: Literal["binary", "hex"] = "binary"


class CustomFraming(_Model):
    """A framing from the unit's plugin."""

    kind: Literal["custom"]
    name: str


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


class NoCheck(_Model):
    """No check."""

    kind: Literal["none"]


class SumCheck(_CheckModel):
    """Sum of the bytes, or its ones' or two's complement."""

    kind: Literal["sum"]
    type: CheckType = "u8"
    complement: Literal["none", "ones", "twos"] = "none"


class XorCheck(_CheckModel):
    """XOR of the bytes."""

    kind: Literal["xor"]
    init: Byte = 0


class CrcCheck(_CheckModel):
    """Cyclic redundancy check in the parameters of the CRC catalogue (`poly` in normal notation)."""

    kind: Literal["crc"]
    type: CheckType
    poly: Annotated[int, Field(ge=1)]
    init: Annotated[int, Field(ge=0)] = 0
    reflect: bool = False
    """Whether bytes enter and the register leaves lowest bit first."""
    xor: Annotated[int, Field(ge=0)] = 0


class XxHashCheck(_CheckModel):
    """XXH32 with a seed."""

    kind: Literal["xxh32"]
    seed: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] = 0


class CustomCheck(_CheckModel):
    """A check from the unit's plugin."""

    kind: Literal["custom"]
    name: str


CheckModel = Annotated[
    NoCheck | SumCheck | XorCheck | CrcCheck | XxHashCheck | CustomCheck, Field(discriminator="kind")
]


class HeaderBitModel(_Model):
    """One bit or a group of bits of a header field, lowest first."""

    role: Role | None = None
    width: Annotated[int, Field(ge=1, le=32)] = 1
    const: Annotated[int, Field(ge=0)] | None = None
    default: Annotated[int, Field(ge=0)] | None = None


class HeaderFieldModel(_Model):
    """One field of a header."""

    role: Role | None = None
    type: HeaderType
    const: int | None = None
    """Value that is sent and required."""
    default: int | None = None
    """Value that is sent where the message has none (an address, a flag), and not required."""
    order: Order | None = None
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Seconds a count, of `ticks` and `time`."""
    includes: list[SizedPart] = ["data"]
    """What a `length` counts."""
    classes: list[str] | None = None
    """Classes whose messages have the field; all unless given."""
    bits: list[HeaderBitModel] = []


class SerialLinkModel(_Model):
    """`[link.serial]`."""

    baud: Annotated[int, Field(ge=300)] = 115200
    framing: FramingModel
    check: CheckModel = NoCheck(kind="none")
    request_header: list[HeaderFieldModel] = []
    reply_header: list[HeaderFieldModel] = []
    max_size: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Longest message in bytes that a receiver accepts; 512, or the longest row, unless given."""
    timeout: Annotated[float, Field(gt=0)] = DEFAULT_TIMEOUT_S
    """Silence within a message after which it is abandoned, seconds."""


class CubeSpaceCanModel(_Model):
    """`[link.can]`: the CAN IDs and segments of the CubeSpace family."""

    kind: Literal["cubespace"]
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000


class LinkModel(_Model):
    """`[link]`: the links that a unit has."""

    serial: SerialLinkModel | None = None
    can: CubeSpaceCanModel | None = None
