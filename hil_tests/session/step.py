"""A step of a session script, whatever its action: expectations, repetition, and the outcome of an attempt.

Validation takes from its context `icd`, the interface definition; `captured`, the variables of earlier steps; and `has_truth`.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Protocol, Self, TypeVar

from pydantic import Field, ValidationInfo, model_validator

from starhil.hil_tests.attitude import Quaternion, attitude_fields
from starhil.hil_tests.client.transactions import Ack, Reading
from starhil.hil_tests.errors import BenchError, NackError
from starhil.hil_tests.rig.rig import Rig
from starhil.hil_tests.session.expect import (
    AttitudeCheck,
    Keys,
    ReadConditions,
    impossible,
    show,
    show_angle,
    unknown_fields,
)
from starhil.hil_tests.session.results import summarize
from starhil.hil_tests.session.step_keys import Count, Duration, Link, Refusal, Timeout
from starhil.protocol.icd.codec import Row
from starhil.protocol.icd.values import Value

MS_PER_S: Final = 1e3

BOOTING: Final = "the unit boots; an emulator does so until it prints its ready line, for minutes while it compiles kernels"

Answer = TypeVar("Answer", Ack, Reading)


class TruthOverTime(Protocol):
    """True attitudes over the time of the device."""

    def at(self, time_s: float) -> Quaternion:
        """Return the attitude at a Unix time of the device's clock."""


@dataclass
class SessionState:
    """What the steps of a session share."""

    rig: Rig
    folder: Path
    """Gets CSV and image files."""
    truth: Quaternion | TruthOverTime | None
    captured: dict[str, Value] = field(default_factory=dict)
    step_begin_s: float = 0.0
    """Begin of the present step, on `time.monotonic`."""

    def truth_of(self, reading: Reading) -> Quaternion:
        """Return the true attitude at the time of a reading."""
        if self.truth is None:
            raise BenchError("no truth to compare the attitude with")
        if isinstance(self.truth, Quaternion):
            return self.truth
        if "time_of_exposure" not in reading.values:
            raise BenchError(f"{reading.name} has no time; read precise_attitude")
        return self.truth.at(float(reading["time_of_exposure"]))

    @property
    def variables(self) -> dict[str, Value]:
        """The captured values and the time."""
        now = time.time()
        return {**self.captured, "now": now, "now_s": int(now), "now_ms": int(now % 1.0 * MS_PER_S)}


@dataclass
class Attempt:
    """Outcome of one attempt of a step; `problem` is None if it passed, otherwise what was wrong."""

    problem: str | None = None
    detail: str = ""
    """What was observed."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """Telemetry read."""
    figures: dict[str, float] = field(default_factory=dict)
    latency_s: float | None = None
    """Largest latency, s."""


class Step(Keys):
    """One step: its action, given by the class; its expectations; how often it is tried."""

    default_name: ClassVar[str] = ""
    """The name of a step that has none, in which `self` is the step."""
    needs_link: ClassVar[bool] = True
    needs_emulator: ClassVar[bool] = False
    """Whether the step is for an emulator that the bench has started."""
    needs_control: ClassVar[bool] = False
    """Whether the step is for an emulator whose control channel the bench has."""

    name: str = ""
    expect: dict[str, ReadConditions] = Field(default_factory=dict)
    attitude: AttitudeCheck | None = None
    capture: dict[str, str] = Field(default_factory=dict)
    """Variable → field."""
    link: Link | None = None
    repeat: Count = 1
    every_s: Duration = 0.2
    within_s: Duration | None = None
    """Repeat until the expectations hold, for at most this long."""
    timeout_s: Timeout | None = None
    retries: Annotated[int, Field(ge=0)] = 0
    max_latency_s: Duration | None = None

    @abstractmethod
    def run(self, session: SessionState, link: str) -> Attempt:
        """Try the action once on a link; `link` is empty for a step that needs none."""

    @property
    def pause_s(self) -> float:
        """Pause between attempts and between repetitions, s."""
        return self.every_s

    @property
    def patience(self) -> dict[str, Any]:
        """How long and how often the client asks."""
        return {"timeout_s": self.timeout_s, "retries": self.retries}

    @property
    def reading(self) -> Row | None:
        """The row that the step reads; None if it reads no telemetry."""
        return None

    @model_validator(mode="after")
    def _fits_its_row(self, info: ValidationInfo) -> Self:
        problems = [*self._problems(info)]
        if problems:
            raise ValueError(*problems)
        self.name = self.name or self.default_name.format(self=self)
        return self

    def _problems(self, info: ValidationInfo) -> Iterator[str]:
        row = self.reading
        if row is None:
            yield from (
                f"'{key}' needs a step that reads telemetry"
                for key in ("expect", "capture")
                if getattr(self, key)
            )
        if self.attitude is not None:
            if row is None or attitude_fields(row) is None:
                yield "'attitude' needs a step that reads a row with a quaternion, Gibbs vector, MRPs or rotation vector"
            elif self.attitude.attitude is None and not (info.context or {})["has_truth"]:
                yield "'attitude' has no truth to compare with: give one here or in a table [truth]"
        if row is not None:
            yield from unknown_fields("capture", row, self.capture.values())
            yield from unknown_fields("expect", row, self.expect)
            for name in self.expect.keys() & row.named_fields.keys():
                yield from (
                    f"expect: {text}" for text in impossible(row.named_fields[name], self.expect[name])
                )

    def judged(self, session: SessionState, reading: Reading) -> Attempt:
        attempt = Attempt(
            detail=summarize(reading.values), values=reading.values, latency_s=reading.latency_s or None
        )
        variables = session.variables
        problems = [
            text
            for name, wanted in self.expect.items()
            if (text := wanted.mismatch(name, reading[name], variables)) is not None
        ]
        if self.expect and not problems:
            attempt.detail = " ".join(f"{name}={show(reading[name])}" for name in self.expect)
        if self.attitude is not None and self.reading is not None and not problems:
            truth = self.attitude.attitude or session.truth_of(reading)
            error, problem = self.attitude.judge(
                self.reading, reading.values, truth, session.rig.icd.conventions
            )
            if error is not None:
                attempt.figures.update(vars(error))
                attempt.detail += f" error: {show_angle(error.cross_boresight_arcsec)} cross, {show_angle(error.roll_arcsec)} roll"
            problems += [] if problem is None else [problem]
        if problems and _boots(self.reading, reading.values):
            problems.append(BOOTING)
        attempt.problem = "; ".join(problems) or None
        return attempt


def _boots(row: Row | None, values: Mapping[str, Value]) -> bool:
    """Return whether a row reports that the unit boots."""
    fields = {} if row is None else row.named_fields
    return any(field.value == "mode" and values.get(name) == "boot" for name, field in fields.items())


class RequestStep(Step):
    """A step whose request the unit accepts, or refuses if an error code is given."""

    refused: Refusal | None = None
    """Name of the expected error code; None if the request must be accepted."""

    def exchange(
        self, send: Callable[..., Answer], *arguments: Any, **options: Any
    ) -> tuple[Attempt, Answer | None]:
        """Send the request; return the attempt, and the answer if the request was accepted."""
        try:
            answer = send(*arguments, **self.patience, **options)
        except NackError as error:
            if self.refused is None:
                raise
            if error.code_name != self.refused:
                problem = f"refused with {error.code} ({error.code_name}), expected {self.refused}"
                return Attempt(problem=problem), None
            return Attempt(detail=f"refused with {error.code} ({self.refused}), as expected"), None
        if self.refused is not None:
            return Attempt(problem=f"accepted, expected to be refused with {self.refused}"), answer
        if isinstance(answer, Ack) and not answer.answered:
            return Attempt(detail="sent; no reply is expected"), answer
        return Attempt(detail="accepted", latency_s=answer.latency_s), answer
