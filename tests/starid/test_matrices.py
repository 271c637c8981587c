"""Small matrices by sums in a stated order, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from starid.arithmetic.arrays import interpolated, on_grid
from starid.arithmetic.matrices import (
    carried,
    dot,
    eigenvectors,
    inverse,
    length,
    lengths,
    product,
    root,
    sum_of_products,
)

RNG = np.random.default_rng(3)


def positive_definite(*shape: int) -> np.ndarray:
    half = RNG.standard_normal((*shape, shape[-1]))
    return half @ np.swapaxes(half, -1, -2) + 0.1 * np.eye(shape[-1])


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ((3,), (3,)),
        ((3, 3), (3,)),
        ((3,), (3, 4)),
        ((50, 3), (3, 3)),
        ((7, 2, 3), (7, 3, 2)),
        ((7, 2, 3), (3,)),
    ],
)
def test_products_are_those_of_numpy(left: tuple[int, ...], right: tuple[int, ...]) -> None:
    a, b = RNG.standard_normal(left), RNG.standard_normal(right)
    assert product(a, b).shape == (a @ b).shape
    np.testing.assert_allclose(product(a, b), a @ b, rtol=1e-13, atol=1e-14)


def test_sums_and_lengths() -> None:
    a, b = RNG.standard_normal((20, 3)), RNG.standard_normal((20, 4))
    np.testing.assert_allclose(sum_of_products(a, b), a.T @ b, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(lengths(a), np.linalg.norm(a, axis=1), rtol=1e-15)
    assert dot(a[0], a[1]) == pytest.approx(a[0] @ a[1], rel=1e-14)
    assert length(a[0]) == pytest.approx(np.linalg.norm(a[0]), rel=1e-15)


@pytest.mark.parametrize("shape", [(2,), (3,), (9,), (5, 4, 2), (6, 3)])
def test_inverses_and_roots(shape: tuple[int, ...]) -> None:
    matrices = positive_definite(*shape)
    identity = np.broadcast_to(np.eye(shape[-1]), matrices.shape)
    np.testing.assert_allclose(inverse(matrices) @ matrices, identity, atol=1e-10)
    triangles = root(matrices)
    np.testing.assert_array_equal(triangles, np.tril(triangles))
    np.testing.assert_allclose(triangles @ np.swapaxes(triangles, -1, -2), matrices, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(inverse(triangles) @ triangles, identity, atol=1e-10)


def test_the_root_of_a_singular_matrix() -> None:
    half = RNG.standard_normal((4, 2)) * np.array([[1.0], [1e4], [1e-4], [1.0]])
    triangle = root(half @ half.T)
    np.testing.assert_allclose(triangle @ triangle.T, half @ half.T, rtol=1e-7, atol=1e-16)
    np.testing.assert_array_equal(root(np.zeros((3, 3))), np.zeros((3, 3)))


@pytest.mark.parametrize("size", [2, 3, 4, 9])
def test_eigenvectors(size: int) -> None:
    half = RNG.standard_normal((size, size))
    symmetric = half + half.T
    values, vectors = eigenvectors(symmetric)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(symmetric), atol=1e-13)
    np.testing.assert_allclose(symmetric @ vectors, vectors * values, atol=1e-12)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(size), atol=1e-13)


def test_the_covariance_of_what_follows_from_another() -> None:
    slopes, covariance = RNG.standard_normal((5, 2, 3)), positive_definite(3)
    np.testing.assert_allclose(
        carried(slopes, covariance), slopes @ covariance @ slopes.transpose(0, 2, 1), rtol=1e-12, atol=1e-13
    )


def test_interpolation_is_that_of_numpy() -> None:
    nodes, heights = np.array([0.0, 1.0, 3.0, 3.5]), np.array([1.0, -2.0, 5.0, 5.5])
    at = np.append(RNG.uniform(-1.0, 5.0, 200), [0.0, 3.5, np.nan])
    np.testing.assert_allclose(
        interpolated(at, nodes, heights), np.interp(at, nodes, heights), rtol=1e-15, atol=1e-15
    )


def test_numbers_on_a_grid() -> None:
    values = RNG.uniform(-1e5, 1e5, 100)
    rounded = on_grid(values, 2.0**-20)
    assert np.abs(rounded - values).max() <= 2.0**-21
    np.testing.assert_array_equal(rounded * 2.0**20, np.rint(rounded * 2.0**20))
