"""`starid bench`: star identification solvers on the same scenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from starid.cli.options import AsJson
from starid.cli.output import Column, prepare_folder, print_table, progress
from starid.errors import StaridError


def _entry(name: str, digits: int) -> Callable[[Any], str]:
    """Return a function that formats an entry of a dictionary with a number of decimals, or a dash."""
    return lambda row: "–" if row[name] is None else f"{row[name]:.{digits}f}"


_COLUMNS: Final[tuple[Column, ...]] = (
    ("σ px, false, missing", lambda row: row["row"]),
    ("solver", lambda row: row["solver"]),
    ("frames", lambda row: str(row["frames"])),
    ("valid %", _entry("valid_pct", 2)),
    ("wrong (ill-conditioned)", lambda row: f"{row['wrong']} ({row['ill_conditioned']})"),
    ("″", _entry("boresight_median_arcsec", 1)),
    ("÷ floor", _entry("floor_ratio", 3)),
    ("roll ÷", _entry("roll_floor_ratio", 3)),
    ("ms", _entry("median_ms", 3)),
    ("p99 ms", _entry("p99_ms", 2)),
    ("CPU ms", _entry("cpu_median_ms", 3)),
    ("p99", _entry("cpu_p99_ms", 2)),
)


def command(
    peers: Annotated[
        str,
        typer.Option(
            help="Third-party solvers to compare with: tetra3rs,ruststartracker,cedar-solve,solve-field."
        ),
    ] = "",
    solvers: Annotated[
        str,
        typer.Option(
            help="Solvers: geometric,lsi,rsi, lsi-matlab,lsi-sklearn, published ones such as pyramid,grid "
            "(pyramid-even: with evenly spread guide stars), or MODULE:FUNCTION; 'all': geometric, lsi, rsi, the published and "
            "the third-party ones."
        ),
    ] = "geometric",
    frames: Annotated[int, typer.Option(min=1, help="Scenes per row.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="Row of the table. Repeatable. 'all': every row; 'papers': the scenes in the papers of the published algorithms. "
            "Default: the standard rows; with --solvers all, also other fields of view."
        ),
    ] = None,
    budget: Annotated[
        float,
        typer.Option(
            min=0.0, help="Processor time of a solver per row, seconds; the rest of the row is skipped."
        ),
    ] = 120.0,
    raw: Annotated[
        bool, typer.Option("--raw", help="Use the answers of published algorithms without verification.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder for leaderboard.md, leaderboard.json and plots."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare star identification solvers on the same scenes and with the least-squares bound."""
    from starid.lab.leaderboard.comparison import LEADERBOARD, PAPERS, ROWS, STANDARD, run
    from starid.lab.leaderboard.peers import ALL
    from starid.lab.leaderboard.report import write_leaderboard

    if output is not None:
        import_module("matplotlib")  # before the work
        prepare_folder(output, "-o")
    everyone = solvers.strip() == "all"
    own = ALL if everyone else _names(solvers)
    if not (own or _names(peers)):
        raise StaridError("bench --solvers: name at least one, such as geometric, or all")
    usual = LEADERBOARD if everyone else STANDARD
    report = progress()
    answer = run(
        frames,
        seed,
        peers=_names(peers),
        own=own,
        rows=list(usual if not row else ROWS if "all" in row else PAPERS if "papers" in row else row),
        budget_s=budget,
        raw=raw,
        progress=lambda name: report(f"row {name}"),
    )
    if output is not None:
        command = (
            f"starid bench --solvers {solvers} --frames {frames} --seed {seed} --budget {budget:g}"
            + (" --raw" if raw else "")
            + "".join(f' --row "{name}"' for name in row or [])
        )
        for path in write_leaderboard(answer, output, command):
            report(f"wrote {path}")
    if as_json:
        print(json.dumps(answer))
        return
    print_table(_COLUMNS, answer["rows"])
    for name, why in answer["skipped"].items():
        print(f"{name}: skipped, {why}")


def _names(text: str) -> list[str]:
    """Split a comma-separated list."""
    return [name.strip() for name in text.split(",") if name.strip()]
