"""The LASSO path of a dictionary, eq. 2.34: exact solutions for all regularisation parameters.

The solution of min 1/(2M)·‖ψ̂ − Tω‖² + λ‖ω‖₁ is piecewise linear in λ. With five features and nine columns it
has one or two dozen breakpoints, which are found one by one with the least-angle regression of Efron et al.
(2004) and its LASSO modification; between them the solution is interpolated. Neighbouring cells have similar
features, so the columns are nearly parallel. The solution at the end of the path, where errors have
accumulated, is therefore checked against the optimality conditions; if it fails (columns can be equal, as
stored codes are coarse), coordinate descent takes over.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import square
from starid.kernels.jit import compiled, inner_checked

LAMBDAS: Final[Array] = np.arange(1, 101, dtype=np.float64) * np.float64(0.05)
"""The regularisation parameters of the thesis: 0.05, 0.10 … 5.00."""
LAMBDAS.setflags(write=False)

MAX_STEPS: Final = 96
"""Largest number of breakpoints before coordinate descent takes over."""

_MAX_SWEEPS: Final = 2000
_SINGULAR: Final = 1e-11
_TIE: Final = 1e-10
_OPTIMALITY: Final = 1e-6


@inner_checked
def _solve_active(
    gram: Array, active: Indices, size: int, right: Array, work: Array, solution: Array
) -> bool:
    """Solve the active part of the Gram matrix by Cholesky; False if it is singular."""
    for i in range(size):
        for j in range(i + 1):
            value = gram[active[i], active[j]]
            for k in range(j):
                value -= work[i, k] * work[j, k]
            if i == j:
                if value <= _SINGULAR * gram[active[i], active[i]]:
                    return False
                work[i, i] = math.sqrt(value)
            else:
                work[i, j] = value / work[j, j]
    for i in range(size):
        value = right[active[i]]
        for k in range(i):
            value -= work[i, k] * solution[k]
        solution[i] = value / work[i, i]
    for back in range(size):
        i = size - 1 - back
        value = solution[i]
        for k in range(i + 1, size):
            value -= work[k, i] * solution[k]
        solution[i] = value / work[i, i]
    return True


@inner_checked
def _slope(gram: Array, j: int, active: Indices, size: int, direction: Array) -> float:
    """Rate at which the correlation of column j falls along the path."""
    value = 0.0
    for k in range(size):
        value += gram[j, active[k]] * direction[k]
    return value


@inner_checked
def _next_joining(
    gram: Array,
    rest: Array,
    level: float,
    idle: Mask,
    active: Indices,
    size: int,
    direction: Array,
    dropped: int,
    length: float,
) -> tuple[int, float]:
    """First column to reach the active ones' correlation within `length`, and where; −1 if none does."""
    joining = -1
    for j in range(rest.size):
        if not idle[j]:
            continue
        slope = _slope(gram, j, active, size, direction)
        for target in (1.0, -1.0):
            closing = 1.0 - target * slope
            if closing <= _TIE:
                continue
            gap = (level - target * rest[j]) / closing
            if gap < length and not (j == dropped and gap < _TIE * level):
                length = max(gap, 0.0)
                joining = j
    return joining, length


@inner_checked
def _next_dropping(
    omega: Array, active: Indices, size: int, direction: Array, length: float
) -> tuple[int, float]:
    """First active column whose weight reaches zero within `length`, and where; −1 if none does."""
    dropping = -1
    for k in range(size):
        if direction[k] != 0.0:
            gap = -omega[active[k]] / direction[k]
            if 0.0 < gap < length:
                length = gap
                dropping = k
    return dropping, length


@inner_checked
def lars_path(gram: Array, correlation: Array, end: float, breaks: Array, weights: Array) -> int:
    """Follow the LASSO path down to λ = `end`; return the number of breakpoints, or 0 on failure.

    Parameters
    ----------
    gram, correlation
        TᵀT/M (n, n) and Tᵀψ̂/M (n,).
    end
        Smallest λ required.
    breaks, weights
        Output: λ of each breakpoint, decreasing, (MAX_STEPS,), and ω there, (MAX_STEPS, n).
    """
    n = correlation.size
    rest = correlation.copy()
    omega = np.zeros(n)
    sign = np.zeros(n)
    idle = np.ones(n, dtype=np.bool_)
    active = np.empty(n, dtype=np.int64)
    size = 0
    work = np.empty((n, n))
    direction = np.empty(n)
    joining = int(np.argmax(np.abs(rest)))
    level = abs(rest[joining])
    breaks[0] = max(level, end)
    weights[0] = omega
    if level <= end:
        return 1
    dropped = -1
    for step in range(1, MAX_STEPS):
        if joining >= 0:
            active[size] = joining
            sign[joining] = 1.0 if rest[joining] > 0.0 else -1.0
            idle[joining] = False
            size += 1
        solved = _solve_active(gram, active, size, sign, work, direction)
        if not solved and joining >= 0:
            size -= 1
            solved = _solve_active(gram, active, size, sign, work, direction)
        if size == 0 or not solved:
            return 0
        joining, length = _next_joining(
            gram, rest, level, idle, active, size, direction, dropped, level - end
        )
        dropping, length = _next_dropping(omega, active, size, direction, length)
        for k in range(size):
            omega[active[k]] += length * direction[k]
        for j in range(n):
            rest[j] -= length * _slope(gram, j, active, size, direction)
        level -= length
        dropped = -1
        if dropping >= 0:
            joining = -1
            dropped = active[dropping]
            omega[dropped] = 0.0
            for k in range(dropping, size - 1):
                active[k] = active[k + 1]
            size -= 1
            idle[:] = True
            for k in range(size):
                idle[active[k]] = False
        breaks[step] = level
        weights[step] = omega
        if joining < 0 and dropping < 0:
            return step + 1
    return 0


@compiled
def coordinate_descent(gram: Array, correlation: Array, penalty: float, omega: Array) -> int:
    """Solve a LASSO problem in place, starting from `omega`; return the number of sweeps."""
    n = correlation.size
    for sweep in range(_MAX_SWEEPS):
        change = 0.0
        largest = 0.0
        for j in range(n):
            if gram[j, j] <= 0.0:
                omega[j] = 0.0
                continue
            partial = correlation[j] + gram[j, j] * omega[j]
            for k in range(n):
                partial -= gram[j, k] * omega[k]
            value = math.copysign(max(abs(partial) - penalty, 0.0), partial) / gram[j, j]
            change = max(change, abs(value - omega[j]))
            omega[j] = value
            largest = max(largest, abs(value))
        if change <= 1e-10 * max(largest, 1e-12):
            return sweep + 1
    return _MAX_SWEEPS


@compiled
def optimality_gap(gram: Array, correlation: Array, penalty: float, omega: Array) -> float:
    """Violation of the optimality conditions of the LASSO by ω, relative to the largest correlation."""
    n = correlation.size
    worst = 0.0
    scale = penalty
    for j in range(n):
        rest = correlation[j]
        for k in range(n):
            rest -= gram[j, k] * omega[k]
        scale = max(scale, abs(correlation[j]))
        if omega[j] > 0.0:
            worst = max(worst, abs(rest - penalty))
        elif omega[j] < 0.0:
            worst = max(worst, abs(rest + penalty))
        else:
            worst = max(worst, abs(rest) - penalty)
    return worst / scale if scale > 0.0 else 0.0


@compiled
def lasso_path(dictionary: Array, observation: Array, lambdas: Array, weights: Array) -> bool:
    """Solve the LASSO for all λ; return False if coordinate descent was needed.

    This is the least-squares problem of eq. 2.31 with the penalty of eq. 2.32, P_a of eq. 2.33 at a = 1.

    Parameters
    ----------
    dictionary
        T, (M, n) with M = 5 features and n = 9 cells, normalised.
    observation
        ψ̂, (M,).
    lambdas
        λ, increasing, (k,).
    weights
        Output: ω for each λ, (k, n).
    """
    features, n = dictionary.shape
    gram = np.zeros((n, n))
    correlation = np.zeros(n)
    for j in range(n):
        for f in range(features):
            correlation[j] += dictionary[f, j] * observation[f] / features
        for k in range(j + 1):
            value = 0.0
            for f in range(features):
                value += dictionary[f, j] * dictionary[f, k] / features
            gram[j, k] = value
            gram[k, j] = value
    breaks = np.empty(MAX_STEPS)
    knots = np.empty((MAX_STEPS, n))
    count = lars_path(gram, correlation, lambdas[0], breaks, knots)
    if count > 0 and optimality_gap(gram, correlation, breaks[count - 1], knots[count - 1]) <= _OPTIMALITY:
        at = count - 1
        for i in range(lambdas.size):
            while at > 0 and breaks[at - 1] <= lambdas[i]:
                at -= 1
            if at == 0 or lambdas[i] <= breaks[at]:
                share = 0.0
            else:
                share = (lambdas[i] - breaks[at]) / (breaks[at - 1] - breaks[at])
            before = knots[max(at - 1, 0)]
            for j in range(n):
                weights[i, j] = knots[at, j] + share * (before[j] - knots[at, j])
        return True
    omega = np.zeros(n)
    for back in range(lambdas.size):
        i = lambdas.size - 1 - back
        coordinate_descent(gram, correlation, lambdas[i], omega)
        weights[i] = omega
    return False


@compiled
def choose_lambdas(dictionary: Array, observation: Array, weights: Array, error: Array) -> tuple[int, int]:
    """Choose the λ of the least mean squared error, and the largest λ within one standard error of it.

    The error is the mean over the M features of the squared residual ψ̂ − Tω; its standard error is their
    standard deviation (over M − 1) divided by √M, at the least error. `error` (k,) receives the errors.
    """
    features, n = dictionary.shape
    squared = np.empty(features)
    best = 0
    spread = 0.0
    for i in range(weights.shape[0]):
        total = 0.0
        for f in range(features):
            residual = observation[f]
            for j in range(n):
                residual -= dictionary[f, j] * weights[i, j]
            squared[f] = residual * residual
            total += squared[f]
        error[i] = total / features
        if i == 0 or error[i] < error[best]:
            best = i
            spread = 0.0
            for f in range(features):
                spread += square(squared[f] - error[i])
            spread = math.sqrt(spread / (features - 1) / features)
    largest = best
    for i in range(weights.shape[0]):
        if error[i] <= error[best] + spread:
            largest = i
    return best, largest
