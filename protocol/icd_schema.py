"""Schema of the files of a unit's interface definition; it rejects unknown keys and wrong types."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from starhil.protocol.link_schema import HEX, LinkModel, Order

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
Code = Annotated[int, Field(ge=0, le=0xFFFF, json_schema_extra=HEX)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class UnitModel(_Model):
    """Name, version and description of a unit."""

    name: str
    """Name of the unit."""
    version: str
    """Version of the definition."""
    doc: str
    """Description, one sentence."""
    source: str = ""
    """Public source of confirmed rows without a `source`."""
    first_telemetry_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Lowest telemetry ID; lower IDs are telecommands. Omit it if IDs do not distinguish them."""
    provenance: Provenance | None = None
    """Default provenance of rows."""
    plugin: str | None = None
    """Name of a Python file beside the definition, with custom quantities, actions, framings or checks. Reading the
    definition runs this file."""


class ConventionsModel(_Model):
    """How all rows report attitude, vectors and time."""

    quaternion: Literal["rotation", "attitude"] = "rotation"
    """`rotation`: v_sensor = q v q*; `attitude`: the conjugate, the q of an attitude matrix A(q)."""
    scalar_sign: Literal["positive", "any"] = "positive"
    """`positive`: the scalar part is never negative; `any`: the sign that gives the quaternion closer to the
    last reported one."""
    axes: Annotated[list[Axis], Field(min_length=3, max_length=3)] = ["+x", "+y", "+z"]
    """Axes of the reported frame in the sensor frame (+x right in the image, +y down, +z boresight)."""
    epoch: str = "unix"
    """Epoch of all times: `unix`, `gps`, `j2000`, `midnight` (of the current day), or a date such as
    `2000-01-01`."""
    byte_order: Order = "little"
    """Default byte order of fields."""
    telecommand_crc: bool = False
    """Whether the CRC-8 of its data may follow the data of a telecommand: reflected polynomial 12h, initial value
    0, but FFh without data (CubeSpace). If it is wrong, the telecommand is refused with `crc`."""


class ClassModel(_Model):
    """A class of rows, with its codes in a message."""

    name: Name
    """Name that rows refer to."""
    kind: Kind
    """Kind of its rows."""
    code: Code | None = None
    """Code in a request."""
    reply: Code | None = None
    """Code in a reply; default: `code`."""
    unsolicited: Code | None = None
    """Code in unsolicited telemetry; default: `reply`."""
    answer: list[str] | None = None
    """Answers of its rows, in order: `echo`, `reply`, `row:NAME`; default: `["reply"]`."""


class EnumModel(_Model):
    """An enumeration."""

    name: Name
    """Name that fields refer to."""
    doc: str
    """Description."""
    values: dict[Name, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(min_length=1)
    """Name → number on the wire."""


class _BoundModel(_Model):
    """Keys that fields and bits share."""

    name: Name | None = None
    """Name of the field; a field without a name is sent as zeros."""
    enum: str | None = None
    """Name of an enumeration of the unit or the device model."""
    default: Scalar | None = None
    """Value if a client omits the field of a telecommand, or if the quantity of a telemetry field has no
    value, or one to which `map` or `enum` assigns no number."""
    parameter: str | None = None
    """Parameter that the field sets or reports."""
    value: str | None = None
    """Quantity that a telemetry field reports."""
    argument: str | None = None
    """Argument of the row's action that a telecommand field sets."""
    const: int | float | None = None
    """Value that is always sent, and required in a telecommand."""
    map: dict[str, Scalar | list[Scalar]] | None = None
    """Number on the wire → value of the quantity or argument, or a list of values that share the number."""
    doc: str = ""
    """Description."""


class BitModel(_BoundModel):
    """One bit or a group of bits; unused and sent as zeros if it has no name."""

    width: Annotated[int, Field(ge=1, le=31)] = 1
    """Width in bits."""


class RepeatModel(_Model):
    """A group of fields, sent `count` times; `[n]` in a quantity or argument is the repetition's number."""

    count: Annotated[int, Field(ge=1, le=256)]
    """Number of repetitions; the names of their fields end in _1, _2 …, unless `first` is given."""
    fields: list[FieldModel] = Field(min_length=1)
    """Fields of the group."""
    first: Annotated[int, Field(ge=0, le=256)] = 1
    """Number of the first repetition."""


class FieldModel(_BoundModel):
    """One field of a row; unused and sent as zeros if it has no name. A string is short for `{ text = … }`."""

    text: str | None = None
    """Short form of one or several fields, such as `i16 mag{0,1}_{x,y,z} uT 0.01`, instead of all other
    keys."""
    count: Annotated[int, Field(ge=2, le=64)] | None = None
    """Expands to the fields name_1 … name_count; `[n]` in a quantity or argument is the number."""
    repeat: RepeatModel | None = None
    """A repeated group instead of a single field."""
    type: FieldType | None = None
    """Type on the wire."""
    size: Annotated[int, Field(ge=1, le=4096)] | None = None
    """Size of a `bytes` or `text` field in bytes."""
    order: Order | None = None
    """Byte order; default: the unit's."""
    unit: str = ""
    """Unit of the physical value, converted from or to the unit of the quantity or argument
    (s, ms, us, ns; rad, deg, arcmin, arcsec; rad/s, deg/s …)."""
    scale: float = 1.0
    """Physical = raw × scale + offset."""
    offset: float = 0.0
    """Physical = raw × scale + offset."""
    min: float | None = None
    """Lowest physical value."""
    max: float | None = None
    """Highest physical value."""
    bits: list[BitModel] = []
    """Bits of a bit field, lowest first."""
    wrap: bool = False
    """Whether an out-of-range value is sent modulo the range (a counter) instead of as the nearest limit."""
    provenance: Provenance | None = None
    """Provenance; default: the row's."""

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, given: object) -> object:
        return {"text": given} if isinstance(given, str) else given


class RowModel(_Model):
    """A telecommand or telemetry row."""

    id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    """ID on the wire."""
    last_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Expands to the rows name_1 … with the IDs `id` to `last_id` and the same layout; `[n]` is the number of
    the row."""
    name: Name
    """Name for clients, sessions and exports."""
    class_: str | None = Field(default=None, alias="class")
    """Class of the row; required if the unit has several classes of its kind."""
    doc: str
    """Description."""
    provenance: Provenance | None = None
    """`confirmed`: from a public source; `proxy`: public for another unit of the family; `ours`: chosen here;
    default: the unit's."""
    source: str = ""
    """Public source of the row."""
    size: Annotated[int, Field(ge=0, le=4096)] | None = None
    """Expected size of the data in bytes; the fields are checked against it."""
    fields: list[FieldModel] = []
    """Fields in wire order, after the fields of `include`; each is a table or a string (`text`)."""
    include: list[str] | None = None
    """Rows whose fields this row concatenates, in order."""
    unbound: Literal["zeros"] | None = None
    """`zeros`: fields without a binding are sent as zeros; default: they are an error."""
    readback: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """ID of a telemetry row that reports the last accepted values of this telecommand. If the
    telecommand is `set_NAME`, the telemetry row is `NAME`."""
    action: str | None = None
    """Action that a telecommand performs, or that follows each reading of a telemetry row."""
    arguments: dict[Name, Scalar] = {}
    """Fixed arguments of the action; the text `[n]` is the number of an expanded row."""
    answer: list[str] | None = None
    """Answers, in order: `echo`, `reply`, `row:NAME`; default: the answers of the class."""


class ParameterModel(_Model):
    """A device parameter that the unit exposes; omitted keys have the values of the device model."""

    id: Annotated[int, Field(ge=1, le=254)]
    """ID in set_parameter and select_parameter."""
    name: Name
    """Name of the parameter in the device model."""
    type: ParameterType | None = None
    """Type on the wire."""
    unit: str | None = None
    """Unit; must be the one in the device model."""
    min: float | None = None
    """Lowest value."""
    max: float | None = None
    """Highest value."""
    default: Scalar | None = None
    """Default value."""
    enum: str | None = None
    """Name of an enumeration."""
    doc: str | None = None
    """Description."""


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
    """Error name → number on the wire."""
    enum: list[EnumModel] = []
    telecommand: list[RowModel] = []
    telemetry: list[RowModel] = []
    parameter: list[ParameterModel] = []
    section: list[SectionModel] = []
    link: LinkModel | None = None
    canopen: dict[str, object] | None = None
    """Mapping to the object dictionary, read by `starhil.protocol.canopen.layout`."""


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
