"""Separation of attitude errors into the kinds of ECSS-E-ST-60-20C, from series that vary one influence at a time.

An error is a rotation vector in the sensor frame (``starid.attitude.AttitudeDifference``): x and y are across the
boresight, z is about it. The main series has several sub-pixel positions for each field (direction in the sky),
and several frames for each position, so that the error is

    e = bias + field + position + noise

with a random term for each level. A nested analysis of variance gives unbiased estimates of the variances
(Henderson's method 1; Searle, Casella and McCulloch, Variance Components, section 3.6), and F tests show whether
they are significant: a term that is not significant is reported as zero, with the smallest value that
would have been significant. Thermo-elastic error and aberration residual come from separate series, in which fields are repeated
at other temperatures and dates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starid.arithmetic.arrays import Array, Indices

SIGNIFICANCE: Final = 1e-3
"""Probability of reporting an influence that is not present."""

BIAS: Final = "bias"
THERMO_ELASTIC: Final = "thermo-elastic error"
ABERRATION: Final = "aberration residual"

_TURNS: Final = 2001
"""Number of directions for which the turn by a velocity is computed."""

Vectors = Array
Labels = Indices


@dataclass(frozen=True)
class ErrorSeries:
    """Errors at known conditions."""

    error_arcsec: Vectors
    """Rotation vectors of the errors, arcseconds, (n, 3)."""
    field: Labels
    """Number of the direction of the sky, (n,)."""
    condition: Labels
    """Number of the condition within each field: the sub-pixel position, the temperature or the date, (n,)."""
    to_sensor: Array
    """Attitude matrices ICRS→sensor, (n, 3, 3)."""


@dataclass(frozen=True)
class ErrorLine:
    """One kind of error."""

    name: str
    """Name in the standard."""
    arcsec: Vectors | None
    """Size about x, y and z at the confidence level, arcseconds, (3,); 0 if not significant. None: not evaluated."""
    resolution_arcsec: Vectors
    """Smallest size that would have been significant, (3,)."""

    @property
    def across_arcsec(self) -> float:
        """Size about an axis across the boresight: RMS of x and y."""
        return math.nan if self.arcsec is None else math.sqrt(0.5 * float(np.sum(self.arcsec[:2] ** 2)))

    @property
    def about_arcsec(self) -> float:
        return math.nan if self.arcsec is None else float(self.arcsec[2])


def coverage_factor(confidence: float) -> float:
    """Return the number of standard deviations for a confidence level, for a normal error: 2.97 for 0.997."""
    from scipy.stats import norm

    if not 0.5 <= confidence < 1.0:
        raise EmulatorError(f"confidence must be at least 0.5 and below 1, such as 0.997, not {confidence}")
    return float(norm.ppf(0.5 * (1.0 + confidence)))


@dataclass(frozen=True)
class _Nested:
    """Mean squares (3,) of a series: of fields, of conditions in fields, and of frames.

    Their expectations are noise + k2·condition + k3·field, noise + k1·condition, and noise.
    """

    mean: Vectors
    field_ms: Vectors
    condition_ms: Vectors
    noise_ms: Vectors
    fields: int
    cells: int
    total: int
    k1: float
    k2: float
    k3: float

    @classmethod
    def of(cls, series: ErrorSeries) -> _Nested:
        """Analyse a series, in which the numbers of frames may differ."""
        error = series.error_arcsec
        total = len(error)
        _, field = np.unique(series.field, return_inverse=True)
        _, cell, in_cell = np.unique(
            np.column_stack([series.field, series.condition]), axis=0, return_inverse=True, return_counts=True
        )
        cell = cell.reshape(-1)
        fields, cells = int(field.max(initial=-1)) + 1, len(in_cell)
        if not 1 < fields < cells < total:
            raise EmulatorError(
                f"errors of {fields} fields, {cells} positions and {total} frames cannot be separated: "
                "more of each are needed"
            )
        in_field = np.bincount(field)
        of_cell = np.zeros(cells, dtype=np.int64)
        of_cell[cell] = field
        mean, field_mean, cell_mean = (
            error.mean(axis=0),
            _means(error, field, in_field),
            _means(error, cell, in_cell),
        )
        field_ss = np.sum((field_mean - mean) ** 2 * in_field[:, None], axis=0)
        cell_ss = np.sum((cell_mean - field_mean[of_cell]) ** 2 * in_cell[:, None], axis=0)
        noise_ss = np.sum((error - cell_mean[cell]) ** 2, axis=0)
        squares = float(np.sum(in_cell**2 / in_field[of_cell]))
        return cls(
            mean,
            field_ss / (fields - 1),
            cell_ss / (cells - fields),
            noise_ss / (total - cells),
            fields,
            cells,
            total,
            (total - squares) / (cells - fields),
            (squares - float(np.sum(in_cell.astype(np.float64) ** 2)) / total) / (fields - 1),
            (total - float(np.sum(in_field.astype(np.float64) ** 2)) / total) / (fields - 1),
        )

    def condition_variance(
        self, pixel: Vectors | float = 0.0, pixel_dof: float = math.inf
    ) -> tuple[Vectors, Vectors]:
        """Return the variance of the conditions beyond a known variance, and the smallest significant value."""
        dof = (self.cells - self.fields, min(self.total - self.cells, pixel_dof))
        return _level(self.condition_ms, self.noise_ms + self.k1 * pixel, self.k1, dof)

    def field_variance(self, condition: Vectors) -> tuple[Vectors, Vectors]:
        """Return the field variance, corrected for the conditions, and the smallest significant value."""
        dof = (self.fields - 1, self.cells - self.fields)
        return _level(self.field_ms, self.noise_ms + self.k2 * condition, self.k3, dof)


def _level(above: Vectors, below: Vectors, k: float, dof: tuple[float, float]) -> tuple[Vectors, Vectors]:
    """Return a level's variance above the next, 0 if not significant, and the smallest significant value."""
    from scipy.stats import f as f_distribution

    threshold = below * float(f_distribution.isf(SIGNIFICANCE, *dof))
    found = np.where(above > threshold, np.maximum(above - below, 0.0) / k, 0.0)
    return found, np.maximum(threshold - below, 0.0) / k


def static_errors(
    series: ErrorSeries, confidence: float
) -> tuple[ErrorLine, ErrorLine, ErrorLine, ErrorLine]:
    """Separate a series into bias, field-of-view spatial error, pixel spatial error and temporal noise."""
    from scipy.stats import t as t_distribution

    factor = coverage_factor(confidence)
    nested = _Nested.of(series)
    pixel, pixel_least = nested.condition_variance()
    field, field_least = nested.field_variance(pixel)
    standard_error = np.sqrt(nested.field_ms / nested.total)
    bias_least = standard_error * float(t_distribution.isf(0.5 * SIGNIFICANCE, nested.fields - 1))
    bias = np.where(np.abs(nested.mean) > bias_least, np.abs(nested.mean), 0.0)
    return (
        ErrorLine(BIAS, bias, bias_least),
        ErrorLine("field-of-view spatial error", factor * np.sqrt(field), factor * np.sqrt(field_least)),
        ErrorLine("pixel spatial error", factor * np.sqrt(pixel), factor * np.sqrt(pixel_least)),
        ErrorLine("temporal noise (NEA)", factor * np.sqrt(nested.noise_ms), np.zeros(3)),
    )


def aberration_residual(dated: ErrorSeries | None, static: ErrorSeries, confidence: float) -> ErrorLine:
    """Return the error that differs between dates: the aberration that the device does not correct.

    The conditions of the first series are dates. Across the boresight, the size is the quantile, over all directions of the sky
    and the dates, of the turn by the velocity that all fields have in common, relative to the mean of the dates. A turn has the speed
    as its bound, which a multiple of its standard deviation would exceed. What differs between fields for other reasons, such
    as stars that cross pixels, is left out. About the boresight, aberration turns a field
    only as far as its stars are unevenly distributed; that is a multiple of the standard deviation, without the
    pixel spatial error in the second series (see `static_errors`). If a series is None, the line is not evaluated.
    """
    if dated is None:
        return ErrorLine(ABERRATION, None, np.zeros(3))
    factor = coverage_factor(confidence)
    at_rest = _Nested.of(static)
    pixel = np.maximum(at_rest.condition_ms - at_rest.noise_ms, 0.0) / at_rest.k1
    variance, least = _Nested.of(dated).condition_variance(pixel, at_rest.cells - at_rest.fields)
    size, smallest = _common_velocity(dated, confidence)
    return ErrorLine(
        ABERRATION,
        np.append(size, factor * np.sqrt(variance[2])),
        np.append(smallest, factor * np.sqrt(least[2])),
    )


def _common_velocity(series: ErrorSeries, confidence: float) -> tuple[Vectors, Vectors]:
    """Return the turn about x and y due to one velocity for each condition, 0 if not significant, and the smallest significant (2,).

    A velocity v, in units of c and the sensor frame, turns a sensor that does not correct it by (−v_y, v_x). In a random direction of
    the sky, the turn about an axis is uniform up to the speed (Archimedes).
    """
    from scipy.stats import f as f_distribution

    cells, first, of_cell, frames = np.unique(
        np.column_stack([series.field, series.condition]),
        axis=0, return_index=True, return_inverse=True, return_counts=True,
    )  # fmt: skip
    mean_error = _means(series.error_arcsec, of_cell.reshape(-1), frames)[:, :2]
    _, field, sizes = np.unique(cells[:, 0], return_inverse=True, return_counts=True)
    dates, date = np.unique(cells[:, 1], return_inverse=True)
    to_sensor = series.to_sensor[first]
    design = np.zeros((len(cells), 2, len(dates), 3))
    design[np.arange(len(cells)), :, date] = np.stack([-to_sensor[:, 1], to_sensor[:, 0]], axis=1)

    def within_fields(values: Vectors) -> Vectors:
        sums = np.zeros((len(sizes), *values.shape[1:]))
        np.add.at(sums, field, values)
        return np.asarray(values - (sums / sizes.reshape(-1, *[1] * (values.ndim - 1)))[field])

    error = within_fields(mean_error)
    matrix = within_fields(design).reshape(error.size, -1)
    velocity, _, rank, _ = np.linalg.lstsq(matrix, error.ravel(), rcond=1e-9)
    explained = (matrix @ velocity).reshape(error.shape)
    left = error.size - 2 * len(sizes) - rank
    if rank == 0 or left <= 0:
        raise EmulatorError(
            f"{ABERRATION}: {len(sizes)} fields on {len(dates)} dates: more of each are needed"
        )
    rest_ms = float(np.sum((error - explained) ** 2)) / left
    limit = rest_ms * float(f_distribution.isf(SIGNIFICANCE, rank, left))
    significant = float(np.sum(explained**2)) > rank * limit
    covariance = rest_ms * np.linalg.pinv(matrix.T @ matrix, rcond=1e-9)
    speeds = _speeds(
        np.asarray(velocity, dtype=np.float64).reshape(-1, 3),
        covariance.reshape(len(dates), 3, len(dates), 3),
    )
    turns = np.outer(speeds, np.linspace(0.0, 1.0, _TURNS))
    size = np.full(2, np.quantile(turns, confidence) if significant else 0.0)
    return size, np.full(2, math.sqrt(2.0 * rank * limit / error.size))


def _speeds(velocity: Vectors, covariance: Array) -> Vectors:
    """Lengths (k,) of fitted velocities (k, 3) without the length that their errors add, by their covariance (k, 3, k, 3).

    The errors make a mean square too large by the trace of the covariance, and the largest of several speeds too large by
    their scatter. If the scatter is not significantly larger than that of the errors, all speeds are the same.
    """
    from scipy.stats import chi2

    own = np.einsum("iaib->iab", covariance)
    squares = np.sum(velocity**2, axis=1) - np.trace(own, axis1=1, axis2=2)
    variance = 4.0 * np.einsum("ia,iab,ib->i", velocity, own, velocity) + 2.0 * np.sum(own**2, axis=(1, 2))
    mean, dof = squares.mean(), len(squares) - 1
    limit = float(variance.mean()) * float(chi2.isf(SIGNIFICANCE, dof))
    if np.sum((squares - mean) ** 2) <= limit:
        squares = np.full(len(squares), mean)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def thermo_elastic_error(series: ErrorSeries, confidence: float) -> ErrorLine:
    """Return the error that follows the temperature and is the same in all fields.

    The conditions of the series are points of the orbit. The size is the quantile of the deviation from their mean.
    Effects of temperature that differ between fields are not included.
    """
    from scipy.stats import f as f_distribution

    table = _by_field_and_condition(series)
    fields, conditions, _ = table.shape
    if fields < 2 or conditions < 2:
        raise EmulatorError(
            f"{THERMO_ELASTIC}: {fields} fields are valid under all of {conditions} conditions: more of each are needed"
        )
    of_condition = table.mean(axis=0)
    deviation = of_condition - of_condition.mean(axis=0)
    rest = table - table.mean(axis=1, keepdims=True) - deviation[None]
    rest_ms = np.sum(rest**2, axis=(0, 1)) / ((fields - 1) * (conditions - 1))
    condition_ms = fields * np.sum(deviation**2, axis=0) / (conditions - 1)
    limit = rest_ms * float(f_distribution.isf(SIGNIFICANCE, conditions - 1, (fields - 1) * (conditions - 1)))
    size = np.quantile(np.abs(deviation), confidence, axis=0, method="higher")
    least = np.sqrt(limit / fields)
    return ErrorLine(THERMO_ELASTIC, np.where(condition_ms > limit, size, 0.0), least)


def _means(values: Vectors, group: Labels, sizes: Labels) -> Vectors:
    """Return the means (g, 3) of values (n, 3) by group."""
    sums = np.column_stack([np.bincount(group, values[:, axis], len(sizes)) for axis in range(3)])
    return np.asarray(sums / sizes[:, None])


def _by_field_and_condition(series: ErrorSeries) -> Vectors:
    """Return errors (fields, conditions, 3) of the fields that are valid under every condition."""
    conditions, column = np.unique(series.condition, return_inverse=True)
    fields, row = np.unique(series.field, return_inverse=True)
    table: Vectors = np.full((len(fields), len(conditions), 3), np.nan)
    table[row, column] = series.error_arcsec
    complete: Vectors = table[~np.isnan(table).any(axis=(1, 2))]
    return complete
