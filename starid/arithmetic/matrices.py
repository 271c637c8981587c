"""Small matrices by sums in a stated order: the same bytes on each processor.

The order of the sums in BLAS and LAPACK (``@``, ``numpy.linalg``) and in ``numpy.einsum`` depends on the processor, as does whether
they fuse multiplication and addition. See `starid.arithmetic.elementary`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array

_MAX_SWEEPS: Final = 30
_ZERO_SHARE: Final = 1e-14


def product(left: Array, right: Array) -> Array:
    """Return the matrix product, as ``left @ right`` does, of two vectors (k,) as an array of no dimension.

    It is meant for few columns of `left`: the sum goes over them one by one.
    """
    rows = left if left.ndim > 1 else left[None, :]
    columns = right if right.ndim > 1 else right[:, None]
    total: Array = rows[..., :, 0, None] * columns[..., 0, None, :]
    for k in range(1, rows.shape[-1]):
        total = total + rows[..., :, k, None] * columns[..., k, None, :]
    if right.ndim == 1:
        total = total[..., 0]
    if left.ndim == 1:
        total = total[..., 0] if right.ndim == 1 else total[..., 0, :]
    return total


def carried(slopes: Array, covariance: Array) -> Array:
    """Return J C Jᵀ (…, m, m), the covariances of what has the derivatives J (…, m, k)."""
    return product(product(slopes, covariance), np.swapaxes(slopes, -1, -2))


def sum_of_products(left: Array, right: Array) -> Array:
    """Return Σ lᵢ rᵢᵀ (k, m) of the rows of two tables (n, k) and (n, m), as ``left.T @ right`` does."""
    return np.asarray(np.sum(left[:, :, None] * right[:, None, :], axis=0), dtype=np.float64)


def dot(left: Array, right: Array) -> float:
    """Return the scalar product of two vectors (k,)."""
    total = 0.0
    for one, other in zip(left.tolist(), right.tolist(), strict=True):
        total += one * other
    return total


def length(vector: Array) -> float:
    """Return the length of a vector (k,)."""
    return math.sqrt(dot(vector, vector))


def lengths(vectors: Array) -> Array:
    """Return the lengths (…) of vectors (…, k)."""
    return np.asarray(np.sqrt(np.sum(vectors * vectors, axis=-1)), dtype=np.float64)


def inverse(matrices: Array) -> Array:
    """Return the inverses of matrices (…, k, k) that are triangular, or symmetric and positive definite.

    By Gauss–Jordan elimination without pivots.
    """
    size = matrices.shape[-1]
    table = np.concatenate([matrices, np.broadcast_to(np.eye(size), matrices.shape)], axis=-1)
    for k in range(size):
        pivot_row = table[..., k, :] / table[..., k, k, None]
        table -= table[..., :, k, None] * pivot_row[..., None, :]
        table[..., k, :] = pivot_row
    return np.asarray(table[..., size:], dtype=np.float64)


def root(matrices: Array) -> Array:
    """Return lower triangles L (…, k, k) with L Lᵀ = C, of positive semidefinite matrices C (Cholesky).

    A diagonal element that is 0 after elimination, to 1e-14 of what it was, leaves a column of zeros.
    """
    left = matrices.copy()
    result = np.zeros_like(left)
    for k in range(left.shape[-1]):
        pivot = left[..., k, k]
        counts = pivot > _ZERO_SHARE * matrices[..., k, k]
        scale = np.where(counts, 1.0 / np.sqrt(np.where(counts, pivot, 1.0)), 0.0)
        column = left[..., :, k] * scale[..., None]
        column[..., :k] = 0.0
        result[..., :, k] = column
        left -= column[..., :, None] * column[..., None, :]
    return result


def eigenvectors(symmetric: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (k,) of a symmetric matrix (k, k), ascending, and its eigenvectors, the columns (k, k).

    By Jacobi's rotations, cyclic over the elements (Golub & Van Loan, *Matrix Computations*, 4th ed., 8.5).
    """
    a: list[list[float]] = symmetric.tolist()
    size = len(a)
    v: list[list[float]] = np.eye(size).tolist()
    negligible = 1e-17 * float(np.abs(symmetric).max())
    for _ in range(_MAX_SWEEPS):
        turned = False
        for p in range(size - 1):
            for q in range(p + 1, size):
                off = a[p][q]
                if abs(off) <= negligible:
                    continue
                turned = True
                tau = (a[q][q] - a[p][p]) / (2.0 * off)
                t = math.copysign(1.0, tau) / (abs(tau) + math.sqrt(1.0 + tau * tau))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for row in a:
                    row[p], row[q] = c * row[p] - s * row[q], s * row[p] + c * row[q]
                above, below = a[p], a[q]
                a[p] = [c * x - s * y for x, y in zip(above, below, strict=True)]
                a[q] = [s * x + c * y for x, y in zip(above, below, strict=True)]
                a[p][q] = a[q][p] = 0.0
                for row in v:
                    row[p], row[q] = c * row[p] - s * row[q], s * row[p] + c * row[q]
        if not turned:
            break
    values = [a[k][k] for k in range(size)]
    order = sorted(range(size), key=values.__getitem__)
    return np.array([values[k] for k in order]), np.array([[row[k] for k in order] for row in v])
