"""Session scripts: TOML files of telecommands, reads and expectations, validated before the run.

    title = "First light"

    [emulator]                      # used by `starhil session --start`
    profile = "default"
    set = ["truth.ra_deg=83.8"]

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

Every step has exactly one of the keys in `ACTIONS`. Rows, fields, parameters and enumeration names are those
of the interface definition; the error for an unknown name gives file, step and near matches.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from starhil.hil_tests.errors import BenchError, ScriptError
from starhil.hil_tests.expect import (
    AttitudeCheck,
    Expectation,
    Operand,
    Variable,
    operand,
    read_attitude_check,
    read_expectation,
    read_stated_attitude,
    show,
)
from starhil.hil_tests.raw_traffic import parse_frame, pattern
from starhil.hil_tests.script_model import (
    LINKS,
    SIGNALS,
    Action,
    Command,
    DownloadImage,
    EmulatorRequest,
    GetParameter,
    Listen,
    Read,
    Restart,
    Sample,
    Script,
    Send,
    SetParameter,
    Step,
    Truth,
    Wait,
)
from starhil.hil_tests.script_reader import TableReader
from starhil.protocol.codec import Field, Row
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.errors import ProtocolError
from starhil.protocol.names import did_you_mean
from starhil.protocol.user_file import read_user_text
from starhil.protocol.values import Parameter, Value

LISTED: Final = "; `starhil icd list` lists all"
"""Hint if no known name is similar."""

ATTITUDE_FIELDS: Final = frozenset({"q_x", "q_y", "q_z"})


def load_script(path: Path, icd: InterfaceDefinition) -> Script:
    """Read and check a session script.

    Raises
    ------
    ScriptError
        The file cannot be read, is not TOML, or does not match the interface definition; the text gives file,
        step and near matches.
    """
    try:
        table = tomllib.loads(read_user_text(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ScriptError(f"{path}: cannot be read: {reason}") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ScriptError(f"{path}: not valid TOML: {error}") from None
    return _Checker(path, icd).script(table)


class _Checker:
    """Validates the tables of one file, with the variables that earlier steps captured."""

    def __init__(self, path: Path, icd: InterfaceDefinition) -> None:
        self._path = path
        self._icd = icd
        self._captured: set[str] = set()
        self._has_truth = False

    def script(self, table: dict[str, Any]) -> Script:
        """Check the whole file."""
        reader = TableReader(table, self._path.name)
        title = reader.text("title", self._path.stem.replace("_", " "))
        doc = reader.text("doc", "")
        truth = self._truth(reader.sub("truth"))
        self._has_truth = truth.attitude is not None or truth.file is not None
        emulator = self._emulator(reader.sub("emulator"))
        defaults = reader.sub("defaults")
        timeout_s = defaults.number("timeout_s", 1.0, minimum=0.001)
        retries = defaults.count("retries", 0, minimum=0)
        keep_going = defaults.flag("keep_going", default=False)
        link = self._link(defaults)
        defaults.reject_unknown_keys()
        tables = reader.sub_tables("step")
        reader.reject_unknown_keys()
        if not tables:
            reader.fail("has no steps: write [[step]] and one of the actions below it")
        steps = tuple(self._step(number, item) for number, item in enumerate(tables, start=1))
        return Script(self._path, title, doc, truth, emulator, timeout_s, retries, keep_going, link, steps)

    def _truth(self, reader: TableReader) -> Truth:
        attitude = read_stated_attitude(reader)
        file = self._file_name(reader, "file") if reader.has("file") else None
        reader.reject_unknown_keys()
        if attitude is not None and file is not None:
            reader.fail("give an attitude or a file, not both")
        return Truth(attitude, file)

    def _emulator(self, reader: TableReader) -> EmulatorRequest:
        request = EmulatorRequest(
            reader.text("profile") if reader.has("profile") else None,
            reader.texts("set"),
            reader.count("seed", 1, minimum=0) if reader.has("seed") else None,
        )
        reader.reject_unknown_keys()
        return request

    def _step(self, number: int, table: dict[str, Any]) -> Step:
        reader = TableReader(table, f"{self._path.name}: step {number}")
        present = [key for key in ACTIONS if key in table]
        if len(present) != 1:
            unknown = [key for key in table if key not in STEP_KEYS]
            hint = f"; '{unknown[0]}' is unknown{did_you_mean(unknown[0], STEP_KEYS)}" if unknown else ""
            found = "has none" if not present else f"has {' and '.join(present)}"
            reader.fail(f"needs exactly one action of {', '.join(ACTIONS)}; {found}{hint}")
        verb = present[0]
        action, default_name = ACTIONS[verb](self, reader)
        name = reader.text("name", default_name)
        row = self._answer_row(action)
        expect = self._expectations(reader, row)
        attitude = self._attitude(reader, row)
        capture = self._captures(reader, row)
        step = Step(
            number=number,
            name=name,
            action=action,
            expect=expect,
            attitude=attitude,
            capture=capture,
            link=action.link if isinstance(action, Send) else self._link(reader),
            repeat=reader.count("repeat", 1),
            every_s=action.every_s
            if isinstance(action, Sample)
            else reader.number("every_s", 0.2, minimum=0.0),
            within_s=reader.optional_number("within_s", minimum=0.0),
            timeout_s=reader.optional_number("timeout_s", minimum=0.001),
            retries=reader.count("retries", 0, minimum=0),
            max_latency_s=reader.optional_number("max_latency_s", minimum=0.0),
        )
        reader.reject_unknown_keys()
        self._captured.update(capture)
        return step

    # --- parts of a step ---

    @staticmethod
    def _link(reader: TableReader) -> str | None:
        return reader.choice("link", LINKS) if reader.has("link") else None

    def _answer_row(self, action: Action) -> Row | None:
        """Return the row of the answer to an action, or None if it has no values."""
        if isinstance(action, Read | Listen | Sample):
            return action.row
        if isinstance(action, GetParameter):
            return self._icd.telemetry["parameter"]
        return None

    def _expectations(self, reader: TableReader, row: Row | None) -> tuple[Expectation, ...]:
        table = reader.value("expect", {})
        if not isinstance(table, dict):
            reader.fail("'expect' must be a table, such as { valid = true }")
        if table and row is None:
            reader.fail("'expect' needs a step that reads telemetry")
        known = frozenset(self._captured)
        place = TableReader(table, f"{reader.location}: expect")
        expectations = []
        for name, value in table.items():
            self._check_field(place, row, name)
            expectation = read_expectation(name, value, place, known)
            expectations.append(self._check_kind(place, row, expectation))
        return tuple(expectations)

    def _attitude(self, reader: TableReader, row: Row | None) -> AttitudeCheck | None:
        if not reader.has("attitude"):
            return None
        if row is None or not row.named_fields.keys() >= ATTITUDE_FIELDS:
            reader.fail("'attitude' needs a step that reads a row with a quaternion (attitude, quaternion)")
        check = read_attitude_check(reader.sub("attitude"))
        if check.truth is None and not self._has_truth:
            reader.fail("'attitude' has no truth to compare with: give one here or in a table [truth]")
        return check

    def _captures(self, reader: TableReader, row: Row | None) -> dict[str, str]:
        table = reader.value("capture", {})
        if not isinstance(table, dict) or not all(isinstance(v, str) for v in table.values()):
            reader.fail("'capture' must be a table such as { variable = \"field\" }")
        if table and row is None:
            reader.fail("'capture' needs a step that reads telemetry")
        for name in table.values():
            self._check_field(TableReader(table, f"{reader.location}: capture"), row, name)
        return dict(table)

    def _check_field(self, reader: TableReader, row: Row | None, name: str) -> None:
        if row is not None and name not in row.named_fields:
            known = f"; its fields: {', '.join(row.named_fields)}" if row.named_fields else "; it has none"
            reader.fail(
                f"row '{row.name}' has no field '{name}'{did_you_mean(name, row.named_fields) or known}"
            )

    def _check_kind(self, reader: TableReader, row: Row | None, expectation: Expectation) -> Expectation:
        """Reject an expectation that can never hold: wrong type, or unknown name of an enumeration.

        For a field of bytes, hexadecimal text is converted.
        """
        if row is None:
            return expectation
        item = row.named_fields[expectation.field]
        if item.kind == "bytes":
            return _in_bytes(reader, item, expectation)
        for value in (expectation.equals, expectation.differs_from, *expectation.one_of):
            if value is None or isinstance(value, Variable):
                continue
            if item.enum is not None:
                if value not in item.enum.values and (isinstance(value, bool) or not isinstance(value, int)):
                    known = f"; one of: {', '.join(item.enum.values)}"
                    near = did_you_mean(show(value), item.enum.values) or known
                    reader.fail(f"'{item.name}' is never '{show(value)}'{near}")
            elif (item.kind == "flag") != isinstance(value, bool):
                kind = "true or false" if item.kind == "flag" else "not true or false"
                reader.fail(f"'{item.name}' is {kind}, not {value!r}")
            elif item.kind in ("integer", "float", "bits") and isinstance(value, str):
                reader.fail(f"'{item.name}' is a number, not {value!r}")
        return expectation

    def _row(self, reader: TableReader, key: str, *, telecommand: bool) -> Row:
        name = reader.text(key)
        rows = self._icd.telecommands if telecommand else self._icd.telemetry
        if name not in rows:
            other = self._icd.telemetry if telecommand else self._icd.telecommands
            kind = "telecommand" if telecommand else "telemetry row"
            remedy = "; it is telemetry: use read" if telecommand else "; it is a telecommand: use command"
            reader.fail(
                f"unknown {kind} '{name}'{remedy if name in other else did_you_mean(name, rows) or LISTED}"
            )
        return rows[name]

    def _parameter(self, reader: TableReader, key: str) -> Parameter:
        name = reader.text(key)
        if name not in self._icd.parameters:
            reader.fail(f"unknown parameter '{name}'{did_you_mean(name, self._icd.parameters) or LISTED}")
        return self._icd.parameters[name]

    def _refusal_code(self, reader: TableReader) -> str | None:
        if not reader.has("refused"):
            return None
        return reader.choice("refused", self._icd.enums["error_code"].values)

    # --- the actions, one reader each ---

    def command(self, reader: TableReader) -> tuple[Action, str]:
        """Read a telecommand and check its parameters."""
        row = self._row(reader, "command", telecommand=True)
        refused = self._refusal_code(reader)
        raw = reader.hex_bytes("with_hex") if reader.has("with_hex") else None
        given = reader.value("with", {})
        if not isinstance(given, dict) or (given and raw is not None):
            reader.fail("give the parameters as a table 'with' or as bytes 'with_hex', not both")
        place = TableReader(given, f"{reader.location}: with")
        for name in given:
            self._check_field(place, row, name)
        known = frozenset(self._captured)
        values = {name: operand(value, place, name, known) for name, value in given.items()}
        if raw is None and not any(isinstance(value, Variable) for value in values.values()):
            try:
                row.encode(static_values(values), check=refused is None)
            except ProtocolError as error:
                reader.fail(str(error))
        return Command(row, values, raw, refused), f"command {row.name}"

    def read(self, reader: TableReader) -> tuple[Action, str]:
        """Read a request for telemetry."""
        row = self._row(reader, "read", telecommand=False)
        return Read(row, self._refusal_code(reader)), f"read {row.name}"

    def listen(self, reader: TableReader) -> tuple[Action, str]:
        """Read a wait for unsolicited telemetry."""
        row = self._row(reader, "listen", telecommand=False)
        return Listen(row, reader.count("count", 1)), f"listen for {row.name}"

    def sample(self, reader: TableReader) -> tuple[Action, str]:
        """Read a series of samples, from a table or from the keys of the step."""
        place = reader
        if isinstance(reader.value("sample"), dict):
            place = reader.sub("sample")
            row = self._row(place, "telemetry", telecommand=False)
        else:
            row = self._row(place, "sample", telecommand=False)
        at_least = place.number("at_least", 1.0, minimum=0.0)
        if at_least > 1.0:
            place.fail("'at_least' is a fraction of the samples, from 0 to 1")
        action = Sample(
            row,
            place.number("every_s", minimum=0.0),
            place.number("for_s", minimum=0.0),
            self._file_name(place, "file", f"{row.name}.csv"),
            at_least,
            place.count("min_samples", 1),
        )
        if place is not reader:
            place.reject_unknown_keys()
        return action, f"sample {row.name}"

    def set_parameter(self, reader: TableReader) -> tuple[Action, str]:
        """Read a parameter to be set."""
        parameter = self._parameter(reader, "set_parameter")
        refused = self._refusal_code(reader)
        value = operand(reader.value("value"), reader, "value", frozenset(self._captured))
        if refused is None and not isinstance(value, Variable):
            try:
                parameter.check(static_values({"value": value})["value"])
            except ProtocolError as error:
                reader.fail(str(error))
        elif isinstance(value, str):
            reader.fail("'value' must be a number if a refusal is expected")
        return SetParameter(parameter, value, refused), f"set parameter {parameter.name}"

    def get_parameter(self, reader: TableReader) -> tuple[Action, str]:
        """Read a request for a parameter."""
        parameter = self._parameter(reader, "get_parameter")
        return GetParameter(parameter), f"get parameter {parameter.name}"

    def download_image(self, reader: TableReader) -> tuple[Action, str]:
        """Read an image download."""
        file = self._file_name(reader, "download_image")
        size = reader.choice("size", self._icd.enums["image_size"].values, "size_128")
        method = reader.choice("method", ("frames", "burst"), "frames")
        return DownloadImage(file, size, method), f"download image {file}"

    def send(self, reader: TableReader) -> tuple[Action, str]:
        """Read raw bytes or frames to send; their format determines the link."""
        data = reader.texts("send")
        answer = reader.texts("answer") if reader.has("answer") else None
        kinds = set()
        try:
            for text in data:
                kinds.add("can" if "#" in text else "serial")
                if "#" in text:
                    parse_frame(text)
                else:
                    bytes.fromhex(text)
            for text in answer or ():
                pattern(text)
        except (BenchError, ValueError) as error:
            reader.fail(f"'send' or 'answer': {error}")
        if len(kinds) != 1:
            reader.fail("'send' takes bytes in hexadecimal or CAN frames in the format of cansend, not both")
        listen_s = reader.number("listen_s", 0.3, minimum=0.0)
        return Send(kinds.pop(), data, answer, listen_s), "send raw data"

    def wait(self, reader: TableReader) -> tuple[Action, str]:
        """Read a pause."""
        seconds = reader.number("wait_s", minimum=0.0)
        return Wait(seconds), f"wait {seconds:g} s"

    def restart(self, reader: TableReader) -> tuple[Action, str]:
        """Read a restart of the emulator."""
        signal = reader.choice("restart", SIGNALS)
        return Restart(signal), f"restart the emulator ({signal})"

    def _file_name(self, reader: TableReader, key: str, default: str | None = None) -> str:
        """Read the name of a file to write in the log folder."""
        name = reader.text(key, default)
        if name in {"", ".."} or Path(name).name != name or "\0" in name:
            reader.fail(f"'{key}' must be a plain file name; the file is written to the log folder")
        return name


ACTIONS: Final[Mapping[str, Callable[[_Checker, TableReader], tuple[Action, str]]]] = {
    "command": _Checker.command,
    "read": _Checker.read,
    "listen": _Checker.listen,
    "sample": _Checker.sample,
    "set_parameter": _Checker.set_parameter,
    "get_parameter": _Checker.get_parameter,
    "download_image": _Checker.download_image,
    "send": _Checker.send,
    "wait_s": _Checker.wait,
    "restart": _Checker.restart,
}
"""Key of an action → its reader."""

STEP_KEYS: Final = (
    *ACTIONS,
    "name", "with", "with_hex", "refused", "expect", "attitude", "capture", "link", "repeat", "every_s", "within_s",
    "timeout_s", "retries", "max_latency_s", "count", "for_s", "file", "at_least", "min_samples", "value", "size", "method", "answer",
    "listen_s",
)  # fmt: skip


def _in_bytes(reader: TableReader, item: Field, expectation: Expectation) -> Expectation:
    """Convert the hexadecimal text in the expectation of a field of bytes."""

    def convert(value: Operand) -> Operand:
        if isinstance(value, Variable):
            return value
        try:
            data = bytes.fromhex(value) if isinstance(value, str) else b""
        except ValueError:
            data = b""
        if len(data) != item.size:
            reader.fail(f"'{item.name}' is {item.size} bytes in hexadecimal, not {show(value)!r}")
        return data

    for word, given in (
        ("min", expectation.minimum),
        ("max", expectation.maximum),
        ("above", expectation.above),
        ("within", expectation.within),
        ("plus", expectation.plus or None),
        ("angle_deg", expectation.angle or None),
    ):
        if given is not None:
            reader.fail(f"'{item.name}' is bytes, and '{word}' is for numbers; give value, one_of or not")
    return replace(
        expectation,
        equals=None if expectation.equals is None else convert(expectation.equals),
        one_of=tuple(convert(value) for value in expectation.one_of),
        differs_from=None if expectation.differs_from is None else convert(expectation.differs_from),
    )


def static_values(values: Mapping[str, Operand]) -> dict[str, Value]:
    """Return the literal values, without variables."""
    return {name: value for name, value in values.items() if not isinstance(value, Variable)}
