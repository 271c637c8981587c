"""The thesis's false-star filter (algorithm 2): differences between pairs in two frames cluster.

The number of differences grows with the fourth power of the number of objects; for more than four dozen
objects use `starid.identification.thesis.scalable_filter`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.arithmetic.elementary import atan2, square
from starid.identification.thesis.false_stars import FilterError, FilterResult, ObservedFrame
from starid.kernels.jit import compiled, inner_checked

EPSILON: Final = 0.4
"""Radius of the neighbourhood, the same in magnitudes and in degrees."""

MIN_SAMPLES_SHARE: Final = 0.5
"""Smallest number of points in the neighbourhood of a core point, as a share of the number of objects."""

MAX_OBJECTS: Final = 48
"""Largest number of objects in a frame: 1 128 pairs, 1 272 384 disparities."""

_MAX_BINS: Final = 1_048_576


def pair_count(objects: int) -> int:
    """Number of feature vectors of a frame, L = (N_o choose 2), eq. 3.7."""
    return objects * (objects - 1) // 2


@compiled
def pair_features(brightness: Array, positions: Array, vectors: Array, members: Indices) -> None:
    """Write the feature vectors of a frame (eq. 3.8), v = (A_ij, d_ij, m_ij) (eq. 3.3) for each pair i < j.

    A_ij is the mean brightness, eq. 3.4, d_ij the separation in degrees, eq. 3.5, and m_ij the slope of the
    line between the two in degrees, 0 ≤ m < 180, eq. 3.6.
    """
    k = 0
    for i in range(brightness.size):
        for j in range(i + 1, brightness.size):
            dx = positions[j, 0] - positions[i, 0]
            dy = positions[j, 1] - positions[i, 1]
            vectors[k, 0] = 0.5 * (brightness[i] + brightness[j])
            vectors[k, 1] = math.sqrt(dx * dx + dy * dy)
            vectors[k, 2] = math.degrees(atan2(dy, dx)) % 180.0
            members[k, 0] = i
            members[k, 1] = j
            k += 1


def pairs_of(frame: ObservedFrame) -> Array:
    """Feature vectors of the pairs in a frame, (L, 3)."""
    vectors = np.empty((pair_count(len(frame)), 3))
    pair_features(frame.brightness, frame.positions, vectors, np.empty((len(vectors), 2), dtype=np.int64))
    return vectors


@compiled
def disparity_list(before: Array, now: Array, disparities: Array) -> None:
    """Write all differences d = v_i − v_j (eq. 3.9): D = L₁·L₂ rows (eq. 3.10).

    The pairs of the later frame vary fastest. The difference of slopes is taken modulo 180°, −90 < Δm ≤ 90,
    so that a nearly horizontal line is not special.
    """
    k = 0
    for i in range(before.shape[0]):
        for j in range(now.shape[0]):
            disparities[k, 0] = before[i, 0] - now[j, 0]
            disparities[k, 1] = before[i, 1] - now[j, 1]
            turn = before[i, 2] - now[j, 2]
            disparities[k, 2] = turn - 180.0 * math.ceil(turn / 180.0 - 0.5)
            k += 1


@inner_checked
def _bin_points(points: Array, side: float, order: Indices, shape: Indices) -> tuple[Indices, Indices]:
    """Sort points into square bins in their second and third coordinate.

    `order` (n,) receives the points bin by bin, in their original order within each, and `shape` (2,) the
    number of bins. Returns the bin of each sorted point and the first point of each bin.
    """
    n = points.shape[0]
    low = np.array([points[:, 1].min(), points[:, 2].min()])
    for axis in range(2):
        shape[axis] = int((points[:, 1 + axis].max() - low[axis]) / side) + 1
    where = np.empty(n, dtype=np.int64)
    start = np.zeros(shape[0] * shape[1] + 1, dtype=np.int64)
    for i in range(n):
        first = int((points[i, 1] - low[0]) / side)
        second = int((points[i, 2] - low[1]) / side)
        where[i] = first * shape[1] + second
        start[where[i] + 1] += 1
    for b in range(start.size - 1):
        start[b + 1] += start[b]
    fill = start.copy()
    for i in range(n):
        order[fill[where[i]]] = i
        fill[where[i]] += 1
    return where[order], start


@inner_checked
def _neighbours(
    points: Array, bins: tuple[Indices, Indices, Indices], here: int, epsilon: float, neighbours: Indices
) -> int:
    """List all points within ε of a point, including itself; return their number.

    The points are sorted by bin; `bins` (shape, bin of each point, first of each bin) are at least ε wide.
    """
    shape, where, start = bins
    count = 0
    limit = epsilon * epsilon
    row = where[here] // shape[1]
    column = where[here] % shape[1]
    a, b, c = points[here, 0], points[here, 1], points[here, 2]
    for r in range(max(row - 1, 0), min(row + 2, shape[0])):
        begin = start[r * shape[1] + max(column - 1, 0)]
        end = start[r * shape[1] + min(column + 1, shape[1] - 1) + 1]
        for k in range(begin, end):
            distance2 = square(points[k, 0] - a) + square(points[k, 1] - b) + square(points[k, 2] - c)
            if distance2 <= limit:
                neighbours[count] = k
                count += 1
    return count


@compiled
def density_clusters(points: Array, epsilon: float, min_samples: float) -> Indices:
    """Label the density-based clusters of a list of points (n, 3); −1 is an outlier (eq. 3.1).

    The labels equal those of scikit-learn's DBSCAN: clusters are numbered by their first core point, and a
    border point belongs to the first cluster that reaches it. Neighbours are looked up in bins of the second
    and third coordinate, separation and slope, which vary most.
    """
    n = points.shape[0]
    labels = np.full(n, -1, dtype=np.int64)
    if n == 0:
        return labels
    width = points[:, 1].max() - points[:, 1].min()
    height = points[:, 2].max() - points[:, 2].min()
    # a little wider than ε, because the quotient of a point on the edge of a bin may round either way
    side = max(1.000001 * epsilon, math.sqrt((width + epsilon) * (height + epsilon) / _MAX_BINS))
    side = max(side, max(width, height) / _MAX_BINS)
    order = np.empty(n, dtype=np.int64)
    shape = np.empty(2, dtype=np.int64)
    where, start = _bin_points(points, side, order, shape)
    bins = (shape, where, start)
    ordered = points[order]
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    neighbours = np.empty(n, dtype=np.int64)
    core = np.zeros(n, dtype=np.bool_)
    for k in range(n):
        core[k] = _neighbours(ordered, bins, k, epsilon, neighbours) >= min_samples
    stack = np.empty(n, dtype=np.int64)
    label = 0
    for i in range(n):
        first = place[i]
        if labels[first] != -1 or not core[first]:
            continue
        labels[first] = label
        stack[0] = first
        top = 1
        while top > 0:
            top -= 1
            count = _neighbours(ordered, bins, stack[top], epsilon, neighbours)
            for k in range(count):
                j = neighbours[k]
                if labels[j] == -1:
                    labels[j] = label
                    if core[j]:
                        stack[top] = j
                        top += 1
        label += 1
    return labels[place]


@compiled
def main_cluster(labels: Indices) -> int:
    """Label of the largest cluster, the first of equal ones; −1 if there is none."""
    clusters = 0
    for i in range(labels.size):
        clusters = max(clusters, labels[i] + 1)
    if clusters == 0:
        return -1
    count = np.zeros(clusters, dtype=np.int64)
    for i in range(labels.size):
        if labels[i] >= 0:
            count[labels[i]] += 1
    return int(np.argmax(count))


@inner_checked
def trace_back(
    labels: Indices, main: int, members_before: Indices, members_now: Indices, votes: Indices
) -> None:
    """Count how often each object of the earlier and of the later frame correspond in the main cluster."""
    width = members_now.shape[0]
    for k in range(labels.size):
        if labels[k] == main:
            i = k // width
            j = k % width
            for a in range(2):
                for b in range(2):
                    votes[members_before[i, a], members_now[j, b]] += 1


@inner_checked
def _mutual_matches(votes: Indices, matches: Indices) -> int:
    """List the pairs of objects that vote for each other most, at least twice each; return their number."""
    count = 0
    for i in range(votes.shape[0]):
        j = int(np.argmax(votes[i]))
        if votes[i, j] >= 2 and int(np.argmax(votes[:, j])) == i:
            matches[count, 0] = i
            matches[count, 1] = j
            count += 1
    return count


@compiled
def filter_kernel(
    brightness_before: Array,
    positions_before: Array,
    brightness_now: Array,
    positions_now: Array,
    epsilon: float,
    min_samples: float,
    true_before: Mask,
    true_now: Mask,
    matches: Indices,
) -> int:
    """Run the filter; return the number of matches."""
    first, second = brightness_before.size, brightness_now.size
    true_before[:] = False
    true_now[:] = False
    if first < 2 or second < 2:
        return 0
    rows = first * (first - 1) // 2
    columns = second * (second - 1) // 2
    before = np.empty((rows, 3))
    now = np.empty((columns, 3))
    members_before = np.empty((rows, 2), dtype=np.int64)
    members_now = np.empty((columns, 2), dtype=np.int64)
    pair_features(brightness_before, positions_before, before, members_before)
    pair_features(brightness_now, positions_now, now, members_now)
    disparities = np.empty((rows * columns, 3))
    disparity_list(before, now, disparities)
    labels = density_clusters(disparities, epsilon, min_samples)
    main = main_cluster(labels)
    if main < 0:
        return 0
    votes = np.zeros((first, second), dtype=np.int64)
    trace_back(labels, main, members_before, members_now, votes)
    for i in range(first):
        for j in range(second):
            if votes[i, j] > 0:
                true_before[i] = True
                true_now[j] = True
    return _mutual_matches(votes, matches)


@dataclass(frozen=True, slots=True)
class ClusterFilter:
    """The thesis's filter as a `FalseStarFilter`: objects in the main cluster are true stars.

    Attributes
    ----------
    epsilon
        Radius ε of the neighbourhood.
    min_samples
        Smallest number of points in the neighbourhood of a core point; default `MIN_SAMPLES_SHARE`.
    """

    epsilon: float = EPSILON
    min_samples: float | None = None

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two frames.

        Raises
        ------
        FilterError
            A frame has more than `MAX_OBJECTS` objects.
        """
        largest = max(len(before), len(now))
        if largest > MAX_OBJECTS:
            raise FilterError(
                f"filter: {largest} objects in a frame, at most {MAX_OBJECTS} for the cluster filter; "
                "use the scalable filter"
            )
        least = MIN_SAMPLES_SHARE * len(now) if self.min_samples is None else self.min_samples
        true_before = np.zeros(len(before), dtype=np.bool_)
        true_now = np.zeros(len(now), dtype=np.bool_)
        matches = np.empty((len(before), 2), dtype=np.int64)
        count = filter_kernel(
            before.brightness,
            before.positions,
            now.brightness,
            now.positions,
            self.epsilon,
            least,
            true_before,
            true_now,
            matches,
        )
        return FilterResult(true_before, true_now, matches[:count])
