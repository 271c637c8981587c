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
_IMAGE: Final = re.compile(r'(<img src=")([\w.-]+)(")')
_MARKS: Final = re.compile(r"[!-/:-@\[-`{-~]")
"""Characters that Markdown may take for marks, and a backslash makes plain."""
_EMPHASIS: Final = re.compile(r"</?(?:em|strong|code)>")
"""Tags that fpdf2 does not end within the cell of a table."""
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
    body = _IMAGE.sub(lambda image: f'{image[1]}{folder / image[2]}" width="520{image[3]}', _body(markdown))
    body = _EMPHASIS.sub("", body).replace("<td>", '<td align="left">').replace("<th>", '<th align="left">')
    body = body.replace("<table>", f'<table cellpadding="{CELL_PADDING_MM}">')
    pdf.write_html(
        body,
        font_family="report",
        ul_bullet_char="•",
        tag_styles={
            "h1": heading(font_size_pt=16),
            "h2": heading(font_size_pt=11),
            "p": TextStyle("report", font_size_pt=FONT_PT, t_margin=1, b_margin=2),
            "li": TextStyle("report", font_size_pt=FONT_PT, l_margin=4),
        },
    )
    return bytes(pdf.output())
