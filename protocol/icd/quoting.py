"""Text and names of a definition in the languages of the exports, one function per language.

A definition contains free text: descriptions, units of measure, values of a `map`, the name of the unit. Nothing
in it may end the comment, string or tag that holds it, or be executed. A `Scope` keeps exported names apart.
"""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Iterable
from typing import Final

from starhil.protocol.errors import IcdError

_WIDTH: Final = 107
"""Width of the text in a C comment."""
_KEYWORDS: Final = re.compile(
    "(?:alignas|alignof|and|and_eq|asm|assert|auto|bitand|bitor|bool|break|case|catch|char|char16_t|char32_t|char8_t|class|co_await|"
    "co_return|co_yield|compl|complex|concept|const|const_cast|consteval|constexpr|constinit|continue|decltype|default|delete|do|"
    "double|dynamic_cast|else|enum|errno|explicit|export|extern|false|far|float|for|friend|goto|huge|i386|if|imaginary|inline|int|"
    "interface|linux|long|mutable|namespace|near|new|noexcept|noreturn|not|not_eq|nullptr|operator|or|or_eq|pascal|private|protected|"
    "public|register|reinterpret_cast|requires|restrict|return|short|signed|sizeof|small|static|static_assert|static_cast|stderr|"
    "stdin|stdout|struct|switch|template|this|thread_local|throw|true|try|typedef|typeid|typename|typeof|typeof_unqual|union|unix|"
    "unsigned|using|virtual|void|volatile|wchar_t|while|xor|xor_eq|ptrdiff_t|size_t|u?int(?:_least|_fast)?(?:8|16|32|64|ptr|max)_t)_*"
)
"""Reserved in C or C++, or a macro or type of common compilers and headers; a trailing underscore is appended to
these and to what already has one, so that no two names become equal."""
_COMMENT: Final = re.compile(r"\*(?=/)|/(?=\*)|\?(?=\?)")
"""What is separated in a C comment: its marks, and trigraphs."""
_ASCII: Final = str.maketrans({"°": "deg", "µ": "u", "μ": "u", "×": "x", "–": "-", "−": "-", "″": "arcsec"})


class Scope:
    """The names in one scope of an export, each with what it belongs to.

    `reserved` are names that the exported file or the language itself uses.
    """

    def __init__(self, language: str, reserved: Iterable[str] = ()) -> None:
        self._language = language
        self._owners = dict.fromkeys(reserved, f"the {language} export itself")

    def claim(self, name: str, owner: str) -> str:
        """Return a name for its first owner; raise IcdError, which names both owners, for any other."""
        other = self._owners.setdefault(name, owner)
        if other != owner:
            raise IcdError(
                f"{owner}: has the same name as {other} in {self._language}: {name}; rename one of them"
            )
        return name


def one_line(text: str) -> str:
    """Return text as one line of printable characters.

    The other characters could end a line, reorder the text or are not allowed in XML.
    """
    if not text.isprintable():
        text = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(text.split())


def ascii_line(text: str) -> str:
    line = one_line(text)
    if line.isascii():
        return line
    return line.translate(_ASCII).encode("ascii", errors="replace").decode("ascii")


def eds_text(text: str) -> str:
    """Return text as an EDS allows: one line of ASCII without comment signs."""
    return ascii_line(text).replace(";", ",").replace("#", "No.")


def identifier(text: str) -> str:
    """Return text as an identifier of ASCII letters, digits and underscores."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    return name if name[:1].isalpha() else f"unit_{name}"


def c_member(name: str) -> str:
    """Return the name of a field as the member of a C structure; different names stay different."""
    return f"{name}_" if _KEYWORDS.fullmatch(name) else name


def c_comment(*paragraphs: str) -> str:
    """Return paragraphs as a C comment; an empty text if they are empty."""
    lines = [
        line
        for paragraph in "\n\n".join(paragraphs).split("\n")
        for line in textwrap.wrap(_COMMENT.sub(r"\g<0> ", one_line(paragraph)), _WIDTH) or [""]
    ]
    if len(lines) == 1:
        return f"/* {lines[0]} */" if lines[0] else ""
    return "\n".join(("/* " + lines[0], *(f" * {line}".rstrip() for line in lines[1:]), " */"))


def c_string(text: str) -> str:
    """Return text as a C string in UTF-8, whose other characters than letters, digits and spaces are escaped."""
    escaped = (
        chr(byte) if re.match(rb"[A-Za-z0-9 ]", bytes([byte])) else f"\\{byte:03o}" for byte in text.encode()
    )
    return f'"{"".join(escaped)}"'


def dbc_string(text: str) -> str:
    """Return text as a string of a DBC, which has no escapes."""
    return _without_escapes(ascii_line(text))


def cosmos_string(text: str) -> str:
    """Return text as a parameter or comment of a COSMOS file, which has no escapes.

    A comment in quotes does not end with a sign that continues it on the next line. ERB, which reads all files of
    a plugin, finds no tag in the text.
    """
    return _without_escapes(one_line(text).replace("<%", "< %"))


def cosmos_name(name: str) -> str:
    """Return the name of a COSMOS packet or item: capitals, single underscores, none at the end."""
    return re.sub("_+", "_", name).rstrip("_").upper()


def cosmos_state(label: str) -> str:
    """Return the name of a state in capitals, without characters that end a word in COSMOS."""
    return re.sub(r"[^\w.-]", "_", label, flags=re.ASCII).upper() or "_"


def ruby_string(text: str) -> str:
    """Return text as a Ruby string, without interpolation."""
    return "'" + one_line(text).replace("<%", "< %").replace("\\", r"\\").replace("'", r"\'") + "'"


def xtce_name(text: str) -> str:
    return re.sub(r"[./:\[\] ]", "_", one_line(text)) or "_"


def xtce_text(text: str) -> str:
    """Return text as one line in an element or attribute of XML."""
    return html.escape(one_line(text)).replace("&#x27;", "'")


def html_text(text: str) -> str:
    """Return text with its markup escaped, and what is between backticks as code."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", html.escape(one_line(text)))


def markdown(text: str) -> str:
    """Return text as one line of Markdown without markup, except what is between backticks, as code."""
    parts = re.split(r"(?<!`)(`[^`]+`)(?!`)", one_line(text))
    parts[::2] = [_markdown_text(part) for part in parts[::2]]
    return re.sub(r"^(?:([#~]|[-+*](?=[-+* ]))|(\d+)(?=[.)](?: |$)))", r"\2\\\1", "".join(parts))


def _markdown_text(text: str) -> str:
    escaped = re.sub(r"[\\`~\[\]]|\*(?=\S)|(?<=\S)\*|(?<![^\W_])_|_(?![^\W_])", r"\\\g<0>", text)
    return html.escape(escaped, quote=False)


def _without_escapes(text: str) -> str:
    """Return text between double quotes; a backslash at its end would escape the quote."""
    return '"' + re.sub(r"\\$", r"\\ ", text.replace('"', "'")) + '"'
