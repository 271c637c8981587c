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


class PlacedObject(_Model):
    """One object of the application and its content."""

    index: Index
    name: str
    requests: bool = False
    telemetry: str | None = None
    value: str | None = None
    telecommand: str | None = None
    parameters: bool = False
    image: Literal["frame", "stored"] | None = None
    packed: list[PackedField] = []

    @model_validator(mode="after")
    def _one_kind(self) -> PlacedObject:
        kinds = [
            bool(self.requests),
            self.telemetry is not None,
            self.value is not None or self.telecommand is not None,
            self.parameters,
            self.image is not None,
            bool(self.packed),
        ]
        if sum(kinds) != 1:
            raise ValueError(
                "needs exactly one of requests, telemetry, value and/or telecommand, parameters, image, packed"
            )
        return self


class PdoModel(_Model):
    """Default configuration of a PDO."""

    name: str
    enabled: bool = False
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
