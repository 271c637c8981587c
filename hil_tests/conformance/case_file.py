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
lacks is left out, an unknown name is an error. The language of `lines` is that of `dialogue`.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from starhil.hil_tests.conformance.case import Case, Probe, case_in
from starhil.hil_tests.conformance.dialogue import IN_BRACES, Dialogue, LinkDialogue
from starhil.hil_tests.errors import BenchError
from starhil.hil_tests.judge.links import BUSES, LinkName
from starhil.protocol.errors import did_you_mean
from starhil.protocol.files.user_file import TomlError, read_user_toml
from starhil.protocol.files.validation import problems

CUBESPACE_CASES: Final = Path(__file__).with_name("cubespace_cases.toml")


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


@cache
def _names_of_links() -> frozenset[str]:
    """Return all names in braces of serial and CAN, of which a unit may lack some."""
    return frozenset(IN_BRACES.findall(CUBESPACE_CASES.read_text(encoding="utf-8")))


def _hold(dialogue: type[Dialogue[Any]], lines: str, probe: Probe) -> None:
    dialogue(probe).hold(lines)


def text_cases(
    path: Path, link: str, names: Mapping[str, str], dialogue: type[Dialogue[Any]] = LinkDialogue
) -> list[Case[Any]]:
    """Return the cases of a file for a link; `names` are its names in braces, `dialogue` holds a case with a probe.

    Raises BenchError: the file cannot be read, or has errors; one line for each.
    """
    file = _read(path)
    replacements = ChainMap(file.texts, dict(names))
    optional = _names_of_links() if link in BUSES else frozenset()
    cases, wrong = [], []
    for area in file.area:
        for item in area.cases if link in area.links else ():
            try:
                texts = item.id, item.title, item.clause or area.clause, item.lines
                name, title, clause, lines = (text.format_map(replacements) for text in texts)
            except KeyError as missing:
                name = missing.args[0]
                if name not in optional:
                    close = did_you_mean(name, {*replacements, *optional})
                    wrong.append(f"{path}: {area.name}.{item.id}: unknown name {name!r} in braces{close}")
                continue
            except ValueError as error:
                wrong.append(f"{path}: {area.name}.{item.id}: braces: {error}")
                continue
            changes = area.intrusive if item.intrusive is None else item.intrusive
            cases.append(
                case_in(area.name, name, title, partial(_hold, dialogue, lines), clause, intrusive=changes)
            )
            wrong += [f"{path}: {area.name}.{name}: {fault}" for fault in dialogue.faults(lines)]
    if wrong:
        raise BenchError(*wrong)
    return cases
