"""The keys of the files of a unit: models that reject unknown keys and wrong types.

An attribute whose name differs from its key has the key as alias. `FieldKeys` are the keys that a field keeps when
`starhil.protocol.unit.layout` places it in a row, `RowKeys` those that a row keeps; `codec.Field` and `codec.Row` extend
them with positions in the bytes.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from starhil.protocol.icd.canopen_schema import CanopenModel
from starhil.protocol.icd.conventions import Conventions, Order
from starhil.protocol.icd.link_schema import LineText, LinkModel, MessageClass
from starhil.protocol.icd.values import (
    DefinitionModel,
    EnumDefinition,
    Name,
    Number,
    ParameterType,
    Scalar,
    Section,
    bounded,
)

Provenance = Literal["confirmed", "copy", "proxy", "ours"]
FieldType = Literal[
    "u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32", "u64", "i64", "f32", "f64",
    "enum8", "enum16", "enum32", "bits8", "bits16", "bits32", "bytes", "text",
]  # fmt: skip


class UnitModel(DefinitionModel):
    """Name, version and description of a unit."""

    name: Annotated[str, Field(max_length=100)]
    """Name of the unit; files of exports are called after it."""
    version: str
    """Version of the definition."""
    doc: str
    """Description, one sentence."""
    source: str = ""
    """Public source of confirmed rows without a `source`."""
    first_telemetry_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Lowest telemetry ID; lower IDs are telecommands. Omit it if IDs do not distinguish them; on CubeSpace's links it is 128."""
    provenance: Provenance | None = None
    """Default provenance of rows."""
    plugin: str | None = None
    """Name of a Python file beside the definition, with custom quantities, actions, framings or checks. Reading the
    definition runs this file."""


class FieldKeys(DefinitionModel):
    """Keys that a field, or a bit, keeps."""

    name: Name | None = None
    """Name of the field; a field without a name is sent as zeros."""
    default: Scalar | None = None
    """Value if a client omits the field of a telecommand, or if the quantity of a telemetry field has no
    value, or one to which `map` or `enum` assigns no number."""
    parameter: str | None = None
    """Parameter that the field sets or reports."""
    value: str | None = None
    """Quantity that a telemetry field reports."""
    argument: str | None = None
    """Argument of the row's action that a telecommand field sets."""
    const: Annotated[int | float, AfterValidator(bounded)] | None = None
    """Value that is always sent, and required in a telecommand."""
    doc: str = ""
    """Description."""
    unit: str = ""
    """Unit of the physical value, converted from or to the unit of the quantity or argument
    (s, ms, us, ns; rad, deg, arcmin, arcsec; rad/s, deg/s …)."""
    scale: Number = 1.0
    """Physical = raw × scale + offset."""
    bias: Number = Field(default=0.0, alias="offset")
    """Physical = raw × scale + offset."""
    minimum: Number | None = Field(default=None, alias="min")
    """Lowest physical value."""
    maximum: Number | None = Field(default=None, alias="max")
    """Highest physical value."""
    wrap: bool = False
    """Whether an out-of-range value is sent modulo the range (a counter) instead of as the nearest limit."""
    provenance: Provenance | None = None
    """Provenance; default: the row's."""


class _MappedModel(FieldKeys):
    """Keys of fields and bits that become an enumeration."""

    enumeration: str | None = Field(default=None, alias="enum")
    """Name of an enumeration of the unit or the device model."""
    map: dict[str, Scalar | list[Scalar]] | None = None
    """Number on the wire → value of the quantity or argument, or a list of values that share the number."""


class BitModel(_MappedModel):
    """One bit or a group of bits, an unsigned number; unused and sent as zeros if it has no name."""

    width: Annotated[int, Field(ge=1, le=31)] = 1
    """Width in bits."""


class RepeatModel(DefinitionModel):
    """A group of fields, sent `count` times; `[n]` in a quantity or argument is the repetition's number."""

    count: Annotated[int, Field(ge=1, le=256)]
    """Number of repetitions; the names of their fields end in _1, _2 …, unless `first` is given."""
    fields: list[FieldModel] = Field(min_length=1)
    """Fields of the group."""
    first: Annotated[int, Field(ge=0, le=256)] = 1
    """Number of the first repetition."""


class FieldModel(_MappedModel):
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
    bits: list[BitModel] = []
    """Bits of a bit field, lowest first."""

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, given: object) -> object:
        return {"text": given} if isinstance(given, str) else given


Event = Literal["start", "frame", "mode", "error", "validity"]
"""What a unit may report unsolicited; described in `RowKeys.unsolicited`."""


class RowKeys(DefinitionModel):
    """Keys that a row keeps."""

    id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    """ID on the wire."""
    name: Name
    """Name for clients, sessions and exports."""
    doc: str
    """Description."""
    provenance: Provenance | None = None
    """`confirmed`: from a public source; `copy`: from a public copy of the vendor's document, whose revision is not known;
    `proxy`: public for another unit of the family; `ours`: chosen here; default: the unit's."""
    source: str = ""
    """Public source of the row."""
    action: str | None = None
    """Action that a telecommand performs, or that follows each reading of a telemetry row."""
    confirm: bool = False
    """Whether the console asks before it sends the telecommand, because it interrupts the unit or deletes something."""
    arguments: dict[Name, Scalar] = {}
    """Fixed arguments of the action; the text `[n]` is the number of an expanded row."""
    unsolicited: (
        Annotated[float, Field(gt=0, le=100)] | Annotated[list[Event], Field(min_length=1)] | None
    ) = None
    """Sends a telemetry row without a request: at a rate in Hz, or after listed events. `start`: of the unit; `frame`: a new
    measurement; `mode`: another mode; `error`: the error mode, or another error in it; `validity`: the attitude has become
    valid or invalid."""


class RowModel(RowKeys):
    """A telecommand or telemetry row."""

    last_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """Expands to the rows name_1 … with the IDs `id` to `last_id` and the same layout; `[n]` is the number of
    the row. A unit has at most 65536 rows."""
    message_class: str | None = Field(default=None, alias="class")
    """Class of the row; required if the unit has several classes of its kind."""
    size: Annotated[int, Field(ge=0, le=4096)] | None = None
    """Expected size of the data in bytes; the fields are checked against it."""
    min_size: Annotated[int, Field(ge=0, le=4096)] | None = None
    """Fewest bytes of a telecommand's data, if they may end early: the plugin's action gets no argument of a field that is missing
    or incomplete, and a `bytes` field as far as it goes. Clients send all fields."""
    fields: list[FieldModel] = []
    """Fields in wire order, after the fields of `include`; each is a table or a string (`text`)."""
    include: list[str] | None = None
    """Rows whose fields this row concatenates, in order."""
    unbound: Literal["zeros"] | None = None
    """`zeros`: fields without a binding are sent as zeros; default: they are an error."""
    readback: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | None = None
    """ID of a telemetry row that reports the last accepted values of this telecommand. If the
    telecommand is `set_NAME`, the telemetry row is `NAME`."""
    answer: list[str] | None = None
    """Answers, in order: `echo`, `reply`, `row:NAME`; default: the answers of the class."""
    request: LineText | Literal[False] | None = None
    """Text that requests the row on the serial line, instead of header and data; the ID then stands only in exports and logs.
    `false`: the telemetry row is only sent, and no request reads it."""


class ParameterModel(DefinitionModel):
    """A device parameter that the unit exposes; omitted keys have the values of the device model."""

    id: Annotated[int, Field(ge=1, le=254)]
    """ID in set_parameter and select_parameter."""
    name: Name
    """Name of the parameter in the device model."""
    type: ParameterType | None = None
    """Type on the wire."""
    unit: str | None = None
    """Unit; must be the one in the device model."""
    minimum: float | None = Field(default=None, alias="min")
    """Lowest value."""
    maximum: float | None = Field(default=None, alias="max")
    """Highest value."""
    default: Scalar | None = None
    """Default value."""
    enumeration: str | None = Field(default=None, alias="enum")
    """Name of an enumeration."""
    doc: str | None = None
    """Description."""


class FileModel(DefinitionModel):
    """One file of a definition."""

    unit: UnitModel | None = None
    conventions: Conventions | None = None
    classes: list[MessageClass] = Field(default=[], alias="class")
    errors: dict[str, Annotated[int, Field(ge=0, le=0xFFFF)]] | None = None
    """Error name → number on the wire."""
    enum: list[EnumDefinition] = []
    telecommand: list[RowModel] = []
    telemetry: list[RowModel] = []
    parameter: list[ParameterModel] = []
    section: list[Section] = []
    link: LinkModel | None = None
    canopen: CanopenModel | None = None


RepeatModel.model_rebuild()
