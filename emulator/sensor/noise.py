"""Photon, dark and read noise, full well, gain and digitisation of an image, in one pass over the pixels.

Random bits come from parallel xoshiro128++ generators (Blackman & Vigna 2021), one per lane, so that the compiler
can vectorise the loops. Normal deviates are computed by the Box–Muller transform, with polynomials for logarithm,
sine and cosine. The sum of Poisson and read noise is drawn as a normal deviate with the right mean, variance and
skewness (Cornish–Fisher), unless the difference would be noticeable: for few electrons with little read noise, and
near the full well, each pixel is a true Poisson number plus read noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from starid.arithmetic.arrays import Array32, GreyImage
from starid.arithmetic.elementary import hypot
from starid.kernels.jit import compiled_ieee, inner

LANES: Final = 512
"""Number of parallel random generators; pixels are processed in blocks of twice this size."""

BLOCK: Final = 2 * LANES
FEW_ELECTRONS: Final = 100.0
"""Mean electrons below which true Poisson numbers are used for a sensor with little noise."""

QUIET_NOISE_E: Final = 3.0
"""Read and rounding noise, electrons, below which the discreteness of electrons matters."""

_WELL_MARGIN_SIGMA: Final = 7.0
_LN2: Final = np.float32(0.6931471805599453)


@dataclass(frozen=True)
class Digitizer:
    """Parameters of a sensor's noise and converter, from electrons to counts."""

    read_noise_e: float
    full_well_e: float
    gain_e_per_dn: float
    offset_dn: float
    max_dn: int


def lane_states(seed: int, frame_index: int) -> npt.NDArray[np.uint32]:
    """Return the initial states (4, LANES), uint32, of the generators of one frame.

    Every pair of seed and index, not negative, gives streams independent of all others (`numpy.random.SeedSequence`).
    """
    bits = np.random.Philox(np.random.SeedSequence((seed, frame_index))).random_raw(2 * LANES)
    return np.frombuffer(bits.tobytes(), dtype=np.uint32).reshape(4, LANES).copy()


@inner
def _next_bits(state: npt.NDArray[np.uint32], out: npt.NDArray[np.uint32]) -> None:
    """Advance all lanes by one xoshiro128++ step."""
    for lane in range(LANES):
        s0 = state[0, lane]
        s1 = state[1, lane]
        s2 = state[2, lane]
        s3 = state[3, lane]
        total = np.uint32(s0 + s3)
        out[lane] = np.uint32(np.uint32(np.uint32(total << np.uint32(7)) | (total >> np.uint32(25))) + s0)
        shifted = np.uint32(s1 << np.uint32(9))
        s2 ^= s0
        s3 ^= s1
        s1 ^= s2
        s0 ^= s3
        s2 ^= shifted
        s3 = np.uint32(s3 << np.uint32(11)) | (s3 >> np.uint32(21))
        state[0, lane] = s0
        state[1, lane] = s1
        state[2, lane] = s2
        state[3, lane] = s3


@compiled_ieee
def fill_normal(
    state: npt.NDArray[np.uint32],
    bits_a: npt.NDArray[np.uint32],
    bits_b: npt.NDArray[np.uint32],
    uniform: Array32,
    normal: Array32,
) -> None:
    """Fill `normal` (2·LANES,) with standard normal deviates.

    Box–Muller on 32-bit uniforms, so that the tails reach 6.7 standard deviations; the logarithm is from
    Cephes (`logf`), sine and cosine minimax polynomials on a quarter turn, all within 1e-6.
    """
    _next_bits(state, bits_a)
    _next_bits(state, bits_b)
    for lane in range(LANES):
        uniform[lane] = np.float32(np.int32(bits_a[lane] >> np.uint32(1))) * np.float32(
            2.0**-31
        ) + np.float32(2.0**-32)
    as_bits = uniform.view(np.int32)
    for lane in range(LANES):
        pattern = as_bits[lane]
        exponent = np.float32(np.int32(pattern - np.int32(0x3F3504F3)) >> np.int32(23))
        bits_a[lane] = np.uint32(np.int32(pattern) - np.int32(np.int32(exponent) << np.int32(23)))
        normal[lane] = exponent
    mantissas = bits_a.view(np.float32)
    for lane in range(LANES):
        x = mantissas[lane] - np.float32(1.0)
        z = x * x
        p = np.float32(7.0376836292e-2)
        p = p * x + np.float32(-1.1514610310e-1)
        p = p * x + np.float32(1.1676998740e-1)
        p = p * x + np.float32(-1.2420140846e-1)
        p = p * x + np.float32(1.4249322787e-1)
        p = p * x + np.float32(-1.6668057665e-1)
        p = p * x + np.float32(2.0000714765e-1)
        p = p * x + np.float32(-2.4999993993e-1)
        p = p * x + np.float32(3.3333331174e-1)
        log = x + (x * z * p - np.float32(0.5) * z) + normal[lane] * _LN2
        radius = np.sqrt(max(np.float32(-2.0) * log, np.float32(0.0)))
        # quarter turns: the two top bits choose the quadrant, the others the angle in (-pi/4, pi/4)
        turn = np.int32(bits_b[lane])
        rest = np.int32(turn << np.int32(2))
        angle = np.float32(rest) * np.float32(2.0**-31 * math.pi / 4.0)
        square = angle * angle
        sine = angle + angle * square * (
            np.float32(-1.6666654611e-1)
            + square * (np.float32(8.3321608736e-3) + square * np.float32(-1.9515295891e-4))
        )
        cosine = (
            np.float32(1.0)
            - np.float32(0.5) * square
            + square
            * square
            * (
                np.float32(4.166664568298827e-2)
                + square * (np.float32(-1.388731625493765e-3) + square * np.float32(2.443315711809948e-5))
            )
        )
        swap = (turn >> np.int32(30)) & np.int32(1)
        flip = np.float32(1.0) if turn >= np.int32(0) else np.float32(-1.0)
        first = sine if swap else cosine
        second = cosine if swap else sine
        normal[lane] = flip * radius * first
        uniform[lane] = flip * radius * second
    for lane in range(LANES):
        normal[LANES + lane] = uniform[lane]


@compiled_ieee
def _digitize_kernel(
    expected: Array32,
    state: npt.NDArray[np.uint32],
    generator: np.random.Generator,
    levels: tuple[float, float, float, float, float, float, float],
    counts: GreyImage,
) -> None:
    """Convert mean electrons (n,) to counts (n,); `levels` as in `digitize`."""
    read_noise, full_well, gain_e_per_dn, offset_dn, max_dn, few, near_full = levels
    read = np.float32(read_noise)
    read_variance = np.float32(read_noise * read_noise)
    to_dn = np.float32(1.0 / gain_e_per_dn)
    offset = np.float32(offset_dn + 0.5)
    top = np.float32(max_dn)
    few_e = np.float32(few)
    near_full_e = np.float32(near_full)
    tiny = np.float32(1e-12)
    sixth = np.float32(1.0 / 6.0)
    one = np.float32(1.0)
    zero = np.float32(0.0)
    bits_a = np.empty(LANES, np.uint32)
    bits_b = np.empty(LANES, np.uint32)
    uniform = np.empty(LANES, np.float32)
    normal = np.empty(BLOCK, np.float32)
    for start in range(0, expected.size, BLOCK):
        fill_normal(state, bits_a, bits_b, uniform, normal)
        length = min(BLOCK, expected.size - start)
        mean = expected[start : start + length]
        out = counts[start : start + length]
        for i in range(length):
            electrons = mean[i]
            variance = electrons + read_variance + tiny
            sigma = np.sqrt(variance)
            z = normal[i]
            skew = electrons / (variance * sigma) * sixth
            value = (electrons + sigma * (z + (z * z - one) * skew)) * to_dn + offset
            out[i] = np.int32(min(max(value, zero), top))
        exceptions = 0
        for i in range(length):
            if (mean[i] < few_e) or (mean[i] > near_full_e):
                exceptions += 1
        if exceptions == 0:
            continue
        for i in range(length):
            if few_e <= mean[i] <= near_full_e:
                continue
            drawn = np.float32(min(float(generator.poisson(max(float(mean[i]), 0.0))), full_well))
            value = (drawn + read * normal[i]) * to_dn + offset
            out[i] = np.int32(min(max(value, zero), top))


def digitize(expected_e: Array32, digitizer: Digitizer, seed: int, frame_index: int) -> GreyImage:
    """Convert mean electrons (h, w), float32, not negative, to the counts (h, w) of an image, with noise.

    The counts are uint8 for converters of up to 8 bits, else uint16. Seed and index determine the noise; the same
    pair and input give the same bytes.
    """
    rounding_e = digitizer.gain_e_per_dn / math.sqrt(12.0)
    few = FEW_ELECTRONS if hypot(digitizer.read_noise_e, rounding_e) < QUIET_NOISE_E else -1.0
    near_full = digitizer.full_well_e - _WELL_MARGIN_SIGMA * math.sqrt(digitizer.full_well_e)
    least_e = near_full - _WELL_MARGIN_SIGMA * hypot(math.sqrt(digitizer.full_well_e), digitizer.read_noise_e)
    if few < 0.0 and least_e / digitizer.gain_e_per_dn + digitizer.offset_dn > digitizer.max_dn:
        near_full = math.inf  # the converter saturates before the well, so no pixel needs a Poisson number
    levels = (
        digitizer.read_noise_e,
        digitizer.full_well_e,
        digitizer.gain_e_per_dn,
        digitizer.offset_dn,
        float(digitizer.max_dn),
        few,
        near_full,
    )
    dtype = np.uint8 if digitizer.max_dn <= np.iinfo(np.uint8).max else np.uint16
    counts = np.empty(expected_e.shape, dtype=dtype)
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, frame_index, 1))))
    flat = np.ascontiguousarray(expected_e, dtype=np.float32).reshape(-1)
    _digitize_kernel(flat, lane_states(seed, frame_index), generator, levels, counts.reshape(-1))
    return counts
