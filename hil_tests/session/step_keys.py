"""The keys of a step in a session script: names of the interface definition, raw data, times and files, read and checked.

Validation takes the interface definition from its context, `icd`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, ValidationInfo

from starhil.hil_tests.client.raw_traffic import parse_frame, pattern
from starhil.hil_tests.judge.links import BusName
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import OneLineError, did_you_mean
from starhil.protocol.icd import InterfaceDefinition, UnknownNameError
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import Parameter
from starhil.protocol.serial.stack import dialects_of

Answers: TypeAlias = list[str] | dict[str, list[str]]
"""Patterns of an answer, or those in each dialect."""


def _read_by(read: Callable[[str, InterfaceDefinition], Any]) -> PlainValidator:
    """Return a validator of texts, which a function reads in terms of the definition; its errors are those of the key."""

    def validate(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            raise ValueError("must be a text")  # noqa: TRY004 -- for pydantic
        icd: InterfaceDefinition = (info.context or {})["icd"]
        try:
            return read(value, icd)
        except UnknownNameError as error:
            raise ValueError(f"unit {icd.name}: {error}") from None
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


def _refusal(name: str, icd: InterfaceDefinition) -> str:
    errors = icd.error_numbers
    if name not in errors:
        allowed = ", ".join(f"{known} ({number})" for known, number in errors.items())
        raise ValueError(f"{name!r} is not one of {allowed}{did_you_mean(name, errors)}")
    return name


def _hex_bytes(text: str, _icd: InterfaceDefinition) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ValueError(f'must be bytes in hexadecimal, such as "1F 7F 80 1F FF", not {text!r}') from None


def _raw_item(text: str, icd: InterfaceDefinition) -> bytes | CanFrame:
    for rows, what, action in (
        (icd.telecommands, "a telecommand", "command"),
        (icd.telemetry, "telemetry", "read"),
    ):
        if text in rows:
            raise ValueError(f"takes raw data, and {text!r} is {what}: use {action}")
    return parse_frame(text) if "#" in text else _hex_bytes(text, icd)


def _of_one_link(items: list[bytes | CanFrame]) -> list[bytes | CanFrame]:
    if len(set(map(type, items))) != 1:
        raise ValueError("takes bytes in hexadecimal or CAN frames in the format of cansend, not both")
    return items


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _patterns(value: Any) -> list[str]:
    texts = _as_list(value)
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise ValueError("must be a text, or a list of texts")
    try:
        return [pattern(text) for text in texts]
    except OneLineError as error:
        raise ValueError(str(error)) from None


def _answers(value: Any, info: ValidationInfo) -> Answers:
    if not isinstance(value, dict):
        return _patterns(value)
    icd: InterfaceDefinition = (info.context or {})["icd"]
    dialects = dialects_of(icd.link.serial)
    if set(value) != set(dialects):
        known, given = (", ".join(names) or "none" for names in (dialects, value))
        raise ValueError(
            f"a table has an answer for each dialect of unit {icd.name} ({known}), not for {given}"
        )
    return {dialect: _patterns(answer) for dialect, answer in value.items()}


def check_json(table: dict[str, Any]) -> dict[str, Any]:
    """Return a table that can be written as JSON."""
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
Refusal = Annotated[str, _read_by(_refusal)]
HexBytes = Annotated[bytes, _read_by(_hex_bytes)]
RawItem = Annotated[bytes | CanFrame, _read_by(_raw_item)]
RawItems = Annotated[list[RawItem], BeforeValidator(_as_list), AfterValidator(_of_one_link)]
ReadAnswers = Annotated[Answers, PlainValidator(_answers)]
FileName = Annotated[str, AfterValidator(_file_name)]
Texts = Annotated[list[str], BeforeValidator(_as_list)]
LONGEST_S: Final = 1e6
"""Longest time in a session, seconds: eleven days."""
Duration = Annotated[float, Field(ge=0.0, le=LONGEST_S)]
Timeout = Annotated[float, Field(ge=0.001, le=LONGEST_S)]
Count = Annotated[int, Field(ge=1)]
Link = Literal[BusName, "both"]
