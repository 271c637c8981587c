"""Entries of the tape of a run, as `recorder` writes and `launch.replay` reads them: one JSON object per line."""

from __future__ import annotations

import json
from functools import cached_property
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field, RootModel, field_serializer, model_validator

from starhil.emulator.device.cycle import Phase
from starhil.emulator.links.table import LINKS, LinkName
from starhil.emulator.run.faults import FaultRequest
from starhil.emulator.simulation.config_model import Strict
from starhil.emulator.truth.config import TruthConfig
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.errors import ProtocolError

LONGEST_NOTE: Final = 500
"""Longest note, characters."""


class TimedEntry(Strict):
    """An entry, at a simulation time."""

    ns: Annotated[int, Field(ge=0, lt=1 << 63)]

    def line(self) -> bytes:
        """Return the entry as a line; an optional key without a value is left out."""
        values = {key: value for key, value in self.model_dump(mode="json").items() if value is not None}
        return json.dumps(values).encode() + b"\n"


class Event(TimedEntry):
    """An event that was due."""

    do: Literal["event"] = "event"


class PipelineAnswer(TimedEntry):
    """A reply of the pipeline, or what took its place because the pipeline had ended."""

    do: Literal["reply"] = "reply"
    ended: str | None = None


class PipelineState(TimedEntry):
    """The pipeline was ready, also after a restart; it ended, or was given up."""

    do: Literal["ready", "pipeline_lost", "pipeline_given_up"]


class Stored(TimedEntry):
    """The end of a slow write."""

    do: Literal["stored"] = "stored"


class LinkItem(TimedEntry):
    """Serial bytes or a CAN frame on a link."""

    do: Literal["in", "out"]
    link: LinkName
    data: str | tuple[int, str, bool, bool]

    @staticmethod
    def data_of(item: bytes | CanFrame) -> str | tuple[int, str, bool, bool]:
        if isinstance(item, CanFrame):
            return item.id, item.data.hex(), item.extended, item.remote
        return item.hex()

    @cached_property
    def item(self) -> bytes | CanFrame:
        """Serial bytes or a CAN frame."""
        if isinstance(self.data, str):
            return bytes.fromhex(self.data)
        number, data, extended, remote = self.data
        return CanFrame(number, bytes.fromhex(data), extended, remote)

    @model_validator(mode="after")
    def _check_item(self) -> Self:
        try:
            is_of_link = isinstance(self.item, LINKS[self.link].carries)
        except ProtocolError as error:
            raise ValueError(str(error)) from None
        if not is_of_link:
            raise ValueError(f"data: not that of the link {self.link}")
        return self


class FeedMessage(TimedEntry):
    """A message of a simulator."""

    do: Literal["feed"] = "feed"
    data: Annotated[str, Field(pattern=r"^[\x00-\xff]*$")]


class NewTruth(TimedEntry):
    """A new truth."""

    do: Literal["truth"] = "truth"
    config: TruthConfig
    start_s: Annotated[float, Field(ge=-1e9, le=1e9)]


class NewFaults(TimedEntry):
    """New faults."""

    do: Literal["fault"] = "fault"
    request: FaultRequest

    @field_serializer("request")
    def _as_requested(self, request: FaultRequest) -> dict[str, object]:
        return request.model_dump(mode="json", exclude_unset=True)


class ClearedFaults(TimedEntry):
    """The end of all faults."""

    do: Literal["clear_faults"] = "clear_faults"


class AwaitedPhase(TimedEntry):
    """A wait for a phase of the next exposure, which is an event of the device."""

    do: Literal["wait"] = "wait"
    phase: Phase


class Note(TimedEntry):
    """A note of somebody who watches the run; it changes nothing."""

    do: Literal["note"] = "note"
    text: Annotated[str, Field(max_length=LONGEST_NOTE)]


class End(TimedEntry):
    """The end of the run."""

    do: Literal["end"] = "end"


Entry: TypeAlias = (
    Event
    | PipelineAnswer
    | PipelineState
    | Stored
    | LinkItem
    | FeedMessage
    | NewTruth
    | NewFaults
    | ClearedFaults
    | AwaitedPhase
    | Note
    | End
)


class Line(RootModel[Annotated[Entry, Field(discriminator="do")]]):
    """A line of the tape."""
