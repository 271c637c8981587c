"""Elementary functions whose results are the same bytes on each processor, with each C library and version of Python.

The last bit of ``sin``, ``exp``, ``hypot`` … depends on the C library, on whether it may fuse multiplication and addition, and, in
numpy, on the width of vectors. These functions use only operations whose results IEEE 754 defines to the last bit: + − × ÷, square
root, and scaling by powers of two. All that a telemetry value depends on is computed with them (products of matrices:
`starid.arithmetic.matrices`); a test names the modules and forbids the other functions there.

They are plain Python; `starid.kernels.jit` lets kernels compile the same text. Errors, in units in the last place: below 1 for
``sin``, ``cos``, ``exp`` and ``log``, below 2 for the others, where no error is given. Arguments are finite; beyond 10⁶, an angle counts
as modulo the double 2π. The method is argument reduction, then a polynomial fitted at Chebyshev points, as in Muller, *Elementary
Functions*, 3rd ed., chapters 4 and 11.
"""

from __future__ import annotations

import math
from typing import Any, Final, TypeVar

from numpy.typing import NDArray

Numbers = TypeVar("Numbers", float, NDArray[Any])

_TWO_OVER_PI: Final = 0.6366197723675814
_HALF_PI: Final = 1.5707963267948966
_HALF_PI_REST: Final = 6.123233995736766e-17
_HALF_PI_1: Final = 1.5707963267341256  # π/2 in three parts, of which the first two have 33 bits
_HALF_PI_2: Final = 6.077100506303966e-11
_HALF_PI_3: Final = 2.0222662487959506e-21
_LARGE_ANGLE: Final = 1e6

_LN_2_1: Final = 0.6931471803691238  # ln 2 in two parts, of which the first has 32 bits
_LN_2_2: Final = 1.9082149292705877e-10
_PER_LN_2: Final = 1.4426950408889634
_PER_LN_10: Final = 0.4342944819032518
_SQRT_HALF: Final = 0.7071067811865476
_LARGEST_EXPONENT: Final = 709.782712893384
_SMALLEST_EXPONENT: Final = -745.1332191019411


def square(x: Numbers) -> Numbers:
    """Return x², of a number or of each in an array: Python's and numpy's ``**`` call the C library."""
    squared: Numbers = x * x
    return squared


def hypot(x: float, y: float) -> float:
    """Return √(x² + y²), to one unit in the last place unless a square overflows or is below 10⁻²⁹²."""
    return math.sqrt(x * x + y * y)


def _sine(r: float, rest: float) -> float:
    """Sine of r + rest, |r| ≤ π/4."""
    z = r * r
    p = 0.008333333333330925 + z * (
        -0.00019841269836724904
        + z * (2.7557316085102794e-06 + z * (-2.5051128211610636e-08 + z * 1.5917867766896243e-10))
    )
    return r + (rest * (1.0 - 0.5 * z) + r * z * (-0.16666666666666666 + z * p))


def _cosine(r: float, rest: float) -> float:
    """Cosine of r + rest, |r| ≤ π/4."""
    z = r * r
    p = 0.041666666666666664 + z * (
        -0.0013888888888887382
        + z
        * (
            2.4801587298744625e-05
            + z * (-2.755731726081361e-07 + z * (2.087614399539826e-09 + z * -1.1382468815765352e-11))
        )
    )
    half = 0.5 * z
    first = 1.0 - half
    return first + (((1.0 - first) - half) + (z * z * p - r * rest))


def _reduced(x: float) -> tuple[int, float, float]:
    """Return n modulo 4 and r, as a sum, with x = n·π/2 + r and |r| ≤ π/4."""
    if abs(x) > _LARGE_ANGLE:
        x = x % (4.0 * _HALF_PI)
    n = math.floor(x * _TWO_OVER_PI + 0.5)
    first = x - n * _HALF_PI_1
    second = n * _HALF_PI_2
    r = first - second
    rest = ((first - r) - second) - n * _HALF_PI_3
    total = r + rest
    return n & 3, total, (r - total) + rest


def sin(x: float) -> float:
    """Return the sine of x radians."""
    if x == 0.0:
        return x
    n, r, rest = _reduced(x)
    value = _cosine(r, rest) if n & 1 else _sine(r, rest)
    return -value if n & 2 else value


def cos(x: float) -> float:
    """Return the cosine of x radians."""
    n, r, rest = _reduced(x)
    value = _sine(r, rest) if n & 1 else _cosine(r, rest)
    return -value if (n + 1) & 2 else value


def tan(x: float) -> float:
    """Return the tangent of x radians, to three units in the last place."""
    return sin(x) / cos(x)


def atan(x: float) -> float:
    """Return the arc tangent, radians."""
    size = abs(x)
    base, rest, t = 0.0, 0.0, size
    if size > 2.4375:
        base, rest, t = _HALF_PI, _HALF_PI_REST, -1.0 / size
    elif size > 1.1875:
        base, rest, t = 0.982793723247329, 1.3903311031230998e-17, (size - 1.5) / (1.0 + 1.5 * size)
    elif size > 0.6875:
        base, rest, t = 0.7853981633974483, 3.061616997868383e-17, (size - 1.0) / (1.0 + size)
    elif size > 0.4375:
        base, rest, t = 0.4636476090008061, 2.2698777452961687e-17, (2.0 * size - 1.0) / (2.0 + size)
    z = t * t
    p = 0.11111110900215952 + z * (
        -0.09090900183018957
        + z
        * (
            0.076920870877362
            + z
            * (
                -0.06663236004679035
                + z
                * (
                    0.05847699077669016
                    + z * (-0.050338225361720675 + z * (0.03782210597221972 + z * -0.01754381921319604))
                )
            )
        )
    )
    p = -0.33333333333333326 + z * (0.19999999999987741 + z * (-0.14285714283143858 + z * p))
    return math.copysign(base + (t + (rest + t * z * p)), x)


def atan2(y: float, x: float) -> float:
    """Return the angle of the point (x, y) from the x axis, −π … π."""
    if y == 0.0:
        return y if math.copysign(1.0, x) > 0.0 else math.copysign(2.0 * _HALF_PI, y)
    if x == 0.0:
        return math.copysign(_HALF_PI, y)
    angle = atan(abs(y / x))
    if x < 0.0:
        angle = 2.0 * _HALF_PI - (angle - 2.0 * _HALF_PI_REST)
    return math.copysign(angle, y)


def asin(x: float) -> float:
    """Return the arc sine of x, −1 … 1, to three units in the last place."""
    return atan2(x, math.sqrt((1.0 - x) * (1.0 + x)))


def acos(x: float) -> float:
    """Return the arc cosine of x, −1 … 1, to three units in the last place."""
    return atan2(math.sqrt((1.0 - x) * (1.0 + x)), x)


def exp(x: float) -> float:
    """Return e to the power of x; infinite where a double cannot hold it."""
    if x > _LARGEST_EXPONENT:
        return math.inf
    if x < _SMALLEST_EXPONENT:
        return 0.0
    n = math.floor(x * _PER_LN_2 + 0.5)
    first = x - n * _LN_2_1
    rest = n * _LN_2_2
    r = first - rest
    rest = (first - r) - rest
    p = 0.008333333333326127 + r * (
        0.0013888888888883742
        + r
        * (
            0.00019841269874850708
            + r
            * (
                2.4801587325569223e-05
                + r
                * (
                    2.755725536205433e-06
                    + r * (2.7557273615865557e-07 + r * (2.510523288117511e-08 + r * 2.0914698305573583e-09))
                )
            )
        )
    )
    p = 0.5 + r * (0.1666666666666667 + r * (0.04166666666666667 + r * p))
    return math.ldexp(1.0 + (r + (rest * (1.0 + r) + r * r * p)), n)


def log(x: float) -> float:
    """Return the natural logarithm; that of 0 is −infinity."""
    if x <= 0.0:
        return -math.inf if x == 0.0 else math.nan
    m, n = math.frexp(x)
    if m < _SQRT_HALF:
        m, n = 2.0 * m, n - 1
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    p = 0.2857142862609589 + z * (
        0.2222221111514416 + z * (0.18182890556695602 + z * (0.1533167403016786 + z * 0.1461703754879165))
    )
    p = z * (0.666666666666667 + z * (0.3999999999989924 + z * p))
    half = 0.5 * f * f
    return n * _LN_2_1 - ((half - (s * (half + p) + n * _LN_2_2)) - f)


def log10(x: float) -> float:
    """Return the logarithm to base 10; that of 0 is −infinity."""
    return log(x) * _PER_LN_10


def power(base: float, exponent: float) -> float:
    """Return a positive base to the power of an exponent, to 1 + 2 |ln of the result| units in the last place."""
    return exp(exponent * log(base))
