"""Results of a session's steps, as data, JSON and JUnit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from starhil.hil_tests.reports import FAILED, PASSED, SKIPPED, TestCase
from starhil.hil_tests.rig.interruption import Interrupted
from starhil.hil_tests.session.expect import show
from starhil.protocol.icd.values import Value

SHOWN_VALUES: Final = 6
"""Number of values of a row shown in the line of a step."""


@dataclass(frozen=True)
class StepResult:
    """Result of one step on one link."""

    number: int
    name: str
    link: str
    status: str
    """`passed`, `failed` or `skipped`."""
    detail: str
    """What was observed, or the problem."""
    seconds: float
    """Duration of the step, including repeats and waits."""
    latency_s: float | None = None
    """Largest latency of its transactions."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """The telemetry read last."""
    figures: Mapping[str, float] = field(default_factory=dict)
    """Numbers that the step computed, such as the attitude error."""

    def to_json(self) -> dict[str, Any]:
        values = {
            key: value.hex() if isinstance(value, bytes) else value for key, value in self.values.items()
        }
        return {
            "step": self.number,
            "name": self.name,
            "link": self.link,
            "status": self.status,
            "detail": self.detail,
            "seconds": round(self.seconds, 6),
            "latency_ms": None if self.latency_s is None else round(self.latency_s * 1e3, 3),
            "values": values,
            "figures": dict(self.figures),
        }


@dataclass(frozen=True)
class SessionResult:
    """Result of a whole session."""

    title: str
    results: tuple[StepResult, ...]
    seconds: float
    interruption: Interrupted | None = None
    """The signal that ended the session before its last step."""

    def count(self, status: str) -> int:
        """Return how many steps ended with a status."""
        return sum(result.status == status for result in self.results)

    @property
    def passed(self) -> bool:
        """Whether the session was complete, no step failed and at least one passed."""
        return self.interruption is None and self.count(FAILED) == 0 and self.count(PASSED) > 0

    def to_json(self) -> dict[str, Any]:
        return {
            "title": self.title,
            "passed": self.passed,
            "interrupted": self.interruption is not None,
            "steps": len(self.results),
            "failed": self.count(FAILED),
            "skipped": self.count(SKIPPED),
            "seconds": round(self.seconds, 3),
            "results": [result.to_json() for result in self.results],
        }


def summarize(values: Mapping[str, Value]) -> str:
    """Return the first values of a row as `name=value` pairs."""
    parts = [f"{name}={show(value)}" for name, value in list(values.items())[:SHOWN_VALUES]]
    return " ".join([*parts, "…"] if len(values) > SHOWN_VALUES else parts)


def junit_cases(result: SessionResult, suite: str) -> list[TestCase]:
    return [
        TestCase(
            suite,
            f"step {item.number}: {item.name} [{item.link}]"
            if item.link
            else f"step {item.number}: {item.name}",
            item.status,
            item.detail,
            item.seconds,
            "\n".join(f"{name} = {show(value)}" for name, value in item.values.items()),
        )
        for item in result.results
    ]
