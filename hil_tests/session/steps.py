"""The actions of a session script, one class each: their keys, their checks before the run, and what the step does.

The keys of a class are the keys of its step, and a validated step is what the session runs. Rows, fields, parameters
and names in enumerations are those of the interface definition. Beside what `step` takes from the context of validation,
`broken` are the keys of the step that are wrong.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from starhil.hil_tests.client.images import check_download, write_png
from starhil.hil_tests.client.raw_traffic import matches, send_and_listen
from starhil.hil_tests.session.expect import ReadOperand, Variable, resolve, show, unknown_fields
from starhil.hil_tests.session.step import MS_PER_S, Attempt, RequestStep, SessionState, Step
from starhil.hil_tests.session.step_keys import (
    Count,
    Duration,
    FileName,
    HexBytes,
    ParameterName,
    RawItems,
    Readable,
    ReadAnswers,
    Telecommand,
    Telemetry,
    check_json,
)
from starhil.hil_tests.timing.figures import percentile
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import Value
from starhil.protocol.serial.stack import chosen_dialect
from starid.storage.files import open_output

CLOCK_GRAIN_S: Final = 1e-6


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
        yield from unknown_fields("with", self.row, self.values)
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
        return self.row


class Read(ReadingStep, RequestStep):
    """Read a telemetry row."""

    default_name = "read {self.row.name}"
    row: Readable = Field(alias="read")

    def run(self, session: SessionState, link: str) -> Attempt:
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
        with open(
            session.folder / name, "w", newline="", encoding="utf-8", buffering=1, opener=open_output
        ) as stream:
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
        return self._row

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        self._row = (info.context or {})["icd"].telemetry["parameter"]
        yield from super()._problems(info)

    def run(self, session: SessionState, link: str) -> Attempt:
        return self.judged(session, session.rig.client(link).read_parameter(self.parameter.name))


class DownloadImage(Step):
    """Save an image in the unit, download it and write it as a PNG file."""

    default_name = "download image {self.file}"
    file: FileName = Field(alias="download_image")
    size: str = "size_128"
    """A name of the enumeration `image_size`."""
    method: Literal["frames", "burst"] = "frames"
    """`frames` of 128 bytes, or `burst` packets with hole maps."""

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        yield from super()._problems(info)
        try:
            check_download((info.context or {})["icd"], self.size)
        except ProtocolError as error:
            yield str(error)

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

    The format determines the link. Without `answer`, anything may be answered; it can be a table of answers by dialect.
    """

    default_name = "send raw data"
    data: RawItems = Field(alias="send")
    answer: ReadAnswers | None = None
    listen_s: Duration = 0.3

    @model_validator(mode="after")
    def _on_the_link_of_its_format(self) -> Self:
        self.link = "can" if isinstance(self.data[0], CanFrame) else "serial"
        return self

    def run(self, session: SessionState, link: str) -> Attempt:
        """Send the data and compare what comes back."""
        patterns = self.answer or []
        if isinstance(patterns, dict):
            patterns = patterns[str(chosen_dialect(session.rig.icd, session.rig.options.dialect))]
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
        time.sleep(self.seconds)
        return Attempt()


class Restart(Step):
    """End the emulator that the session started, by a signal, and start it again."""

    default_name = "restart the emulator ({self.signal})"
    needs_link = False
    needs_emulator = True
    signal: Literal["term", "kill"] = Field(alias="restart")

    def run(self, session: SessionState, link: str) -> Attempt:  # noqa: ARG002 -- no link
        session.rig.restart(self.signal)
        return Attempt(detail="ready again")


class Control(Step):
    """Send a request on the control channel of the emulator."""

    default_name = "control channel: {self.action}"
    needs_link = False
    needs_control = True
    action: Literal["fault", "clear_faults", "set_truth", "scenario", "step", "wait"] = Field(alias="control")
    keys: Annotated[dict[str, Any], AfterValidator(check_json)] = Field({}, alias="with")

    def run(self, session: SessionState, link: str) -> Attempt:  # noqa: ARG002 -- no link
        return Attempt(detail=in_words(session.rig.control(self.action, self.keys)))


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


def in_words(answer: Mapping[str, Any]) -> str:
    """Return an answer of the control channel in one line, for people."""
    return ", ".join(_shown(key, value) for key, value in answer.items())


def _shown(key: str, value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{key} {in_words(value) or 'none'}"
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        return "; ".join(_shown(key, item) for item in value)
    if value is True:
        return key
    if isinstance(value, list):
        return f"{key} {' '.join(map(show, value))}"
    return f"{key} {show(value)}" if isinstance(value, int | float | str) else f"{key} none"


def _in_csv(value: Value) -> Value:
    """Return a value as it stands in a CSV file, where a flag is 0 or 1; numbers keep all digits."""
    if isinstance(value, bytes):
        return value.hex()
    return int(value) if isinstance(value, bool) else value
