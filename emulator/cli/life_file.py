"""A life of `starhil endurance` in a file, which another person may have written: it is checked before anything is run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.run.faults import FaultRequest
from starhil.emulator.simulation.config_model import Strict
from starhil.emulator.truth.config import FixedConfig, RateConfig
from starhil.hil_tests.endurance.life import Life
from starhil.hil_tests.judge.links import LinkName
from starhil.protocol.files.user_file import read_user_text
from starhil.protocol.files.validation import problems

LONGEST_WAIT_S: Final = 1e6
MOST_REQUESTS: Final = 100_000
MOST_EVENTS: Final = 1_000_000

Hex = Annotated[str, Field(pattern=r"^([0-9a-fA-F]{2})*$")]
Row = tuple[str, Annotated[int, Field(ge=0, lt=2**32)], Literal["telemetry", "telecommand"]]
"""Class, ID and kind."""
OtherFrame = tuple[Annotated[int, Field(ge=0, lt=2**29)], Annotated[Hex, Field(max_length=16)]]
"""Identifier and data of a CAN frame."""


class _Wait(Strict):
    do: Literal["wait"]
    s: Annotated[float, Field(ge=0.0, le=LONGEST_WAIT_S)]
    most: Annotated[int, Field(ge=1, le=MOST_EVENTS)] = 1


class _Request(Strict):
    do: Literal["request"]
    link: LinkName
    row: Row
    data: Hex = ""


class _Burst(Strict):
    do: Literal["burst"]
    link: LinkName
    rows: list[Row]


class _Flood(Strict):
    do: Literal["flood"]
    link: LinkName
    row: Row
    data: Hex = ""
    count: Annotated[int, Field(ge=1, le=MOST_REQUESTS)]


class _Cut(Strict):
    do: Literal["cut"]
    link: LinkName
    row: Row
    share: Annotated[float, Field(ge=0.0, le=1.0)]


class _Nmt(Strict):
    do: Literal["nmt"]
    link: LinkName
    command: Annotated[int, Field(ge=0, le=255)]


class _Junk(Strict):
    do: Literal["junk"]
    link: LinkName
    data: Hex = ""
    frames: list[OtherFrame] = Field(default_factory=list)


class _Truth(Strict):
    do: Literal["truth"]
    truth: Annotated[FixedConfig | RateConfig, Field(discriminator="kind")]

    @model_validator(mode="after")
    def _is_known_to_the_oracle(self) -> Self:
        given = self.truth.model_fields_set
        if "attitude" not in given or not {"ra_deg", "dec_deg"} <= self.truth.attitude.model_fields_set:
            raise ValueError("truth.attitude: must be given by ra_deg and dec_deg")
        if "mount" in given:
            raise ValueError("truth.mount: no life has it")
        return self


class _Fault(Strict):
    do: Literal["fault"]
    fault: FaultRequest


class _Power(Strict):
    do: Literal["power"]
    factory: bool


class _Disk(Strict):
    do: Literal["disk"]
    full: bool


class _Peer(Strict):
    do: Literal["peer"]
    link: LinkName
    reads: bool


class _Other(Strict):
    do: Literal["clear", "end_pipeline", "recover"]


_AnyStep = Annotated[
    _Wait
    | _Request
    | _Burst
    | _Flood
    | _Cut
    | _Nmt
    | _Junk
    | _Truth
    | _Fault
    | _Power
    | _Disk
    | _Peer
    | _Other,
    Field(discriminator="do"),
]


class _RunKeys(BaseModel):
    """Those of `[run]` that the oracle knows; the profile checks the others."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)

    start_unix_s: float = 0.0


class _Profile(Strict):
    parameters: dict[str, Any] = Field(default_factory=dict)
    run: _RunKeys = Field(default_factory=_RunKeys)


class _LifeFile(Strict):
    unit: str
    seed: Annotated[int, Field(ge=0)]
    links: Annotated[list[LinkName], Field(min_length=1)]
    profile: _Profile
    steps: list[_AnyStep]
    rendered: bool = False
    violation: str = ""

    @model_validator(mode="after")
    def _links_are_open(self) -> Self:
        for number, step in enumerate(self.steps, 1):
            link = getattr(step, "link", None)
            if link is not None and link not in self.links:
                raise ValueError(f"step {number}: {link} is not in links")
        return self


def read_life(path: Path) -> Life:
    """Read a life that an earlier run has written.

    Raises
    ------
    EmulatorError
        It cannot be read, or is none: a link, a step or a key that no life has, for example a truth from a file or a socket.
    """
    what = f"{path}: not a life of `starhil endurance`"
    with explained(what, errors=(OSError, UnicodeDecodeError)):
        text = read_user_text(path)
    try:
        file = _LifeFile.model_validate_json(text)
    except ValidationError as error:
        raise EmulatorError(*(f"{what}: {problem}" for problem in problems(error, _LifeFile))) from None
    content = file.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    return Life(
        file.unit, file.seed, tuple(file.links), content["profile"], tuple(content["steps"]), file.rendered
    )
