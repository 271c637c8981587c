"""Scenario files: what happens to a run at which run time, so that a hard day can be repeated to the byte.

TOML, one `[[at]]` table an event, in any order::

    name = "glare"

    [[at]]
    run_time_s = 20.0
    fault = { optical = { blocked_share = 0.5 } }

    [[at]]
    run_time_s = 40.0
    clear_faults = true

`fault` and `truth` take what the control channel's `fault` and `set_truth` take. Events happen in run time, so that
they come at the same frames whatever the clock. Names, links and truth files are checked when the run starts. A live feed
cannot be set by a scenario: it needs a socket, which takes time.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import Field, ValidationError, model_validator

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.control.faults import FaultRequest
from starhil.emulator.device.scheduler import Action
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import configs_folder
from starhil.emulator.toml_file import read_toml
from starhil.emulator.truth.config import LiveConfig, Strict, TruthConfig
from starhil.emulator.validation_messages import explain
from starid.errors import StaridError

if TYPE_CHECKING:
    from starhil.emulator.emulation import Emulation

log = logging.getLogger("starhil.scenario")


class ScenarioEvent(Strict):
    """What happens at a run time."""

    run_time_s: Annotated[float, Field(ge=0.0, le=1e9)]
    """When: seconds of simulation time since the start."""
    fault: FaultRequest | None = None
    """Faults to inject, as in the control channel's `fault`."""
    clear_faults: bool = False
    """End all faults first."""
    truth: TruthConfig | None = None
    """Another truth, as in the control channel's `set_truth`; not `live`."""

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.fault is None and self.truth is None and not self.clear_faults:
            raise ValueError("give fault, truth or clear_faults = true")
        if isinstance(self.truth, LiveConfig):
            raise ValueError("a live feed cannot be set by a scenario; set it in the profile")  # noqa: TRY004
        return self

    def prepare(self, emulation: Emulation) -> Action:
        """Make what is to be done at the run time; whatever it needs is read and checked before."""
        if self.fault is not None:
            emulation.faults.check(self.fault)
        folder = emulation.profile.folder
        truth = None if self.truth is None else self.truth.build(self.run_time_s, folder)

        def happen(_due_ns: int) -> None:
            if self.clear_faults:
                emulation.faults.clear()
            if self.fault is not None:
                emulation.faults.inject(self.fault)
            if truth is not None:
                emulation.device.cycle.truth = truth
                emulation.close_feed()
            log.info("scenario at %g s", self.run_time_s)

        return happen


class Scenario(Strict):
    """A whole scenario."""

    name: str = ""
    """Name in messages."""
    at: Annotated[list[ScenarioEvent], Field(min_length=1)]
    """Events, in any order."""

    def enter(self, emulation: Emulation) -> None:
        """Enter all events into a run whose links are open; what they need is read and checked now.

        Raises
        ------
        EmulatorError
            An event asks for what this run does not have, or names a file that cannot be read.
        """
        for event in sorted(self.at, key=lambda each: each.run_time_s):
            try:
                action = event.prepare(emulation)
            except (EmulatorError, StaridError) as error:
                raise EmulatorError(f"scenario at {event.run_time_s:g} s: {error}") from None
            emulation.device.scheduler.at(round(event.run_time_s * NANOSECONDS), action)


def load_scenario(name_or_path: str) -> Scenario:
    """Read a scenario by its path, or by its name among those of the product.

    Raises
    ------
    EmulatorError
        One line: file, key and remedy.
    """
    path = Path(name_or_path).expanduser()
    if "/" not in name_or_path and not name_or_path.endswith(".toml"):
        path = configs_folder() / "scenarios" / f"{name_or_path}.toml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in (configs_folder() / "scenarios").glob("*.toml")))
        raise EmulatorError(f"scenario {name_or_path!r}: no such file; give a path, or one of: {known}")
    values = read_toml(path, "scenario")
    try:
        return Scenario.model_validate(values)
    except ValidationError as error:
        raise EmulatorError(f"scenario {path}: {explain(error, Scenario)}") from None
