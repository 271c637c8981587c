"""Cases written as data: what is sent on a line or bus, and what must come back.

    [texts]
    clear = "command clear_counters"            # names in braces, besides those of the link

    [[area]]
    name = "errors"
    clause = "ICD 4.3"
    links = ["serial"]                          # default: serial and can; for canopen, see `canopen_dialogue`
    intrusive = true                            # default: false
    cases = [
        { id = "junk", title = "junk sets a flag", lines = "{clear}; 00 55; silence; telemetry status junk=true" },
    ]

`clause` and `intrusive` of a case replace those of its area; a case with a name in braces that the unit
lacks is left out, an unknown name is an error.
The steps of `lines` are separated by semicolons or stand in lines of their own:

    1F 7F 80 1F FF > 128        raw bytes, and the next answers: telemetry rows by ID
    1F 7F 03 1F FF > 3!crc      ... or a refusal by an error's name
    0480HHDD# > 0580DDHH#....   on CAN, frames in the format of cansend, and frames in which `..` is any byte;
                                HH and DD are the addresses of host and device
    silence, silence 0.8        nothing comes within a time, s
    sleep 0.1, drain            wait; discard what was received
    command clear_counters      a telecommand without values, which must be accepted
    telemetry status a=1 b=true     a row with these values; of two for one field, the last

`(00)*600` repeats a text. At the end nothing more may come, and the next request must be answered.
"""

from __future__ import annotations

import json
import re
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from starhil.hil_tests.conformance.case import Case, case_in, check, check_equal
from starhil.hil_tests.conformance.link_probe import LinkProbe
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.links import BUSES, LinkName
from starhil.protocol.errors import did_you_mean
from starhil.protocol.files.user_file import TomlError, read_user_toml
from starhil.protocol.files.validation import problems

CUBESPACE_CASES: Final = Path(__file__).with_name("cubespace_cases.toml")
IN_BRACES: Final = re.compile(r"\{(\w+)\}")
REPEATED: Final = re.compile(r"\(([^()]*)\)\*(\d+)")
VERBS: Final = {
    "silence": range(2),
    "sleep": range(1, 2),
    "drain": range(1),
    "command": range(1, 2),
    "telemetry": range(2, 99),
}
"""Steps other than raw traffic, and how many words may follow."""
SECONDS: Final = re.compile(r"\d+(\.\d*)?")
SENT: Final = re.compile(r"([0-9A-F]{2})+|[0-9A-FHD]+#([0-9A-F]*|R)", re.IGNORECASE)
ANSWER: Final = re.compile(r"\d+(!\w*)?|[0-9A-FHD]+#[0-9A-F.]*", re.IGNORECASE)
"""Bytes or a frame, and an answer."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class CaseText(_Model):
    """One case; id, title and clause as in `Case`."""

    id: str
    title: str
    lines: str
    clause: str | None = None
    intrusive: bool | None = None


class AreaText(_Model):
    """The cases of one area of the protocol."""

    name: str
    clause: str
    links: list[LinkName] = list(BUSES)
    intrusive: bool = False
    cases: list[CaseText]


class CaseFile(_Model):
    """A file of cases."""

    texts: dict[str, str] = {}
    area: list[AreaText]


def _read(path: Path) -> CaseFile:
    """Read a file of cases.

    Raises BenchError: it is not one; the text names all errors.
    """
    try:
        document = read_user_toml(path)
        return CaseFile.model_validate(document)
    except ValidationError as error:
        raise BenchError(*(f"{path}: {item}" for item in problems(error, CaseFile, document))) from None
    except OSError as error:
        raise BenchError(f"{path}: cannot be read: {error.strerror}") from None
    except TomlError as error:
        raise BenchError(f"{path}: not valid TOML: {error}") from None


def _steps(lines: str) -> list[str]:
    """Return the steps of a case, with repeated texts written out."""
    whole = REPEATED.sub(lambda found: found[1] * int(found[2]), lines.strip())
    return [step.strip() for step in re.split("[;\n]", whole) if step.strip()]


def _faults(lines: str) -> Iterator[str]:
    """Yield what is wrong with the steps of a case."""
    for step in _steps(lines):
        verb, *words = step.split()
        counts = VERBS.get(verb)
        if counts is not None:
            numbers = verb in ("silence", "sleep")
            if len(words) not in counts or (numbers and not all(map(SECONDS.fullmatch, words))):
                yield f"{step}: wrong words after {verb!r}"
            continue
        sent, _, answers = step.partition(">")
        raw = all(map(SENT.fullmatch, sent.split())) and all(map(ANSWER.fullmatch, answers.split()))
        if not raw or not sent:
            yield f"{step}: neither raw traffic nor a known step{did_you_mean(verb, VERBS)}"


@cache
def _names_of_links() -> frozenset[str]:
    """Return all names in braces of serial and CAN, of which a unit may lack some."""
    return frozenset(IN_BRACES.findall(CUBESPACE_CASES.read_text(encoding="utf-8")))


def hold(lines: str, probe: LinkProbe) -> None:
    """Carry out the steps of a case."""
    for step in _steps(lines):
        match step.split():
            case "silence", *seconds:
                probe.expect_silence("nothing was requested", float(seconds[0]) if seconds else None)
            case "sleep", seconds:
                probe.sleep(float(seconds))
            case "drain", *_:
                probe.drain()
            case "command", name:
                check(name in probe.unit.telecommands, f"a telecommand {name!r} in the definition", "none")
                probe.command(name)
            case "telemetry", name, *values:
                check(name in probe.unit.telemetry, f"telemetry {name!r} in the definition", "none")
                wanted = {key: _value(text) for key, _, text in (item.partition("=") for item in values)}
                seen = probe.telemetry(name)
                check_equal({key: seen.get(key, "no such field") for key in wanted}, wanted, name)
            case _:
                sent, _, answers = step.partition(">")
                probe.exchange(sent, answers.split())
    probe.expect_silence("no more was requested")
    # an incomplete message ends at the start of the next one
    probe.expect_alive()


def _value(text: str) -> Any:
    """Return a number, a flag, or the name of a value."""
    with suppress(ValueError):
        return json.loads(text)
    return text


def text_cases(
    path: Path,
    link: str,
    names: dict[str, str],
    run: Callable[[str, Any], None] = hold,
    faults: Callable[[str], Iterable[str]] = _faults,
) -> list[Case[Any]]:
    """Return the cases of a file for a link; `names` are its names in braces, `run` carries out lines with a probe.

    Raises BenchError: the file cannot be read, has errors, or `faults` finds some in lines; one line for each.
    """
    file = _read(path)
    known = ChainMap(file.texts, names)
    found, wrong = [], []
    for area in file.area:
        for item in area.cases if link in area.links else ():
            try:
                texts = item.id, item.title, item.clause or area.clause, item.lines
                name, title, clause, lines = (text.format_map(known) for text in texts)
            except KeyError as missing:
                name = missing.args[0]
                if name not in _names_of_links():
                    close = did_you_mean(name, {*known, *_names_of_links()})
                    wrong.append(f"{path}: {area.name}.{item.id}: unknown name {name!r} in braces{close}")
                continue
            except ValueError as error:
                wrong.append(f"{path}: {area.name}.{item.id}: braces: {error}")
                continue
            changes = area.intrusive if item.intrusive is None else item.intrusive
            found.append(case_in(area.name, name, title, partial(run, lines), clause, intrusive=changes))
            wrong += [f"{path}: {area.name}.{name}: {fault}" for fault in faults(lines)]
    if wrong:
        raise BenchError(*wrong)
    return found
