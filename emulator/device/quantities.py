"""The functions of the device's quantities, which `configs/units/model.toml` declares with type, unit and meaning.

The function of a `Snapshot` returns the value in the declared unit, or None if there is none; the field then has its
default or 0. The function of a numbered quantity, such as `stars[n].x`, also takes the number, from 1 to its `count`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.reported import SEQUENCES
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.device.stored_images import BMP_TYPE, StoredImage, msdos_time
from starhil.emulator.sensor.pipeline.messages import MatchedStar, Triple, as_triple
from starhil.protocol.icd.conventions import DAY_NS, NANOSECONDS
from starhil.protocol.icd.device_model import HEALTH, PARAMETER, generic, number_in
from starhil.protocol.icd.values import Parameter, Value
from starhil.protocol.image_transfer import (
    burst_packet,
    file_checksum,
    frame_checksum,
    parse_burst_packet,
)
from starhil.protocol.messages import ErrorCode
from starid.identification.solution import FeatureReport

Getter: TypeAlias = Callable[[Snapshot], Value | None]

UINT32: Final = 0xFFFF_FFFF


QUANTITIES: Final[dict[str, Callable[..., Value | None]]] = {}
"""Name → function of each quantity that `configs/units/model.toml` declares."""


def getter_of(name: str) -> Getter:
    """Return the function of a quantity such as `attitude.w`, `stars[3].x` or `parameter.exposure`."""
    if name.startswith(PARAMETER):
        parameter = name.removeprefix(PARAMETER)
        return lambda shot: shot.parameters[parameter]
    if name.startswith(HEALTH):
        key = name.removeprefix(HEALTH)
        return lambda shot: shot.constants.health.get(key)
    function, number = QUANTITIES[generic(name)], number_in(name)
    return function if number is None else lambda shot: function(shot, number)


# --- how the function of a quantity is bound to its name ---


def _quantity(name: str, function: Callable[..., Value | None]) -> None:
    if name in QUANTITIES:
        raise ValueError(f"quantity {name} has two functions")
    QUANTITIES[name] = function


def _vector(name: str, function: Callable[[Snapshot], Triple]) -> None:
    """Bind the components x, y and z of a vector."""
    for axis, letter in enumerate("xyz"):

        def component(shot: Snapshot, axis: int = axis) -> float:
            return function(shot)[axis]

        _quantity(name + letter, component)


def _attitude(name: str, function: Callable[..., float]) -> None:
    """Bind a form of the reported attitude, which has no value if the attitude is invalid."""

    def of_attitude(shot: Snapshot, *number: int) -> float | None:
        return function(shot.reported, *number) if shot.reported.valid else None

    _quantity(name, of_attitude)


def _frame(name: str, function: Callable[[Measurement], Value]) -> None:
    """Bind a quantity of the last frame, which has no value without a frame."""
    _quantity(name, lambda shot: None if shot.frame is None else function(shot.frame))


def _solution(name: str, function: Callable[[Measurement], float]) -> Callable[[Snapshot], float | None]:
    """Bind a quantity of the last frame, which has no value if the attitude is invalid."""

    def of_solution(shot: Snapshot) -> float | None:
        return function(shot.frame) if shot.frame is not None and shot.frame.valid else None

    _quantity(name, of_solution)
    return of_solution


def _features(name: str, function: Callable[[FeatureReport], Value]) -> None:
    """Bind a quantity of the features of the last frame, which has no value for the algorithm `geometric`."""

    def of_features(shot: Snapshot) -> Value | None:
        known = None if shot.frame is None else shot.frame.result.features
        return None if known is None else function(known)

    _quantity(f"features.{name}", of_features)


def _star(name: str, function: Callable[[Snapshot, MatchedStar], Value | None]) -> None:
    """Bind a quantity of the nth identified star, which has no value if there are fewer."""

    def of_star(shot: Snapshot, number: int) -> Value | None:
        return function(shot, shot.stars[number - 1]) if number <= len(shot.stars) else None

    _quantity(f"stars[n].{name}", of_star)


def _star_direction(name: str, function: Callable[[Snapshot, MatchedStar], Triple]) -> None:
    """Bind the components x, y and z of a direction of the nth identified star."""
    for axis, letter in enumerate("xyz"):

        def component(shot: Snapshot, star: MatchedStar, axis: int = axis) -> float:
            return function(shot, star)[axis]

        _star(name + letter, component)


def _flag(name: str) -> None:
    """Bind a flag of the links."""
    _quantity(f"link.{name}", lambda shot: name in shot.counters.flags)


def _identity(name: str) -> None:
    """Bind a number that identifies the device."""
    _quantity(f"identity.{name}", lambda shot: int(getattr(shot.constants.identity, name)))


def _selected(name: str, function: Callable[[Snapshot, Parameter], float]) -> None:
    """Bind a quantity of the selected parameter, which has no value if no parameter has the ID."""

    def of_selected(shot: Snapshot) -> float | None:
        return None if shot.selected is None else function(shot, shot.selected)

    _quantity(f"selected.{name}", of_selected)


def _file(name: str, function: Callable[[StoredImage], int]) -> None:
    """Bind a number of the current file of the list, which is 0 if there is none."""

    def of_file(shot: Snapshot) -> int:
        return 0 if shot.file is None else function(shot.file)

    _quantity(f"file.{name}", of_file)


# --- attitude and rate ---

_vector("attitude.", lambda shot: shot.reported.quaternion_xyzw[:3])
_quantity("attitude.w", lambda shot: shot.reported.quaternion_xyzw[3])
_quantity("attitude.valid", lambda shot: bool(shot.frame is not None and shot.frame.valid))
_quantity("attitude.stable", lambda shot: shot.valid_in_a_row)
_quantity("attitude.reason", lambda shot: str(shot.reported.reason))
_solution("attitude.sigma_cross", lambda frame: float(frame.result.sigma_cross_arcsec))
_solution("attitude.sigma_roll", lambda frame: float(frame.result.sigma_roll_arcsec))
_confidence = _solution("attitude.confidence", lambda frame: 100.0 * (1.0 - frame.result.probability_false))

_attitude("attitude.ra", lambda reported: reported.mounted.ra_deg)
_attitude("attitude.dec", lambda reported: reported.mounted.dec_deg)
_attitude("attitude.roll", lambda reported: reported.mounted.roll_deg)
_vector("attitude.rotation_", lambda shot: shot.reported.rotation_vector_rad)
for _axis, _letter in enumerate("xyz"):
    _attitude(
        f"attitude.dcm_{_letter}[n]",
        lambda reported, number, axis=_axis: float(reported.attitude.matrix[axis, number - 1]),
    )
for _sequence in SEQUENCES:
    _attitude(
        f"attitude.euler_{_sequence}[n]",
        lambda reported, number, sequence=_sequence: reported.euler_rad(sequence)[number - 1],
    )

_vector("rate.", lambda shot: shot.reported.rate_rad_s)
_frame("rate.valid", lambda frame: frame.rate_valid)
_quantity(
    "rate.clipped",
    lambda shot: (
        shot.frame is not None
        and any(
            field.clips(shot.reported.rate_rad_s[axis] * factor)
            for field, axis, factor in shot.constants.rate_fields
        )
    ),
)

# --- the last frame ---

_quantity("frame.available", lambda shot: shot.frame is not None)
_frame("frame.counter", lambda frame: int(frame.counter))
_quantity("frame.time", lambda shot: None if shot.exposure_ns is None else shot.exposure_ns / NANOSECONDS)
_quantity(
    "frame.time_seconds", lambda shot: None if shot.exposure_ns is None else shot.exposure_ns // NANOSECONDS
)
_quantity(
    "frame.time_nanoseconds",
    lambda shot: None if shot.exposure_ns is None else shot.exposure_ns % NANOSECONDS,
)
_frame("frame.time_of_day", lambda frame: frame.mid_unix_ns % DAY_NS / NANOSECONDS)
_quantity(
    "frame.period",
    lambda shot: 1.0 / float(shot.parameters["update_rate"]) if shot.frame is None else shot.frame.period_s,
)
_frame("frame.latency", lambda frame: float(frame.latency_s))
_quantity(
    "frame.age", lambda shot: None if shot.frame is None else (shot.now_ns - shot.frame.mid_ns) / NANOSECONDS
)
_frame("frame.capture", lambda frame: float(frame.capture_s))
_frame("frame.detect", lambda frame: float(frame.detect_s))
_frame("frame.identify", lambda frame: float(frame.identify_s))
_quantity("frame.mode", lambda shot: (shot.mode if shot.frame is None else shot.frame.mode).value)
_quantity(
    "frame.method",
    lambda shot: None if shot.frame is None else "tracking" if shot.frame.result.tracked else "lost_in_space",
)
_frame("frame.tracking", lambda frame: bool(frame.result.tracked))
_frame("frame.capture_ok", lambda frame: frame.reason not in {"no_frame", "processing_error"})
_frame("frame.detection_ok", lambda frame: frame.result.detected > 0)
_frame("frame.identification_ok", lambda frame: frame.result.matched > 0)
_frame("frame.late", lambda frame: bool(frame.late or frame.reason == "timeout"))
_frame("frame.index_pending", lambda frame: bool(frame.result.index_pending))
_frame("frame.background", lambda frame: float(frame.result.background_dn))
_frame("frame.noise", lambda frame: float(frame.result.noise_dn))

# --- features: how an algorithm of the thesis worked ---

_features("available", lambda known: known.observed is not None)
_features("region_searched", lambda known: known.search == "rsi")
_features("triggered", lambda known: known.triggered)
_features("refined", lambda known: known.refined)
_features("error_psi", lambda known: 0.0 if math.isnan(known.error_psi) else known.error_psi)
_features("cell", lambda known: known.cell + 1)
_features("weights", lambda known: known.weights)
_features("region", lambda known: known.region_deg)
_features("stars", lambda known: known.stars)
_features("removed", lambda known: known.removed)
_features("rotation", lambda known: known.rotation_deg)
_features("translation", lambda known: known.translation_deg)

# --- stars ---

_frame("stars.detected", lambda frame: int(frame.result.detected))
_frame("stars.matched", lambda frame: int(frame.result.matched))
_frame("stars.refused", lambda frame: int(frame.result.refused))
_quantity("stars.reported", lambda shot: len(shot.stars))
_star("hip", lambda _shot, star: star.hip)
_star("x", lambda _shot, star: star.x)
_star("y", lambda _shot, star: star.y)
_star("centred_x", lambda shot, star: star.x - (shot.constants.image_size[0] - 1) / 2.0)
_star("centred_y", lambda shot, star: star.y - (shot.constants.image_size[1] - 1) / 2.0)
_star("magnitude", lambda _shot, star: star.magnitude)
_star("confidence", lambda shot, _star: _confidence(shot))
_star_direction(
    "vector_", lambda shot, star: as_triple(shot.reported.in_reported_frame(np.array(star.vector)))
)
_star_direction("icrs_", lambda _shot, star: star.icrs)

# --- time ---

_quantity("clock.unix", lambda shot: shot.clock_ns / NANOSECONDS)
_quantity("clock.seconds", lambda shot: shot.clock_ns // NANOSECONDS & UINT32)
_quantity("clock.milliseconds", lambda shot: shot.clock_ns % NANOSECONDS // 1_000_000)
_quantity("clock.microseconds", lambda shot: shot.clock_ns % NANOSECONDS // 1_000)
_quantity("clock.nanoseconds", lambda shot: shot.clock_ns % NANOSECONDS)
_quantity("clock.day", lambda shot: shot.clock_ns // DAY_NS)
_quantity("clock.day_milliseconds", lambda shot: shot.clock_ns % DAY_NS // 1_000_000)
_quantity("clock.submilliseconds", lambda shot: shot.clock_ns % 1_000_000 // 1_000)
_quantity("clock.set", lambda shot: shot.clock_set)
_quantity("uptime", lambda shot: shot.uptime_ns / NANOSECONDS)
_quantity("uptime.seconds", lambda shot: shot.uptime_ns // NANOSECONDS)
_quantity("uptime.milliseconds", lambda shot: shot.uptime_ns % NANOSECONDS // 1_000_000)

# --- state ---

_quantity("mode", lambda shot: shot.mode.value)
_quantity("mode.changes", lambda shot: shot.mode_changes)
_quantity("error", lambda shot: shot.error or "none")
_quantity("error.active", lambda shot: bool(shot.error))
_quantity("boot.reset_cause", lambda shot: shot.reset_cause)
_quantity("boot.cause", lambda shot: "power" if shot.reset_cause == "power_on" else "command")
_quantity("boot.count", lambda shot: shot.boot_count)
_quantity("boot.program", lambda _shot: 1)
_identity("node_type")
_identity("interface_version")
_identity("firmware_major")
_identity("firmware_minor")
_quantity("counters.telecommands", lambda shot: shot.counters.telecommands)
_quantity("counters.telemetry", lambda shot: shot.counters.telemetry)
_quantity("counters.requests", lambda shot: shot.counters.telecommands + shot.counters.telemetry)
_quantity("counters.frames", lambda shot: shot.frames)
_quantity("counters.frames_valid", lambda shot: shot.frames_valid)

_quantity("link.error", lambda shot: bool(shot.counters.flags))
_flag("telecommand_overrun")
_flag("uart_protocol_error")
_flag("uart_incomplete")
_flag("uart_check_error")
_flag("uart_address_error")
_flag("can_telecommand_error")
_quantity("link.faults", lambda shot: sum(shot.counters.faults.values()))
_quantity("request.last", lambda shot: shot.acknowledge.last_telecommand)
_quantity("request.processed", lambda shot: shot.acknowledge.processed)
_quantity("request.error", lambda shot: shot.acknowledge.error.name.lower())
_quantity("request.index", lambda shot: shot.acknowledge.parameter_index)

# --- parameters ---

_quantity("parameters.changed", lambda shot: shot.parameters.differs_from_store)
_quantity("parameters.store_fault", lambda shot: shot.store_fault)
_quantity("selected.id", lambda shot: shot.selected_id)
_selected("value", lambda shot, chosen: chosen.to_number(shot.parameters[chosen.name]))
_selected("minimum", lambda _shot, chosen: float(chosen.minimum))
_selected("maximum", lambda _shot, chosen: float(chosen.maximum))
_selected("default", lambda shot, chosen: float(chosen.to_number(shot.parameters.defaults[chosen.name])))

# --- images and files ---


def _image_chunk(shot: Snapshot) -> bytes:
    if shot.images.busy and shot.images.download is None:
        raise Refused(ErrorCode.BUSY)
    return shot.images.chunk


_quantity("image.stored", lambda shot: shot.images.stored is not None)
_quantity("image.percent", lambda shot: shot.images.percent)
_quantity("image.status", lambda shot: shot.images.status)
_quantity("image.chunk", _image_chunk)
_quantity("image.chunk_number", lambda shot: shot.images.chunk_number)
_quantity("image.chunk_checksum", lambda shot: frame_checksum(shot.images.chunk))
_quantity("file.ready", lambda shot: bool(shot.files.block))
_quantity("file.parameter_error", lambda shot: shot.files.parameter_error)
_quantity("file.checksum", lambda shot: file_checksum(shot.files.block))
_quantity("file.length", lambda shot: len(shot.files.block))
_quantity("file.packet_number", lambda shot: shot.files.packets[0])
_quantity(
    "file.packet", lambda shot: parse_burst_packet(burst_packet(shot.files.block, shot.files.packets[0]))[1]
)
_file("type", lambda _image: BMP_TYPE)
_quantity("file.updating", lambda shot: shot.file_updating)
_file("counter", lambda image: image.number)
_file("size", lambda image: image.file_size)
_file("time", lambda image: msdos_time(image.unix_ns))
_file("crc", lambda image: image.file_crc)
_quantity("card.formatting", lambda shot: shot.erasing and shot.files.formatting)
_quantity("card.erasing", lambda shot: shot.erasing and not shot.files.formatting)
_quantity("file.hole_map[n]", lambda shot, number: shot.files.arrived.part(number))

# --- health ---

_quantity("power.phase", lambda shot: shot.phase.value)
_quantity("power.voltage", lambda shot: shot.constants.power.config.voltage_v)
_quantity("power.current", lambda shot: shot.constants.power.current_a(shot.phase))
_quantity("power.now", lambda shot: shot.constants.power.power_w(shot.phase))
_quantity("power.mean", lambda shot: shot.constants.power.mean_power_w(shot.timing))
_quantity("temperature.mounting", lambda shot: shot.thermal.mounting_c(shot.now_ns))
_quantity("temperature.detector", lambda shot: shot.thermal.temperature_c(shot.now_ns))
_frame("sky.sun_in_field", lambda frame: "sun" in frame.result.in_field)
_frame("sky.moon_in_field", lambda frame: "moon" in frame.result.in_field)
_frame("sky.earth_in_field", lambda frame: "earth" in frame.result.in_field)
_frame("rate.too_high", lambda frame: frame.reason == "rate_too_high")
