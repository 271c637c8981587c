"""Data model of a session script."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starhil.hil_tests.attitude import Quaternion
from starhil.hil_tests.expect import AttitudeCheck, Expectation, Operand
from starhil.protocol.codec import Row
from starhil.protocol.values import Parameter

LINKS: Final = ("serial", "can", "both")
SIGNALS: Final = ("term", "kill")


# --- actions: what a step does ---


@dataclass(frozen=True)
class Command:
    """Send a telecommand."""

    row: Row
    values: Mapping[str, Operand]
    raw: bytes | None
    """Data as bytes instead of `values`, for malformed telecommands."""
    refused: str | None
    """Name of the expected error code; None if the telecommand must be accepted."""


@dataclass(frozen=True)
class Read:
    """Read a telemetry row."""

    row: Row
    refused: str | None


@dataclass(frozen=True)
class Listen:
    """Wait for unsolicited telemetry of a row, `count` times."""

    row: Row
    count: int


@dataclass(frozen=True)
class Sample:
    """Read a telemetry row repeatedly into a CSV file."""

    row: Row
    every_s: float
    for_s: float
    file: str
    at_least: float
    """Fraction of the samples for which the expectations must hold, 0 to 1."""
    min_samples: int
    """Smallest number of samples."""


@dataclass(frozen=True)
class SetParameter:
    """Set a parameter by name and read it back."""

    parameter: Parameter
    value: Operand
    refused: str | None


@dataclass(frozen=True)
class GetParameter:
    """Read a parameter by name; expectations refer to the fields of the row `parameter`."""

    parameter: Parameter


@dataclass(frozen=True)
class DownloadImage:
    """Save an image in the unit, download it and write it as a PNG file."""

    file: str
    size: str
    method: str
    """`frames` of 128 bytes, or `burst` packets with hole maps."""


@dataclass(frozen=True)
class Send:
    """Send raw bytes or CAN frames, and check the answer."""

    link: str
    """`serial` or `can`, by the format of the data."""
    data: tuple[str, ...]
    """Bytes in hexadecimal (serial), or frames in the format of `cansend` (CAN)."""
    answer: tuple[str, ...] | None
    """Expected answer in the same format; None to accept anything."""
    listen_s: float


@dataclass(frozen=True)
class Wait:
    """Do nothing for a while."""

    seconds: float


@dataclass(frozen=True)
class Restart:
    """End the emulator that the session started, by a signal, and start it again."""

    signal: str


Action = (
    Command | Read | Listen | Sample | SetParameter | GetParameter | DownloadImage | Send | Wait | Restart
)


# --- the script ---


@dataclass(frozen=True)
class Step:
    """One step: an action, its expectations, and how often it is tried."""

    number: int
    name: str
    action: Action
    expect: tuple[Expectation, ...]
    attitude: AttitudeCheck | None
    capture: Mapping[str, str]
    """Variable → field."""
    link: str | None
    repeat: int
    every_s: float
    within_s: float | None
    """Repeat until the expectations hold, for at most this long."""
    timeout_s: float | None
    retries: int
    max_latency_s: float | None


@dataclass(frozen=True)
class EmulatorRequest:
    """How `--start` starts the emulator for this script."""

    profile: str | None = None
    settings: tuple[str, ...] = ()
    seed: int | None = None


@dataclass(frozen=True)
class Truth:
    """The true attitude, or a file of true attitudes over time that the emulator writes."""

    attitude: Quaternion | None = None
    file: str | None = None


@dataclass(frozen=True)
class Script:
    """A validated session script."""

    path: Path
    title: str
    doc: str
    truth: Truth
    emulator: EmulatorRequest
    timeout_s: float
    retries: int
    keep_going: bool
    link: str | None
    steps: tuple[Step, ...]
