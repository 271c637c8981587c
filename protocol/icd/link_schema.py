"""Keys of `[[class]]`, `[link.serial]` and `[link.can]` in a unit's definition.

A serial message consists of header, data and checksum; the framing marks where it begins and ends. The header
is a list of fields by role; the checksum covers header and data unless `covers` lists other parts.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Annotated, Literal

from pydantic import Field, WithJsonSchema

from starhil.protocol.icd.conventions import Order
from starhil.protocol.icd.values import HEX, SCALAR_SIZES, DefinitionModel, Name
from starhil.protocol.messages import DEFAULT_TIMEOUT_S, RequestKind

Code = Annotated[int, Field(ge=0, le=0xFFFF, json_schema_extra=HEX)]
Byte = Annotated[int, Field(ge=0, le=0xFF, json_schema_extra=HEX)]
CheckType = Literal["u8", "u16", "u32", "u64"]
HeaderType = Literal[
    "u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u64", "i64", "bits8", "bits16", "bits32"
]
CoveredPart = Literal["start", "header", "data"]
SizedPart = Literal["start", "header", "data", "check", "end"]
LineText = Annotated[str, Field(min_length=1, max_length=200, pattern="^[!-~]([ -~]*[!-~])?$")]
"""Printable ASCII without spaces at its ends."""
Role = Literal[
    "address", "source", "destination", "class", "id", "sequence", "length",
    "status", "ack", "final", "poll", "flags", "ticks", "time",
]  # fmt: skip
"""Meaning of a header field; described in `HeaderFieldModel`."""
CountedMessage = Literal["reply", "unsolicited"]


class MessageClass(DefinitionModel):
    """A class of rows, with its codes in a message."""

    name: Name
    """Name that rows refer to."""
    kind: Annotated[RequestKind, Field(strict=False), WithJsonSchema({"enum": ["telecommand", "telemetry"]})]
    """Kind of its rows."""
    code: Code | None = None
    """Code in a request."""
    reply: Code | None = None
    """Code in a reply; default: `code`."""
    unsolicited: Code | None = None
    """Code in unsolicited telemetry; default: `reply`."""
    answer: list[str] | None = None
    """Answers of its rows, in order: `echo`, `reply`, `row:NAME`; default: `["reply"]`."""

    @property
    def reply_code(self) -> int | None:
        return self.code if self.reply is None else self.reply

    @property
    def unsolicited_code(self) -> int | None:
        return self.reply_code if self.unsolicited is None else self.unsolicited


class CubeSpaceFraming(DefinitionModel):
    """The CubeSpace family's framing with its three reply dialects, without header and checksum."""

    kind: Literal["cubespace"]
    """Selects this framing."""
    dialect: Literal["a", "b", "c"] | None = None
    """Dialect of the unit; default: selected by the parameter `serial_dialect`."""
    unanswered: list[str] = []
    """Telecommands to which the serial line has no reply, whether accepted or rejected."""


class EscapedFraming(DefinitionModel):
    """`escape start … escape end`, with escape bytes in between doubled (DLE framing)."""

    kind: Literal["escaped"]
    """Selects this framing."""
    escape: Byte = 0x10
    """Byte before `start` and `end`, doubled inside a message."""
    start: Byte = 0x02
    """Byte that begins a message, after `escape`."""
    end: Byte = 0x03
    """Byte that ends a message, after `escape`."""


class SlipFraming(DefinitionModel):
    """Messages between `end` bytes; `end` and `escape` inside a message are escaped (RFC 1055)."""

    kind: Literal["slip"]
    """Selects this framing."""
    end: Byte = 0xC0
    """Byte after a message, and before it with `leading_end`."""
    escape: Byte = 0xDB
    """Byte before an escaped byte."""
    substitutes: Annotated[list[Byte], Field(min_length=2, max_length=2)] | None = None
    """Escaped forms of `end` and `escape`; default without `xor`: `[0xDC, 0xDD]`."""
    xor: Byte | None = None
    """XOR mask applied to an escaped byte, instead of `substitutes` (HDLC: end 0x7E, escape 0x7D, xor
    0x20)."""
    leading_end: bool = True
    """Whether an `end` byte also precedes each message."""

    @property
    def escaped(self) -> tuple[int, int]:
        """Bytes that follow an escape byte instead of `end` and `escape`."""
        if self.xor is not None:
            return self.end ^ self.xor, self.escape ^ self.xor
        first, second = self.substitutes or (0xDC, 0xDD)
        return first, second


class ByteStuffing(DefinitionModel):
    """Bytes of a range are sent as two: with `{ escape = 0xF0, mask = 0x0F }`, F3 is sent as F0 03."""

    escape: Byte
    """First byte of the range, and the byte sent before each stuffed byte."""
    mask: Byte
    """Bits in which the bytes of the range differ; only they are sent after `escape`."""


class _SizedFraming(DefinitionModel):
    kind: str
    """Selects this framing."""
    start: list[Byte] = []
    """Bytes before the header."""
    end: list[Byte] = []
    """Bytes after the checksum."""
    stuffing: ByteStuffing | None = None
    """Byte stuffing between `start` and `end`; sizes and checksums are those of the message before it."""


class LengthFraming(_SizedFraming):
    """`start`, a message whose header field `length` gives its size, then `end`."""

    kind: Literal["length"]


class FixedFraming(_SizedFraming):
    """`start`, a message of the size that its row has, then `end`."""

    kind: Literal["fixed"]
    request_size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Bytes between `start` and `end` if all requests have the same size."""


class DelimitedFraming(DefinitionModel):
    """`start`, a message that must not contain the bytes of `end`, then `end`."""

    kind: Literal["delimited"]
    """Selects this framing."""
    start: list[Byte] = []
    """Bytes before the header."""
    end: Annotated[list[Byte], Field(min_length=1)]
    """Bytes after the checksum."""
    encoding: Literal["binary", "hex"] = "binary"
    """`binary`: raw bytes; `hex`: two hexadecimal digits per byte."""


class CustomFraming(DefinitionModel):
    """A framing of the unit's plugin."""

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


class _CheckModel(DefinitionModel):
    order: Order | None = None
    """Byte order of the checksum; default: the unit's."""
    covers: Annotated[list[CoveredPart], Field(min_length=1)] = ["header", "data"]
    """Parts of the message that the checksum covers."""


class NoCheck(DefinitionModel):
    """No checksum."""

    kind: Literal["none"]
    """Selects this check."""


class SumCheck(_CheckModel):
    """Sum of the bytes."""

    kind: Literal["sum"]
    """Selects this check."""
    type: CheckType = "u8"
    """Width of the sum."""
    complement: Literal["none", "ones", "twos"] = "none"
    """Whether the ones' or two's complement of the sum is sent."""


class XorCheck(_CheckModel):
    """XOR of the bytes, or of words of two bytes."""

    kind: Literal["xor"]
    """Selects this check."""
    type: Literal["u8", "u16"] = "u8"
    """Width: a byte, or a word in the byte order of the checksum. A zero completes an odd number of bytes."""
    init: Code = 0
    """Initial value."""


class FletcherCheck(_CheckModel):
    """Fletcher's checksum of two bytes: the lower is the sum of the bytes, the upper the sum of these sums."""

    kind: Literal["fletcher16"]
    """Selects this check."""
    modulus: Literal[255, 256] = 255
    """Number below which both sums stay: 255, or 256 as in RFC 1146 and UBX."""


class CrcCheck(_CheckModel):
    """CRC with the parameters of the Rocksoft model, as listed in CRC catalogues."""

    kind: Literal["crc"]
    """Selects this check."""
    type: CheckType
    """Width of the CRC."""
    poly: Annotated[int, Field(ge=1, json_schema_extra=HEX)]
    """Polynomial in normal (not reversed) notation, without the highest term."""
    init: Annotated[int, Field(ge=0, json_schema_extra=HEX)] = 0
    """Initial value."""
    reflect: bool = False
    """Reflect input and output (refin = refout)."""
    xor: Annotated[int, Field(ge=0, json_schema_extra=HEX)] = 0
    """Final XOR value (xorout)."""


class XxHashCheck(_CheckModel):
    """XXH32 hash."""

    kind: Literal["xxh32"]
    """Selects this check."""
    seed: Annotated[int, Field(ge=0, le=0xFFFFFFFF, json_schema_extra=HEX)] = 0
    """Seed."""


class CustomCheck(_CheckModel):
    """A checksum of the unit's plugin."""

    kind: Literal["custom"]
    """Selects this check."""
    name: str
    """Name in `@check`."""


CheckModel = Annotated[
    NoCheck | SumCheck | XorCheck | FletcherCheck | CrcCheck | XxHashCheck | CustomCheck,
    Field(discriminator="kind"),
]


class HeaderBitModel(DefinitionModel):
    """One bit or group of bits of a header field."""

    role: Role | None = None
    """Meaning; none: a constant."""
    width: Annotated[int, Field(ge=1, le=32)] = 1
    """Width in bits."""
    const: Annotated[int, Field(ge=0)] | None = None
    """Value that is sent, and required on reception."""
    default: Annotated[int, Field(ge=0)] | None = None
    """Value that is sent if the message sets none; not checked on reception, except for an address."""
    counts: list[CountedMessage] = []
    """Messages that a `sequence` numbers, beginning with 0 after a start, instead of repeating a request's number."""

    @property
    def initial(self) -> int:
        """Value that is sent if the message sets none."""
        return self.const if self.const is not None else self.default or 0

    @property
    def mask(self) -> int:
        """Highest value."""
        return (1 << self.width) - 1


class HeaderFieldModel(DefinitionModel):
    """One field of a header.

    Roles: `address` is the address of the device, in both directions; `source` (in a request) and `destination` (in a
    reply) are the address of the OBC. `class`, `id` and `status` are the codes of class, row and error. `length` is the
    number of bytes of the parts in `includes`, plus `offset`. `ack` is 0 in a refusal, otherwise 1; `final` is 1 in the
    last reply to a request. A request with `poll` 0 is executed and not answered; its `default` is 1. A reply repeats
    the `sequence` and `flags` of its request. `ticks` is the time since start, `time` the time of the unit's clock.
    """

    role: Role | None = None
    """Meaning; none: a constant."""
    type: HeaderType
    """Type on the wire; `bits8`, `bits16` and `bits32` need `bits`."""
    const: int | None = None
    """Value that is sent, and required on reception."""
    default: int | None = None
    """Value that is sent if the message sets none; not checked on reception, except for an address."""
    counts: list[CountedMessage] = []
    """Messages that a `sequence` numbers, beginning with 0 after a start, instead of repeating a request's number."""
    order: Order | None = None
    """Byte order; default: the unit's."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Seconds per count of `ticks` or `time`."""
    includes: list[SizedPart] = ["data"]
    """Parts of the message that a `length` counts; `header` includes the length field itself."""
    offset: int = 0
    """Number added to a `length` (CCSDS packets: -1)."""
    classes: list[str] | None = None
    """Classes whose messages have the field; default: all."""
    bits: list[HeaderBitModel] = []
    """Bits, lowest first."""

    @property
    def initial(self) -> int:
        """Value that is sent if the message sets none."""
        return self.const if self.const is not None else self.default or 0

    @property
    def size(self) -> int:
        """Number of bytes."""
        return SCALAR_SIZES[self.type.replace("bits", "u")]

    @property
    def placed_bits(self) -> list[tuple[HeaderBitModel, int]]:
        """The bits, each with its shift."""
        shifts = accumulate((bit.width for bit in self.bits), initial=0)
        return list(zip(self.bits, shifts, strict=False))

    @property
    def by_role(self) -> dict[str, HeaderFieldModel | HeaderBitModel]:
        """The field and its bits by role, those without left out."""
        parts: list[HeaderFieldModel | HeaderBitModel] = [self, *self.bits]
        return {part.role: part for part in parts if part.role}

    def in_class(self, message_class: str) -> bool:
        return self.classes is None or message_class in self.classes


class FormatModel(DefinitionModel):
    """Another framing or checksum for the messages of a direction, or of some classes.

    The first format that fits a message applies. If several remain in a direction, messages are distinguished by their first
    byte: each has another `start`, and at most one has none.
    """

    direction: Literal["request", "reply"] | None = None
    """`request`, `reply`; default: both."""
    classes: Annotated[list[str], Field(min_length=1)] | None = None
    """Classes whose messages have the format; default: all others."""
    framing: FramingModel | None = None
    """Framing; default: the link's."""
    check: CheckModel | None = None
    """Checksum; default: the link's."""


class SerialLinkModel(DefinitionModel):
    """The serial line."""

    baud: Annotated[int, Field(ge=300)] = 115200
    """Bit rate."""
    framing: FramingModel
    """Marks where a message begins and ends."""
    check: CheckModel = NoCheck(kind="none")
    """Checksum."""
    request_header: list[HeaderFieldModel] = []
    """Fields before the data of a request."""
    reply_header: list[HeaderFieldModel] = []
    """Fields before the data of a reply."""
    format: list[FormatModel] = []
    """Messages with another framing or checksum."""
    acknowledge: LineText | None = None
    """Text that acknowledges a telecommand, instead of header and data."""
    refusal: LineText | None = None
    """Text that refuses any request, instead of header and data; `{code}` is the error's number."""
    max_size: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Longest message that a receiver accepts, in bytes; default: 512, or more if a row is longer."""
    timeout: Annotated[float, Field(gt=0)] = DEFAULT_TIMEOUT_S
    """Silence after which an incomplete message is discarded, in seconds."""


class CubeSpaceCanModel(DefinitionModel):
    """CAN with the CubeSpace family's CAN ID layout and segmentation."""

    kind: Literal["cubespace"]
    """CAN ID layout and segmentation."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """Bit rate."""


class LinkModel(DefinitionModel):
    """`[link]`: the links that a unit has."""

    serial: SerialLinkModel | None = None
    can: CubeSpaceCanModel | None = None
