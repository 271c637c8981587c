"""Outcomes of steps and cases, and reports as JUnit or any file."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from starhil.hil_tests.errors import BenchError
from starid.storage.files import is_stream, write_atomically

PASSED: Final = "passed"


FAILED: Final = "failed"


SKIPPED: Final = "skipped"


NOT_RUN: Final = "not run"
"""Status of a case that was not run; skipped in a JUnit file."""


INVALID_IN_XML: Final = re.compile("[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Control characters, surrogates and U+FFFE and U+FFFF; a carriage return would become a line feed."""


@dataclass(frozen=True)
class TestCase:
    """One case of a JUnit file."""

    __test__ = False  # pytest must not collect it

    suite: str
    name: str
    status: str
    detail: str
    seconds: float
    output: str = ""


def prepare_report(path: Path) -> None:
    """Create the folder of a report; called before the run, so that its results are not lost.

    Raises BenchError: no file can be written there.
    """
    if path.is_dir():
        raise BenchError(f"{path}: is a folder; name the file of the report")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BenchError(f"{path}: its folder cannot be created: {error.strerror}") from None
    if not is_stream(path) and not os.access(path.parent, os.W_OK | os.X_OK):
        raise BenchError(f"{path}: cannot be written: its folder takes no new files")


def write_report(path: Path, data: bytes) -> None:
    """Write a report atomically, or to a device or standard output; create its folder if needed.

    Raises BenchError: no file can be written there.
    """
    prepare_report(path)
    try:
        write_atomically(path, lambda part: part.write_bytes(data))
    except OSError as error:
        raise BenchError(f"{path}: cannot be written: {error.strerror}") from None


def write_junit(path: Path, name: str, cases: Sequence[TestCase], seconds: float) -> None:
    """Write a JUnit XML file atomically."""
    counts = {
        "tests": len(cases),
        "failures": sum(case.status == FAILED for case in cases),
        "errors": 0,
        "skipped": sum(case.status in (SKIPPED, NOT_RUN) for case in cases),
    }
    attributes = {
        "name": name,
        "time": f"{seconds:.3f}",
        **{key: str(value) for key, value in counts.items()},
    }
    root = ET.Element("testsuites", attributes)
    suite = ET.SubElement(root, "testsuite", attributes)
    for case in cases:
        item = ET.SubElement(
            suite,
            "testcase",
            {"classname": case.suite, "name": case.name, "time": f"{case.seconds:.6f}"},
        )
        if case.status == FAILED:
            failure = ET.SubElement(item, "failure", {"message": case.detail})
            failure.text = case.detail
        elif case.status in (SKIPPED, NOT_RUN):
            ET.SubElement(item, "skipped", {"message": case.detail})
        if case.output:
            ET.SubElement(item, "system-out").text = case.output
    for element in root.iter():
        element.attrib = {key: _replace_invalid(value) for key, value in element.attrib.items()}
        element.text = element.text and _replace_invalid(element.text)
    ET.indent(root)
    write_report(path, ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _replace_invalid(text: str) -> str:
    """Replace characters that XML 1.0 cannot carry."""
    return INVALID_IN_XML.sub("\N{REPLACEMENT CHARACTER}", text)
