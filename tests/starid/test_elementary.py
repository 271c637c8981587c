"""Elementary functions by plain arithmetic: their stated errors against exact arithmetic, and the same bytes when compiled."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from decimal import Decimal, localcontext

import pytest

from starid.arithmetic import elementary
from starid.arithmetic.elementary import (
    acos,
    asin,
    atan,
    atan2,
    cos,
    exp,
    hypot,
    log,
    log10,
    power,
    sin,
    square,
    tan,
)
from starid.kernels.jit import compiled_ieee

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899")
DIGITS = 60


def exact_sine(x: float | Decimal) -> Decimal:
    """Taylor's series."""
    r = Decimal(x) % (2 * PI)
    total, term, k = Decimal(0), r, 1
    while abs(term) > Decimal(10) ** -DIGITS:
        total += term
        term *= -r * r / ((k + 1) * (k + 2))
        k += 2
    return total


def exact_cosine(x: float) -> Decimal:
    return exact_sine(Decimal(x) + PI / 2)


def exact_arc(x: float | Decimal) -> Decimal:
    """Gregory's series, after the argument is halved until it is small."""
    r, halvings = Decimal(x), 0
    while abs(r) > Decimal("0.05"):
        r /= 1 + (1 + r * r).sqrt()
        halvings += 1
    total, term, k = Decimal(0), r, 1
    while abs(term) > Decimal(10) ** -DIGITS:
        total += term / k
        term *= -r * r
        k += 2
    return total * 2**halvings


def exact_angle(y: float | Decimal, x: float | Decimal) -> Decimal:
    arc = exact_arc(abs(Decimal(y) / Decimal(x)))
    return (arc if x > 0 else PI - arc) * (1 if y > 0 else -1)


def other_leg(x: float) -> Decimal:
    return (1 - Decimal(x) ** 2).sqrt()


def spread(low: float, high: float) -> Callable[[random.Random], float]:
    """Draw numbers of either sign, uniform in the logarithm of their size."""
    return lambda rng: rng.choice((-1.0, 1.0)) * math.exp(rng.uniform(math.log(low), math.log(high)))


def between(low: float, high: float) -> Callable[[random.Random], float]:
    return lambda rng: rng.uniform(low, high)


def positive(low: float, high: float) -> Callable[[random.Random], float]:
    return lambda rng: math.exp(rng.uniform(math.log(low), math.log(high)))


CASES = [
    ("sin", sin, exact_sine, (spread(1e-8, 1e6),), 1.0),
    ("sin near multiples of pi", sin, exact_sine, (lambda rng: rng.randrange(1, 1000) * math.pi,), 1.0),
    ("cos", cos, exact_cosine, (spread(1e-8, 1e6),), 1.0),
    ("tan", tan, lambda x: exact_sine(x) / exact_cosine(x), (spread(1e-8, 1e3),), 3.0),
    ("atan", atan, exact_arc, (spread(1e-8, 1e8),), 2.0),
    ("atan2", atan2, exact_angle, (spread(1e-3, 1e3), spread(1e-3, 1e3)), 2.0),
    ("asin", asin, lambda x: exact_angle(x, other_leg(x)), (between(-1.0, 1.0),), 3.0),
    ("acos", acos, lambda x: exact_angle(other_leg(x), x), (between(-1.0, 1.0),), 3.0),
    ("exp", exp, lambda x: Decimal(x).exp(), (spread(1e-8, 700.0),), 1.0),
    ("log", log, lambda x: Decimal(x).ln(), (positive(1e-300, 1e300),), 1.0),
    ("log near 1", log, lambda x: Decimal(x).ln(), (between(0.5, 2.0),), 1.0),
    ("log10", log10, lambda x: Decimal(x).log10(), (positive(1e-300, 1e300),), 2.0),
    ("hypot", hypot, lambda x, y: (Decimal(x) ** 2 + Decimal(y) ** 2).sqrt(), (spread(1e-9, 1e9),) * 2, 1.0),
]


@pytest.mark.parametrize(
    ("function", "exact", "arguments", "limit"), [each[1:] for each in CASES], ids=[each[0] for each in CASES]
)
def test_the_error_is_as_stated(function, exact, arguments, limit) -> None:
    rng = random.Random(7)
    with localcontext() as context:
        context.prec = DIGITS + 20
        for _ in range(400):
            values = [draw(rng) for draw in arguments]
            true = exact(*values)
            error = abs(Decimal(function(*values)) - true) / Decimal(math.ulp(float(true)))
            assert error < limit, (values, error)


def test_the_error_of_a_power_grows_with_its_logarithm() -> None:
    rng = random.Random(8)
    with localcontext() as context:
        context.prec = DIGITS
        for _ in range(400):
            exponent = rng.uniform(-12.0, 12.0)
            true = Decimal(10) ** Decimal(exponent)
            units = abs(Decimal(power(10.0, exponent)) - true) / Decimal(math.ulp(float(true)))
            assert units < 1.0 + 2.0 * abs(math.log(true)), exponent


def test_special_arguments() -> None:
    assert [math.copysign(1.0, sin(zero)) for zero in (0.0, -0.0)] == [1.0, -1.0]
    assert (cos(0.0), exp(0.0), log(1.0)) == (1.0, 1.0, 0.0)
    assert (exp(1000.0), exp(-1000.0), log(0.0)) == (math.inf, 0.0, -math.inf)
    assert math.isnan(log(-1.0))
    assert exp(-740.0) == math.exp(-740.0)  # a subnormal number
    assert [atan2(y, x) for y, x in ((0.0, -1.0), (-0.0, -1.0), (0.0, 1.0), (2.0, 0.0), (-2.0, 0.0))] == [
        math.pi,
        -math.pi,
        0.0,
        0.5 * math.pi,
        -0.5 * math.pi,
    ]
    assert (asin(1.0), acos(1.0), acos(-1.0)) == (0.5 * math.pi, 0.0, math.pi)
    assert sin(1e9 + 0.5) == pytest.approx(math.sin(1e9 + 0.5), abs=1e-6)


ONE = ("sin", "cos", "tan", "atan", "exp", "square", "asin", "acos", "log", "log10")
TWO = ("hypot", "atan2", "power")


@compiled_ieee
def in_kernel(x: float, sine: float, positive: float) -> tuple[float, ...]:
    return (
        sin(x), cos(x), tan(x), atan(x), exp(x), square(x), asin(sine), acos(sine), log(positive), log10(positive),
        hypot(positive, x), atan2(positive, x), power(positive, x),
    )  # fmt: skip


@pytest.mark.long
def test_kernels_compute_the_same_bytes() -> None:
    rng = random.Random(9)
    for _ in range(2000):
        x, sine, positive = rng.uniform(-30.0, 30.0), rng.uniform(-1.0, 1.0), rng.uniform(1e-9, 9.0)
        arguments = 6 * [(x,)] + 2 * [(sine,)] + 2 * [(positive,)] + 3 * [(positive, x)]
        outside = [
            (name, getattr(elementary, name)(*values))
            for name, values in zip((*ONE, *TWO), arguments, strict=True)
        ]
        inside = in_kernel(x, sine, positive)
        assert list(zip((*ONE, *TWO), inside, strict=True)) == outside
