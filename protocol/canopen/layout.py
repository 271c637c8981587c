"""The layout of the interface definition in the object dictionary: its table `[canopen]`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.values import IcdError

Index = Annotated[int, Field(ge=0x2000, le=0xFFFF)]
PackedType = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u48"]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PackedField(_Model):
    """A field of a telemetry row as a narrower integer."""

    source: str = Field(alias="from")
    """ROW.FIELD; a bit selects the whole byte that contains it."""
    name: str | None = None
    """Name in the record; the field's name by default."""
    type: PackedType
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Physical = raw * scale."""
    wrap: bool = False
    """Keep the lowest bits of a counter instead of clipping it."""


class PlacedMember(_Model):
    """One entry of a record: a field to read, a telecommand to write, or both; a parameter; or a file that is never there."""

    subindex: Annotated[int, Field(ge=1, le=254)] | None = None
    """One more than that of the entry before unless given."""
    name: str
    value: str | None = None
    telecommand: str | None = None
    parameter: str | None = None
    domain: Literal["ro", "wo"] | None = None
    """A DOMAIN that never has data: reading and writing it are refused for that."""

    @model_validator(mode="after")
    def _one_kind(self) -> PlacedMember:
        row = self.value is not None or self.telecommand is not None
        if row + (self.parameter is not None) + (self.domain is not None) != 1:
            raise ValueError("needs value and/or telecommand, or parameter, or domain")
        return self


class PlacedObject(_Model):
    """One object of the application and its content."""

    index: Index
    name: str
    requests: bool = False
    telemetry: str | None = None
    """Record of the row's fields; with a telecommand that it includes, each of them sets this one and keeps the others."""
    value: str | None = None
    telecommand: str | None = None
    type: Literal["u8", "u16", "u32", "u64"] | None = None
    """Number that holds all bytes of the telecommand, so that a PDO can carry it."""
    parameters: bool = False
    image: Literal["frame", "stored"] | None = None
    packed: list[PackedField] = []
    members: list[PlacedMember] = []

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
        if self.type is not None and (
            self.telecommand is None or self.value is not None or self.telemetry is not None
        ):
            raise ValueError("`type` is for a telecommand alone")
        return self


class PdoModel(_Model):
    """Default configuration of a PDO."""

    name: str
    enabled: bool = False
    can_id: Annotated[int, Field(ge=0x181, le=0x57F)] | None = None
    """CAN ID, to which the node-ID is added; the predefined one of the first four PDOs unless given."""
    relative: bool = True
    """Whether the node-ID is added to `can_id`."""
    transmission_type: Annotated[int, Field(ge=0, le=255)] = 255
    inhibit_ms: Annotated[float, Field(ge=0, le=6553.5)] = 0
    event_ms: Annotated[int, Field(ge=0, le=0xFFFF)] = 0
    objects: list[str] = []


class CanopenModel(_Model):
    """Content of the table `canopen`."""

    device_type: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    device_name: str
    vendor_name: str
    vendor_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    product_code: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    revision: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    bit_rates: list[int] = Field(min_length=1)
    object: list[PlacedObject] = Field(min_length=1)
    tpdo: list[PdoModel] = []
    rpdo: list[PdoModel] = []


def read_layout(icd: InterfaceDefinition) -> CanopenModel:
    """Return the layout of the interface definition in the object dictionary.

    Raises
    ------
    IcdError
        The definition has none, or it is invalid; the text names file and key.
    """
    table = icd.canopen
    if table is None:
        raise IcdError(f"unit {icd.name}: has no CANopen: its definition lacks the table [canopen]")
    try:
        return CanopenModel.model_validate(table.document)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(step) for step in ("canopen", *first["loc"]))
        raise IcdError(f"{table.file}: {key}: {first['msg']}") from None
