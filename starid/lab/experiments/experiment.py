"""Experiments of `starid reproduce`: separately computed parts, and an outcome for the report."""

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
"""Results of a part: named arrays."""

Parameters = Mapping[str, Any]
"""What an experiment depends on; JSON values only."""

EPOCH: Final = 1991.25
"""Epoch of the catalogue: the published numbers are without proper motion."""

Kind = Literal["", "agrees", "fitted", "better", "ours"]
"""Class of a check: agreement with a published number, the same after a constant was fitted to that number (only in
the report, see `choices`), improvement on it, our own bound, or none ("")."""


class ReproduceError(StaridError):
    """A reproduction that cannot be run as requested."""


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of an experiment that can be computed separately.

    Attributes
    ----------
    key
        Name of the part, unique in its experiment; also used as a file name.
    values
        Values that distinguish this part from the others.
    """

    key: str
    values: Parameters = field(default_factory=dict)


def parts_of(key: str, **values: Iterable[Any]) -> list[Part]:
    """Make a part for each combination of values, the last varying fastest; `key` is a format string."""
    chosen = [dict(zip(values, line, strict=True)) for line in itertools.product(*values.values())]
    return [Part(key.format(**line), line) for line in chosen]


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the report.

    Attributes
    ----------
    quantity
        What was measured, and under what conditions.
    published, ours
        The published value and this project's, as printed in the report; "—" if there is none.
    target
        What is checked, and the tolerance and its origin; "" without a check.
    passed
        Outcome of the check; None if there is none.
    remark
        Why the values differ, or how to read them.
    author, printed
        Values from the author's version of the algorithm and from the printed one; "—" if there is none.
    kind
        Class of the check.
    met, of
        How many of the published numbers in the row agree, and how many there are.
    interval
        Lowest and highest value that agrees, for one published number.
    weak, weak_met
        How many of the published numbers the best constant answer of the null model meets as well, and how
        many of these agree.
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
    interval: tuple[float, ...] = ()
    weak: int = 0
    weak_met: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an experiment adds to the report: rows, names of files, and paragraphs of Markdown."""

    rows: tuple[Row, ...]
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[Row, ...]:
        """Rows whose check failed."""
        return tuple(row for row in self.rows if row.passed is False)

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Outcome:
        """Make an outcome from the values of `to_dict`."""
        rows = tuple(Row(**{**row, "interval": tuple(row["interval"])}) for row in values["rows"])
        return cls(rows, tuple(values["files"]), tuple(values["notes"]))


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment.

    Attributes
    ----------
    name, title
        Name on the command line, and heading in the report.
    parts
        Function that lists the parts for given parameters.
    compute
        Function that computes a part, in a separate process; it must be defined at module level.
    evaluate
        Function that makes tables, figures and rows from the results of all parts, by key.
    full, quick
        Parameters of the full run and of the quick one; None leaves the experiment out of the quick run.
    alone
        The experiment measures time: in the full run nothing else runs at the same time.
    start_order
        Experiments with smaller numbers start first. These are experiments that compile different kernels
        which others need: two processes that work on the same experiment compile everything twice.
    revision
        Incremented when a change of the code changes the results, so that they are computed again.
    """

    name: str
    title: str
    parts: Callable[[Parameters], Sequence[Part]]
    compute: Callable[[Context, Part], Results]
    evaluate: Callable[[Context, Mapping[str, Results]], Outcome]
    full: Parameters
    quick: Parameters | None
    alone: bool = False
    start_order: int = 2
    revision: int = 1

    def fingerprint(self, parameters: Parameters, seed: int, part: Part | None = None) -> str:
        """Checksum of everything on which the outcome, or one part, depends."""
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
    """Parameters common to all parts; lists, which say which parts there are, are left out."""
    return {key: value for key, value in parameters.items() if not isinstance(value, list | tuple)}


@dataclass(frozen=True, slots=True)
class Context:
    """Folders, seed and parameters of a run of an experiment.

    Attributes
    ----------
    folder
        Folder of the experiment.
    databases
        Folder of the feature databases of all experiments.
    name, seed, parameters
        Name of the experiment, seed of the run, parameters of this run of the experiment.
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
        """Random generator that depends only on the seed of the run, the experiment and the keys."""
        text = json.dumps([self.name, *keys])
        entropy = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")
        return np.random.default_rng([self.seed, entropy])

    def database(self, overlap: float) -> FeatureDatabase:
        """Planar database of the thesis for an overlap ratio (a fraction), built once and stored."""
        return _database(self.databases, overlap)

    def database_file(self, overlap: float) -> Path:
        """File of the database."""
        return _database_file(self.databases, overlap)

    def lost_in_space(self, overlap: float, solver: Solver = "exact") -> LostInSpace:
        """The LSI algorithm with that database, kept for this process."""
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
    """Make a row for the report; with a bound it becomes a check of class "ours".

    `starid.lab.experiments.comparison` makes the checks against published numbers.

    Parameters
    ----------
    quantity
        What was measured.
    ours, published
        Values: numbers (printed with `digits` decimals and `unit`) or text; published may be None.
    at_least, at_most
        Bounds on `ours`, set by this project; `ours` must then be a number.
    passed, target
        Result of another kind of check, and its description.
    remark
        Why the two values differ.
    """
    space = space_before(unit)
    if isinstance(ours, str) and not (at_least is None and at_most is None):
        raise ReproduceError(f"reproduce: {quantity}: text cannot have bounds; give a number")
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
    """Separator between a number and its unit."""
    return "" if unit in ("", "°", "″") else " "


def value_text(value: float | str | None, unit: str, digits: int) -> str:
    """Format a value for the report; "—" for None."""
    if value is None:
        return "—"
    return value if isinstance(value, str) else f"{value:.{digits}f}{space_before(unit)}{unit}"


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


def write_lines(path: Path, lines: Sequence[Mapping[str, Any]]) -> str:
    """As `write_csv`, for a list of lines with the same keys."""
    return write_csv(path, {name: [line[name] for line in lines] for name in lines[0]})


@lru_cache(maxsize=1)
def star_catalog() -> StarCatalog:
    """The stars at the epoch of the catalogue."""
    from starid.catalog import load_catalog

    return load_catalog(epoch=EPOCH)


@lru_cache(maxsize=16)
def planar_sky(kappa: float | None, direction: str, fov_deg: float | None = None) -> FrameSky:
    """Stars of the flat sky for a brightness limit (None: as in the published databases)."""
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
    """Planar database with brightness relative to the brightest star of the catalogue.

    These are the weights of the thesis's frame object, a − min(a). The normalised features differ only in r,
    by hundredths of a degree before normalisation. The mean brightness A is larger by −min(a).
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
