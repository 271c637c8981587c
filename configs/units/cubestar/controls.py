"""CubeStar's controls for its own conformance cases: mode, reset, parameters, and the settings that a run restores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

from starhil.hil_tests.conformance.case import CaseFailed, check_equal
from starhil.hil_tests.conformance.link_probe import LinkProbe

SAVE_S: Final = 5.0


def standby(probe: LinkProbe) -> None:
    """Bring the device into standby."""
    if probe.telemetry("device_status")["mode"] != "standby":
        probe.command("set_mode", mode="standby")
        probe.wait_for("device_status", {"mode": "standby"}, 2.0)


def reset(probe: LinkProbe) -> None:
    """Reset the device and wait until it is in standby, the start mode that `CubeStarSettings` stores."""
    probe.command("reset")
    if not probe.answers(probe.unit.telecommands["reset"]):
        probe.expect_silence("reset is not answered on this link", 0.05)
    probe.sleep(0.05)
    probe.drain()
    probe.wait_for("device_status", {"mode": "standby"}, probe.times.boot_s)


def parameter(probe: LinkProbe, name: str) -> dict[str, float]:
    """Read value and limits of a parameter, as numbers."""
    probe.command("select_parameter", parameter=probe.unit.parameters[name].id)
    return {key: float(value) for key, value in probe.telemetry("parameter").items()}


def value_of(probe: LinkProbe, name: str) -> float:
    """Read the value of a parameter."""
    return parameter(probe, name)["value"]


def set_parameter(probe: LinkProbe, name: str, number: float) -> None:
    """Set a parameter, which must be accepted."""
    probe.command("set_parameter", parameter=probe.unit.parameters[name].id, value=number)


def set_parameters(probe: LinkProbe, values: Mapping[str, float]) -> None:
    """Set parameters in any order; those limited by others are set in a second pass."""
    refused: list[str] = []
    for name, value in values.items():
        try:
            set_parameter(probe, name, value)
        except CaseFailed:
            refused.append(name)
    for name in refused:
        set_parameter(probe, name, values[name])


def save_parameters(probe: LinkProbe) -> None:
    """Store the parameters, which must succeed."""
    probe.command("save_parameters")
    seen = probe.wait_for("acknowledge", {"processed": True}, SAVE_S)
    check_equal(seen["error"], "ok", "result of save_parameters")
    probe.wait_for("device_status", {"parameters_changed": False}, 2.0)


@contextmanager
def parameters_kept(probe: LinkProbe, *names: str) -> Iterator[None]:
    """Restore the values of parameters afterwards."""
    before = {name: value_of(probe, name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            set_parameter(probe, name, value)


class CubeStarSettings:
    """Parameters, stored parameters and mode, recorded before a run and restored after it."""

    def __init__(self) -> None:
        self._running: dict[str, float] = {}
        self._stored: dict[str, float] = {}
        self._defaults: dict[str, float] = {}
        self._mode = "standby"

    def prepare(self, probe: LinkProbe) -> None:
        """Record the settings; then set standby and the defaults of the unit, and store them with standby as the start mode.

        Stored parameters that differ from the current ones become current.
        """
        status = probe.telemetry("device_status")
        rows = _read_parameters(probe)
        self._running = self._stored = {name: row["value"] for name, row in rows.items()}
        if status["parameters_changed"]:
            probe.command("restore_parameters")
            self._stored = {name: row["value"] for name, row in _read_parameters(probe).items()}
        self._defaults = {name: row["default"] for name, row in rows.items()}
        self._mode = str(status["mode"])
        standby(probe)
        start_mode = probe.unit.parameters["start_mode"]
        set_parameters(probe, self._defaults | {start_mode.name: float((start_mode.enum or {})["standby"])})
        save_parameters(probe)

    def restore(self, probe: LinkProbe) -> None:
        """Restore parameters, stored parameters and mode."""
        try:
            standby(probe)
            set_parameters(probe, self._stored)
            save_parameters(probe)
            if self._running != self._stored:
                set_parameters(probe, self._running)
            if self._mode != "standby":  # the device resumes tracking after its next attitude
                mode = "lost_in_space" if self._mode == "tracking" else self._mode
                probe.command("set_mode", mode=mode)
        except CaseFailed as failure:
            own = {name: value for name, value in self._stored.items() if value != self._defaults[name]}
            text = ", ".join(f"{name} = {value:g}" for name, value in own.items()) or "all at their defaults"
            raise CaseFailed(f"the stored parameters restored ({text})", failure.seen) from None


def _read_parameters(probe: LinkProbe) -> dict[str, dict[str, float]]:
    """Read the row of each parameter that the run may change."""
    return {name: parameter(probe, name) for name, item in probe.unit.parameters.items() if not item.of_link}
