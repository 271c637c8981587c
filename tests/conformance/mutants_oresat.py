"""Mutants of a unit on CANopen: its definition with one error, served to a tester with the correct definition."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.files.bundled import find_unit
from tests.conformance.mutant_seams import Damage, incoming, only_acknowledged, outgoing
from tests.conformance.simulated import SimulatedUnit

UNIT = "oresat"


@dataclasses.dataclass(frozen=True)
class DefinitionMutant:
    """A text of the definition that is replaced everywhere, and the case that must then fail."""

    name: str
    caught_by: str
    old: str
    new: str

    def write(self, folder: Path) -> Path:
        """Write the definition with the error.

        Raises
        ------
        ValueError
            The definition does not contain the text.
        """
        text = (find_unit(UNIT) / f"{UNIT}.toml").read_text(encoding="utf-8")
        if self.old not in text:
            raise ValueError(f"{self.name}: {UNIT}.toml has no {self.old!r}")
        (folder / "unit.toml").write_text(text.replace(self.old, self.new), encoding="utf-8")
        return folder


DEFINITION_MUTANTS = (
    DefinitionMutant("the orientation has another index", "rows.orientation", "4002", "4012"),
    DefinitionMutant("a sub-index is left out", "rows.system", 'name = "unix_time", value', 'name = "unix_time", subindex = 5, value'),
    DefinitionMutant("fields are shifted by one", "rows.orientation", '    { name = "attitude_i"', '    { name = "count", type = "u8", default = 0 },\n    { name = "attitude_i"'),
    DefinitionMutant("a number has another size", "rows.system", 'name = "power_cycles", type = "u16"', 'name = "power_cycles", type = "u32"'),
    DefinitionMutant("a number has another scale", "attitude.orientation", 'value = "attitude.z"', 'value = "attitude.z", scale = 0.5'),
    DefinitionMutant("the scalar part is missing", "attitude.orientation", 'value = "attitude.w"', "default = 0"),
    DefinitionMutant("the attitude is known when it is not", "attitude.orientation", 'value = "attitude.valid"', "const = 1"),
    DefinitionMutant("another number stands for a mode", "commands.set_status", '4 = ["lost_in_space"', '5 = ["lost_in_space"'),
    DefinitionMutant("a mode is refused", "commands.set_status", '2 = "standby", 4 = "lost_in_space" }', '2 = "standby" }'),
    DefinitionMutant("another mode is accepted", "limits.set_status.status.unknown", '4 = "lost_in_space" }', '4 = "lost_in_space", 255 = "tracking" }'),
    DefinitionMutant("the status cannot be written", "commands.set_status", 'telecommand = "set_status"', ""),
    DefinitionMutant("limits are wider", "limits.set_capture_filter.upper_percentage.high", "max = 100", "max = 255"),
    DefinitionMutant("limits are tighter", "records.set_capture_filter", "max = 255", "max = 254"),
    DefinitionMutant("settings cannot be written", "records.set_capture_filter", '\ntelecommand = "set_capture_filter"', ""),
    DefinitionMutant("a reset is accepted without one", "commands.reset", 'action = "reset"', 'action = "nothing"'),
    DefinitionMutant("seconds and fractions are exchanged", "rpdos.1.clock", 'name = "coarse", type = "u32", unit = "s", argument = "seconds" }', 'name = "coarse", type = "u32", default = 0 }'),
    DefinitionMutant("an RPDO has another CAN ID", "rpdos.1.default", "relative = false", ""),
    DefinitionMutant("a TPDO has another CAN ID", "tpdos.5.default", "can_id = 0x181                      # 1ADh", "can_id = 0x182  #"),
    DefinitionMutant("a TPDO is off", "tpdos.4.default", '"attitude real, i"\nenabled = true', '"attitude real, i"'),
    DefinitionMutant("a TPDO is synchronous", "tpdos.3.default", "transmission_type = 254", "transmission_type = 1"),
    DefinitionMutant("a TPDO has another period", "tpdos.2.default", "event_ms = 5000", "event_ms = 500"),
    DefinitionMutant("a TPDO has its objects in another order", "tpdos.4.default", '"4002.attitude_real", "4002.attitude_i"', '"4002.attitude_i", "4002.attitude_real"'),
    DefinitionMutant("a TPDO lacks an object", "tpdos.3.default", '"4002.attitude_known", ', ""),
)  # fmt: skip


def in_tpdo(frame: CanFrame) -> list[CanFrame]:
    """Change the first byte of TPDO 4."""
    return [CanFrame(frame.id, bytes([frame.data[0] ^ 1]) + frame.data[1:], extended=False) if frame.id == 0x4AC and frame.data else frame]  # fmt: skip


def reversed_answer(frame: CanFrame) -> list[CanFrame]:
    """Send the numbers of expedited uploads with the highest byte first."""
    if frame.id != 0x5AC or frame.data[0] & 0xE3 != 0x43:
        return [frame]
    size = 4 - (frame.data[0] >> 2 & 3)
    data = frame.data[:4] + frame.data[4 : 4 + size][::-1] + frame.data[4 + size :]
    return [CanFrame(frame.id, data, extended=False)]


def no_tpdo_with_frames(unit: SimulatedUnit) -> None:
    unit.link._frame_rows = ()
    unit.link._status_rows = ()


DAMAGES: dict[str, tuple[str, Damage]] = {
    "a TPDO carries other data": ("tpdos.4.data", outgoing(in_tpdo)),
    "numbers have the other byte order": ("attitude.orientation", outgoing(reversed_answer)),
    "TPDOs are not sent with frames": ("tpdos.4.frames", no_tpdo_with_frames),
    "settings are acknowledged and forgotten": ("records.set_capture_filter", only_acknowledged(4)),
    "the clock is not set": ("rpdos.1.clock", only_acknowledged(3)),
    "answers are missing": ("rows.system", outgoing(lambda frame: [] if frame.id == 0x5AC and frame.data[1:4] == b"\x03\x30\x05" else [frame])),
    "RPDOs are not taken": ("rpdos.1.clock", incoming(lambda frame: [] if frame.id == 0x181 else [frame])),
}  # fmt: skip
"""Mistakes that a definition cannot have, put in at the link."""
