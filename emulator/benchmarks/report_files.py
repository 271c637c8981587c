"""A report in Markdown as one HTML file and as PDF, with the images of its folder."""

from __future__ import annotations

import base64
import re
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

FONT_PT: Final = 8.0
CELL_PADDING_MM: Final = 0.4
IMAGE_PX: Final = 520
MM_PER_PX: Final = 25.4 / 72
"""Of fpdf2 in HTML."""
HEADED_MM: Final = 35.0
"""Height that a heading takes with the first lines below it, or with the rest of a paragraph that has an image."""
_IMAGE: Final = re.compile(r'(<img src=")([\w.-]+)(")')
_MARKS: Final = re.compile(r"[!-/:-@\[-`{-~]")
"""Characters that Markdown may take for marks, and a backslash makes plain."""
_CELL: Final = re.compile(r"<(t[dh])>(.*?)</\1>", re.DOTALL)
_BOLD_CELL: Final = re.compile(r"<strong>((?:(?!</?strong>).)*)</strong>", re.DOTALL)
_EMPHASIS: Final = re.compile(r"</?(?:em|strong|code)>")
"""Tags of which fpdf2 allows no more than one within the cell of a table, around all of it."""
_SECTION: Final = re.compile(r"(?=<h[1-6]>)")
_FIRST_BLOCK: Final = re.compile(r".*?</(?:p|table|ul|ol)>", re.DOTALL)
"""Of a section: its heading and the block below."""
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #1b1f24; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { border: 1px solid #c9ced6; padding: .25rem .6rem; text-align: left; }
th { background: #eef1f5; } img { max-width: 100%; } code { background: #eef1f5; padding: 0 .2em; overflow-wrap: anywhere; }
@media print { h2 { break-after: avoid; } table { break-inside: avoid; } }
"""


def plain(text: str) -> str:
    """Return Markdown that shows a user's text as it is, also in a table."""
    return _MARKS.sub(r"\\\g<0>", " ".join(text.split()))


def code(text: str) -> str:
    """Return Markdown that shows a user's text as code, also in a table."""
    runs = [len(run) for run in re.findall("`+", text)]
    fence, gap = "`" * (1 + max(runs, default=0)), " " if runs else ""
    return f"{fence}{gap}{' '.join(text.split())}{gap}{fence}".replace("|", r"\|")


def _body(markdown: str) -> str:
    from markdown_it import MarkdownIt

    body: str = MarkdownIt("commonmark", {"html": False}).enable("table").render(markdown)
    return body


def as_html(markdown: str, title: str, folder: Path) -> str:
    """Return a page that needs no other file: the images of the folder are part of it."""

    def embedded(image: re.Match[str]) -> str:
        content = base64.b64encode((folder / image[2]).read_bytes()).decode()
        return f"{image[1]}data:image/png;base64,{content}{image[3]}"

    body = _IMAGE.sub(embedded, _body(markdown))
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n{body}</html>\n"
    )


def _pdf_cell(cell: re.Match[str]) -> str:
    """Return a cell as fpdf2 takes it: all of it bold, or none."""
    inner = _EMPHASIS.sub("", cell[2])
    is_bold = _BOLD_CELL.fullmatch(cell[2].strip()) is not None
    return f'<{cell[1]} align="left">{f"<b>{inner}</b>" if is_bold else inner}</{cell[1]}>'


def _least_height_mm(section: str, folder: Path) -> float:
    """Return the height of a heading with what must be on its page: the lines or images of the block below."""
    from PIL import Image

    begin = _FIRST_BLOCK.match(section)
    height_mm = HEADED_MM
    for _, file, _ in _IMAGE.findall(begin[0] if begin else section):
        with Image.open(folder / file) as image:
            height_mm += IMAGE_PX * MM_PER_PX * image.height / image.width
    return height_mm


def as_pdf(markdown: str, title: str, folder: Path) -> bytes:
    """Return the pages as PDF, A4 upright, in the font of the plots."""
    import matplotlib as mpl
    from fpdf import FPDF
    from fpdf.fonts import TextStyle

    pdf = FPDF(format="A4")
    fonts = Path(mpl.get_data_path()) / "fonts/ttf"
    for style, file in {"": "DejaVuSans", "B": "DejaVuSans-Bold", "I": "DejaVuSans-Oblique"}.items():
        pdf.add_font("report", style, fonts / f"{file}.ttf")
    pdf.set_title(title)
    pdf.set_font("report", size=FONT_PT)
    pdf.add_page()
    heading = partial(TextStyle, "report", "B", color=(20, 40, 80), t_margin=4, b_margin=2)
    body = _CELL.sub(_pdf_cell, _body(markdown).replace("<code>", "").replace("</code>", ""))
    body = body.replace("<table>", f'<table cellpadding="{CELL_PADDING_MM}">')
    write = partial(
        FPDF.write_html,
        font_family="report",
        ul_bullet_char="•",
        tag_styles={
            "h1": heading(font_size_pt=16),
            "h2": heading(font_size_pt=11),
            "p": TextStyle("report", font_size_pt=FONT_PT, t_margin=1, b_margin=2),
            "li": TextStyle("report", font_size_pt=FONT_PT, l_margin=4),
        },
    )
    for section in filter(str.strip, _SECTION.split(body)):
        if pdf.y + _least_height_mm(section, folder) > pdf.page_break_trigger:
            pdf.add_page()
        write(pdf, _IMAGE.sub(rf'\g<1>{folder}/\g<2>" width="{IMAGE_PX}\g<3>', section))
    return bytes(pdf.output())
