"""The thesis's filter and camera motion as its MATLAB program ran them, inferred from tables A.1–A.18.

The main cluster of algorithm 2 gives objects of each frame, and pairs of them that vote for each other. MATLAB's
`estimateGeometricTransform(…, 'affine')` fits the motion to the pairs: MSAC, with its defaults. Only the
inliers of the fit are true stars. If the cluster has more objects of one frame than of the other, the frame
is lost: none of its objects is a true star, as if the function had been given lists of different length.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, Indices, Mask
from starid.identification.thesis.cme import affine_fit, transform_distances
from starid.identification.thesis.false_stars import FilterResult, ObservedFrame
from starid.identification.thesis.fsf import ClusterFilter
from starid.kernels.jit import compiled, inner_checked

MAX_DISTANCE_PX: Final = 1.5
"""`MaxDistance` of MATLAB's function: a match at this distance from the fit, or farther, is an outlier."""

CONFIDENCE: Final = 0.99
"""`Confidence`: probability that a sample without an outlier has been drawn when the trials end."""

MAX_TRIALS: Final = 1000
"""`MaxNumTrials`."""

_SAMPLE: Final = 3
_LARGEST_SKIP: Final = 10 * MAX_TRIALS


@compiled
def trials_needed(inliers: int, matches: int) -> int:
    """Number of samples after which one without an outlier has been drawn, with probability `CONFIDENCE`."""
    share = (inliers / matches) ** _SAMPLE
    if share >= 1.0:
        return 0
    if share < 1e-9:
        return MAX_TRIALS
    return min(MAX_TRIALS, math.ceil(math.log10(1.0 - CONFIDENCE) / math.log10(1.0 - share)))


@inner_checked
def _draw_three(order: Indices, sample: Mask, state: int) -> int:
    """Choose three matches at random; return the state of the generator."""
    sample[:] = False
    for k in range(_SAMPLE):
        state = (state * 1103515245 + 12345) & 0x7FFFFFFF
        j = k + (state >> 8) % (order.size - k)
        order[k], order[j] = order[j], order[k]
        sample[order[k]] = True
    return state


@compiled
def affine_inliers(before: Array, now: Array, largest: float, seed: int, inliers: Mask) -> bool:
    """Mark the inliers of an affine motion by MSAC; False, and no inlier, if there is no motion.

    The cost of a sample is the sum of min(d, largest) over the distances d of all matches. As in MATLAB's
    function, the inliers are those of the best sample, not of the fit to them.

    Parameters
    ----------
    before, now
        Matched positions, (m, 2), in the unit of `largest`.
    largest
        Distance from which a match is an outlier.
    seed
        Seed of the random choices, 0 … 2³¹ − 1.
    inliers
        Output, (m,).
    """
    m = before.shape[0]
    inliers[:] = False
    if m < _SAMPLE:
        return False
    order = np.arange(m)
    sample = np.zeros(m, dtype=np.bool_)
    matrix = np.empty((2, 3))
    distances = np.empty(m)
    best, trials, done, skipped = math.inf, MAX_TRIALS, 0, 0
    while done < trials and skipped < _LARGEST_SKIP:
        seed = _draw_three(order, sample, seed)
        if not affine_fit(before, now, sample, matrix):
            skipped += 1
            continue
        done += 1
        transform_distances(before, now, matrix, distances)
        cost = np.minimum(distances, largest).sum()
        if cost < best:
            best = cost
            inliers[:] = distances < largest
            trials = min(trials, trials_needed(int(inliers.sum()), m))
    return best < math.inf


@dataclass(frozen=True, slots=True)
class MatlabFilter:
    """The thesis's filter as its program ran it, as a `FalseStarFilter`.

    Attributes
    ----------
    pixel_deg
        Width of a pixel, degrees: the limit for inliers is in pixels.
    loses_unequal
        A frame is lost if the cluster has different numbers of objects of the two frames.
    """

    pixel_deg: float
    loses_unequal: bool = True

    def __call__(self, before: ObservedFrame, now: ObservedFrame) -> FilterResult:
        """Compare two frames; raises `FilterError` as `ClusterFilter`."""
        return self.inliers(before, now, self.pairs(before, now))

    def pairs(self, before: ObservedFrame, now: ObservedFrame) -> Indices:
        """Pairs of objects (earlier, later) in the main cluster, (m, 2); none if the frame is lost."""
        found = ClusterFilter()(before, now)
        unequal = np.count_nonzero(found.true_before) != np.count_nonzero(found.true_now)
        return found.matches[:0] if self.loses_unequal and unequal else found.matches

    def inliers(self, before: ObservedFrame, now: ObservedFrame, pairs: Indices) -> FilterResult:
        """Keep the pairs that an affine motion explains."""
        inliers = np.zeros(len(pairs), dtype=np.bool_)
        first, second = before.positions[pairs[:, 0]], now.positions[pairs[:, 1]]
        # the samples differ from frame to frame, and are the same whenever a frame is filtered again
        seed = zlib.crc32(now.positions.tobytes()) & 0x7FFFFFFF
        affine_inliers(first, second, MAX_DISTANCE_PX * self.pixel_deg, seed, inliers)
        kept = pairs[inliers]
        true_before, true_now = (np.zeros(len(frame), dtype=np.bool_) for frame in (before, now))
        true_before[kept[:, 0]] = True
        true_now[kept[:, 1]] = True
        return FilterResult(true_before, true_now, kept)
