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
they come at the same frames whatever the clock. Truth files are read when the run starts. A live feed cannot be set by a
scenario: it needs a socket, which takes time.
"""

from __future__ import annotations

import logging
import tomllib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import Field, ValidationError, model_validator

from emulator.clock import NANOSECONDS
from emulator.errors import EmulatorError
from emulator.faults import FaultRequest
from emulator.profile import configs_folder
from emulator.truth.config import LiveConfig, Strict, TruthConfig
from emulator.truth.source import TruthSource
from emulator.wording import explain
from protocol.user_file import read_user_text

if TYPE_CHECKING:
    from emulator.emulation import Emulation

log = logging.getLogger("starhil.scenario")


class ScenarioEvent(Strict):
    """What happens at a run time."""

    run_time_s: Annotated[float, Field(ge=0.0, le=1e9)]
    fault: FaultRequest | None = None
    clear_faults: bool = False
    truth: TruthConfig | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.fault is None and self.truth is None and not self.clear_faults:
            raise ValueError("give fault, truth or clear_faults = true")
        if isinstance(self.truth, LiveConfig):
            raise ValueError("a live feed cannot be set by a scenario; set it in the profile")  # noqa: TRY004
        return self


class Scenario(Strict):
    """A whole scenario."""

    name: str = ""
    at: Annotated[list[ScenarioEvent], Field(min_length=1)]

    def enter(self, emulation: Emulation) -> None:
        """Enter all events into the run.

        Raises
        ------
        EmulatorError
            A truth file cannot be read.
        """
        for event in sorted(self.at, key=lambda each: each.run_time_s):
            due_ns = round(event.run_time_s * NANOSECONDS)
            truth = None
            if event.truth is not None:
                truth = event.truth.build(event.run_time_s, emulation.profile.folder)
            emulation.device.scheduler.at(due_ns, partial(_happen, emulation, event, truth))


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
    try:
        values = tomllib.loads(read_user_text(path))
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in (configs_folder() / "scenarios").glob("*.toml")))
        raise EmulatorError(
            f"scenario {name_or_path!r}: no such file; give a path, or one of: {known}"
        ) from None
    except OSError as error:
        raise EmulatorError(f"scenario {path}: cannot be read ({error.strerror}); give a TOML file") from None
    except UnicodeDecodeError as error:
        raise EmulatorError(f"scenario {path}: not UTF-8 ({error.reason}); give a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise EmulatorError(f"scenario {path}: not TOML ({error})") from None
    try:
        return Scenario.model_validate(values)
    except ValidationError as error:
        raise EmulatorError(f"scenario {path}: {explain(error, Scenario)}") from None


def _happen(emulation: Emulation, event: ScenarioEvent, truth: TruthSource | None, _due_ns: int) -> None:
    """Do an event; what this run cannot do is told in the log, and the run goes on."""
    try:
        if event.clear_faults:
            emulation.faults.clear()
        if event.fault is not None:
            emulation.faults.inject(event.fault)
        if truth is not None:
            emulation.device.cycle.truth = truth
            emulation.close_feed()
    except EmulatorError as error:
        log.warning("scenario at %g s: %s", event.run_time_s, error)
    else:
        log.info("scenario at %g s", event.run_time_s)
