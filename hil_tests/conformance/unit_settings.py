"""The settings of a unit that a conformance run changes and restores: parameters, store, mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from starhil.hil_tests.conformance.case import CaseFailed, check_equal

if TYPE_CHECKING:
    from starhil.hil_tests.conformance.link_probe import LinkProbe

LINK_PARAMETERS: Final = frozenset(
    {"serial_dialect", "serial_baud", "can_address", "host_address", "canopen_node"}
)
"""Parameters that would disconnect the tester; every case restores their values."""
SAVE_S: Final = 5.0


@dataclass(frozen=True)
class UnitSettings:
    """The settings of a unit before a run.

    Attributes
    ----------
    running, stored
        Values of the parameters by name, as numbers: current ones, and those that apply after a restart.
    defaults
        Defaults of the unit.
    mode
        Name of the mode.
    """

    running: Mapping[str, float]
    stored: Mapping[str, float]
    defaults: Mapping[str, float]
    mode: str

    @staticmethod
    def read(probe: LinkProbe) -> UnitSettings:
        """Read the settings.

        Stored parameters that differ from the current ones become current.
        """
        status = probe.telemetry("device_status")
        rows = _read_parameters(probe)
        running = {name: row["value"] for name, row in rows.items()}
        stored = running
        if status["parameters_changed"]:
            probe.command("restore_parameters")
            stored = {name: row["value"] for name, row in _read_parameters(probe).items()}
        defaults = {name: row["default"] for name, row in rows.items()}
        return UnitSettings(running, stored, defaults, str(status["mode"]))

    def prepare(self, probe: LinkProbe) -> None:
        """Set standby and the defaults of the unit."""
        probe.standby()
        set_parameters(probe, self.defaults)

    def restore(self, probe: LinkProbe) -> None:
        """Restore parameters, stored parameters and mode."""
        probe.standby()
        set_parameters(probe, self.stored)
        save_parameters(probe)
        if self.running != self.stored:
            set_parameters(probe, self.running)
        if self.mode != "standby":  # the device resumes tracking after its next attitude
            probe.command("set_mode", mode="lost_in_space" if self.mode == "tracking" else self.mode)

    def __str__(self) -> str:
        """Parameters that differ from their defaults, for a user who has to restore them."""
        own = {name: value for name, value in self.stored.items() if value != self.defaults[name]}
        return ", ".join(f"{name} = {value:g}" for name, value in own.items()) or "all at their defaults"


def _read_parameters(probe: LinkProbe) -> dict[str, dict[str, float]]:
    """Read value and default of each parameter that the run may change."""
    return {
        name: {key: float(seen[key]) for key in ("value", "default")}
        for name in probe.icd.parameters
        if name not in LINK_PARAMETERS
        for seen in (probe.parameter(name),)
    }


def set_parameters(probe: LinkProbe, values: Mapping[str, float]) -> None:
    """Set parameters in any order; those limited by others are set in a second pass."""
    refused: list[str] = []
    for name, value in values.items():
        try:
            probe.set_parameter(name, value)
        except CaseFailed:
            refused.append(name)
    for name in refused:
        probe.set_parameter(name, values[name])


def save_parameters(probe: LinkProbe) -> None:
    """Store the parameters, which must succeed."""
    probe.command("save_parameters")
    seen = probe.wait_for("acknowledge", {"processed": True}, SAVE_S)
    check_equal(seen["error"], "ok", "result of save_parameters")
    probe.wait_for("device_status", {"parameters_changed": False}, 2.0)
