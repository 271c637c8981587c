"""The steps of a session script: the keys of each action, their check before the run, and what the step does.

The keys of a class are the keys of its step, and a validated step is what the session runs. Rows, fields, parameters
and names in enumerations are those of the interface definition, which validation takes from its context: `icd`;
`captured`, the variables of earlier steps; `has_truth`; and `broken`, the keys of the step that are wrong.
"""

from __future__ import annotations

import csv
import json
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, ValidationInfo, model_validator

from starhil.hil_tests.attitude import Quaternion
from starhil.hil_tests.client.images import write_png
from starhil.hil_tests.client.raw_traffic import matches, parse_frame, pattern, send_and_listen
from starhil.hil_tests.client.transactions import Ack, Reading
from starhil.hil_tests.errors import BenchError, NackError
from starhil.hil_tests.judge.links import BusName
from starhil.hil_tests.rig.rig import Rig
from starhil.hil_tests.rig.truth_log import TruthLogReader
from starhil.hil_tests.session.expect import (
    AttitudeCheck,
    Conditions,
    Keys,
    Operand,
    ReadConditions,
    ReadOperand,
    Variable,
    resolve,
    show,
    show_angle,
)
from starhil.hil_tests.session.results import summarize
from starhil.hil_tests.timing.figures import percentile
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import OneLineError, ProtocolError, did_you_mean, remedy
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field as RowField
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import FLAGS, EnumDefinition, Parameter, Value

ATTITUDE_FIELDS: Final = frozenset({"q_x", "q_y", "q_z"})
MS_PER_S: Final = 1e3
CLOCK_GRAIN_S: Final = 1e-6

Answer = TypeVar("Answer", Ack, Reading)


# --- values of keys ---


def _read_by(read: Callable[[str, InterfaceDefinition], Any]) -> PlainValidator:
    """Return a validator of texts, which a function reads in terms of the definition; its errors are those of the key."""

    def validate(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            raise ValueError("must be a text")  # noqa: TRY004 -- for pydantic
        try:
            return read(value, (info.context or {})["icd"])
        except OneLineError as error:
            raise ValueError(str(error)) from None

    return PlainValidator(validate)


def _telemetry(name: str, icd: InterfaceDefinition) -> Row:
    if name in icd.telecommands:
        raise ValueError(f"{name!r} is a telecommand: use command")
    return icd.telemetry[name]


def _readable(name: str, icd: InterfaceDefinition) -> Row:
    row = _telemetry(name, icd)
    if row.only_sent:
        raise ValueError(f"{name!r} is only sent, and no request reads it: use listen")
    return row


def _telecommand(name: str, icd: InterfaceDefinition) -> Row:
    if name in icd.telemetry:
        raise ValueError(f"{name!r} is telemetry: use read")
    return icd.telecommands[name]


def _member(name: str, enum: EnumDefinition) -> str:
    enum.number(name)
    return name


def _hex_bytes(text: str, _icd: InterfaceDefinition) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ValueError(f'must be bytes in hexadecimal, such as "1F 7F 80 1F FF", not {text!r}') from None


def _raw_item(text: str, icd: InterfaceDefinition) -> bytes | CanFrame:
    return parse_frame(text) if "#" in text else _hex_bytes(text, icd)


def _of_one_link(items: list[bytes | CanFrame]) -> list[bytes | CanFrame]:
    if len(set(map(type, items))) != 1:
        raise ValueError("takes bytes in hexadecimal or CAN frames in the format of cansend, not both")
    return items


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _as_json(table: dict[str, Any]) -> dict[str, Any]:
    try:
        json.dumps(table)
    except TypeError:
        raise ValueError("must be numbers, texts, lists and tables; put a date in quotes") from None
    return table


def _file_name(name: str) -> str:
    if name in {"", ".."} or Path(name).name != name:
        raise ValueError("must be a plain file name; the file is written to the log folder")
    return name


Telemetry = Annotated[Row, _read_by(_telemetry)]
Readable = Annotated[Row, _read_by(_readable)]
Telecommand = Annotated[Row, _read_by(_telecommand)]
ParameterName = Annotated[Parameter, _read_by(lambda name, icd: icd.parameters[name])]
Refusal = Annotated[str, _read_by(lambda name, icd: _member(name, icd.enums["error_code"]))]
ImageSize = Annotated[str, _read_by(lambda name, icd: _member(name, icd.enums["image_size"]))]
HexBytes = Annotated[bytes, _read_by(_hex_bytes)]
RawItem = Annotated[bytes | CanFrame, _read_by(_raw_item)]
RawItems = Annotated[list[RawItem], BeforeValidator(_as_list), AfterValidator(_of_one_link)]
Pattern = Annotated[str, _read_by(lambda text, _icd: pattern(text))]
Patterns = Annotated[list[Pattern], BeforeValidator(_as_list)]
FileName = Annotated[str, AfterValidator(_file_name)]
Texts = Annotated[list[str], BeforeValidator(_as_list)]
LONGEST_S: Final = 1e6
"""Longest time in a session, seconds: eleven days."""
Duration = Annotated[float, Field(ge=0.0, le=LONGEST_S)]
Timeout = Annotated[float, Field(ge=0.001, le=LONGEST_S)]
Count = Annotated[int, Field(ge=1)]
Link = Literal[BusName, "both"]


# --- steps ---


@dataclass
class SessionState:
    """What the steps of a session share."""

    rig: Rig
    folder: Path
    """Gets CSV and image files."""
    truth: Quaternion | TruthLogReader | None
    captured: dict[str, Value] = field(default_factory=dict)
    step_begin_s: float = 0.0
    """Begin of the present step, on `time.monotonic`."""

    def truth_of(self, reading: Reading) -> Quaternion:
        """Return the true attitude at the time of a reading."""
        if self.truth is None:
            raise BenchError("no truth to compare the attitude with")
        if not isinstance(self.truth, TruthLogReader):
            return self.truth
        if "time_of_exposure" not in reading.values:
            raise BenchError(f"{reading.name} has no time; read precise_attitude")
        return self.truth.at(float(reading["time_of_exposure"]))

    @property
    def variables(self) -> dict[str, Value]:
        """The captured values and the time."""
        now = time.time()
        return {**self.captured, "now": now, "now_s": int(now), "now_ms": int(now % 1.0 * MS_PER_S)}


@dataclass
class Attempt:
    """Outcome of one attempt of a step; `problem` is None if it passed, otherwise what was wrong."""

    problem: str | None = None
    detail: str = ""
    """What was observed."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """Telemetry read."""
    figures: dict[str, float] = field(default_factory=dict)
    latency_s: float | None = None
    """Largest latency, s."""


class Step(Keys):
    """One step: its action, given by the class; its expectations; how often it is tried."""

    default_name: ClassVar[str] = ""
    """The name of a step that has none, in which `self` is the step."""
    needs_link: ClassVar[bool] = True
    needs_emulator: ClassVar[bool] = False
    """Whether the step is for an emulator that the bench has started."""

    name: str = ""
    expect: dict[str, ReadConditions] = Field(default_factory=dict)
    attitude: AttitudeCheck | None = None
    capture: dict[str, str] = Field(default_factory=dict)
    """Variable → field."""
    link: Link | None = None
    repeat: Count = 1
    every_s: Duration = 0.2
    within_s: Duration | None = None
    """Repeat until the expectations hold, for at most this long."""
    timeout_s: Timeout | None = None
    retries: Annotated[int, Field(ge=0)] = 0
    max_latency_s: Duration | None = None

    @abstractmethod
    def run(self, session: SessionState, link: str) -> Attempt:
        """Try the action once on a link; `link` is empty for a step that needs none."""

    @property
    def pause_s(self) -> float:
        """Pause between attempts and between repetitions, s."""
        return self.every_s

    @property
    def patience(self) -> dict[str, Any]:
        """How long and how often the client asks."""
        return {"timeout_s": self.timeout_s, "retries": self.retries}

    @property
    def reading(self) -> Row | None:
        """The row that the step reads; None if it reads no telemetry."""
        return None

    @model_validator(mode="after")
    def _fits_its_row(self, info: ValidationInfo) -> Self:
        problems = [*self._problems(info)]
        if problems:
            raise ValueError(*problems)
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

    def judged(self, session: SessionState, reading: Reading) -> Attempt:
        """Compare a reading with the expectations."""
        attempt = Attempt(
            detail=summarize(reading.values), values=reading.values, latency_s=reading.latency_s or None
        )
        variables = session.variables
        problems = [
            text
            for name, wanted in self.expect.items()
            if (text := wanted.mismatch(name, reading[name], variables)) is not None
        ]
        if self.expect and not problems:
            attempt.detail = " ".join(f"{name}={show(reading[name])}" for name in self.expect)
        if self.attitude is not None and not problems:
            truth = self.attitude.attitude or session.truth_of(reading)
            error, problem = self.attitude.judge(reading.values, truth, session.rig.icd.conventions)
            if error is not None:
                attempt.figures.update(vars(error))
                attempt.detail += f" error: {show_angle(error.cross_boresight_arcsec)} cross, {show_angle(error.roll_arcsec)} roll"
            problems += [] if problem is None else [problem]
        attempt.problem = "; ".join(problems) or None
        return attempt


class RequestStep(Step):
    """A step whose request the unit accepts, or refuses if an error code is given."""

    refused: Refusal | None = None
    """Name of the expected error code; None if the request must be accepted."""

    def exchange(
        self, send: Callable[..., Answer], *arguments: Any, **options: Any
    ) -> tuple[Attempt, Answer | None]:
        """Send the request; return the attempt, and the answer if the request was accepted."""
        try:
            answer = send(*arguments, **self.patience, **options)
        except NackError as error:
            if self.refused is None:
                raise
            if error.code_name != self.refused:
                problem = f"refused with {error.code} ({error.code_name}), expected {self.refused}"
                return Attempt(problem=problem), None
            return Attempt(detail=f"refused with {error.code} ({self.refused}), as expected"), None
        if self.refused is not None:
            return Attempt(problem=f"accepted, expected to be refused with {self.refused}"), answer
        return Attempt(detail="accepted", latency_s=answer.latency_s), answer


class Command(RequestStep):
    """Send a telecommand."""

    default_name = "command {self.row.name}"
    row: Telecommand = Field(alias="command")
    values: dict[str, ReadOperand] = Field({}, alias="with")
    raw: HexBytes | None = Field(None, alias="with_hex")
    """Data as bytes instead of `values`, for malformed telecommands."""

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        yield from super()._problems(info)
        if self.values and self.raw is not None:
            yield "give the parameters as a table 'with' or as bytes 'with_hex', not both"
        yield from _unknown_fields("with", self.row, self.values)
        for name, item in self.row.named_fields.items() if self.raw is None else ():
            value = self.values.get(name)
            if value is None and item.required and not {"with", "with_hex"} & (info.context or {})["broken"]:
                yield f"with: row '{self.row.name}' needs the field '{name}', which is missing"
            elif value is not None and not isinstance(value, Variable):
                try:
                    item.to_raw(value, check=self.refused is None)
                except ProtocolError as error:
                    yield f"with: {self.row.name}.{name}: {error}"

    def run(self, session: SessionState, link: str) -> Attempt:
        """Send the telecommand."""
        data = self.raw
        if data is None:
            variables = session.variables
            values = {name: resolve(value, variables) for name, value in self.values.items()}
            data = self.row.encode(values, check=self.refused is None)
        return self.exchange(session.rig.client(link).command_raw, self.row.name, data)[0]


class ReadingStep(Step):
    """A step that reads a telemetry row."""

    row: Telemetry

    @property
    def reading(self) -> Row | None:
        """The row that the step reads."""
        return self.row


class Read(ReadingStep, RequestStep):
    """Read a telemetry row."""

    default_name = "read {self.row.name}"
    row: Readable = Field(alias="read")

    def run(self, session: SessionState, link: str) -> Attempt:
        """Read the row."""
        attempt, reading = self.exchange(session.rig.client(link).read, self.row.name)
        return attempt if reading is None or attempt.problem else self.judged(session, reading)


class Listen(ReadingStep):
    """Wait for unsolicited telemetry of a row, `count` times."""

    default_name = "listen for {self.row.name}"
    row: Telemetry = Field(alias="listen")
    count: Count = 1

    @property
    def pause_s(self) -> float:
        """No pause: the messages set the pace, and each is judged."""
        return 0.0

    def run(self, session: SessionState, link: str) -> Attempt:
        """Judge the next messages since the begin of the step that no earlier attempt has judged."""
        client = session.rig.client(link)
        attempt = Attempt()
        times: list[float] = []
        for _ in range(self.count):
            reading = client.wait_unsolicited(
                self.row.name, timeout_s=self.timeout_s, since_s=session.step_begin_s
            )
            times.append(reading.received_s)
            attempt = self.judged(session, reading)
            if attempt.problem is not None:
                return attempt
        if self.count > 1:  # without the wait for the first reading
            attempt.figures["rate_hz"] = (self.count - 1) / max(times[-1] - times[0], CLOCK_GRAIN_S)
        return attempt


class Sample(ReadingStep):
    """Read a telemetry row repeatedly into a CSV file."""

    default_name = "sample {self.row.name}"
    row: Readable = Field(alias="sample")
    every_s: Duration
    for_s: Duration
    file: FileName = ""
    at_least: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    """Fraction of the samples for which the expectations must hold."""
    min_samples: Count = 1

    @model_validator(mode="before")
    @classmethod
    def _from_table(cls, table: dict[str, Any]) -> dict[str, Any]:
        """Take the keys from a table `sample` too."""
        inner = table.get("sample")
        if not isinstance(inner, dict):
            return table
        return {**table, **{"sample" if key == "telemetry" else key: value for key, value in inner.items()}}

    def run(self, session: SessionState, link: str) -> Attempt:
        """Read the row for some time; write the values, and judge each reading."""
        client = session.rig.client(link)
        name = self.file or f"{self.row.name}.csv"
        fields = list(self.row.named_fields)
        latencies: list[float] = []
        crosses: list[float] = []
        problems: list[str] = []
        last = Attempt()
        begin = time.monotonic()
        with (session.folder / name).open("w", newline="", encoding="utf-8", buffering=1) as stream:
            writer = csv.writer(stream)
            writer.writerow(["obc_time_s", "latency_ms", *fields])
            while time.monotonic() - begin < self.for_s or not latencies:
                reading = client.read(self.row.name, **self.patience)
                head = f"{reading.received_unix_s:.6f}", f"{reading.latency_s * MS_PER_S:.3f}"
                writer.writerow([*head, *(_in_csv(reading[field]) for field in fields)])
                latencies.append(reading.latency_s)
                last = self.judged(session, reading)
                if last.problem is not None:
                    problems.append(last.problem)
                crosses += [last.figures[key] for key in ("cross_boresight_arcsec",) if key in last.figures]
                time.sleep(max(0.0, begin + len(latencies) * self.every_s - time.monotonic()))
        count = len(latencies)
        measured = {
            "latency_p50_ms": percentile(latencies, 0.5) * MS_PER_S,
            "latency_p99_ms": percentile(latencies, 0.99) * MS_PER_S,
        }
        if crosses:
            measured["cross_boresight_median_arcsec"] = percentile(crosses, 0.5)
            measured["cross_boresight_max_arcsec"] = max(crosses)
        shown = " ".join(f"{key}={value:.4g}" for key, value in measured.items())
        detail = f"{count} samples in {name}, {count - len(problems)} good, {shown}"
        good_share = (count - len(problems)) / count
        problem = None
        if good_share < self.at_least:
            problem = f"{len(problems)} of {count} samples did not meet the expectations; the last one: {problems[-1]}"
        elif count < self.min_samples:
            problem = (
                f"only {count} samples arrived in {self.for_s:g} s, expected at least {self.min_samples}"
            )
        figures = {"samples": float(count), "good_share": good_share, **measured}
        return Attempt(problem, detail, last.values, figures, max(latencies))


class SetParameter(RequestStep):
    """Set a parameter by name and read it back."""

    default_name = "set parameter {self.parameter.name}"
    parameter: ParameterName = Field(alias="set_parameter")
    value: ReadOperand

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

    def run(self, session: SessionState, link: str) -> Attempt:
        """Set the parameter; if it must be accepted, read it back."""
        client, name = session.rig.client(link), self.parameter.name
        value = resolve(self.value, session.variables)
        attempt, ack = self.exchange(client.set_parameter, name, value, checked=self.refused is None)
        if ack is not None and self.refused is None:
            read_back = client.get_parameter(name)
            expected = self.parameter.check(value)
            if read_back != expected and not (
                isinstance(read_back, float) and abs(read_back - float(expected)) <= 1e-6 * abs(read_back)
            ):
                attempt.problem = f"{name} reads back as {show(read_back)}, expected {show(expected)}"
            attempt.detail = f"{name}={show(read_back)}"
        return attempt


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
        self._row = (info.context or {})["icd"].telemetry["parameter"]
        yield from super()._problems(info)

    def run(self, session: SessionState, link: str) -> Attempt:
        """Read the parameter."""
        return self.judged(session, session.rig.client(link).read_parameter(self.parameter.name))


class DownloadImage(Step):
    """Save an image in the unit, download it and write it as a PNG file."""

    default_name = "download image {self.file}"
    file: FileName = Field(alias="download_image")
    size: ImageSize = "size_128"
    method: Literal["frames", "burst"] = "frames"
    """`frames` of 128 bytes, or `burst` packets with hole maps."""

    def run(self, session: SessionState, link: str) -> Attempt:
        """Download the image; a blank one is a problem."""
        image = session.rig.client(link).download_image(self.size, method=self.method)
        write_png(session.folder / self.file, image.pixels, image.width, image.height)
        figures = {
            "seconds": image.seconds,
            "bytes": float(image.bytes_received),
            "repeats": float(image.repeats),
        }
        levels = set(image.pixels)
        detail = f"{image.width}x{image.height} in {image.seconds:.2f} s → {self.file}"
        problem = f"{detail}: the image is blank (all pixels {levels.pop()})" if len(levels) == 1 else None
        return Attempt(problem, detail, {}, figures)


class Send(Step):
    """Send raw bytes in hexadecimal (serial) or CAN frames in the format of `cansend`, and check the answer.

    The format determines the link. Without `answer`, anything may be answered.
    """

    default_name = "send raw data"
    data: RawItems = Field(alias="send")
    answer: Patterns | None = None
    listen_s: Duration = 0.3

    @model_validator(mode="after")
    def _on_the_link_of_its_format(self) -> Self:
        self.link = "can" if isinstance(self.data[0], CanFrame) else "serial"
        return self

    def run(self, session: SessionState, link: str) -> Attempt:
        """Send the data and compare what comes back."""
        patterns = self.answer or []
        client = session.rig.client(link)
        listening = send_and_listen(client.core, self.data, self.listen_s, patterns, self.timeout_s)
        received = client.run(listening)
        shown = ", ".join(text for text in received if text) or "nothing"
        if self.answer is None:
            return Attempt(detail=f"came back: {shown}")
        if link == "serial":
            patterns = ["".join(patterns)]
        if len(received) == len(patterns) and all(
            matches(a, b) for a, b in zip(patterns, received, strict=True)
        ):
            return Attempt(detail=f"came back: {shown}, as expected")
        return Attempt(
            problem=f"came back: {shown}, expected {', '.join(filter(None, patterns)) or 'nothing'}"
        )


class Wait(Step):
    """Do nothing for a while."""

    default_name = "wait {self.seconds:g} s"
    needs_link = False
    seconds: Duration = Field(alias="wait_s")

    def run(self, session: SessionState, link: str) -> Attempt:  # noqa: ARG002 -- any session, no link
        """Wait."""
        time.sleep(self.seconds)
        return Attempt()


class Restart(Step):
    """End the emulator that the session started, by a signal, and start it again."""

    default_name = "restart the emulator ({self.signal})"
    needs_link = False
    needs_emulator = True
    signal: Literal["term", "kill"] = Field(alias="restart")

    def run(self, session: SessionState, link: str) -> Attempt:  # noqa: ARG002 -- no link
        """Restart the emulator."""
        session.rig.restart(self.signal)
        return Attempt(detail="ready again")


class Control(Step):
    """Send a request on the control channel of the emulator that the session started."""

    default_name = "control channel: {self.action}"
    needs_link = False
    needs_emulator = True
    action: Literal["fault", "clear_faults", "set_truth", "scenario", "step"] = Field(alias="control")
    keys: Annotated[dict[str, Any], AfterValidator(_as_json)] = Field({}, alias="with")

    def run(self, session: SessionState, link: str) -> Attempt:  # noqa: ARG002 -- no link
        """Send the request."""
        return Attempt(detail=json.dumps(session.rig.control(self.action, self.keys)))


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


def _in_csv(value: Value) -> Value:
    """Return a value as it stands in a CSV file, where a flag is 0 or 1; numbers keep all digits."""
    if isinstance(value, bytes):
        return value.hex()
    return int(value) if isinstance(value, bool) else value


# --- expectations and fields of the definition ---


def _unknown_fields(key: str, row: Row, names: Iterable[str]) -> Iterator[str]:
    known = row.named_fields
    for name in names:
        if name not in known:
            yield f"{key}: row '{row.name}' has no field '{name}'{remedy(name, known)}"


def _impossible(item: RowField, conditions: Conditions) -> Iterator[str]:
    """Yield why conditions can never hold, and convert their values in place to those of the field."""
    if item.kind == "bytes":
        numeric = {"min", "max", "above", "within", "plus", "angle_deg"}
        keys = {Conditions.model_fields[name].alias or name for name in conditions.model_fields_set}
        for key in sorted(numeric & keys):
            yield f"'{item.name}' is bytes, and '{key}' is for numbers; give value, one_of or not"
    problems: list[str] = []

    def convert(value: Operand) -> Operand:
        try:
            return value if isinstance(value, Variable) else _expected(item, value)
        except ValueError as error:
            problems.append(f"'{item.name}' is {error}")
            return value

    for key in ("value", "angle_deg", "differs_from"):
        if (value := getattr(conditions, key)) is not None:
            setattr(conditions, key, convert(value))
    conditions.one_of = [convert(value) for value in conditions.one_of]
    yield from problems


def _expected(item: RowField, value: Value) -> Value:
    """Return a value of a script as the field has it: bytes for hexadecimal text, true for the name `true` of a flag."""
    if item.kind == "bytes":
        with suppress(ValueError):
            if isinstance(value, str) and len(data := bytes.fromhex(value)) == item.size:
                return data
        raise ValueError(f"{item.size} bytes in hexadecimal, not {show(value)!r}")
    if item.is_flag:
        value = FLAGS.get(value, value) if item.enum is not None and isinstance(value, str) else value
        if not isinstance(value, bool):
            raise ValueError(f"true or false, not {value!r}")
    elif item.enum is not None:
        if value not in item.enum.values and type(value) is not int:
            hint = did_you_mean(show(value), item.enum.values) or f"; one of: {', '.join(item.enum.values)}"
            raise ValueError(f"never '{show(value)}'{hint}")
    elif isinstance(value, bool):
        raise ValueError(f"not true or false, not {value!r}")
    elif item.kind != "text" and isinstance(value, str):
        raise ValueError(f"a number, not {value!r}")
    return value
