"""Scenario files: faults and changes of truth at given simulation times.

A scenario is a TOML file with one `[[at]]` table per event, in any order::

    name = "glare"

    [[at]]
    run_time_s = 20.0
    fault = { optical = { blocked_share = 0.5 } }

    [[at]]
    run_time_s = 40.0
    clear_faults = true

`fault` and `truth` have the keys of `fault` and `set_truth` on the control channel. Events occur in simulation
time, at the same exposures on any clock. Names, links and truth files are checked when the run starts. A scenario
cannot set a live feed, because opening a socket takes time.
"""

from __future__ import annotations

import logging
from typing import Annotated, Final, Self

from pydantic import Field, ValidationError, model_validator

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile.toml_file import find_toml, read_toml
from starhil.emulator.run.faults import FaultRequest
from starhil.emulator.run.head import Head
from starhil.emulator.simulation.config_model import Strict
from starhil.emulator.simulation.scheduler import Action
from starhil.emulator.truth.config import FeedConfig, TruthConfig
from starhil.emulator.truth.truth import Truth
from starhil.protocol.errors import did_you_mean
from starhil.protocol.files.validation import problems
from starhil.protocol.icd.conventions import NANOSECONDS
from starid.errors import StaridError

log = logging.getLogger("starhil.scenario")


MAX_EVENTS: Final = 1000
"""Most events of a scenario."""


class ScenarioEvent(Strict):
    """Changes at a simulation time."""

    run_time_s: Annotated[float, Field(ge=0.0, le=1e9)]
    """Time of the event: simulation time since the start."""
    fault: FaultRequest | None = None
    """Faults to inject, as in `fault` on the control channel."""
    clear_faults: bool = False
    """End all faults first."""
    truth: TruthConfig | None = None
    """New truth, as in `set_truth` on the control channel; not `live` or `42`."""

    @model_validator(mode="after")
    def _check_content(self) -> Self:
        if self.fault is None and self.truth is None and not self.clear_faults:
            raise ValueError("give fault, truth or clear_faults = true")
        if isinstance(self.truth, FeedConfig):
            raise ValueError("a scenario cannot set a live feed; set it in the profile")  # noqa: TRY004
        return self

    def prepare(self, head: Head, truth: Truth | None, at_s: float) -> Action:
        """Return the action of the event; files and values are read and checked now."""
        faults, config = head.faults, self.truth
        if self.fault is not None:
            faults.check(self.fault)
        source = None if config is None else config.build(at_s, head.profile.folder)

        def act(_due_ns: int) -> None:
            if self.clear_faults:
                faults.clear()
            if self.fault is not None:
                try:
                    faults.inject(self.fault)
                except EmulatorError as error:
                    log.warning("scenario at %g s: %s", at_s, error)
            if config is not None and source is not None and truth is not None:
                truth.put(source, config)
            log.info("scenario at %g s", at_s)

        return act


class Scenario(Strict):
    """A scenario."""

    name: str = ""
    """Name in messages."""
    at: Annotated[list[ScenarioEvent], Field(min_length=1, max_length=MAX_EVENTS)]
    """Events, in any order."""

    def prepare(self, head: Head, truth: Truth | None, start_s: float = 0.0) -> list[tuple[int, Action]]:
        """Return the time of each event, nanoseconds, and its action; all files are read and checked now.

        Times are relative to a simulation time in seconds. The faults affect a head whose links are open. The truth
        is that of the run; None if another head sets it.
        """
        events = []
        for event in sorted(self.at, key=lambda each: each.run_time_s):
            at_s = start_s + event.run_time_s
            try:
                events.append((round(at_s * NANOSECONDS), event.prepare(head, truth, at_s)))
            except (EmulatorError, StaridError) as error:
                raise EmulatorError(f"scenario at {event.run_time_s:g} s: {error}") from None
        return events


def load_scenario(name_or_path: str) -> Scenario:
    """Read a scenario from a path, or by the name of one in `configs/scenarios`."""
    path = find_toml("scenario", name_or_path)
    values = read_toml(path, "scenario")
    if "at" not in values:
        known = did_you_mean("at", values) or f"; its keys are {', '.join(values) or 'none'}"
        raise EmulatorError(f"scenario {path}: not a scenario: has no events, each under [[at]]{known}")
    try:
        return Scenario.model_validate(values)
    except ValidationError as error:
        found = problems(error, Scenario, values)
        raise EmulatorError(*(f"scenario {path}: {problem}" for problem in found)) from None
