"""What an experiment of `starhil reproduce` is: parts that can be computed apart, and an outcome with rows for the report."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from starid.errors import StaridError

if TYPE_CHECKING:
    from starid.catalog import StarCatalog
    from starid.thesis.database import FeatureDatabase
    from starid.thesis.frame_sky import FrameSky
    from starid.thesis.lsi import LostInSpace, Solver

Results = dict[str, NDArray[Any]]
"""What one part yields: named arrays."""

Parameters = Mapping[str, Any]
"""What an experiment depends on; plain values only, as JSON has them."""

EPOCH: Final = 1991.25
"""The catalogue's own epoch: the published numbers know no proper motion."""

Kind = Literal["", "agrees", "better", "ours"]
"""Class of a check: against a published number on both sides, on one side, or against a bound of this project; "" is none."""


class ReproduceError(StaridError):
    """A reproduction that cannot be run as asked for."""


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of an experiment that can be computed by itself.

    Attributes
    ----------
    key
        Name of the part, unique in its experiment; it names a file too.
    values
        What sets this part apart from the others.
    """

    key: str
    values: Parameters = field(default_factory=dict)


def parts_of(key: str, **values: Iterable[Any]) -> list[Part]:
    """A part for each combination of values, the last running fastest; `key` is a format of their names."""
    chosen = [dict(zip(values, line, strict=True)) for line in itertools.product(*values.values())]
    return [Part(key.format(**line), line) for line in chosen]


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the report.

    Attributes
    ----------
    quantity
        What was measured, with its conditions.
    published, ours
        The published value and this project's, as they are printed; "—" where there is none.
    target
        What is checked, and the tolerance with its origin; "" without a check.
    passed
        Outcome of the check; None if there is none.
    remark
        Why the values differ, or what to know about them.
    author, printed
        The value of the algorithm as the thesis's author ran it, and as the thesis prints it; "—" where there is none.
    kind
        Class of the check.
    met, of
        How many of the published numbers that the row stands for agree, and how many they are.
    """

    quantity: str
    published: str
    ours: str
    target: str = ""
    passed: bool | None = None
    remark: str = ""
    author: str = "—"
    printed: str = "—"
    kind: Kind = ""
    met: int = 0
    of: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an experiment adds to the report: rows, the names of its files, and paragraphs of Markdown."""

    rows: tuple[Row, ...]
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows whose check was missed."""
        return tuple(row for row in self.rows if row.passed is False)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Outcome:
        """Read back what `to_dict` wrote."""
        rows = tuple(Row(**row) for row in values["rows"])
        return cls(rows, tuple(values["files"]), tuple(values["notes"]))


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment.

    Attributes
    ----------
    name, title
        Name on the command line, and heading in the report.
    parts
        Parts for given parameters.
    work
        Computes a part, in a separate process; it must be a function of a module.
    finish
        Makes tables, figures and rows from the results of all parts, by key.
    full, quick
        Parameters of the full run and of the quick one; None leaves the experiment out of the quick run.
    alone
        Measures time: nothing runs beside it in the full run.
    turn
        Experiments with smaller numbers begin first. Those that compile different kernels, which others need, do: two
        processes at work on the same experiment compile everything twice.
    revision
        Raised when the code changes what comes out, so that older results are made again.
    """

    name: str
    title: str
    parts: Callable[[Parameters], Sequence[Part]]
    work: Callable[[Context, Part], Results]
    finish: Callable[[Context, Mapping[str, Results]], Outcome]
    full: Parameters
    quick: Parameters | None
    alone: bool = False
    turn: int = 2
    revision: int = 1

    def fingerprint(self, parameters: Parameters, seed: int, part: Part | None = None) -> str:
        """Checksum of all that the outcome, or one part of it, depends on."""
        content = {
            "name": self.name,
            "revision": self.revision,
            "seed": seed,
            "parameters": dict(parameters) if part is None else _without_lists(parameters),
            "part": None if part is None else [part.key, dict(part.values)],
        }
        text = json.dumps(content, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _without_lists(parameters: Parameters) -> dict[str, Any]:
    """Parameters that hold for every part: a list says which parts there are, and a part names its own entry."""
    return {key: value for key, value in parameters.items() if not isinstance(value, list | tuple)}


@dataclass(frozen=True, slots=True)
class Context:
    """Where and with what an experiment runs.

    Attributes
    ----------
    folder
        The experiment's own folder.
    databases
        Folder in which feature databases are kept for all experiments.
    name, seed, parameters
        Of the experiment, the run, and this run of the experiment.
    quick
        Whether this is the quick run.
    """

    folder: Path
    databases: Path
    name: str
    seed: int
    parameters: Parameters
    quick: bool

    def rng(self, *keys: str | int) -> np.random.Generator:
        """Source of chance that depends on the run's seed, the experiment and the keys, and on nothing else."""
        text = json.dumps([self.name, *keys])
        entropy = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")
        return np.random.default_rng([self.seed, entropy])

    def database(self, overlap: float) -> FeatureDatabase:
        """Planar database of the thesis for an overlap ratio (a fraction), built once and kept in a file."""
        return _database(self.databases, overlap)

    def database_file(self, overlap: float) -> Path:
        """Where that database is kept."""
        return _database_file(self.databases, overlap)

    def lost_in_space(self, overlap: float, solver: Solver = "exact") -> LostInSpace:
        """The LSI algorithm on that database, kept in this process."""
        return _lost_in_space(self.databases, overlap, solver)

    def sky(self) -> FrameSky:
        """The stars of the planar databases."""
        return planar_sky(None, "faintest")


def row(
    quantity: str,
    *,
    ours: float | str,
    published: float | str | None = None,
    unit: str = "",
    digits: int = 2,
    at_least: float | None = None,
    at_most: float | None = None,
    passed: bool | None = None,
    target: str = "",
    remark: str = "",
) -> Row:
    """Make a row for the report; a bound, which is this project's own, makes it a check of the class "ours".

    `starid.thesis.experiments.comparison` makes the checks against published numbers.

    Parameters
    ----------
    quantity
        What was measured.
    ours, published
        Values: numbers (printed with `digits` decimals and `unit`) or text; published may be None.
    at_least, at_most
        Bounds of this project on `ours`, which must then be a number.
    passed, target
        A check of another kind, and its wording.
    remark
        Why the two differ.
    """
    space = space_before(unit)
    if isinstance(ours, str) and not (at_least is None and at_most is None):
        raise ReproduceError(f"reproduce: {quantity}: a text has no bounds; give a number")
    bounds = []
    if at_least is not None and not isinstance(ours, str):
        bounds.append(f"≥ {at_least:g}{space}{unit}")
        passed = bool(ours >= at_least) and passed is not False
    if at_most is not None and not isinstance(ours, str):
        bounds.append(f"≤ {at_most:g}{space}{unit}")
        passed = bool(ours <= at_most) and passed is not False
    verdict = None if passed is None else bool(passed)
    return Row(
        quantity,
        value_text(published, unit, digits),
        value_text(ours, unit, digits),
        target or ", ".join(bounds),
        verdict,
        remark,
        kind="" if verdict is None else "ours",
        met=int(verdict is True),
        of=int(verdict is not None),
    )


def space_before(unit: str) -> str:
    """What stands between a number and its unit."""
    return "" if unit in ("", "°", "″") else " "


def value_text(value: float | str | None, unit: str, digits: int) -> str:
    """A value as the report prints it; "—" for none."""
    if value is None:
        return "—"
    return value if isinstance(value, str) else f"{value:.{digits}f}{space_before(unit)}{unit}"


def write_csv(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> str:
    """Write columns of equal length under their names; numbers with nine significant digits. Return the file's name."""
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


def write_lines(path: Path, lines: Sequence[Mapping[str, Any]]) -> str:
    """Write lines that all have the same names as `write_csv` does."""
    return write_csv(path, {name: [line[name] for line in lines] for name in lines[0]})


@lru_cache(maxsize=1)
def star_catalog() -> StarCatalog:
    """The stars at the catalogue's own epoch."""
    from starid.catalog import load_catalog

    return load_catalog(epoch=EPOCH)


@lru_cache(maxsize=16)
def planar_sky(kappa: float | None, direction: str, fov_deg: float | None = None) -> FrameSky:
    """Stars of the flat sky for a brightness limit (None: the one of the published databases)."""
    from dataclasses import replace
    from typing import cast

    from starid.thesis.database import DatabaseParameters, sky_of
    from starid.thesis.frame_sky import Direction

    parameters = replace(DatabaseParameters(), direction=cast("Direction", direction))
    if kappa is not None:
        parameters = replace(parameters, kappa=kappa)
    if fov_deg is not None:
        parameters = replace(parameters, fov_deg=fov_deg)
    return sky_of(star_catalog(), parameters)


@lru_cache(maxsize=4)
def author_database(overlap: float) -> FeatureDatabase:
    """Planar database whose brightness counts from the brightest star of the catalogue.

    These are the weights of the thesis's frame object, a − min(a); the normalised features differ in r alone, by
    hundredths of a degree before they are normalised. The mean brightness A is greater by −min(a).
    """
    from dataclasses import replace

    from starid.thesis.database import DatabaseParameters, build_database

    stars, parameters = star_catalog(), DatabaseParameters(overlap=overlap)
    least = float(stars.hp.min())
    shifted = replace(stars, hp=stars.hp - least)
    return build_database(shifted, replace(parameters, kappa=parameters.kappa - least))


def _database_file(folder: Path, overlap: float) -> Path:
    return folder / f"planar-{100 * overlap:g}.features"


@lru_cache(maxsize=3)
def _database(folder: Path, overlap: float) -> FeatureDatabase:
    from starid.thesis.database import DatabaseParameters, build_database
    from starid.thesis.database_file import load_database, save_database

    catalog = star_catalog()
    path = _database_file(folder, overlap)
    if path.exists():
        database = load_database(path)
        if database.catalog_identity == catalog.identity:
            return database
    folder.mkdir(parents=True, exist_ok=True)
    save_database(build_database(catalog, DatabaseParameters(overlap=overlap)), path)
    return load_database(path)


@lru_cache(maxsize=6)
def _lost_in_space(folder: Path, overlap: float, solver: Solver) -> LostInSpace:
    from starid.thesis.lsi import LostInSpace

    return LostInSpace(_database(folder, overlap), solver=solver)
