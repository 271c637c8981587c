"""Shared parts of the published algorithms, against brute force and theory."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starid.errors import StaridError
from starid.kernels.jit import compiled_ieee
from starid.lab.classic import ant_colony, correlation, grid, oriented_svd, svd
from starid.lab.classic.agreement import largest_group
from starid.lab.classic.log_polar import _strings
from starid.lab.classic.neighbours import neighbour_table
from starid.lab.classic.pairs import MAX_STARS, pair_table, pairs_within
from starid.lab.classic.radial_dynamic_cyclic import likeness
from starid.lab.classic.subgraph import simplest_size

pytestmark = pytest.mark.long


def fixed(vectors: np.ndarray) -> np.ndarray:
    """Vectors as a solver has them, contiguous and read-only, for which kernels are compiled."""
    vectors = np.ascontiguousarray(vectors)
    vectors.setflags(write=False)
    return vectors


def sky(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).standard_normal((count, 3))
    return fixed(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_pair_ranges_match_a_scan_of_all_pairs() -> None:
    vectors, longest = sky(120, 1), 0.7
    table = pair_table(vectors, longest)
    i, j = np.triu_indices(len(vectors), 1)
    chords = np.linalg.norm(vectors[i] - vectors[j], axis=1).astype(np.float32)
    expected = {(int(a), int(b)) for a, b, c in zip(i, j, chords, strict=True) if c <= longest}
    assert set(zip(table.first.tolist(), table.second.tolist(), strict=True)) == expected
    rng = np.random.default_rng(2)
    for low, width in [(-1.0, 0.5), (0.69, 1.0), (2.0, 1.0), *rng.uniform(0.0, [0.8, 0.05], (200, 2))]:
        start, end = pairs_within(table, float(low), float(low + width))
        inside = (table.chord >= low) & (table.chord <= low + width)
        assert end - start == inside.sum()
        assert inside[start:end].all()


def test_pair_ranges_of_equal_distances_or_none() -> None:
    axes = np.eye(3)
    table = pair_table(axes, 1.5)
    assert pairs_within(table, 1.41, 1.42) == (0, 3)
    assert pairs_within(table, 0.0, 1.0) == (0, 0)
    assert pairs_within(pair_table(axes, 0.1), 0.0, 1.0) == (0, 0)


def test_more_stars_than_fit_16_bits_are_rejected() -> None:
    with pytest.raises(StaridError, match="brighter limit"):
        pair_table(np.zeros((MAX_STARS + 1, 3)), 0.1)


def neighbours(vectors: np.ndarray, star: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Chords and azimuths of a star's neighbours, and their rows, from the table of all stars."""
    start, polar, rows = neighbour_table(vectors, radius)
    own = slice(start[star], start[star + 1])
    return polar[own].astype(float), rows[own].astype(int)


@pytest.mark.parametrize("seed", range(4))
def test_neighbours_differ_by_one_angle_after_a_rotation(seed: int) -> None:
    vectors = sky(300, seed)
    if seed == 0:
        vectors = fixed(np.concatenate([[[0.0, 0.0, 1.0]], vectors[1:]]))
    turned = fixed(Rotation.random(random_state=seed).apply(vectors.copy()))
    polar, rows = neighbours(vectors, 0, 0.6)
    other, same = neighbours(turned, 0, 0.6)
    expected = np.flatnonzero(np.linalg.norm(vectors - vectors[0], axis=1) <= 0.6)
    assert set(rows) == set(expected) - {0}
    assert np.array_equal(rows, same)
    assert np.all(np.diff(polar[:, 0]) >= 0.0)
    assert np.allclose(polar[:, 0], other[:, 0])
    shift = np.exp(1j * (polar[:, 1] - other[:, 1]))
    assert np.allclose(shift, shift[0])
    # azimuths against the angles of the great circles
    a, b = vectors[rows[0]], vectors[rows[1]]
    angle = math.atan2(vectors[0] @ np.cross(a, b), a @ b - (a @ vectors[0]) * (b @ vectors[0]))
    assert math.isclose(math.remainder(polar[1, 1] - polar[0, 1] - angle, math.tau), 0.0, abs_tol=1e-6)


def test_a_table_of_neighbours_has_those_of_each_star() -> None:
    vectors = sky(200, 6)
    start, polar, rows = neighbour_table(vectors, 0.5)
    assert len(rows) == len(polar) == start[-1]
    for star in range(200):
        chords = np.linalg.norm(vectors - vectors[star], axis=1)
        expected = [row for row in np.argsort(chords) if row != star and chords[row] <= 0.5]
        found, whose = neighbours(vectors, star, 0.5)
        assert whose.tolist() == expected
        assert np.allclose(found[:, 0], chords[expected], atol=1e-6)


def test_ants_find_the_shortest_path_through_most_circles() -> None:
    rng, shortest = np.random.default_rng(8), 0
    for _ in range(30):
        points = rng.random((7, 2))
        chord = np.linalg.norm(points[:, None] - points, axis=2) + np.eye(7)
        path = np.empty(7, dtype=np.int64)
        length = ant_colony.shortest_path.py_func(chord, 7, path)
        assert sorted(path) == list(range(7))
        assert path[0] == 0
        assert length == pytest.approx(sum(chord[a, b] for a, b in itertools.pairwise(path)))
        lengths = [
            sum(chord[a, b] for a, b in itertools.pairwise((0, *others)))
            for others in itertools.permutations(range(1, 7))
        ]
        shortest += length < min(lengths) + 1e-12
    assert shortest >= 24


def test_images_correlate_as_the_integral_of_their_product() -> None:
    rng, width = np.random.default_rng(2), 0.1
    one, other = (np.column_stack([np.sort(rng.random(count)), 6.0 * rng.random(count)]) for count in (6, 7))
    x, y = np.meshgrid(*2 * [np.linspace(-1.6, 1.6, 800)])

    def image(stars):
        at = [(r * np.cos(angle), r * np.sin(angle)) for r, angle in stars]
        return sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * width**2)) for a, b in at)

    itself = (image([(0.0, 0.0)]) ** 2).sum()
    expected = (image(one) * image(other)).sum() / itself
    assert correlation.correlation.py_func(one, 6, other, width) == pytest.approx(expected, rel=0.01)


@compiled_ieee
def alike(pattern, other, tolerance):
    return likeness(pattern, pattern.shape[0], other, tolerance, np.empty(100))


def test_patterns_are_alike_at_the_angle_between_them() -> None:
    rng = np.random.default_rng(3)
    pattern = np.column_stack([np.sort(rng.uniform(0.1, 1.0, 9)), rng.uniform(-3.0, 3.0, 9)])
    turned = pattern + np.array([0.0, 2.0])
    assert alike(pattern, turned, 1e-4) == 9
    assert alike(pattern, turned * [1.0, -1.0], 1e-4) < 5
    assert alike(pattern, turned + np.array([0.01, 0.0]), 1e-4) == 0


def test_the_largest_group_has_the_true_matches() -> None:
    stars = sky(50, 5)
    turn = Rotation.random(random_state=1)
    turned = fixed(turn.apply(stars[:8].copy()))
    true = np.column_stack([np.arange(8), np.arange(8)])
    rng = np.random.default_rng(3)
    wrong = np.column_stack([rng.integers(0, 8, 30), rng.integers(8, 50, 30)])
    group = largest_group(turned, stars, np.concatenate([wrong, true]), 1e-3)
    assert np.array_equal(group, true)


def test_mirrored_groups_and_pairs_are_rejected() -> None:
    stars = sky(6, 8)
    rows = np.column_stack([np.arange(6), np.arange(6)])
    assert len(largest_group(fixed(stars * [-1.0, 1.0, 1.0]), stars, rows, 1e-6)) == 0
    assert len(largest_group(stars, stars, rows[:2], 1e-6)) == 0
    assert len(largest_group(stars, stars, rows[:3], 1e-6)) == 3


def test_singular_values_are_invariant_and_give_the_rotation() -> None:
    stars = sky(5, 4) * 0.2 + [0.0, 0.0, 1.0]
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    turn = Rotation.random(random_state=9)
    found = svd.singular_attitude(turn.apply(stars).T, stars.T)
    assert np.allclose(found, turn.as_matrix(), atol=1e-9)


def test_oriented_triangles_distinguish_mirror_images() -> None:
    stars = sky(3, 11)
    corners = np.array([[2, 0, 1], [0, 1, 2]])
    one = oriented_svd.oriented_triangles(stars, corners)
    other = oriented_svd.oriented_triangles(stars * [1.0, 1.0, -1.0], corners)
    assert len(one[0]) == 1
    assert np.array_equal(one[0], other[0])
    assert np.allclose(one[1], other[1])
    assert one[2] == -other[2]
    assert np.allclose(one[1], np.linalg.svd(stars, compute_uv=False)[1:])


@pytest.mark.parametrize("alike", [True, False])
def test_a_grid_pattern_has_each_cell_once_and_the_alignment_star_on_the_axis(alike: bool) -> None:
    vectors = sky(400, 21)
    polar, rows = neighbours(vectors, 7, 0.5)
    beyond = polar[:, 0] > 0.05
    magnitude = np.zeros(400)
    if not alike:  # the nearest star is the faintest
        magnitude = np.random.default_rng(4).random(400)
        magnitude[rows[np.argmax(beyond)]] = 2.0
    start, owner = grid.lookup_table(vectors, magnitude, 0.5, 0.05)
    aligned = int(np.argmax(beyond & (magnitude[rows] <= np.median(magnitude[rows]))))
    angle = (polar[:, 1] - polar[aligned, 1]) % math.tau
    half = grid.GRID / 2
    x = half * (1.0 + polar[:, 0] / 0.5 * np.cos(angle))
    y = half * (1.0 + polar[:, 0] / 0.5 * np.sin(angle))
    cells = {int(b) * grid.GRID + int(a) for a, b in zip(x, y, strict=True)}
    held = {cell for cell in range(grid.GRID**2) if 7 in owner[start[cell] : start[cell + 1]]}
    # a star on the border of a cell may round to either side, as the alignment star does
    assert len(held ^ cells) <= 2
    assert len(owner) == start[-1]


def test_log_polar_strings_shift_with_roll() -> None:
    vectors = sky(400, 31)
    turned = fixed(Rotation.random(random_state=3).apply(vectors.copy()))
    one, other = _strings(vectors, 0.5)[5], _strings(turned, 0.5)[5]
    best = max(
        sum(1 for a, b in zip(np.roll(one, shift), other, strict=True) if a and abs(int(a) - int(b)) <= 1)
        for shift in range(len(one))
    )
    # a rotation by part of a sector moves some stars into the next
    assert best >= 0.3 * np.count_nonzero(one)
    assert np.array_equal(one, _strings(vectors, 0.5)[5])


def test_a_subgraph_grows_with_the_tolerance_and_the_number_of_stars() -> None:
    sizes = [simplest_size(600, 0.7, tolerance) for tolerance in (1e-5, 1e-3, 1e-2)]
    assert sizes[0] == 3
    assert sizes == sorted(sizes)
    assert simplest_size(6000, 0.7, 1e-3) >= simplest_size(600, 0.7, 1e-3)
