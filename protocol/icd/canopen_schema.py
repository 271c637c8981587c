"""Keys of `[canopen]`: the layout of the object dictionary; `canopen.device_dictionary` builds it."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from starhil.protocol.icd.values import HEX, DefinitionModel

OS_OBJECTS: Final = range(0x1023, 0x1026)
"""Objects of the communication profile that a unit may define: OS command, its mode, debugger (CiA 301)."""


def _index(index: int) -> int:
    if index < 0x2000 and index not in OS_OBJECTS:
        raise ValueError("must be at least 2000h, or 1023h to 1025h")
    return index


Index = Annotated[int, Field(ge=0x1023, le=0xFFFF, json_schema_extra=HEX), AfterValidator(_index)]
Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF, json_schema_extra=HEX)]
PackedType = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u48"]


class PackedField(DefinitionModel):
    """A telemetry field as a narrower integer."""

    source: str = Field(alias="from")
    """`ROW.FIELD`; a bit selects the whole bit field that contains it."""
    name: str | None = None
    """Name in the record; default: the name of the field."""
    type: PackedType
    """Type of the entry."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Physical = raw × scale."""
    wrap: bool = False
    """Whether an out-of-range value is sent modulo the range (a counter) instead of as the nearest limit."""


class PlacedMember(DefinitionModel):
    """An entry of a record: give `parameter`, `domain`, or one or both of `value` and `telecommand`."""

    subindex: Annotated[int, Field(ge=1, le=254)] | None = None
    """Sub-index; default: the next one."""
    name: str
    """Name of the entry."""
    value: str | None = None
    """`ROW.FIELD` of the telemetry field that is read."""
    telecommand: str | None = None
    """Telecommand that a write executes."""
    parameter: str | None = None
    """Parameter that is read and set."""
    domain: Literal["ro", "wo"] | None = None
    """A DOMAIN that never has data, such as a missing file: access is refused with 0800 0024h."""

    @model_validator(mode="after")
    def _one_kind(self) -> PlacedMember:
        row = self.value is not None or self.telecommand is not None
        if row + (self.parameter is not None) + (self.domain is not None) != 1:
            raise ValueError("needs value and/or telecommand, or parameter, or domain")
        return self


class PlacedObject(DefinitionModel):
    """An application object.

    The keys after `name`, except `type`, define its content. Give one of them, or `telecommand` with
    `value` or `telemetry`.
    """

    index: Index
    """Index in the object dictionary."""
    name: str
    """Name of the object."""
    requests: bool = False
    """A record of all rows, with the ID as sub-index: read a telemetry row, write a telecommand."""
    telemetry: str | None = None
    """A record of the fields of a telemetry row. With `telecommand`, which the row must include, a write to
    one field executes the telecommand with the other fields unchanged. With `type`, the row is a single entry."""
    value: str | None = None
    """A telemetry field to read, as `ROW.FIELD`."""
    telecommand: str | None = None
    """A telecommand, which a write executes."""
    type: Literal["u8", "u16", "u32", "u64"] | None = None
    """Integer type that holds all data of the telecommand, the telemetry row or both, so that a PDO can carry it."""
    parameters: bool = False
    """A record of all parameters, with the ID as sub-index."""
    image: Literal["frame", "stored"] | None = None
    """A record of the last frame or the stored image: pixels (DOMAIN), width, height, frame counter."""
    packed: list[PackedField] = []
    """A record of telemetry fields in narrower types."""
    members: list[PlacedMember] = []
    """A record of the listed entries."""

    @model_validator(mode="after")
    def _one_kind(self) -> PlacedObject:
        kinds = [
            bool(self.requests),
            self.telemetry is not None,
            self.telemetry is None and (self.value is not None or self.telecommand is not None),
            self.parameters,
            self.image is not None,
            bool(self.packed),
            bool(self.members),
        ]
        if sum(kinds) != 1:
            raise ValueError(
                "needs exactly one of requests, telemetry, value and/or telecommand, parameters, image, packed, "
                "members"
            )
        if self.type is not None and (self.value is not None or self.telecommand is self.telemetry is None):
            raise ValueError("`type` is only for a telecommand or a telemetry row")
        return self


class PdoModel(DefinitionModel):
    """Default configuration of a PDO."""

    name: str
    """Name of the PDO."""
    enabled: bool = False
    """Whether the PDO is enabled."""
    can_id: Annotated[int, Field(ge=0x181, le=0x57F, json_schema_extra=HEX)] | None = None
    """CAN ID; the first four PDOs have a predefined default."""
    relative: bool = True
    """Whether the node ID is added to `can_id`."""
    transmission_type: Annotated[int, Field(ge=0, le=255)] = 255
    """Transmission type (CiA 301)."""
    inhibit_ms: Annotated[float, Field(ge=0, le=6553.5)] = 0
    """Inhibit time in milliseconds."""
    event_ms: Annotated[int, Field(ge=0, le=0xFFFF)] = 0
    """Event timer in milliseconds; 0: off."""
    objects: list[str] = []
    """Mapped entries, as `INDEX.NAME` or `INDEX` in hexadecimal digits."""


class CanopenModel(DefinitionModel):
    """The CANopen node: its identity and the content of its object dictionary."""

    device_type: Unsigned32
    """Object 1000h."""
    device_name: str
    """Object 1008h."""
    vendor_name: str
    """Vendor in the EDS."""
    vendor_id: Unsigned32
    """Object 1018h, sub-index 1."""
    product_code: Unsigned32
    """Object 1018h, sub-index 2."""
    revision: Unsigned32
    """Object 1018h, sub-index 3."""
    sdo_client: Annotated[int, Field(ge=1, le=127)] | None = None
    """Object 1200h, sub-index 3: node ID of the client; none: the object has no such sub-index."""
    bit_rates: list[int] = Field(min_length=1)
    """Supported bit rates, in bit/s."""
    object: list[PlacedObject] = Field(min_length=1)
    """Application objects: `[[canopen.object]]`."""
    tpdo: list[PdoModel] = []
    """Transmit PDOs: `[[canopen.tpdo]]`."""
    rpdo: list[PdoModel] = []
    """Receive PDOs: `[[canopen.rpdo]]`."""
