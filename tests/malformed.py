"""What each reader of files says of malformed ones: `malformed.toml` holds the texts, with every line of every message.

After a change of wording, `python -m tests.malformed` writes the messages again; the difference is what a user will read.
"""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.profile import load_profile
from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.live import LiveTruth
from starhil.hil_tests.session.script import load_script
from starhil.protocol.errors import OneLineError
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude

SNAPSHOT: Final = Path(__file__).with_suffix(".toml")


def _message(path: Path) -> None:
    """A message of a live feed; it is rejected by a fault instead of an exception."""
    live = LiveTruth(Attitude.identity())
    if not live.receive(path.read_text(), 0.5):
        raise OneLineError(live.last_fault)


READERS: Final[dict[str, tuple[str, Callable[[Path], object]]]] = {
    "profile": (".toml", lambda path: load_profile(str(path))),
    "scenario": (".toml", lambda path: load_scenario(str(path))),
    "session": (".toml", lambda path: load_script(path, load_unit())),
    "truth": (".csv", read_truth_file),
    "feed": (".json", _message),
}


def errors_of(reader: str, text: str, folder: Path) -> list[str]:
    """Return the lines that a reader reports, in which the file is called FILE."""
    suffix, read = READERS[reader]
    path = folder / f"file{suffix}"
    path.write_text(text, encoding="utf-8")
    try:
        read(path)
    except OneLineError as error:
        return [str(line).replace(str(path), "FILE").replace(str(folder), "FOLDER") for line in error.args]
    return []


def cases() -> list[dict[str, Any]]:
    """Return the cases, each with reader, text and errors."""
    return tomllib.loads(SNAPSHOT.read_text(encoding="utf-8"))["case"]


def _quoted(text: str) -> str:
    """A text as a TOML string without escapes."""
    if "\n" in text:
        return f"'''\n{text}'''"
    marks = ("'", "'''") if "\\" in text else ('"', "'", "'''")
    mark = next(mark for mark in marks if mark not in text)
    return f"{mark}{text}{mark}"


def written(items: list[dict[str, Any]], folder: Path) -> str:
    """Return the snapshot of these cases, with the messages as they are now."""
    parts = ["# Texts, and what their reader says of them. Written by `python -m tests.malformed`.\n"]
    for case in items:
        errors = "".join(
            f"    {_quoted(line)},\n" for line in errors_of(case["reader"], case["text"], folder)
        )
        parts.append(
            f'[[case]]\nreader = "{case["reader"]}"\ntext = {_quoted(case["text"])}\nerrors = [\n{errors}]\n'
        )
    return "\n".join(parts)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        SNAPSHOT.write_text(written(cases(), Path(name)), encoding="utf-8")
