"""The actions of the device: one function for each name declared in `configs/units/model.toml`.

`starhil.emulator.device.bindings.TelecommandBinding.execute` calls them. An action gets its arguments by name,
range-checked and in the declared units, and returns the messages that follow the answer, if any. To refuse the
telecommand it raises `Refused`, whose `argument` names the invalid argument. An action that continues in the
background returns a `PendingAnswer`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

from starhil.emulator.device.counters import Counters
from starhil.emulator.device.device import Device
from starhil.emulator.device.images import edge_of
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.pending import PendingAnswer
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.subscriptions import Subscription
from starhil.protocol.icd.conventions import NANOSECONDS
from starhil.protocol.icd.values import MessageError, Value
from starhil.protocol.messages import ErrorCode, Reply

Arguments: TypeAlias = Mapping[str, Any]
"""Values by argument; `parameters` has the values of fields that are bound to a parameter."""
Outcome: TypeAlias = list[Reply] | PendingAnswer[ErrorCode] | None
Action: TypeAlias = Callable[[Device, Arguments], Outcome]

PARAMETERS: Final = "parameters"
"""Key for the values of fields that are bound to a parameter."""

SRAM_STORED: Final = 0
"""Bank of the image that save_image stored; the other bank holds the last exposure."""


def nothing(_device: Device, _arguments: Arguments) -> None:
    """Accept the telecommand and do nothing."""


def reset(device: Device, _arguments: Arguments) -> None:
    """Restart once the answer has been sent."""
    device.scheduler.at(device.clock.now_ns(), lambda _due_ns: device.reset("command"))


def set_clock(device: Device, arguments: Arguments) -> None:
    """Set the clock to the sum of the arguments, since the unit's epoch."""
    reported_ns = round(float(arguments.get("unix") or 0.0) * NANOSECONDS)
    for name, nanoseconds in (("seconds", NANOSECONDS), ("milliseconds", 1_000_000), ("microseconds", 1_000)):
        reported_ns += round((arguments.get(name) or 0) * nanoseconds)
    reported_ns += round(arguments.get("nanoseconds") or 0)
    device.time.set_unix_ns(device.icd.conventions.unix_ns(reported_ns, device.time.unix_ns()))


def set_parameters(device: Device, arguments: Arguments) -> None:
    """Set the parameters to which the fields of the row are bound, all or none."""
    changes: Mapping[str, Value] = arguments[PARAMETERS]
    try:
        device.parameters.set(changes)
    except MessageError as error:
        culprit = str(error).partition(":")[0]
        raise Refused(ErrorCode.INVALID_PARAMETER, argument=culprit) from None


def open_image(device: Device, arguments: Arguments) -> PendingAnswer[ErrorCode] | None:
    """Open an image for download in numbered chunks."""
    images = device.images
    if images.state.busy:
        raise Refused(ErrorCode.BUSY)
    edge = edge_of(str(arguments["image_size"]))
    if int(arguments["sram"]) == SRAM_STORED:
        if images.state.stored is None:
            raise Refused(ErrorCode.SEQUENCE)
        if not images.open_stored(edge):
            raise Refused(ErrorCode.INVALID_PARAMETER, argument="image_size")
        return None
    return images.open_last(edge).then(
        lambda found: ErrorCode.OK if found else ErrorCode.SEQUENCE, accepted=True
    )


def load_image_chunk(device: Device, arguments: Arguments) -> None:
    """Load a chunk of the open image."""
    images, number = device.images.state, int(arguments["number"])
    if images.busy and images.download is None:
        raise Refused(ErrorCode.BUSY)
    if images.download is None:
        raise Refused(ErrorCode.SEQUENCE)
    if number >= images.chunks:
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="number")
    device.images.load_chunk(number)


def save_image(device: Device, arguments: Arguments) -> None:
    """Capture an image and store it."""
    if arguments["camera"] != "star":
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="camera")
    if device.modes.mode in {Mode.BOOT, Mode.ERROR}:
        raise Refused(ErrorCode.SEQUENCE)
    if device.images.state.busy:
        raise Refused(ErrorCode.BUSY)
    device.images.save(edge_of(str(arguments["image_size"])))


def convert_image(device: Device, arguments: Arguments) -> None:
    """Compress a stored image into a file of its own; the images are grey, so that `white_balance` has no effect."""
    if device.images.state.conversion.result == "busy":
        raise Refused(ErrorCode.BUSY)
    device.images.convert(int(arguments["file_counter"]), int(arguments["quality"]))


def set_mode(device: Device, arguments: Arguments) -> None:
    """Change the mode."""
    if not device.command_mode(Mode(str(arguments["mode"]))):
        raise Refused(ErrorCode.SEQUENCE)


def set_parameter(device: Device, arguments: Arguments) -> None:
    """Set one parameter and select it."""
    parameter = device.icd.parameters_by_id.get(int(arguments["parameter"]))
    if parameter is None:
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="parameter")
    try:
        device.parameters.set({parameter.name: arguments["value"]})
    except MessageError:
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="value") from None
    device.selected_parameter = parameter.id


def select_parameter(device: Device, arguments: Arguments) -> None:
    """Select the parameter that telemetry reports."""
    chosen = int(arguments["parameter"])
    if chosen not in device.icd.parameters_by_id:
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="parameter")
    device.selected_parameter = chosen


def save_parameters(device: Device, _arguments: Arguments) -> PendingAnswer[ErrorCode]:
    """Store all parameters; answered once they are on disk or storing has failed."""
    return device.save_parameters().then(lambda error: ErrorCode.OK if error is None else ErrorCode.INTERNAL)


def restore_parameters(device: Device, _arguments: Arguments) -> None:
    """Load the stored parameters."""
    device.restore_parameters()


def default_parameters(device: Device, _arguments: Arguments) -> None:
    """Set all parameters to their defaults."""
    device.parameters.set_defaults()


def clear_counters(device: Device, _arguments: Arguments) -> None:
    """Clear the counters and flags of the links."""
    device.counters = Counters()


def subscribe(device: Device, arguments: Arguments) -> None:
    """Send telemetry rows unsolicited; the list replaces the previous one."""
    rate_hz = float(arguments["rate"])
    subscriptions = []
    for name, row_id in arguments.items():
        if not name.startswith("telemetry[") or not row_id:
            continue
        row = device.icd.telemetry_row(int(row_id), arguments.get("class"))
        if row is None:
            raise Refused(ErrorCode.INVALID_PARAMETER, argument=name)
        subscriptions.append(Subscription(row, rate_hz or None))
    device.subscriptions.replace("request", subscriptions)


def select_unsolicited(device: Device, arguments: Arguments) -> None:
    """Set the parameters for one unsolicited telemetry row and its rate."""
    row_id = int(arguments["telemetry"])
    if device.icd.telemetry_row(row_id) is None:
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="telemetry")
    device.parameters.set({"unsolicited_selection": row_id, "unsolicited_rate": arguments["rate"]})


def rewind_file_list(device: Device, _arguments: Arguments) -> None:
    """Go to the first file of the list."""
    device.files.rewind()


def advance_file_list(device: Device, _arguments: Arguments) -> None:
    """Go to the next file of the list."""
    device.files.advance()


def erase_file(device: Device, arguments: Arguments) -> None:
    """Erase one file or all."""
    if arguments["all"]:
        device.files.erase_all(formatting=False)
    elif not device.files.erase(str(arguments["file_type"]), int(arguments["file_counter"])):
        raise Refused(ErrorCode.INVALID_PARAMETER, argument="file_counter")


def format_card(device: Device, _arguments: Arguments) -> None:
    """Erase all files."""
    device.files.erase_all(formatting=True)


def load_file_block(device: Device, arguments: Arguments) -> None:
    """Load a block of a file."""
    offset, length = int(arguments["offset"]), int(arguments["length"])
    if not device.files.load(str(arguments["file_type"]), int(arguments["file_counter"]), offset, length):
        raise Refused(ErrorCode.INVALID_PARAMETER)


def start_burst(device: Device, arguments: Arguments) -> list[Reply]:
    """Send the loaded block in packets."""
    if not device.files.state.block:
        raise Refused(ErrorCode.SEQUENCE)
    return device.files.burst(ignore_hole_map=bool(arguments["ignore_hole_map"]))


def next_packet(device: Device, _arguments: Arguments) -> None:
    """Go to the next packet of the last burst."""
    device.files.next_packet()


def set_hole_map(device: Device, arguments: Arguments) -> None:
    """Report which packets have arrived."""
    device.files.set_hole_map(int(arguments["section"]), bytes(arguments["map"]))


ACTIONS: Final[dict[str, Action]] = {
    name: item for name, item in vars().items() if inspect.isfunction(item) and item.__module__ == __name__
}
"""Name → function: every function of this module is an action."""
