"""What the soak makes of its samples: what grows fails, what wanders or ends high once does not."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location("soak", Path(__file__).parents[2] / "tools" / "soak.py")
soak = importlib.util.module_from_spec(_SPEC)
sys.modules["soak"] = soak
_SPEC.loader.exec_module(soak)

FLAT = soak.Sample(0.0, 300.0, 27, 5.0, 4.0)
ROUNDS = 60


def series(change=lambda sample, _number: sample):
    """A sample every 15 s, each as `change` makes it of the flat one and its number."""
    return [replace(change(FLAT, number), time_s=15.0 * (number + 1)) for number in range(ROUNDS)]


def grown(samples) -> list[str]:
    return [figure.name for figure in soak.compare(samples) if figure.grew]


def test_a_flat_series_passes():
    assert grown(series()) == []


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("memory, MB", lambda sample, number: replace(sample, memory_mb=300.0 + 0.5 * number)),
        ("descriptors", lambda sample, number: replace(sample, descriptors=27 + number // 10)),
        ("serial latency p99, ms", lambda sample, number: replace(sample, serial_p99_ms=5.0 + number)),
        (
            "CAN latency p99, ms",
            lambda sample, number: replace(sample, can_p99_ms=4.0 * 1.05**number + number),
        ),
    ],
)
def test_a_growing_series_fails_by_name(name, change):
    assert grown(series(change)) == [name]


def test_growth_in_the_warm_up_alone_passes():
    warm_up = int(soak.WARM_UP_SHARE * ROUNDS) - 1

    def fill(sample, number):
        return replace(sample, memory_mb=200.0 + 100.0 * min(number, warm_up) / warm_up)

    assert grown(series(fill)) == []


def test_one_bad_round_at_the_end_decides_nothing():
    samples = series()
    samples[-1] = replace(samples[-1], memory_mb=500.0, descriptors=99, serial_p99_ms=900.0, can_p99_ms=900.0)
    assert grown(samples) == []


def test_memory_that_wanders_by_a_few_megabytes_passes():
    assert grown(series(lambda sample, number: replace(sample, memory_mb=300.0 + number * 37 % 7))) == []


def test_a_latency_that_was_not_measured_fails():
    assert grown(series(lambda sample, _: replace(sample, can_p99_ms=float("nan")))) == [
        "CAN latency p99, ms"
    ]


@pytest.mark.parametrize("count", [0, 1, soak.MIN_ROUNDS - 1])
def test_too_few_rounds_are_no_verdict(count):
    with pytest.raises(ValueError, match=f"{count} rounds are too few"):
        soak.compare(series()[:count])
