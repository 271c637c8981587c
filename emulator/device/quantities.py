"""The quantities of the device: one function for each name declared in `configs/units/model.toml`.

A function returns the value in the declared unit, or None if there is none; the field then has its default or 0.
The function of a numbered quantity, such as `stars[n].x`, also takes the number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np

from starhil.emulator.clock import NANOSECONDS
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.reported import to_reported_frame
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.pipeline.messages import MatchedStar
from starhil.protocol.conventions import DAY_NS
from starhil.protocol.device_model import HEALTH, PARAMETER, generic, number_in
from starhil.protocol.image_transfer import frame_checksum
from starhil.protocol.messages import ErrorCode
from starhil.protocol.values import Value

Getter: TypeAlias = Callable[[Snapshot], Value | None]

UINT32: Final = 0xFFFF_FFFF

QUANTITIES: Final[dict[str, Callable[..., Value | None]]] = {}
"""Name → function of the snapshot, and of the number if the name has one."""

Function = TypeVar("Function", bound=Callable[..., Value | None])


def _quantity(name: str) -> Callable[[Function], Function]:
    def register(function: Function) -> Function:
        QUANTITIES[name] = function
        return function

    return register


def getter_of(name: str) -> Getter:
    """Return the function of a quantity such as `attitude.w`, `stars[3].x` or `parameter.exposure`."""
    if name.startswith(PARAMETER):
        parameter = name.removeprefix(PARAMETER)
        return lambda shot: shot.device.parameters[parameter]
    if name.startswith(HEALTH):
        key = name.removeprefix(HEALTH)
        return lambda shot: shot.device.profile.health.get(key)
    function, number = QUANTITIES[generic(name)], number_in(name)
    return function if number is None else lambda shot: function(shot, number)


# --- attitude and rate ---


for _axis, _letter in enumerate("xyzw"):
    QUANTITIES[f"attitude.{_letter}"] = lambda shot, axis=_axis: shot.reported.quaternion_xyzw[axis]
for _axis, _letter in enumerate("xyz"):
    QUANTITIES[f"rate.{_letter}"] = lambda shot, axis=_axis: shot.reported.rate_rad_s[axis]

QUANTITIES["attitude.valid"] = lambda shot: bool(shot.frame is not None and shot.frame.valid)
QUANTITIES["attitude.stable"] = lambda shot: shot.device.valid_in_a_row
QUANTITIES["attitude.reason"] = lambda shot: str(shot.reported.reason)
QUANTITIES["attitude.sigma_cross"] = lambda shot: _if_valid(shot, "sigma_cross_arcsec")
QUANTITIES["attitude.sigma_roll"] = lambda shot: _if_valid(shot, "sigma_roll_arcsec")
QUANTITIES["rate.valid"] = lambda shot: None if shot.frame is None else shot.frame.rate_valid


def _if_valid(shot: Snapshot, attribute: str) -> float | None:
    frame = shot.frame
    return float(getattr(frame.result, attribute)) if frame is not None and frame.valid else None


@_quantity("attitude.confidence")
def _confidence(shot: Snapshot) -> float | None:
    frame = shot.frame
    return 100.0 * (1.0 - frame.result.probability_false) if frame is not None and frame.valid else None


@_quantity("rate.clipped")
def _rate_clipped(shot: Snapshot) -> bool:
    """Return whether a rate is beyond the range of an integer field that reports it."""
    if shot.frame is None:
        return False
    rates = shot.reported.rate_rad_s
    return any(field.clips(rates[axis] * factor) for field, axis, factor in shot.device.rate_fields)


# --- the last frame ---


def _of_frame(name: str, function: Callable[..., Value]) -> None:
    QUANTITIES[name] = lambda shot: None if shot.frame is None else function(shot.frame)


_of_frame("frame.counter", lambda frame: int(frame.counter))
for _name in ("latency", "capture", "detect", "identify"):
    _of_frame(f"frame.{_name}", lambda frame, name=_name: float(getattr(frame, f"{name}_s")))
_of_frame("frame.method", lambda frame: "tracking" if frame.result.tracked else "lost_in_space")
_of_frame("frame.tracking", lambda frame: bool(frame.result.tracked))
_of_frame("frame.capture_ok", lambda frame: frame.reason not in {"no_frame", "processing_error"})
_of_frame("frame.detection_ok", lambda frame: frame.result.detected > 0)
_of_frame("frame.identification_ok", lambda frame: frame.result.matched > 0)
_of_frame("frame.late", lambda frame: bool(frame.late or frame.reason == "timeout"))
_of_frame("frame.index_pending", lambda frame: bool(frame.result.index_pending))
_of_frame("frame.background", lambda frame: float(frame.result.background_dn))
_of_frame("frame.noise", lambda frame: float(frame.result.noise_dn))
for _name in ("detected", "matched", "refused"):
    _of_frame(f"stars.{_name}", lambda frame, name=_name: int(getattr(frame.result, name)))

QUANTITIES["frame.available"] = lambda shot: shot.frame is not None
QUANTITIES["frame.time"] = lambda shot: None if shot.exposure_ns is None else shot.exposure_ns / NANOSECONDS
QUANTITIES["frame.time_seconds"] = lambda shot: (
    None if shot.exposure_ns is None else shot.exposure_ns // NANOSECONDS
)
QUANTITIES["frame.time_nanoseconds"] = lambda shot: (
    None if shot.exposure_ns is None else shot.exposure_ns % NANOSECONDS
)
QUANTITIES["frame.time_of_day"] = lambda shot: (
    None if shot.frame is None else shot.frame.mid_unix_ns % DAY_NS / NANOSECONDS
)


@_quantity("frame.age")
def _frame_age(shot: Snapshot) -> float | None:
    return None if shot.frame is None else (shot.device.clock.now_ns() - shot.frame.mid_ns) / NANOSECONDS


@_quantity("frame.period")
def _frame_period(shot: Snapshot) -> float:
    if shot.frame is not None:
        return shot.frame.period_s
    return 1.0 / float(shot.device.parameters["update_rate"])


@_quantity("frame.mode")
def _frame_mode(shot: Snapshot) -> str:
    return (shot.device.modes.mode if shot.frame is None else shot.frame.mode).value


# --- stars ---


def _of_star(name: str, function: Callable[[Snapshot, MatchedStar], Value | None]) -> None:
    def of_number(shot: Snapshot, number: int) -> Value | None:
        return function(shot, shot.stars[number - 1]) if number <= len(shot.stars) else None

    QUANTITIES[f"stars[n].{name}"] = of_number


QUANTITIES["stars.reported"] = lambda shot: len(shot.stars)
_of_star("hip", lambda _shot, star: star.hip)
_of_star("x", lambda _shot, star: star.x)
_of_star("y", lambda _shot, star: star.y)
_of_star("centred_x", lambda shot, star: star.x - (shot.device.profile.camera.width - 1) / 2.0)
_of_star("centred_y", lambda shot, star: star.y - (shot.device.profile.camera.height - 1) / 2.0)
_of_star("magnitude", lambda _shot, star: star.magnitude)
_of_star("confidence", lambda shot, _star: _confidence(shot))


def _of_directions(letter: str, axis: int) -> None:
    _of_star(
        f"vector_{letter}",
        lambda shot, star: float(to_reported_frame(shot.device, np.array(star.vector))[axis]),
    )
    _of_star(f"icrs_{letter}", lambda _shot, star: star.icrs[axis])


for _axis, _letter in enumerate("xyz"):
    _of_directions(_letter, _axis)


# --- time ---

QUANTITIES["clock.unix"] = lambda shot: shot.clock_ns / NANOSECONDS
QUANTITIES["clock.seconds"] = lambda shot: shot.clock_ns // NANOSECONDS & UINT32
QUANTITIES["clock.milliseconds"] = lambda shot: shot.clock_ns % NANOSECONDS // 1_000_000
QUANTITIES["clock.microseconds"] = lambda shot: shot.clock_ns % NANOSECONDS // 1_000
QUANTITIES["clock.nanoseconds"] = lambda shot: shot.clock_ns % NANOSECONDS
QUANTITIES["clock.set"] = lambda shot: shot.device.time.was_set
QUANTITIES["uptime"] = lambda shot: shot.uptime_ns / NANOSECONDS
QUANTITIES["uptime.seconds"] = lambda shot: shot.uptime_ns // NANOSECONDS
QUANTITIES["uptime.milliseconds"] = lambda shot: shot.uptime_ns % NANOSECONDS // 1_000_000

# --- state ---

QUANTITIES["mode"] = lambda shot: shot.device.modes.mode.value
QUANTITIES["mode.changes"] = lambda shot: shot.device.mode_changes
QUANTITIES["error"] = lambda shot: shot.device.modes.error or "none"
QUANTITIES["boot.reset_cause"] = lambda shot: shot.device.reset_cause
QUANTITIES["boot.cause"] = lambda shot: "power" if shot.device.reset_cause == "power_on" else "command"
QUANTITIES["boot.count"] = lambda shot: shot.device.boot_count
QUANTITIES["boot.program"] = lambda _shot: 1
QUANTITIES["counters.telecommands"] = lambda shot: shot.device.counters.telecommands
QUANTITIES["counters.telemetry"] = lambda shot: shot.device.counters.telemetry
QUANTITIES["counters.requests"] = lambda shot: (
    shot.device.counters.telecommands + shot.device.counters.telemetry
)
QUANTITIES["counters.frames"] = lambda shot: shot.device.cycle.published
QUANTITIES["counters.frames_valid"] = lambda shot: shot.device.frames_valid
for _name in ("node_type", "interface_version", "firmware_major", "firmware_minor"):
    QUANTITIES[f"identity.{_name}"] = lambda shot, name=_name: int(getattr(shot.device.profile.device, name))

QUANTITIES["link.error"] = lambda shot: bool(shot.device.counters.flags)
QUANTITIES["link.faults"] = lambda shot: sum(shot.device.counters.faults.values())
for _name in (
    "telecommand_overrun",
    "uart_protocol_error",
    "uart_incomplete",
    "uart_check_error",
    "uart_address_error",
    "can_telecommand_error",
):
    QUANTITIES[f"link.{_name}"] = lambda shot, name=_name: name in shot.device.counters.flags

QUANTITIES["request.last"] = lambda shot: shot.device.acknowledge.last_telecommand
QUANTITIES["request.processed"] = lambda shot: shot.device.acknowledge.processed
QUANTITIES["request.error"] = lambda shot: shot.device.acknowledge.error.name.lower()
QUANTITIES["request.index"] = lambda shot: shot.device.acknowledge.parameter_index

# --- health ---

QUANTITIES["power.phase"] = lambda shot: shot.phase.value
QUANTITIES["power.voltage"] = lambda shot: shot.device.profile.power.voltage_v
QUANTITIES["power.current"] = lambda shot: shot.device.power.current_a(shot.phase)
QUANTITIES["power.now"] = lambda shot: shot.device.power.power_w(shot.phase)
QUANTITIES["power.mean"] = lambda shot: shot.device.power.mean_power_w(shot.device.cycle.timing)
QUANTITIES["temperature.mounting"] = lambda shot: shot.device.thermal.mounting_c(shot.device.clock.now_ns())
QUANTITIES["temperature.detector"] = lambda shot: shot.device.thermal.temperature_c(
    shot.device.clock.now_ns()
)
for _name in ("sun", "moon", "earth"):
    _of_frame(f"sky.{_name}_in_field", lambda frame, name=_name: name in frame.result.in_field)
_of_frame("rate.too_high", lambda frame: frame.reason == "rate_too_high")

# --- parameters ---

QUANTITIES["parameters.changed"] = lambda shot: shot.device.parameters.differ_from_store
QUANTITIES["parameters.store_fault"] = lambda shot: shot.device.store.corrupt
QUANTITIES["selected.id"] = lambda shot: shot.device.selected_parameter


def _of_selected(name: str, function: Callable[[Snapshot, Any], float]) -> None:
    def of_selected(shot: Snapshot) -> float | None:
        chosen = shot.device.icd.parameters_by_id.get(shot.device.selected_parameter)
        return None if chosen is None else function(shot, chosen)

    QUANTITIES[f"selected.{name}"] = of_selected


_of_selected("value", lambda shot, chosen: shot.device.parameters.number(chosen.name))
_of_selected("minimum", lambda _shot, chosen: float(chosen.minimum))
_of_selected("maximum", lambda _shot, chosen: float(chosen.maximum))
_of_selected(
    "default", lambda shot, chosen: float(chosen.to_number(shot.device.parameters.default(chosen.name)))
)

# --- images and files ---

QUANTITIES["image.stored"] = lambda shot: shot.device.images.stored is not None
QUANTITIES["image.percent"] = lambda shot: shot.device.images.percent
QUANTITIES["image.status"] = lambda shot: shot.device.images.status
QUANTITIES["image.chunk_number"] = lambda shot: shot.device.images.frame
QUANTITIES["image.chunk_checksum"] = lambda shot: frame_checksum(shot.device.images.frame_bytes())
QUANTITIES["file.ready"] = lambda shot: shot.device.files.ready
QUANTITIES["file.parameter_error"] = lambda shot: shot.device.files.parameter_error
QUANTITIES["file.checksum"] = lambda shot: shot.device.files.checksum
QUANTITIES["file.length"] = lambda shot: len(shot.device.files.data)
QUANTITIES["file.updating"] = lambda shot: shot.device.files.updating
for _name in ("type", "counter", "size", "time"):
    QUANTITIES[f"file.{_name}"] = lambda shot, name=_name: int(getattr(shot.device.files.info, name))
QUANTITIES["file.crc"] = lambda shot: shot.device.files.info.checksum
QUANTITIES["file.packet_number"] = lambda shot: shot.device.files.packet[0]
QUANTITIES["file.packet"] = lambda shot: shot.device.files.packet[1]
QUANTITIES["card.formatting"] = lambda shot: shot.device.files.erasing and shot.device.files.formatting
QUANTITIES["card.erasing"] = lambda shot: shot.device.files.erasing and not shot.device.files.formatting
QUANTITIES["file.hole_map[n]"] = lambda shot, number: shot.device.files.arrived.part(number)


@_quantity("image.chunk")
def _image_chunk(shot: Snapshot) -> bytes:
    if shot.device.images.busy and shot.device.images.download is None:
        raise Refused(ErrorCode.BUSY)
    return shot.device.images.frame_bytes()
