"""How far an attitude from features alone is off, measured on simulated fields of the same camera and database.

The answer of algorithm 1 is either right to a fraction of a cell, or somewhere else in the sky: a star on the wrong side
of the brightness limit changes all five features. The smaller ε_ψ is, the rarer is the second. The mean square that is stated
is that of both.

The images of a sequence show the same stars, so their answers are not independent. That a region of search keeps fitting says
little new about its place, and its centre, which is the last answer, may drift away. Where a region stops fitting, the features are
bad, and an answer that is not at the place of the last one is worse than one to a first image with the same ε_ψ. So sequences of
images are simulated, and each kind of answer (`answer_sequence`) has the errors that it had there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, Indices, elementwise
from starid.arithmetic.elementary import exp, log, square
from starid.arithmetic.matrices import length, lengths
from starid.attitude import Attitude, random_attitude
from starid.catalog.photometry import flux_ratio
from starid.identification.thesis.answer_sequence import RIGHT_DEG, AnswerSequence, KeptAnswer
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.features import FeatureVector
from starid.storage.cache import Tables

FIELDS: Final = 800
"""Number of simulated sequences."""

IMAGES: Final = 6
"""Number of images of each."""

MOTIONS: Final = (0.0, 0.007, 0.05)
"""Motion from image to image in the simulated sequences, as a share of the width of the field: at rest, 0.3° and 2° of 42°."""

FAR_DEG: Final = 10.0
"""Error beyond which it is any: those between are of a region that has drifted, or of a neighbouring place."""

_MOTION_LIMITS: Final = (0.0024, 0.019)
"""Between the `MOTIONS`."""

_SEED: Final = 20_221_017
_CLASSES: Final = 8
_ROW: Final = 3
"""Number of classes of answers at the same place, by how many there were in a row; the last has all longer rows."""
_FEW: Final = 8
"""Number of answers of a class from which its mean square is taken; with fewer, it is that of all classes."""
_SLOPE_MAG: Final = 0.2
"""Width of the magnitudes over which the share of stars found falls from 90 to 50 %."""
_BLENDED: Final = 0.04
_BLEND_MAG: Final = 0.1
"""Share of the stars whose magnitudes are off by this, the same in all images: blends, variable stars and the catalogue. On images
of `ideal` and `thesis`, 95 % of the stars near κ are within 0.02 mag, and the others are off by 0.1 mag."""


@dataclass(frozen=True, slots=True)
class Photometry:
    """What a detector finds.

    Attributes
    ----------
    limit
        Magnitude at which 90 % of the stars are found.
    sigma
        One-sigma error of a magnitude there; that of a brighter star is smaller as the root of its flux, by photon noise.
    """

    limit: float
    sigma: float

    def measured(self, rng: np.random.Generator, magnitude: Array) -> Array:
        """Magnitudes as measured in one image, infinite for stars that are not found."""
        sigma = self.sigma * np.sqrt(flux_ratio(self.limit - magnitude))
        slope = log(9.0) / _SLOPE_MAG
        found = 1.0 / (1.0 + elementwise(exp, slope * (magnitude - self.limit - _SLOPE_MAG)))
        seen = rng.uniform(size=magnitude.size) < found
        return np.asarray(
            np.where(seen, magnitude + sigma * rng.normal(size=magnitude.size), np.inf), dtype=np.float64
        )


class StatedError(NamedTuple):
    """Covariance (3, 3) of the rotation vector in the sensor frame, rad², and the probability of another place of the sky."""

    covariance: Array
    wrong: float


RANDOM: Final = StatedError(np.eye(3) * (square(math.pi) / 3.0 + 2.0) / 3.0, 1.0)
"""Error of an attitude that is a random one: the rotation angle θ between two has the density (1 − cos θ)/π."""


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Errors of one kind of answer, in k classes.

    Attributes
    ----------
    squares
        Mean square rotation about an axis across the boresight, and about the boresight, rad², (k, 2).
    wrong
        Share of answers at another place of the sky, (k,).
    """

    squares: Array
    wrong: Array

    def stated(self, row: int) -> StatedError:
        """What is stated of an answer in a class."""
        across, about = self.squares[row]
        return StatedError(np.diag([across, across, about]), float(self.wrong[row]))

    @classmethod
    def of(cls, rows: Indices, errors: Array, classes: int, far: Array) -> Self:
        """The table of answers with classes (n,) and rotation vectors (n, 3), rad.

        The mean squares `far` (2,) of all that are far off stand for the few of one class.
        """
        off = off_deg(errors)
        squares, near = np.empty((classes, 2)), off <= FAR_DEG
        count = np.bincount(rows, minlength=classes)
        share = (np.bincount(rows[~near], minlength=classes) + 0.5) / (count + 1.0)
        for row in range(classes):
            chosen = near & (rows == row)
            others = errors[chosen if np.count_nonzero(chosen) >= _FEW else near]
            squares[row] = share[row] * far + (1.0 - share[row]) * (
                mean_squares(others) if len(others) else far
            )
        wrong = (np.bincount(rows[off > RIGHT_DEG], minlength=classes) + 0.5) / (count + 1.0)
        return cls(squares, wrong)


@dataclass(frozen=True, eq=False)
class FeatureErrors:
    """Errors of an attitude from features.

    Attributes
    ----------
    upper
        Largest ε_ψ of each class, (k,).
    first, elsewhere
        Errors of these kinds of answers, by classes of ε_ψ.
    region, again
        Errors of these kinds by the number of answers in a row at the same place, one table for each of `MOTIONS`.
    """

    upper: Array
    first: ErrorTable
    elsewhere: ErrorTable
    region: tuple[ErrorTable, ...]
    again: tuple[ErrorTable, ...]

    @property
    def arrays(self) -> Tables:
        """Arrays by name, from which `of_arrays` makes the same."""
        kinds = {
            "first": [self.first],
            "elsewhere": [self.elsewhere],
            "region": self.region,
            "again": self.again,
        }
        arrays: Tables = {"upper": self.upper}
        for kind, tables in kinds.items():
            arrays[f"{kind}_squares"] = np.array([table.squares for table in tables])
            arrays[f"{kind}_wrong"] = np.array([table.wrong for table in tables])
        return arrays

    @classmethod
    def of_arrays(cls, arrays: Tables) -> Self:
        def tables(kind: str) -> tuple[ErrorTable, ...]:
            squares, wrong = (
                np.asarray(arrays[f"{kind}_{name}"], np.float64) for name in ("squares", "wrong")
            )
            return tuple(map(ErrorTable, squares, wrong))

        (first,), (elsewhere,) = tables("first"), tables("elsewhere")
        return cls(
            np.asarray(arrays["upper"], np.float64), first, elsewhere, tables("region"), tables("again")
        )

    def of(self, kept: KeptAnswer, moved: float) -> StatedError:
        """Error of an answer, after a motion as a share of the width of the field."""
        if kept.kind in ("first", "elsewhere"):
            table = self.first if kept.kind == "first" else self.elsewhere
            return table.stated(int(_rows(self.upper, kept.answer.error_psi)))
        tables = self.region if kept.kind == "region" else self.again
        return tables[int(np.searchsorted(_MOTION_LIMITS, moved))].stated(min(kept.images, _ROW) - 1)

    @classmethod
    def of_search(
        cls, search: FeatureSearch, photometry: Photometry, side_deg: float, threshold: float, largest: float
    ) -> Self:
        """Measure the errors on simulated sequences.

        `side_deg` is the side of a region, `threshold` the largest ε_ψ with which it fits, and `largest` that of an attitude.
        """
        rng = np.random.default_rng(_SEED)
        first, elsewhere = _Answers(), _Answers()
        region, again = [_Answers() for _ in MOTIONS], [_Answers() for _ in MOTIONS]
        stars = int(search.stars.source.max()) + 1
        for number in range(FIELDS):
            somewhere, axis = random_attitude(rng), rng.normal(size=3)
            truth = Attitude.from_radec_roll(somewhere.ra_deg, somewhere.dec_deg, 0.0)
            which = number % len(MOTIONS)
            move = math.radians(MOTIONS[which] * search.database.parameters.fov_deg) * axis / length(axis)
            own = np.where(rng.uniform(size=stars) < _BLENDED, _BLEND_MAG * rng.normal(size=stars), 0.0)
            kinds = {"first": first, "elsewhere": elsewhere, "region": region[which], "again": again[which]}
            sequence = AnswerSequence(threshold, largest)
            centre: Attitude | None = None
            for _ in range(IMAGES):
                features = _features_at(search, photometry, rng, own, truth)
                if features is None:
                    break
                local = (
                    None
                    if centre is None or sequence.exceeded
                    else search.answer_in_region(features, centre, side_deg)
                )
                everywhere = [partial(search.answer, features)]
                kept = sequence.next(local, everywhere, centre, first=centre is None)
                if kept is None:
                    break
                kinds[kept.kind].add(kept, truth)
                if not kept.valid:
                    break
                truth, centre = truth.rotated(move), kept.answer.attitude.rotated(move)
        upper = np.quantile(first.values, np.arange(1, _CLASSES + 1) / _CLASSES)
        upper[-1] = math.inf
        every = np.concatenate([kind.vectors for kind in (first, elsewhere, *region, *again)])
        off = every[off_deg(every) > FAR_DEG]
        far = mean_squares(off) if len(off) else np.diag(RANDOM.covariance)[:2]

        def by_error(kind: _Answers) -> ErrorTable:
            return ErrorTable.of(_rows(upper, kind.values), kind.vectors, _CLASSES, far)

        def by_row(kinds: list[_Answers]) -> tuple[ErrorTable, ...]:
            return tuple(ErrorTable.of(kind.rows, kind.vectors, _ROW, far) for kind in kinds)

        return cls(upper, by_error(first), by_error(elsewhere), by_row(region), by_row(again))


class _Answers:
    """Answers of one kind: ε_ψ, number in a row, and error as a rotation vector, rad."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._images: list[int] = []
        self._errors: list[Array] = []

    def add(self, kept: KeptAnswer, truth: Attitude) -> None:
        self.values.append(kept.answer.error_psi)
        self._images.append(kept.images)
        self._errors.append(kept.answer.attitude.error_to(truth).rotation_vector_rad)

    @property
    def rows(self) -> Indices:
        """Classes by the number in a row."""
        return np.minimum(np.array(self._images, dtype=np.int64), _ROW) - 1

    @property
    def vectors(self) -> Array:
        """The errors, (n, 3)."""
        return np.array(self._errors).reshape(-1, 3)


def off_deg(errors: Array) -> Array:
    """Angles between boresights, (n,), of rotation vectors (n, 3), rad."""
    return np.degrees(lengths(errors[:, :2]))


def mean_squares(errors: Array) -> Array:
    """Mean squares (2,) of rotation vectors (n, 3) about an axis across the boresight, and about the boresight."""
    return np.array([square(errors[:, :2]).mean(), square(errors[:, 2]).mean()])


def _rows(upper: Array, error_psi: ArrayLike) -> Indices:
    """Classes of ε_ψ."""
    return np.asarray(np.minimum(np.searchsorted(upper, error_psi), upper.size - 1))


def _features_at(
    search: FeatureSearch, photometry: Photometry, rng: np.random.Generator, own: Array, attitude: Attitude
) -> FeatureVector | None:
    """Features of the field at an attitude as the detector sees it, with errors of the stars' own; None with too few stars."""
    brightness, offsets, source = search.stars.stars_in_frame(attitude.ra_deg, attitude.dec_deg)
    return search.features(search.field_of(offsets, photometry.measured(rng, brightness + own[source])))
