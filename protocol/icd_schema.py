"""Schema of the files of a unit's interface definition; it rejects unknown keys and wrong types."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from starhil.protocol.link_schema import LinkModel, Order

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
Provenance = Literal["confirmed", "proxy", "ours"]
FieldType = Literal[
    "u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64",
    "enum8", "enum16", "enum32", "bits8", "bits16", "bits32", "bytes", "text",
]  # fmt: skip
ParameterType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32", "f64", "bool", "enum8"]
Kind = Literal["telecommand", "telemetry"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Scalar = bool | int | float | str
Code = Annotated[int, Field(ge=0, le=0xFFFF)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class UnitModel(_Model):
    """Name, version and description of a unit."""

    name: str
    """Name of the unit."""
    version: str
    """Version of the definition."""
    doc: str
    """What the unit is, in one sentence."""
    source: str = ""
    """The public source of the confirmed rows that name none themselves."""
    first_telemetry_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Ids from this one up are telemetry, those below are telecommands; left out if classes or rows decide."""
    provenance: Provenance | None = None
    """That of the rows that name none."""
    plugin: str | None = None
    """Python file beside the definition, with quantities, actions, framings or checks of the unit's own."""


class ConventionsModel(_Model):
    """How the unit reports attitude, vectors and time, in all rows alike."""

    quaternion: Literal["rotation", "attitude"] = "rotation"
    """`rotation`: v_sensor = q v q*; `attitude`: its conjugate, as in a textbook's A(q)."""
    scalar_sign: Literal["positive", "any"] = "positive"
    """Whether the scalar part is never negative, or the sign stays with the last quaternion that was reported."""
    axes: Annotated[list[Axis], Field(min_length=3, max_length=3)] = ["+x", "+y", "+z"]
    """Axes of the reported frame in terms of the sensor's."""
    epoch: str = "unix"
    """Zero of times: `unix`, `gps`, `j2000`, `midnight` (of the day), or a date such as 2000-01-01."""
    byte_order: Order = "little"
    """Order of the bytes of fields that do not say otherwise."""


class ClassModel(_Model):
    """A class of rows, by which a request says what it is."""

    name: Name
    """Name by which rows refer to it."""
    kind: Kind
    """What its rows are."""
    code: Code | None = None
    """Its code in a request."""
    reply: Code | None = None
    """Its code in a reply; that of the request unless given."""
    unsolicited: Code | None = None
    """Its code in unsolicited telemetry; that of the reply unless given."""
    answer: list[str] | None = None
    """Answers of its rows: `echo`, `reply`, `row:NAME`; `["reply"]` unless given."""


class EnumModel(_Model):
    """Names for numbers."""

    name: Name
    """Name by which fields refer to it."""
    doc: str
    """What is enumerated."""
    values: dict[Name, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(min_length=1)
    """Name → number on the wire."""


class _BoundModel(_Model):
    """What fields and bits have in common: where their value comes from, or goes to."""

    name: Name | None = None
    """Name of the field; one without a name is sent as zeros."""
    enum: str | None = None
    """Enumeration of the unit, or of the device model, that names the numbers."""
    default: Scalar | None = None
    """Value where none is given: a telecommand without this field, a quantity without a value or without a number."""
    parameter: str | None = None
    """Name of the parameter that the field sets or reports."""
    value: str | None = None
    """Quantity that the field of a telemetry row reports."""
    argument: str | None = None
    """Argument of the row's action that the field of a telecommand gives."""
    const: int | float | None = None
    """Value that is always sent, and required in a telecommand."""
    map: dict[str, Scalar | list[Scalar]] | None = None
    """Number on the wire → value of the quantity or argument, or several values for one number."""
    doc: str = ""
    """What the field is."""


class BitModel(_BoundModel):
    """One bit or a group of bits, the lowest first; unused if it has no name."""

    width: Annotated[int, Field(ge=1, le=31)] = 1
    """Bits."""


class RepeatModel(_Model):
    """A group of fields that follows `count` times; `[n]` in a quantity's name is the number of the repetition."""

    count: Annotated[int, Field(ge=1, le=256)]
    """Number of repetitions; their names end in _1, _2 …, unless `first` is given."""
    fields: list[FieldModel] = Field(min_length=1)
    """Fields of the group."""
    first: Annotated[int, Field(ge=0, le=256)] = 1
    """Number of the first repetition."""


class FieldModel(_BoundModel):
    """One field of a row; unused and sent as zeros if it has no name. A text in place of the table is its `text`."""

    text: str | None = None
    """Fields in short, as in `i16 mag{0,1}_{x,y,z} uT 0.01`, in place of all other keys."""
    count: Annotated[int, Field(ge=2, le=64)] | None = None
    """Expands to the fields name_1 … name_count."""
    repeat: RepeatModel | None = None
    """A repeated group in place of one field."""
    type: FieldType | None = None
    """Type on the wire."""
    size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Bytes of a `bytes` or `text` field."""
    order: Order | None = None
    """Order of the bytes; that of the unit unless given."""
    unit: str = ""
    """Unit of the physical value; values are converted from that of the quantity (s, ms, us, ns; rad, deg, arcmin, arcsec; rad/s, deg/s …)."""
    scale: float = 1.0
    """Physical = raw * scale + offset."""
    offset: float = 0.0
    """Added after the scale."""
    min: float | None = None
    """Lowest physical value."""
    max: float | None = None
    """Highest physical value."""
    bits: list[BitModel] = []
    """Bits of a bit field, the lowest first."""
    wrap: bool = False
    """Telemetry sends the lowest bits of a value beyond its range (a counter) instead of the
    nearest limit."""
    provenance: Provenance | None = None
    """That of the row unless given."""

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, given: object) -> object:
        return {"text": given} if isinstance(given, str) else given


class RowModel(_Model):
    """A telecommand or telemetry row."""

    id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    """Identifier on the wire."""
    last_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Expands to the rows name_1 … for the ids id … last_id, all with the same layout; `[n]` is their number."""
    name: Name
    """Name for clients, sessions and exports."""
    class_: str | None = Field(default=None, alias="class")
    """Class of the row; needed where there are several of its kind."""
    doc: str
    """What the row is."""
    provenance: Provenance | None = None
    """`confirmed` by a public source, `proxy` from a relative of the unit, or `ours`; that of the unit unless given."""
    source: str = ""
    """The public source."""
    size: Annotated[int, Field(ge=0, le=4096)] | None = None
    """Bytes of data, to check the fields against."""
    fields: list[FieldModel] | None = None
    """Fields in the order on the wire, after those of `include`; each is a table or a text."""
    include: list[str] | None = None
    """Names of rows whose fields this row concatenates, in order."""
    unbound: Literal["zeros"] | None = None
    """`zeros`: fields that are bound to nothing are sent as zeros on purpose; a mistake unless given."""
    readback: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Identifier of the telemetry that reports what a telecommand named `set_…` was last accepted with; named without `set_`."""
    action: str | None = None
    """What a telecommand does."""
    arguments: dict[Name, Scalar] = {}
    """Arguments of the action that no field gives; the text `[n]` is the number of an expanded row."""
    answer: list[str] | None = None
    """Answers in their order: `echo`, `reply`, `row:NAME`; those of the class unless given."""


class ParameterModel(_Model):
    """A parameter of the device that the unit exposes; what is left out is as in the device model."""

    id: Annotated[int, Field(ge=1, le=254)]
    """Identifier in set_parameter and select_parameter."""
    name: Name
    """Name of the parameter in the device model."""
    type: ParameterType | None = None
    """Type on the wire."""
    unit: str | None = None
    """Unit; that of the device model."""
    min: float | None = None
    """Lowest value."""
    max: float | None = None
    """Highest value."""
    default: Scalar | None = None
    """Default of this unit."""
    enum: str | None = None
    """Enumeration that names the numbers."""
    doc: str | None = None
    """What the parameter does."""


class SectionModel(_Model):
    """Documentation that accompanies the rows: paragraphs and a table."""

    heading: Annotated[str, Field(min_length=1)]
    paragraphs: list[str] = []
    columns: Annotated[list[str], Field(min_length=1)]
    rows: list[list[str]]


class FileModel(_Model):
    """One file of a definition."""

    unit: UnitModel | None = None
    conventions: ConventionsModel | None = None
    class_: list[ClassModel] = Field(default=[], alias="class")
    errors: dict[str, Annotated[int, Field(ge=0, le=0xFFFF)]] | None = None
    """Number on the wire of each error: ok, invalid_id, invalid_length …, and `other` for the rest."""
    enum: list[EnumModel] = []
    telecommand: list[RowModel] = []
    telemetry: list[RowModel] = []
    parameter: list[ParameterModel] = []
    section: list[SectionModel] = []
    link: LinkModel | None = None
    canopen: dict[str, object] | None = None
    """The CANopen mapping, read by `starhil.protocol.canopen.layout`."""


class QuantityModel(_Model):
    """A quantity of the device model."""

    name: str
    """Dotted; `[n]` stands for a number from 1 to `count`."""
    type: Literal["bool", "int", "float", "text", "bytes"]
    enum: str | None = None
    unit: str = ""
    count: Annotated[int, Field(ge=1)] | None = None
    doc: str


class ArgumentModel(_Model):
    """An argument of an action."""

    name: str
    type: Literal["bool", "int", "float", "text", "bytes"]
    enum: str | None = None
    unit: str = ""
    count: Annotated[int, Field(ge=1)] | None = None
    default: Scalar | None = None
    required: bool = False
    doc: str


class ActionModel(_Model):
    """An action of the device model."""

    name: Name
    doc: str
    arguments: list[ArgumentModel] = []


class DeviceParameterModel(_Model):
    """A parameter of the device model."""

    name: Name
    type: ParameterType
    unit: str = ""
    min: float | None = None
    max: float | None = None
    default: Scalar
    enum: str | None = None
    doc: str


class DeviceModelFile(_Model):
    """`configs/units/model.toml`."""

    enum: list[EnumModel]
    parameter: list[DeviceParameterModel]
    quantity: list[QuantityModel]
    action: list[ActionModel]


RepeatModel.model_rebuild()
