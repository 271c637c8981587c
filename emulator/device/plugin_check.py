"""Checks, on a device in memory, that the quantities of a unit's plugin fit their fields."""

from __future__ import annotations

from typing import Final

from starhil.emulator.device.bindings import TelemetryBinding
from starhil.emulator.device.device import Device
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.state_store import MemoryStore
from starhil.emulator.profile import Profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.error_model import ErrorModel
from starhil.emulator.simulation.clock import SteppedClock
from starhil.emulator.truth.source import FixedTruth
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.plugin import guarded
from starid.attitude import Attitude

STEP_NS: Final = NANOSECONDS // 10
LONGEST_NS: Final = 60 * NANOSECONDS


def failing_quantities(icd: InterfaceDefinition, profile: Profile) -> list[str]:
    """Return an error for each telemetry row that cannot be packed because of a quantity of the plugin.

    Each row with such a quantity is read once without a frame and once with a frame that has an attitude.
    """
    rows = [
        row
        for row in icd.telemetry.values()
        if any(field.value in icd.plugin.quantities for field in row.named_fields.values())
    ]
    if not rows:
        return []
    clock = SteppedClock()
    imager = ErrorModel(pipeline_setup(profile))
    device = Device(profile, icd, clock, imager, MemoryStore(), FixedTruth(Attitude.identity()))
    device.power_on()
    device.pipeline_ready({})
    snapshots = {"without a frame": device.snapshot()}
    while device.modes.mode is Mode.BOOT:
        _step(device, clock)
    device.modes.command(Mode.LOST_IN_SPACE, has_attitude=False)
    while not device.snapshot().reported.valid and clock.now_ns() < LONGEST_NS:
        _step(device, clock)
    snapshots["with an attitude"] = device.snapshot()
    errors = []
    for row in rows:
        for when, snapshot in snapshots.items():
            try:
                for field in row.named_fields.values():
                    if (quantity := icd.plugin.quantities.get(field.value or "")) is not None:
                        guarded(f"quantity {field.value} {when}", quantity.function)(snapshot)
                TelemetryBinding(row, icd).encode(snapshot)
            except ProtocolError as error:
                errors += [f"{icd.files[row.name]}: telemetry {row.name}: {text}" for text in error.args]
    return list(dict.fromkeys(errors))


def _step(device: Device, clock: SteppedClock) -> None:
    end_ns = clock.now_ns() + STEP_NS
    while (event := device.scheduler.pop_due(end_ns)) is not None:
        clock.set_ns(max(event.due_ns, clock.now_ns()))
        event.action(event.due_ns)
    clock.set_ns(end_ns)
