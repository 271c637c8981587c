"""The LASSO as MATLAB's function `lasso` solves it, with which the published numbers were computed.

The function removes the mean of the observation and the means of the columns (`Intercept`), divides the
columns by their standard deviation over the rows (`Standardize`, divisor M), and solves for one λ after
another, from the largest down, by coordinate descent over the active set. Each λ starts from the weights of
the previous one and ends as soon as no weight changes by more than `RelTol` = 1e-4 of one plus its size. With
five rows and nine nearly equal columns this stops far from the minimum, near the weights of the larger λ: the
published accuracy is due to this early stop.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Mask
from starid.kernels.jit import compiled, inner_checked

RELATIVE_TOLERANCE: Final = 1e-4
"""`RelTol` of MATLAB's `lasso`: the descent ends when no weight changes by more."""

MAX_SWEEPS: Final = 100_000
"""`MaxIter` of MATLAB's `lasso`."""


@inner_checked
def standardise(dictionary: Array, columns: Array, deviation: Array) -> None:
    """Standardise the columns to mean 0 and standard deviation 1 (divisor M); also return the deviations.

    A constant column becomes zero, with deviation 0.
    """
    rows, n = dictionary.shape
    for j in range(n):
        mean = 0.0
        low = dictionary[0, j]
        high = dictionary[0, j]
        for f in range(rows):
            mean += dictionary[f, j] / rows
            low = min(low, dictionary[f, j])
            high = max(high, dictionary[f, j])
        square = 0.0
        for f in range(rows):
            columns[f, j] = dictionary[f, j] - mean
            square += columns[f, j] * columns[f, j] / rows
        deviation[j] = math.sqrt(square) if high > low else 0.0
        for f in range(rows):
            columns[f, j] = columns[f, j] / deviation[j] if high > low else 0.0


@inner_checked
def sweep(columns: Array, rest: Array, weights: Array, active: Mask, penalty: float) -> float:
    """Set each active weight to its minimum in turn; return the largest change relative to one plus its size.

    `rest` is the residual of the observation; a weight that becomes zero leaves the active set.
    """
    rows, n = columns.shape
    change = 0.0
    for j in range(n):
        if not active[j]:
            continue
        before = weights[j]
        partial = 0.0
        for f in range(rows):
            partial += columns[f, j] * (rest[f] + before * columns[f, j])
        partial /= rows
        after = math.copysign(max(abs(partial) - penalty, 0.0), partial)
        weights[j] = after
        if after == 0.0:
            active[j] = False
        for f in range(rows):
            rest[f] -= columns[f, j] * (after - before)
        change = max(change, abs(after - before) / (1.0 + abs(before)))
    return change


@inner_checked
def _residual(columns: Array, centred: Array, weights: Array, rest: Array) -> None:
    for f in range(centred.size):
        rest[f] = centred[f]
        for j in range(weights.size):
            rest[f] -= columns[f, j] * weights[j]


@inner_checked
def _descend(
    columns: Array, centred: Array, weights: Array, active: Mask, usable: Mask, penalty: float
) -> None:
    """Solve for one λ: sweep over the active set until the weights settle, then once over all."""
    rows, n = columns.shape
    rest = np.empty(rows)
    wider = np.empty(n, dtype=np.bool_)
    for _ in range(MAX_SWEEPS):
        _residual(columns, centred, weights, rest)
        if sweep(columns, rest, weights, active, penalty) >= RELATIVE_TOLERANCE:
            continue
        _residual(columns, centred, weights, rest)
        joins = False
        for j in range(n):
            product = 0.0
            for f in range(rows):
                product += columns[f, j] * rest[f]
            wider[j] = active[j]
            if usable[j] and abs(product) > penalty:
                wider[j] = True
                joins = True
        if not joins:
            return
        change = sweep(columns, rest, weights, wider, penalty)
        same = True
        for j in range(n):
            same = same and wider[j] == active[j]
            active[j] = wider[j]
        if same or change < RELATIVE_TOLERANCE:
            return


@compiled
def matlab_path(dictionary: Array, observation: Array, lambdas: Array, weights: Array) -> None:
    """Solve the LASSO for all λ as MATLAB's `lasso(T, ψ̂, 'Lambda', λ)` does, without the intercept.

    Parameters
    ----------
    dictionary
        T, (M, n): features in rows, cells in columns, normalised.
    observation
        ψ̂, (M,).
    lambdas
        λ, increasing, (k,).
    weights
        Output: ω for each λ, in the scale of the dictionary, (k, n).
    """
    rows, n = dictionary.shape
    columns = np.empty((rows, n))
    deviation = np.empty(n)
    standardise(dictionary, columns, deviation)
    centred = observation - observation.mean()
    usable = deviation > 0.0
    greatest = 0.0
    for j in range(n):
        product = 0.0
        for f in range(rows):
            product += columns[f, j] * centred[f]
        greatest = max(greatest, abs(product) / rows)
    omega = np.zeros(n)
    active = np.zeros(n, dtype=np.bool_)
    for back in range(lambdas.size):
        i = lambdas.size - 1 - back
        if lambdas[i] < greatest:
            _descend(columns, centred, omega, active, usable, lambdas[i])
        for j in range(n):
            weights[i, j] = omega[j] / deviation[j] if usable[j] else 0.0
