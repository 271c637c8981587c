"""Experiments of `starid reproduce`: trials that are computed separately, and what they add to the report.

An experiment is an entry of `experiments.toml` (title, parameters of the full and of the quick run, and the trials
they stand for), a module with two functions, and its lines in `published.csv`. `compute` makes named arrays from one
trial, in a separate process; `evaluate` makes rows, tables and figures from those of all trials. Paragraphs for the
report stand in `notes/NAME.md`.
"""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starid.catalog import StarCatalog, load_catalog
from starid.catalog.hipparcos import EPOCH
from starid.identification.options import Solver
from starid.identification.thesis.database import DatabaseParameters, FeatureDatabase, build_database, sky_of
from starid.identification.thesis.database_file import load_database, save_database
from starid.identification.thesis.frame_sky import FrameSky
from starid.identification.thesis.lsi import LostInSpace
from starid.lab.experiments.comparison import (
    Outcome,
    Published,
    ReproduceError,
    Row,
    claimed,
    compared,
    null_model,
)
from starid.lab.experiments.figures import Curve, Panel, Picture, draw
from starid.lab.experiments.tables import COLUMNS, PUBLISHED, published

Results = dict[str, NDArray[Any]]
"""Results of a part: named arrays."""

Parameters = Mapping[str, Any]
"""What an experiment depends on; JSON values only."""


@dataclass(frozen=True, slots=True)
class Part:
    """Trials that are computed together: a name, also used as a file name, and what distinguishes them from others."""

    key: str
    values: Parameters = field(default_factory=dict)

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


def parts_of(parameters: Parameters) -> list[Part]:
    """List the parts that the parameter ``trials`` stands for.

    Each entry has a format string ``key``, and values by name: a list, a single value, or the name of a parameter.
    There is a part for each combination, the last name varying fastest.
    """
    parts = []
    for entry in parameters["trials"]:
        values = {
            name: parameters.get(value, value) if isinstance(value, str) else value
            for name, value in entry.items()
            if name != "key"
        }
        lists = [value if isinstance(value, list) else [value] for value in values.values()]
        for line in itertools.product(*lists):
            chosen = dict(zip(values, line, strict=True))
            parts.append(Part(entry["key"].format(**chosen), chosen))
    return parts


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment: an entry of `experiments.toml` with the functions of its module.

    The functions must be defined at module level. `full` and `quick` are the parameters of the two runs; None leaves
    the experiment out of the quick one. In the full run nothing else runs at the same time if it measures time
    (`alone`). Experiments with a smaller `start_order` start first: these compile different kernels which others
    need, and two processes that work on the same experiment compile everything twice. `revision` is incremented
    when a change of the code changes the results, so that they are computed again.
    """

    name: str
    title: str
    parts: Callable[[Parameters], Sequence[Part]]
    compute: Callable[[Context, Part], Results]
    evaluate: Callable[[Evaluation], None]
    full: Parameters
    quick: Parameters | None
    alone: bool = False
    start_order: int = 2
    revision: int = 1

    def parameters(self, *, quick: bool) -> Parameters:
        """Return the parameters of the full or the quick run.

        Raises
        ------
        ReproduceError
            There is no quick run.
        """
        chosen = self.quick if quick else self.full
        if chosen is None:
            raise ReproduceError(f"reproduce: {self.name} has no quick form; run it without --quick")
        return chosen

    def fingerprint(self, parameters: Parameters, seed: int, part: Part | None = None) -> str:
        """Checksum of everything on which the outcome, or one part, depends.

        Lists, which say which parts there are, do not matter for a part.
        """
        content = {
            "name": self.name,
            "revision": self.revision,
            "seed": seed,
            "parameters": {
                key: value
                for key, value in parameters.items()
                if part is None or not isinstance(value, list | tuple)
            },
            "part": None if part is None else [part.key, dict(part.values)],
        }
        text = json.dumps(content, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


@dataclass(frozen=True, slots=True)
class Context:
    """A run of an experiment: its folder, that of the databases of all experiments, name, seed and parameters."""

    folder: Path
    databases: Path
    name: str
    seed: int
    parameters: Parameters
    quick: bool

    def rng(self, *keys: str | int) -> np.random.Generator:
        """Random generator that depends only on the seed of the run, the experiment and the keys."""
        text = json.dumps([self.name, *keys])
        entropy = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")
        return np.random.default_rng([self.seed, entropy])

    def database_file(self, overlap: float) -> Path:
        """File of the planar database of the thesis for an overlap ratio (a fraction)."""
        return self.databases / f"planar-{100 * overlap:g}.features"

    def database(self, overlap: float) -> FeatureDatabase:
        """The database, built once and stored."""
        return _database(self.database_file(overlap), overlap)

    def lost_in_space(self, overlap: float, solver: Solver = "exact") -> LostInSpace:
        """The LSI algorithm with that database, kept for this process."""
        return _lost_in_space(self.database_file(overlap), overlap, solver)

    def sky(self) -> FrameSky:
        """The stars of the planar databases."""
        return planar_sky()


class Evaluation:
    """Rows, tables, figures and notes of an experiment in the making, from the results of all its parts, by key."""

    def __init__(self, context: Context, parts: Sequence[Part], results: Mapping[str, Results]) -> None:
        self.context, self.parts, self.results = context, parts, results
        self.parameters = context.parameters
        self.rows: list[Row] = []
        self.files: list[str] = []
        self.note: dict[str, Any] = {}
        """Values for the fields in the notes."""
        self._columns: dict[int, str] = {}
        self._used: set[str] = set()

    def __getitem__(self, part: Part) -> Results:
        return self.results[part.key]

    def published(self, quantity: str) -> list[float]:
        """Return the published numbers of a quantity of this experiment; none if the thesis has none."""
        self._used.add(quantity)
        return published(self.context.name, quantity)

    def compare(
        self,
        quantity: str,
        *,
        text: float | str | None = None,
        unit: str = "",
        digits: int = 2,
        check: str = "",
        column: str = "",
        **readings: Any,
    ) -> None:
        """Add a row that compares what was measured with the line of `published.csv`, as the line says.

        If the file has no line for the quantity, `text`, `unit`, `digits` and `check` stand for it (see `Published`).
        Rows of one `column` of a table are reported together, and those that a constant meets are marked. The
        readings and the others are the arguments of `compared`.
        """
        self._used.add(quantity)
        line = PUBLISHED.get((self.context.name, quantity))
        if line is None:
            line = Published("" if text is None else str(text), unit, digits, check)
        if column:
            self._columns[len(self.rows)] = column
        self.rows.append(compared(quantity, line, **readings))

    def compare_line(
        self, table: str, part: str, where: str, published: Mapping[str, float], measured: Mapping[str, Any]
    ) -> None:
        """Add a row for each measured column of a line of a large table, as `columns.csv` describes the column.

        One constant may answer for a column of a `part` of the table; `where` names the line in the report. Measured
        is a number as the author ran it for each column, or the readings of `compare`.
        """
        for name, values in measured.items():
            column = COLUMNS[table][name]
            self.compare(
                column["words"].format(where=where),
                text=published[name],
                unit=column["unit"],
                digits=int(column["digits"]),
                check=column["check"].format(**published),
                column=f"{table} {part} {name}",
                **(values if isinstance(values, Mapping) else {"author": values}),
            )

    def claim(self, quantity: str, **values: Any) -> None:
        """Add a row with a check that no number states; see `claimed`."""
        self.rows.append(claimed(quantity, **values))

    def write(self, name: str, table: Sequence[Mapping[str, Any]] | Mapping[str, Any]) -> None:
        """Write a CSV file from lines with the same keys, or from columns."""
        columns = (
            table if isinstance(table, Mapping) else {key: [line[key] for line in table] for key in table[0]}
        )
        self.files.append(write_csv(self.context.folder / name, columns))

    def draw(self, name: str, content: Iterable[Panel | Picture | tuple[str, Curve]], **options: Any) -> None:
        """Draw a figure; see `starid.lab.experiments.figures.draw`."""
        self.files.append(draw(self.context.folder / name, content, **options))

    def outcome(self) -> Outcome:
        """Return what was added; rows of a column of a table together, where the first of them stands.

        Raises
        ------
        ReproduceError
            The full run did not compare a published number that has a check.
        """
        lines = {
            quantity
            for (name, quantity), line in PUBLISHED.items()
            if name == self.context.name and line.check
        }
        if (lost := lines - self._used) and not self.context.quick:
            raise ReproduceError(f"reproduce: {self.context.name} does not compare {min(lost)}")
        groups: dict[str | int, list[Row]] = {}
        for i, each in enumerate(self.rows):
            groups.setdefault(self._columns.get(i, i), []).append(each)
        rows = itertools.chain.from_iterable(
            null_model(group) if isinstance(name, str) else group for name, group in groups.items()
        )
        path = Path(__file__).parent / "notes" / f"{self.context.name}.md"
        notes = (path.read_text(encoding="utf-8").strip().format(**self.note),) if path.exists() else ()
        return Outcome(tuple(rows), tuple(self.files), notes)


def write_csv(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> str:
    """Write named columns, numbers with nine significant digits; return the file name."""
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1:
        raise ReproduceError(f"reproduce: columns of {path.name} have the lengths {sorted(lengths)}")

    def text(value: Any) -> str:
        return f"{value:.9g}" if isinstance(value, float | np.floating) else str(value)

    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows([text(value) for value in values] for values in zip(*columns.values(), strict=True))
    return path.name


@lru_cache(maxsize=1)
def star_catalog() -> StarCatalog:
    """The stars at the epoch of the catalogue: the published numbers are without proper motion."""
    return load_catalog(epoch=EPOCH)


@lru_cache(maxsize=16)
def planar_sky(**changes: float) -> FrameSky:
    """Stars of the flat sky of the published databases, with some of the `DatabaseParameters` changed."""
    return sky_of(star_catalog(), DatabaseParameters(**changes))  # type: ignore[arg-type]


@lru_cache(maxsize=3)
def _database(path: Path, overlap: float) -> FeatureDatabase:
    catalog = star_catalog()
    if path.exists():
        database = load_database(path)
        if database.catalog_identity == catalog.identity:
            return database
    path.parent.mkdir(parents=True, exist_ok=True)
    save_database(build_database(catalog, DatabaseParameters(overlap=overlap)), path)
    return load_database(path)


@lru_cache(maxsize=6)
def _lost_in_space(path: Path, overlap: float, solver: Solver) -> LostInSpace:
    return LostInSpace(_database(path, overlap), solver=solver)
