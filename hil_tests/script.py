"""Session scripts: TOML files of telecommands, reads and expectations, validated before the run.

    default_name = "First light"

    [emulator]                      # used by `starhil session --start`
    profile = "default"

    [truth]                         # the true attitude, or a file that the emulator writes
    ra_deg = 83.8
    dec_deg = -1.2
    roll_deg = 30.0

    [[step]]
    read = "identification"
    expect = { interface_version = 1, runtime_s = { max = 60 } }
    capture = { before = "runtime_s" }

    [[step]]
    command = "set_mode"
    with = { mode = "lost_in_space" }

    [[step]]
    read = "attitude"
    expect = { valid = true }
    within_s = 20                   # ask again until the expectations hold
    attitude = { within_arcsec = 30, roll_within_arcsec = 120 }

Every step has exactly one of the keys in `ACTIONS`, each with a class below: the keys of the class are the keys of the
step, and a validated step is what the session runs. Rows, fields, parameters and enumeration names are those of the
interface definition. All errors of a file are reported, one a line, with file, step, key and near matches.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails

from starhil.hil_tests.errors import BenchError, ScriptError
from starhil.hil_tests.expect import (
    AttitudeCheck,
    Conditions,
    Keys,
    NonNegative,
    Operand,
    ReadConditions,
    ReadOperand,
    StatedAttitude,
    Variable,
    show,
)
from starhil.hil_tests.raw_traffic import parse_frame, pattern
from starhil.protocol.codec import Field as RowField
from starhil.protocol.codec import Row
from starhil.protocol.definition import InterfaceDefinition, UnknownNameError
from starhil.protocol.errors import ProtocolError
from starhil.protocol.names import did_you_mean, remedy
from starhil.protocol.user_file import read_user_text
from starhil.protocol.validation_messages import wording
from starhil.protocol.values import FLAGS, Parameter

ATTITUDE_FIELDS: Final = frozenset({"q_x", "q_y", "q_z"})


# --- values of keys ---


def _icd(info: ValidationInfo) -> InterfaceDefinition:
    found: InterfaceDefinition = (info.context or {})["icd"]
    return found


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("must be a text")  # noqa: TRY004 -- for pydantic
    return value


def _texts(value: Any) -> tuple[str, ...]:
    """Return a list of texts; a single text is a list of one."""
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(item, str) for item in values):
        raise ValueError("must be a text or a list of texts")
    return tuple(values)


def _known(table: str, others: str = "", instead: str = "") -> PlainValidator:
    """Return a reader of names in a table of the definition; `instead`: what a name in the table `others` is."""

    def read(value: Any, info: ValidationInfo) -> Any:
        icd = _icd(info)
        if others and _text(value) in getattr(icd, others):
            raise ValueError(f"{value!r} is {instead}")
        try:
            return getattr(icd, table)[_text(value)]
        except UnknownNameError as error:
            raise ValueError(str(error)) from None

    return PlainValidator(read)


def _member(enum: str) -> PlainValidator:
    """Return a reader of the names of an enumeration of the definition."""

    def read(value: Any, info: ValidationInfo) -> str:
        known = sorted(_icd(info).enums[enum].values)
        if _text(value) not in known:
            raise ValueError(f"must be one of {', '.join(known)}, not '{value}'{did_you_mean(value, known)}")
        return str(value)

    return PlainValidator(read)


def _hex_bytes(value: Any) -> bytes:
    try:
        return bytes.fromhex(_text(value))
    except ValueError:
        raise ValueError(f'must be bytes in hexadecimal, such as "1F 7F 80 1F FF", not {value!r}') from None


def _as_json(table: dict[str, Any]) -> dict[str, Any]:
    try:
        json.dumps(table)
    except TypeError:
        raise ValueError("must be numbers, texts, lists and tables; put a date in quotes") from None
    return table


def _file_name(name: str) -> str:
    if name in {"", ".."} or Path(name).name != name or "\0" in name:
        raise ValueError("must be a plain file name; the file is written to the log folder")
    return name


def _fraction(value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise ValueError("must be a fraction of the samples, from 0 to 1")
    return value


Telemetry = Annotated[Row, _known("telemetry", "telecommands", "a telecommand: use command")]
Telecommand = Annotated[Row, _known("telecommands", "telemetry", "telemetry: use read")]
ParameterName = Annotated[Parameter, _known("parameters")]
Refusal = Annotated[str, _member("error_code")]
ImageSize = Annotated[str, _member("image_size")]
HexBytes = Annotated[bytes, PlainValidator(_hex_bytes)]
FileName = Annotated[str, AfterValidator(_file_name)]
Texts = Annotated[tuple[str, ...], PlainValidator(_texts)]
Positive = Annotated[float, Field(ge=0.001)]
Count = Annotated[int, Field(ge=1)]
Link = Literal["serial", "can", "both"]


# --- steps ---


class Step(Keys):
    """One step: its action, given by the class; its expectations; how often it is tried."""

    default_name: ClassVar[str] = ""
    """The name of a step that has none, in which `self` is the step."""

    name: str = ""
    expect: dict[str, ReadConditions] = Field(default_factory=dict)
    attitude: AttitudeCheck | None = None
    capture: dict[str, str] = Field(default_factory=dict)
    """Variable → field."""
    link: Link | None = None
    repeat: Count = 1
    every_s: NonNegative = 0.2
    within_s: NonNegative | None = None
    """Repeat until the expectations hold, for at most this long."""
    timeout_s: Positive | None = None
    retries: Annotated[int, Field(ge=0)] = 0
    max_latency_s: NonNegative | None = None
    _number: int = 0

    @property
    def number(self) -> int:
        """Place in the script, from 1 on."""
        return self._number

    @property
    def pause_s(self) -> float:
        """Pause between attempts and between repetitions, s."""
        return self.every_s

    @property
    def reading(self) -> Row | None:
        """The row that the step reads; None if it reads no telemetry."""
        return None

    @model_validator(mode="after")
    def _fits_its_row(self, info: ValidationInfo) -> Self:
        problems = [*self._problems(info)]
        if problems:
            raise ValueError(*problems)
        self._number = (info.context or {})["number"]
        self.name = self.name or self.default_name.format(self=self)
        return self

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        row = self.reading
        if row is None:
            yield from (
                f"'{key}' needs a step that reads telemetry"
                for key in ("expect", "capture")
                if getattr(self, key)
            )
        if self.attitude is not None:
            if row is None or not row.named_fields.keys() >= ATTITUDE_FIELDS:
                yield "'attitude' needs a step that reads a row with a quaternion (attitude, quaternion)"
            elif self.attitude.attitude is None and not (info.context or {})["has_truth"]:
                yield "'attitude' has no truth to compare with: give one here or in a table [truth]"
        if row is not None:
            yield from _unknown_fields("capture", row, self.capture.values())
            yield from _unknown_fields("expect", row, self.expect)
            for name in self.expect.keys() & row.named_fields.keys():
                yield from (
                    f"expect: {text}" for text in _impossible(row.named_fields[name], self.expect[name])
                )


class Command(Step):
    """Send a telecommand."""

    default_name = "command {self.row.name}"
    row: Telecommand = Field(alias="command")
    values: dict[str, ReadOperand] = Field({}, alias="with")
    raw: HexBytes | None = Field(None, alias="with_hex")
    """Data as bytes instead of `values`, for malformed telecommands."""
    refused: Refusal | None = None
    """Name of the expected error code; None if the telecommand must be accepted."""

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        yield from super()._problems(info)
        if self.values and self.raw is not None:
            yield "give the parameters as a table 'with' or as bytes 'with_hex', not both"
        yield from _unknown_fields("with", self.row, self.values)
        for name, item in self.row.named_fields.items() if self.raw is None else ():
            value = self.values.get(name)
            if value is None and item.required and "with" not in (info.context or {})["broken"]:
                yield f"with: row '{self.row.name}' needs the field '{name}', which is missing"
            elif value is not None and not isinstance(value, Variable):
                try:
                    item.to_raw(value, check=self.refused is None)
                except ProtocolError as error:
                    yield f"with: {self.row.name}.{name}: {error}"


class ReadingStep(Step):
    """A step that reads a telemetry row."""

    row: Telemetry

    @property
    def reading(self) -> Row | None:
        """The row that the step reads."""
        return self.row


class Read(ReadingStep):
    """Read a telemetry row."""

    default_name = "read {self.row.name}"
    row: Telemetry = Field(alias="read")
    refused: Refusal | None = None


class Listen(ReadingStep):
    """Wait for unsolicited telemetry of a row, `count` times."""

    default_name = "listen for {self.row.name}"
    row: Telemetry = Field(alias="listen")
    count: Count = 1

    @property
    def pause_s(self) -> float:
        """No pause: the messages set the pace, and each is judged."""
        return 0.0


class Sample(ReadingStep):
    """Read a telemetry row repeatedly into a CSV file."""

    default_name = "sample {self.row.name}"
    row: Telemetry = Field(alias="sample")
    every_s: NonNegative
    for_s: NonNegative
    file: FileName = ""
    at_least: Annotated[float, AfterValidator(_fraction)] = 1.0
    """Fraction of the samples for which the expectations must hold, 0 to 1."""
    min_samples: Count = 1

    @model_validator(mode="before")
    @classmethod
    def _from_table(cls, table: dict[str, Any]) -> dict[str, Any]:
        """Take the keys from a table `sample` too."""
        inner = table.get("sample")
        if not isinstance(inner, dict):
            return table
        return {**table, **{"sample" if key == "telemetry" else key: value for key, value in inner.items()}}

    @model_validator(mode="after")
    def _named_for_its_row(self) -> Self:
        self.file = self.file or f"{self.row.name}.csv"
        return self


class SetParameter(Step):
    """Set a parameter by name and read it back."""

    default_name = "set parameter {self.parameter.name}"
    parameter: ParameterName = Field(alias="set_parameter")
    value: ReadOperand
    refused: Refusal | None = None

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        yield from super()._problems(info)
        if self.refused is not None:
            if isinstance(self.value, str):
                yield "'value' must be a number if a refusal is expected"
        elif not isinstance(self.value, Variable):
            try:
                self.parameter.check(self.value)
            except ProtocolError as error:
                yield str(error)


class GetParameter(Step):
    """Read a parameter by name; expectations refer to the fields of the row `parameter`."""

    default_name = "get parameter {self.parameter.name}"
    parameter: ParameterName = Field(alias="get_parameter")
    _row: Row | None = None

    @property
    def reading(self) -> Row | None:
        """The row that the step reads."""
        return self._row

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        self._row = _icd(info).telemetry["parameter"]
        yield from super()._problems(info)


class DownloadImage(Step):
    """Save an image in the unit, download it and write it as a PNG file."""

    default_name = "download image {self.file}"
    file: FileName = Field(alias="download_image")
    size: ImageSize = "size_128"
    method: Literal["frames", "burst"] = "frames"
    """`frames` of 128 bytes, or `burst` packets with hole maps."""


class Send(Step):
    """Send raw bytes in hexadecimal (serial) or CAN frames in the format of `cansend`, and check the answer.

    The format determines the link. Without `answer`, anything may be answered.
    """

    default_name = "send raw data"
    data: Texts = Field(alias="send")
    answer: Texts | None = None
    listen_s: NonNegative = 0.3

    @model_validator(mode="after")
    def _has_one_format(self) -> Self:
        try:
            for text in self.data:
                if "#" in text:
                    parse_frame(text)
                else:
                    bytes.fromhex(text)
            if self.answer is not None:
                self.answer = tuple(pattern(text) for text in self.answer)
        except (BenchError, ValueError) as error:
            raise ValueError(f"'send' or 'answer': {error}") from None
        frames = {"#" in text for text in self.data}
        if len(frames) != 1:
            raise ValueError(
                "'send' takes bytes in hexadecimal or CAN frames in the format of cansend, not both"
            )
        self.link = "can" if frames == {True} else "serial"
        return self


class Wait(Step):
    """Do nothing for a while."""

    default_name = "wait {self.seconds:g} s"
    seconds: NonNegative = Field(alias="wait_s")


class Restart(Step):
    """End the emulator that the session started, by a signal, and start it again."""

    default_name = "restart the emulator ({self.signal})"
    signal: Literal["term", "kill"] = Field(alias="restart")


class Control(Step):
    """Send a request on the control channel of the emulator that the session started."""

    default_name = "control channel: {self.action}"
    action: Literal["fault", "clear_faults", "set_truth", "scenario", "step"] = Field(alias="control")
    keys: Annotated[dict[str, Any], AfterValidator(_as_json)] = Field({}, alias="with")


ACTIONS: Final[Mapping[str, type[Step]]] = {
    "command": Command,
    "read": Read,
    "listen": Listen,
    "sample": Sample,
    "set_parameter": SetParameter,
    "get_parameter": GetParameter,
    "download_image": DownloadImage,
    "send": Send,
    "wait_s": Wait,
    "restart": Restart,
    "control": Control,
}
"""Key of an action → its class."""


# --- the script ---


class Truth(StatedAttitude):
    """The true attitude, or a file of true attitudes over time that the emulator writes."""

    file: FileName | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if self.attitude is not None and self.file is not None:
            raise ValueError("give an attitude or a file, not both")
        return self


class EmulatorRequest(Keys):
    """How `--start` starts the emulator for this script."""

    profile: str | None = None
    settings: Texts = Field((), alias="set")
    seed: Annotated[int, Field(ge=0)] | None = None


class Defaults(Keys):
    """Defaults for all steps."""

    timeout_s: Positive = 1.0
    retries: Annotated[int, Field(ge=0)] = 0
    keep_going: bool = False
    link: Link | None = None


class Script(Keys):
    """A validated session script."""

    model_config = ConfigDict(populate_by_name=False)

    title: str = ""
    doc: str = ""
    truth: Truth = Truth()
    emulator: EmulatorRequest = EmulatorRequest()
    defaults: Defaults = Defaults()
    steps: tuple[Step, ...] = Field((), alias="step")


def load_script(path: Path, icd: InterfaceDefinition) -> Script:
    """Read and check a session script.

    Raises ScriptError: the file cannot be read, is not TOML, or does not match the interface definition;
    one line for each error.
    """
    try:
        document = tomllib.loads(read_user_text(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ScriptError(f"{path}: cannot be read: {reason}") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ScriptError(f"{path}: not valid TOML: {error}") from None
    tables = document.pop("step", [])
    script, problems = _checked(Script, {"title": path.stem.replace("_", " "), **document}, path.name)
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        problems.append(f"{path.name}: 'step' must be an array of tables: write [[step]] before each")
        tables = []
    elif not tables:
        problems.append(f"{path.name}: has no steps: write [[step]] and one of the actions below it")
    captured: set[str] = set()
    context = {"icd": icd, "captured": captured, "has_truth": bool(document.get("truth"))}
    steps: list[Step | None] = []
    for number, table in enumerate(tables, 1):
        step, found = _step(f"{path.name}: step {number}", table, {**context, "number": number})
        steps.append(step)
        problems += found
        names = table.get("capture")
        captured.update(names if isinstance(names, dict) else ())  # also of a step with an error
    if problems or script is None:
        raise ScriptError(*problems)
    return script.model_copy(update={"steps": tuple(steps)})


def _step(location: str, table: dict[str, Any], context: dict[str, Any]) -> tuple[Step | None, list[str]]:
    """Check a step; return it, or its problems."""
    present = [key for key in ACTIONS if key in table]
    if len(present) == 1:
        return _checked(ACTIONS[present[0]], table, location, context)
    known = {key for action in ACTIONS.values() for key in _keys_of(action)}
    unknown = [key for key in table if key not in known]
    hint = f"; '{unknown[0]}' is unknown{did_you_mean(unknown[0], known)}" if unknown else ""
    found = f"has {' and '.join(present)}" if present else "has none"
    return None, [f"{location}: needs exactly one action of {', '.join(ACTIONS)}; {found}{hint}"]


# --- errors ---

Table = TypeVar("Table", bound=Keys)
TABLES: Final[Mapping[str, type[Keys]]] = {
    "expect": Conditions,
    "attitude": AttitudeCheck,
    "truth": Truth,
    "emulator": EmulatorRequest,
    "defaults": Defaults,
}
"""The tables in which an error may lie."""


def _checked(
    model: type[Table], table: dict[str, Any], location: str, context: dict[str, Any] | None = None
) -> tuple[Table | None, list[str]]:
    """Validate a table; return the result, or the problems: of its keys, and of the whole without the wrong ones.

    The context `broken` has the keys that were left out.
    """
    try:
        return model.model_validate(table, context={**(context or {}), "broken": set()}), []
    except ValidationError as error:
        found = error.errors()
    broken = {item["loc"][0] for item in found if item["loc"]}
    if broken:
        rest = {key: table[key] for key in table if key not in broken}
        try:
            model.model_validate(rest, context={**(context or {}), "broken": broken})
        except ValidationError as error:
            found += [item for item in error.errors() if item["type"] != "missing"]
    return None, list(dict.fromkeys(text for item in found for text in _texts_of(item, location, model)))


def _texts_of(error: ErrorDetails, location: str, model: type[Keys]) -> Iterator[str]:
    """Yield what an error says in the words of a script: tables that lead to it, key, problem, near matches."""
    path = [str(step) for step in error["loc"]]
    key = path[-1] if path else ""
    table = TABLES.get(path[0], model) if len(path) > 1 else model
    problem = error.get("ctx", {}).get("error")
    found = problem.args if problem is not None else [_explanation(error, key, _keys_of(table))]
    for text in found:
        if text.startswith("must "):
            yield ": ".join([location, *path[:-1], f"'{key}' {text}"])
        else:
            yield ": ".join([location, *(path[:-1] if error["type"] == "extra_forbidden" else path), text])


def _explanation(error: ErrorDetails, key: str, known: list[str]) -> str:
    match error["type"]:
        case "extra_forbidden":
            return f"unknown key '{key}'{remedy(key, known)}"
        case "missing":
            return "must be given, but is missing"
        case _:
            return wording(error)


def _keys_of(model: type[Keys]) -> list[str]:
    keys = (field.alias or name for name, field in model.model_fields.items())
    return sorted(key for key in keys if (model, key) != (Send, "link"))


# --- expectations and fields of the definition ---


def _unknown_fields(key: str, row: Row, names: Iterable[str]) -> Iterator[str]:
    known = row.named_fields
    for name in names:
        if name not in known:
            yield f"{key}: row '{row.name}' has no field '{name}'{remedy(name, known)}"


def _impossible(item: RowField, wanted: Conditions) -> Iterator[str]:
    """Yield why conditions can never hold: wrong type, or unknown name of an enumeration.

    For a field of bytes, hexadecimal text is converted in place, and so are the names `true` and `false` of a flag's `map`.
    """
    if item.kind == "bytes":
        yield from _in_bytes(item, wanted)
        return
    if item.is_flag and item.enum is not None:
        wanted.value, wanted.differs_from = _as_flag(wanted.value), _as_flag(wanted.differs_from)
        wanted.one_of = [_as_flag(value) for value in wanted.one_of]
    for value in (wanted.equals, wanted.differs_from, *wanted.one_of):
        if value is None or isinstance(value, Variable):
            continue
        if item.enum is not None and not item.is_flag:
            if value not in item.enum.values and (isinstance(value, bool) or not isinstance(value, int)):
                known = f"; one of: {', '.join(item.enum.values)}"
                yield f"'{item.name}' is never '{show(value)}'{did_you_mean(show(value), item.enum.values) or known}"
        elif item.is_flag != isinstance(value, bool):
            yield f"'{item.name}' is {'true or false' if item.is_flag else 'not true or false'}, not {value!r}"
        elif item.kind in ("integer", "float", "bits") and isinstance(value, str):
            yield f"'{item.name}' is a number, not {value!r}"


def _as_flag(value: Any) -> Any:
    return FLAGS.get(value, value) if isinstance(value, str) else value


def _in_bytes(item: RowField, wanted: Conditions) -> Iterator[str]:
    """Convert the hexadecimal texts in the conditions of a field of bytes."""
    numeric = {"min", "max", "above", "within", "plus", "angle_deg"}
    given = {Conditions.model_fields[name].alias or name for name in wanted.model_fields_set}
    for key in sorted(numeric & given):
        yield f"'{item.name}' is bytes, and '{key}' is for numbers; give value, one_of or not"

    def convert(value: Operand) -> Operand:
        if isinstance(value, Variable):
            return value
        try:
            data = bytes.fromhex(value) if isinstance(value, str) else b""
        except ValueError:
            data = b""
        if len(data) != item.size:
            wrong.append(f"'{item.name}' is {item.size} bytes in hexadecimal, not {show(value)!r}")
        return data

    wrong: list[str] = []
    wanted.one_of = [convert(value) for value in wanted.one_of]
    wanted.value = None if wanted.value is None else convert(wanted.value)
    wanted.differs_from = None if wanted.differs_from is None else convert(wanted.differs_from)
    yield from wrong
