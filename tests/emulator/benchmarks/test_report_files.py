"""Reports in Markdown as PDF: emphasis, and headings that stay with what they head."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import pytest
from PIL import Image

from starhil.emulator.benchmarks.report_files import as_pdf

pytestmark = pytest.mark.long

HEADING = b"0.0784 0.1569 0.3137 rg"


def pages(printed: bytes) -> list[bytes]:
    """Return the drawing instructions of each page."""
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", printed, re.DOTALL)
    found = []
    for stream in streams:
        try:
            content = zlib.decompressobj().decompress(stream)
        except zlib.error:
            continue
        if content.isascii() and (b" Tj" in content or b" Do" in content):  # neither font nor image
            found.append(content)
    return found


def bold_texts(markdown: str, folder: Path) -> int:
    return sum(len(re.findall(rb"/F2 [\d.]+ Tf", page)) for page in pages(as_pdf(markdown, "title", folder)))


@pytest.mark.parametrize(
    "text",
    ["a **word** in a line", "| a | b |\n|---|---|\n| {} | word |", "- {}"],
    ids=["text", "cell", "item"],
)
def test_bold_words_are_bold(text: str, tmp_path: Path) -> None:
    bold = text.replace("{}", "**word**")
    assert bold_texts(bold, tmp_path) > bold_texts(bold.replace("**", ""), tmp_path)


def test_a_cell_with_marks_inside_is_printed_without_them(tmp_path: Path) -> None:
    cell = "| a |\n|---|\n| one **two** `three` *four* |"
    assert len(pages(as_pdf(cell, "title", tmp_path))) == 1


@pytest.mark.parametrize(
    ("below", "lines"),
    [
        ("| a |\n|---|\n| b |\n| c |", 39),
        ("text", 39),
        ("![plot](plot.png)", 24),
        ("text ![plot](plot.png)", 24),
    ],
)
def test_no_heading_is_the_last_of_its_page(below: str, lines: int, tmp_path: Path) -> None:
    Image.new("RGB", (640, 320)).save(tmp_path / "plot.png")
    page_counts = set()
    for before in (lines - 6, lines, lines + 1):
        text = "# Title\n\n" + "line\n\n" * before + f"## Heading\n\n{below}\n"
        contents = pages(as_pdf(text, "title", tmp_path))
        page_counts.add(len(contents))
        for content in contents:
            last = content.rpartition(HEADING)[2]
            assert len(re.findall(rb"T[jJ]", last)) > 1 or b" Do" in last, before
    assert page_counts == {1, 2}
