"""What a session script says, as data: its steps, their actions, and what stands for the whole script."""

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
    """Parameters as bytes, in place of `values`: for what no honest OBC sends."""
    refused: str | None
    """Error code that the device must answer with; None: it must accept."""


@dataclass(frozen=True)
class Read:
    """Ask for a telemetry row."""

    row: Row
    refused: str | None


@dataclass(frozen=True)
class Listen:
    """Wait for unsolicited telemetry of a row, `count` times."""

    row: Row
    count: int


@dataclass(frozen=True)
class Sample:
    """Read a telemetry row over and over into a CSV file."""

    row: Row
    every_s: float
    for_s: float
    file: str
    at_least: float
    """Part of the samples for which the expectations must hold, 0 to 1."""
    min_samples: int
    """Fewest samples that must have come."""


@dataclass(frozen=True)
class SetParameter:
    """Set a parameter by name and read it back."""

    parameter: Parameter
    value: Operand
    refused: str | None


@dataclass(frozen=True)
class GetParameter:
    """Read a parameter by name; expectations are on the fields of the row `parameter`."""

    parameter: Parameter


@dataclass(frozen=True)
class DownloadImage:
    """Have an image saved, download it and write it as a PNG file."""

    file: str
    size: str
    method: str
    """`frames` of 128 bytes, or `burst` packets with hole maps."""


@dataclass(frozen=True)
class Send:
    """Send bytes or CAN frames as they stand, and look at what comes back."""

    link: str
    """`serial` or `can`, by the form of what is sent."""
    data: tuple[str, ...]
    """Bytes in hexadecimal (serial), or frames as `cansend` writes them (CAN)."""
    answer: tuple[str, ...] | None
    """What must come back, in the same form; None to take anything."""
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
    """One step: an action, what is expected of it, and how often it is tried."""

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
    """Try again until the expectations hold, at most this long."""
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
    """What the sensor looks at: one attitude, or a file of attitudes over time that the emulator writes."""

    attitude: Quaternion | None = None
    file: str | None = None


@dataclass(frozen=True)
class Script:
    """A session script, read and checked."""

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
