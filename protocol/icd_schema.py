"""Schema of interface definition files; it rejects unknown keys and wrong types."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
Provenance = Literal["confirmed", "proxy", "ours"]
ScalarType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]
FieldType = Literal[
    "u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64",
    "enum8", "enum16", "bits8", "bits16", "bits32", "bytes", "text",
]  # fmt: skip
ParameterType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32", "f64", "bool", "enum8"]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class DefinitionModel(_Model):
    """Header of a definition: its name, version and description."""

    name: str
    version: str
    doc: str


class EnumModel(_Model):
    """Names for numbers."""

    name: Name
    doc: str
    values: dict[Name, Annotated[int, Field(ge=0, le=0xFFFF)]] = Field(min_length=1)


class BitModel(_Model):
    """One bit or a group of bits; unused if it has no name."""

    name: Name | None = None
    width: Annotated[int, Field(ge=1, le=31)] = 1
    enum: str | None = None
    default: bool | int | str | None = None
    parameter: str | None = None
    doc: str = ""


class FieldModel(_Model):
    """One field of a row; unused and sent as zeros if it has no name."""

    name: Name | None = None
    count: Annotated[int, Field(ge=2, le=64)] | None = None
    """Expands to the fields name_1 … name_count."""
    type: FieldType
    size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Bytes of a `bytes` or `text` field."""
    unit: str = ""
    scale: Annotated[float, Field(gt=0)] = 1.0
    offset: float = 0.0
    min: float | None = None
    max: float | None = None
    default: bool | int | float | str | None = None
    enum: str | None = None
    bits: list[BitModel] = []
    parameter: str | None = None
    """Name of the parameter that the field sets or reports."""
    wrap: bool = False
    """Telemetry sends the lowest bits of a value beyond its range (a counter) instead of the
    nearest limit."""
    provenance: Provenance | None = None
    doc: str = ""


class RowModel(_Model):
    """A telecommand or telemetry row."""

    id: Annotated[int, Field(ge=0, le=255)]
    last_id: Annotated[int, Field(ge=0, le=255)] | None = None
    """Expands to the rows name_1 … for the ids id … last_id, all with the same layout."""
    name: Name
    doc: str
    provenance: Provenance
    source: str = ""
    size: Annotated[int, Field(ge=0, le=4096)]
    fields: list[FieldModel] | None = None
    include: list[str] | None = None
    """Names of rows whose fields this row concatenates, in order."""


class ParameterModel(_Model):
    """A parameter of the device."""

    id: Annotated[int, Field(ge=1, le=254)]
    name: Name
    type: ParameterType
    unit: str = ""
    min: float | None = None
    max: float | None = None
    default: bool | int | float | str
    enum: str | None = None
    doc: str


class SectionModel(_Model):
    """Documentation that accompanies the rows: paragraphs and a table."""

    heading: Annotated[str, Field(min_length=1)]
    paragraphs: list[str] = []
    columns: Annotated[list[str], Field(min_length=1)]
    rows: list[list[str]]


class FileModel(_Model):
    """One file of a definition."""

    definition: DefinitionModel | None = None
    enum: list[EnumModel] = []
    telecommand: list[RowModel] = []
    telemetry: list[RowModel] = []
    parameter: list[ParameterModel] = []
    section: list[SectionModel] = []
    canopen: dict[str, object] | None = None
    """The CANopen mapping, read by `starhil.protocol.canopen.layout`."""
