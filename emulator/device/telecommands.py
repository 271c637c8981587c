"""Telecommands: a handler for each row of the interface definition, by its name.

A handler gets the decoded, range-checked values. It returns the messages that follow the acknowledge
(mostly none), or None if it continues in the background and ends the acknowledge itself. It raises
`Refused` to answer with an error code. A telecommand that continues is answered at once, unless it
is in `ANSWERED_WHEN_DONE`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.counters import Acknowledge
from starhil.emulator.device.device import Device
from starhil.emulator.device.images import edge_of
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.refusal import Refused
from starhil.emulator.errors import EmulatorError
from starhil.protocol.messages import FIRST_TELEMETRY_ID, ErrorCode, Reply
from starhil.protocol.values import MessageError, Value

Values: TypeAlias = dict[str, Value]
Handler: TypeAlias = Callable[[Device, Values, Acknowledge], list[Reply] | None]

SRAM_STORED: Final = 0
"""Bank of the image that save_image stored; the other bank holds the last exposure."""


def reset(device: Device, _values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """1: restart once the acknowledge is sent."""
    device.scheduler.at(device.clock.now_ns(), lambda _due_ns: device.reset("command"))
    return []


def set_unix_time(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """2: set the clock."""
    unix_ns = _int(values, "seconds") * NANOSECONDS + _int(values, "milliseconds") * 1_000_000
    device.time.set_unix_ns(unix_ns)
    return []


def set_star_config(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """37: set the whole configuration, or none of it."""
    fields = device.icd.telecommands["set_star_config"].named_fields
    changes = {field.parameter: values[name] for name, field in fields.items() if field.parameter}
    try:
        device.parameters.set(changes)
    except MessageError as error:
        names = [field.parameter for field in fields.values()]
        index = next((n for n, name in enumerate(names) if name and str(error).startswith(f"{name}:")), 0)
        raise Refused(ErrorCode.INVALID_PARAMETER, index) from None
    return []


def init_image_download(device: Device, values: Values, acknowledge: Acknowledge) -> list[Reply] | None:
    """64: open an image for download in numbered pieces (image frames)."""
    images = device.images
    if images.busy:
        raise Refused(ErrorCode.BUSY)
    edge = edge_of(str(values["image_size"]))
    if _int(values, "sram") == SRAM_STORED:
        if images.stored is None:
            raise Refused(ErrorCode.SEQUENCE)
        if not images.open_stored(edge):
            raise Refused(ErrorCode.INVALID_PARAMETER, 2)
        return []

    def opened(found: bool) -> None:
        acknowledge.end(ErrorCode.OK if found else ErrorCode.SEQUENCE)

    images.open_last(edge, opened)
    return None


def advance_image_download(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """65: load an image frame of the open image."""
    images = device.images
    if images.busy and images.download is None:
        raise Refused(ErrorCode.BUSY)
    if images.download is None:
        raise Refused(ErrorCode.SEQUENCE)
    frame = _int(values, "next_frame")
    if frame >= images.frames:
        raise Refused(ErrorCode.INVALID_PARAMETER)
    images.frame = frame
    return []


def save_image(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """80: capture an image and store it."""
    if values["camera"] != "star":
        raise Refused(ErrorCode.INVALID_PARAMETER)
    if device.modes.mode in {Mode.BOOT, Mode.ERROR}:
        raise Refused(ErrorCode.SEQUENCE)
    if device.images.busy:
        raise Refused(ErrorCode.BUSY)
    device.images.save(edge_of(str(values["image_size"])))
    return []


def set_mode(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """96: command a mode."""
    if not device.command_mode(Mode(str(values["mode"]))):
        raise Refused(ErrorCode.SEQUENCE)
    return []


def set_update_rate(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """97: set the update rate."""
    device.parameters.set({"update_rate": values["rate"]})
    return []


def set_parameter(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """98: set one parameter and select it for telemetry `parameter`."""
    chosen = device.icd.parameters_by_id.get(_int(values, "parameter"))
    if chosen is None:
        raise Refused(ErrorCode.INVALID_PARAMETER)
    try:
        device.parameters.set({chosen.name: values["value"]})
    except MessageError:
        raise Refused(ErrorCode.INVALID_PARAMETER, 1) from None
    device.selected_parameter = chosen.id
    return []


def select_parameter(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """99: select the parameter that telemetry `parameter` reports."""
    chosen = _int(values, "parameter")
    if chosen not in device.icd.parameters_by_id:
        raise Refused(ErrorCode.INVALID_PARAMETER)
    device.selected_parameter = chosen
    return []


def save_parameters(device: Device, _values: Values, acknowledge: Acknowledge) -> None:
    """100: store all parameters; answered once they are on disk or storing has failed."""

    def done(error: EmulatorError | None) -> None:
        acknowledge.end(ErrorCode.OK if error is None else ErrorCode.INTERNAL)

    device.save_parameters(done)


def restore_parameters(device: Device, _values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """101: load the stored parameters."""
    device.restore_parameters()
    return []


def default_parameters(device: Device, _values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """102: set all parameters to their defaults."""
    device.parameters.set_defaults()
    return []


def clear_counters(device: Device, _values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """103: clear the counters and flags of communication_status."""
    device.counters.clear()
    return []


def set_unsolicited(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """104: send a telemetry row unsolicited at a rate."""
    row = _int(values, "telemetry")
    if row < FIRST_TELEMETRY_ID or row not in device.icd.telemetry_by_id:
        raise Refused(ErrorCode.INVALID_PARAMETER)
    device.parameters.set({"unsolicited_selection": row, "unsolicited_rate": values["rate"]})
    return []


def load_file_block(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """112: load a block of a file."""
    file_type, counter = str(values["file_type"]), _int(values, "file_counter")
    if not device.files.load(file_type, counter, _int(values, "offset"), _int(values, "length")):
        raise Refused(ErrorCode.INVALID_PARAMETER)
    return []


def start_burst(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
    """119: send the loaded block in packets."""
    if not device.files.ready:
        raise Refused(ErrorCode.SEQUENCE)
    return device.files.burst(ignore_hole_map=bool(values["ignore_hole_map"]))


def _set_hole_map(section: int) -> Handler:
    def set_hole_map(device: Device, values: Values, _acknowledge: Acknowledge) -> list[Reply]:
        """120 to 127: report which packets have arrived."""
        data = values["map"]
        device.files.arrived.set_part(section, data if isinstance(data, bytes) else b"")
        return []

    return set_hole_map


def _int(values: Values, name: str) -> int:
    """Return the value of an integer field."""
    return int(values[name])


TELECOMMANDS: Final[dict[str, Handler]] = {
    "reset": reset,
    "set_unix_time": set_unix_time,
    "set_star_config": set_star_config,
    "init_image_download": init_image_download,
    "advance_image_download": advance_image_download,
    "save_image": save_image,
    "set_mode": set_mode,
    "set_update_rate": set_update_rate,
    "set_parameter": set_parameter,
    "select_parameter": select_parameter,
    "save_parameters": save_parameters,
    "restore_parameters": restore_parameters,
    "default_parameters": default_parameters,
    "clear_counters": clear_counters,
    "set_unsolicited": set_unsolicited,
    "load_file_block": load_file_block,
    "start_burst": start_burst,
    **{f"set_hole_map_{n}": _set_hole_map(n) for n in range(1, 9)},
}
"""Row name → handler."""

ANSWERED_WHEN_DONE: Final = frozenset({"save_parameters"})
"""Rows answered with their outcome instead of their acceptance."""
