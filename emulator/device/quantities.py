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
from starhil.emulator.device.stored_images import StoredFile, msdos_time
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
        return lambda snapshot: snapshot.parameters[parameter]
    if name.startswith(HEALTH):
        key = name.removeprefix(HEALTH)
        return lambda snapshot: snapshot.constants.health.get(key)
    function, number = QUANTITIES[generic(name)], number_in(name)
    return function if number is None else lambda snapshot: function(snapshot, number)


# --- how the function of a quantity is bound to its name ---


def _quantity(name: str, function: Callable[..., Value | None]) -> None:
    if name in QUANTITIES:
        raise ValueError(f"quantity {name} has two functions")
    QUANTITIES[name] = function


def _vector(name: str, function: Callable[[Snapshot], Triple]) -> None:
    """Bind the components x, y and z of a vector."""
    for axis, letter in enumerate("xyz"):

        def component(snapshot: Snapshot, axis: int = axis) -> float:
            return function(snapshot)[axis]

        _quantity(name + letter, component)


def _attitude(name: str, function: Callable[..., float]) -> None:
    """Bind a form of the reported attitude, which has no value if the attitude is invalid."""

    def of_attitude(snapshot: Snapshot, *number: int) -> float | None:
        return function(snapshot.reported, *number) if snapshot.reported.valid else None

    _quantity(name, of_attitude)


def _frame(name: str, function: Callable[[Measurement], Value]) -> None:
    """Bind a quantity of the last frame, which has no value without a frame."""
    _quantity(name, lambda snapshot: None if snapshot.frame is None else function(snapshot.frame))


def _solution(name: str, function: Callable[[Measurement], float]) -> Callable[[Snapshot], float | None]:
    """Bind a quantity of the last frame, which has no value if the attitude is invalid."""

    def of_solution(snapshot: Snapshot) -> float | None:
        return function(snapshot.frame) if snapshot.frame is not None and snapshot.frame.valid else None

    _quantity(name, of_solution)
    return of_solution


def _features(name: str, function: Callable[[FeatureReport], Value]) -> None:
    """Bind a quantity of the features of the last frame, which has no value for the algorithm `geometric`."""

    def of_features(snapshot: Snapshot) -> Value | None:
        known = None if snapshot.frame is None else snapshot.frame.result.features
        return None if known is None else function(known)

    _quantity(f"features.{name}", of_features)


def _star(name: str, function: Callable[[Snapshot, MatchedStar], Value | None]) -> None:
    """Bind a quantity of the nth identified star, which has no value if there are fewer."""

    def of_star(snapshot: Snapshot, number: int) -> Value | None:
        return function(snapshot, snapshot.stars[number - 1]) if number <= len(snapshot.stars) else None

    _quantity(f"stars[n].{name}", of_star)


def _star_direction(name: str, function: Callable[[Snapshot, MatchedStar], Triple]) -> None:
    """Bind the components x, y and z of a direction of the nth identified star."""
    for axis, letter in enumerate("xyz"):

        def component(snapshot: Snapshot, star: MatchedStar, axis: int = axis) -> float:
            return function(snapshot, star)[axis]

        _star(name + letter, component)


def _flag(name: str) -> None:
    _quantity(f"link.{name}", lambda snapshot: name in snapshot.counters.flags)


def _identity(name: str) -> None:
    """Bind a number that identifies the device."""
    _quantity(f"identity.{name}", lambda snapshot: int(getattr(snapshot.constants.identity, name)))


def _selected(name: str, function: Callable[[Snapshot, Parameter], float]) -> None:
    """Bind a quantity of the selected parameter, which has no value if no parameter has the ID."""

    def of_selected(snapshot: Snapshot) -> float | None:
        return None if snapshot.selected is None else function(snapshot, snapshot.selected)

    _quantity(f"selected.{name}", of_selected)


def _file(name: str, function: Callable[[StoredFile], int]) -> None:
    """Bind a number of the current file of the list, which is 0 if there is none."""

    def of_file(snapshot: Snapshot) -> int:
        return 0 if snapshot.file is None else function(snapshot.file)

    _quantity(f"file.{name}", of_file)


# --- attitude and rate ---

_vector("attitude.", lambda snapshot: snapshot.reported.quaternion_xyzw[:3])
_quantity("attitude.w", lambda snapshot: snapshot.reported.quaternion_xyzw[3])
_quantity("attitude.valid", lambda snapshot: bool(snapshot.frame is not None and snapshot.frame.valid))
_quantity("attitude.stable", lambda snapshot: snapshot.valid_in_a_row)
_quantity("attitude.reason", lambda snapshot: str(snapshot.reported.reason))
_solution("attitude.sigma_cross", lambda frame: float(frame.result.sigma_cross_arcsec))
_solution("attitude.sigma_roll", lambda frame: float(frame.result.sigma_roll_arcsec))
_confidence = _solution("attitude.confidence", lambda frame: 100.0 * (1.0 - frame.result.probability_false))

_attitude("attitude.ra", lambda reported: reported.mounted.ra_deg)
_attitude("attitude.dec", lambda reported: reported.mounted.dec_deg)
_attitude("attitude.roll", lambda reported: reported.mounted.roll_deg)
_vector("attitude.rotation_", lambda snapshot: snapshot.reported.rotation_vector_rad)
_vector("attitude.gibbs_", lambda snapshot: snapshot.reported.gibbs_vector)
_vector("attitude.mrp_", lambda snapshot: snapshot.reported.modified_rodrigues)
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

_vector("rate.", lambda snapshot: snapshot.reported.rate_rad_s)
_frame("rate.valid", lambda frame: frame.rate_valid)
_quantity(
    "rate.clipped",
    lambda snapshot: (
        snapshot.frame is not None
        and any(
            field.clips(snapshot.reported.rate_rad_s[axis] * factor)
            for field, axis, factor in snapshot.constants.rate_fields
        )
    ),
)

# --- the last frame ---

_quantity("frame.available", lambda snapshot: snapshot.frame is not None)
_frame("frame.counter", lambda frame: int(frame.counter))
_quantity(
    "frame.time",
    lambda snapshot: None if snapshot.exposure_ns is None else snapshot.exposure_ns / NANOSECONDS,
)
_quantity(
    "frame.time_seconds",
    lambda snapshot: None if snapshot.exposure_ns is None else snapshot.exposure_ns // NANOSECONDS,
)
_quantity(
    "frame.time_nanoseconds",
    lambda snapshot: None if snapshot.exposure_ns is None else snapshot.exposure_ns % NANOSECONDS,
)
_frame("frame.time_of_day", lambda frame: frame.mid_unix_ns % DAY_NS / NANOSECONDS)
_quantity(
    "frame.period",
    lambda snapshot: (
        1.0 / float(snapshot.parameters["update_rate"]) if snapshot.frame is None else snapshot.frame.period_s
    ),
)
_frame("frame.latency", lambda frame: float(frame.latency_s))
_quantity(
    "frame.age",
    lambda snapshot: (
        None if snapshot.frame is None else (snapshot.now_ns - snapshot.frame.mid_ns) / NANOSECONDS
    ),
)
_frame("frame.capture", lambda frame: float(frame.capture_s))
_frame("frame.detect", lambda frame: float(frame.detect_s))
_frame("frame.identify", lambda frame: float(frame.identify_s))
_quantity(
    "frame.mode", lambda snapshot: (snapshot.mode if snapshot.frame is None else snapshot.frame.mode).value
)
_quantity(
    "frame.method",
    lambda snapshot: (
        None if snapshot.frame is None else "tracking" if snapshot.frame.result.tracked else "lost_in_space"
    ),
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
_quantity("stars.reported", lambda snapshot: len(snapshot.stars))
_star("hip", lambda _shot, star: star.hip)
_star("x", lambda _shot, star: star.x)
_star("y", lambda _shot, star: star.y)
_star("centred_x", lambda snapshot, star: star.x - (snapshot.constants.image_size[0] - 1) / 2.0)
_star("centred_y", lambda snapshot, star: star.y - (snapshot.constants.image_size[1] - 1) / 2.0)
_star("magnitude", lambda _shot, star: star.magnitude)
_star("confidence", lambda snapshot, _star: _confidence(snapshot))
_star_direction(
    "vector_", lambda snapshot, star: as_triple(snapshot.reported.in_reported_frame(np.array(star.vector)))
)
_star_direction("icrs_", lambda _shot, star: star.icrs)

# --- time ---

_quantity("clock.unix", lambda snapshot: snapshot.clock_ns / NANOSECONDS)
_quantity("clock.seconds", lambda snapshot: snapshot.clock_ns // NANOSECONDS & UINT32)
_quantity("clock.milliseconds", lambda snapshot: snapshot.clock_ns % NANOSECONDS // 1_000_000)
_quantity("clock.microseconds", lambda snapshot: snapshot.clock_ns % NANOSECONDS // 1_000)
_quantity("clock.nanoseconds", lambda snapshot: snapshot.clock_ns % NANOSECONDS)
_quantity("clock.day", lambda snapshot: snapshot.clock_ns // DAY_NS)
_quantity("clock.day_milliseconds", lambda snapshot: snapshot.clock_ns % DAY_NS // 1_000_000)
_quantity("clock.submilliseconds", lambda snapshot: snapshot.clock_ns % 1_000_000 // 1_000)
_quantity("clock.set", lambda snapshot: snapshot.clock_set)
_quantity("uptime", lambda snapshot: snapshot.uptime_ns / NANOSECONDS)
_quantity("uptime.seconds", lambda snapshot: snapshot.uptime_ns // NANOSECONDS)
_quantity("uptime.milliseconds", lambda snapshot: snapshot.uptime_ns % NANOSECONDS // 1_000_000)

# --- state ---

_quantity("mode", lambda snapshot: snapshot.mode.value)
_quantity("mode.changes", lambda snapshot: snapshot.mode_changes)
_quantity("error", lambda snapshot: snapshot.error or "none")
_quantity("error.active", lambda snapshot: bool(snapshot.error))
_quantity("boot.reset_cause", lambda snapshot: snapshot.reset_cause)
_quantity("boot.cause", lambda snapshot: "power" if snapshot.reset_cause == "power_on" else "command")
_quantity("boot.count", lambda snapshot: snapshot.boot_count)
_quantity("boot.program", lambda _shot: 1)
_identity("node_type")
_identity("interface_version")
_identity("firmware_major")
_identity("firmware_minor")
_quantity("counters.telecommands", lambda snapshot: snapshot.counters.telecommands)
_quantity("counters.telemetry", lambda snapshot: snapshot.counters.telemetry)
_quantity("counters.requests", lambda snapshot: snapshot.counters.telecommands + snapshot.counters.telemetry)
_quantity("counters.frames", lambda snapshot: snapshot.frames)
_quantity("counters.frames_valid", lambda snapshot: snapshot.frames_valid)

_quantity("link.error", lambda snapshot: bool(snapshot.counters.flags))
_flag("telecommand_overrun")
_flag("uart_protocol_error")
_flag("uart_incomplete")
_flag("uart_check_error")
_flag("uart_address_error")
_flag("can_telecommand_error")
_quantity("link.faults", lambda snapshot: sum(snapshot.counters.faults.values()))
_quantity("request.last", lambda snapshot: snapshot.acknowledge.last_telecommand)
_quantity("request.processed", lambda snapshot: snapshot.acknowledge.processed)
_quantity("request.error", lambda snapshot: snapshot.acknowledge.error.name.lower())
_quantity("request.index", lambda snapshot: snapshot.acknowledge.parameter_index)

# --- parameters ---

_quantity("parameters.changed", lambda snapshot: snapshot.parameters.differs_from_store)
_quantity("parameters.store_fault", lambda snapshot: snapshot.store_fault)
_quantity("selected.id", lambda snapshot: snapshot.selected_id)
_selected("value", lambda snapshot, chosen: chosen.to_number(snapshot.parameters[chosen.name]))
_selected("minimum", lambda _shot, chosen: float(chosen.minimum))
_selected("maximum", lambda _shot, chosen: float(chosen.maximum))
_selected(
    "default", lambda snapshot, chosen: float(chosen.to_number(snapshot.parameters.defaults[chosen.name]))
)

# --- images and files ---


def _image_chunk(snapshot: Snapshot) -> bytes:
    if snapshot.images.busy and snapshot.images.download is None:
        raise Refused(ErrorCode.BUSY)
    return snapshot.images.chunk


_quantity("image.stored", lambda snapshot: snapshot.images.stored is not None)
_quantity("image.percent", lambda snapshot: snapshot.images.percent)
_quantity("image.status", lambda snapshot: snapshot.images.status)
_quantity("image.chunk", _image_chunk)
_quantity("image.chunk_number", lambda snapshot: snapshot.images.chunk_number)
_quantity("image.chunk_checksum", lambda snapshot: frame_checksum(snapshot.images.chunk))
_quantity("conversion.percent", lambda snapshot: snapshot.images.conversion.percent)
_quantity("conversion.result", lambda snapshot: snapshot.images.conversion.result)
_quantity("conversion.counter", lambda snapshot: snapshot.images.conversion.number)
_quantity("file.ready", lambda snapshot: bool(snapshot.files.block))
_quantity("file.parameter_error", lambda snapshot: snapshot.files.parameter_error)
_quantity("file.checksum", lambda snapshot: file_checksum(snapshot.files.block))
_quantity("file.length", lambda snapshot: len(snapshot.files.block))
_quantity("file.packet_number", lambda snapshot: snapshot.files.packets[0])
_quantity(
    "file.packet",
    lambda snapshot: parse_burst_packet(burst_packet(snapshot.files.block, snapshot.files.packets[0]))[1],
)
_file("type", lambda file: file.type)
_quantity("file.updating", lambda snapshot: snapshot.file_updating)
_file("counter", lambda file: file.number)
_file("size", lambda file: file.file_size)
_file("time", lambda file: msdos_time(file.unix_ns))
_file("crc", lambda file: file.file_crc)
_quantity("card.formatting", lambda snapshot: snapshot.erasing and snapshot.files.formatting)
_quantity("card.erasing", lambda snapshot: snapshot.erasing and not snapshot.files.formatting)
_quantity("file.hole_map[n]", lambda snapshot, number: snapshot.files.arrived.part(number))

# --- health ---

_quantity("power.phase", lambda snapshot: snapshot.phase.value)
_quantity("power.voltage", lambda snapshot: snapshot.constants.power.config.voltage_v)
_quantity("power.current", lambda snapshot: snapshot.constants.power.current_a(snapshot.phase))
_quantity("power.now", lambda snapshot: snapshot.constants.power.power_w(snapshot.phase))
_quantity("power.mean", lambda snapshot: snapshot.constants.power.mean_power_w(snapshot.timing))
_quantity("temperature.mounting", lambda snapshot: snapshot.thermal.mounting_c(snapshot.now_ns))
_quantity("temperature.detector", lambda snapshot: snapshot.thermal.temperature_c(snapshot.now_ns))
_frame("sky.sun_in_field", lambda frame: "sun" in frame.result.in_field)
_frame("sky.moon_in_field", lambda frame: "moon" in frame.result.in_field)
_frame("sky.earth_in_field", lambda frame: "earth" in frame.result.in_field)
_frame("rate.too_high", lambda frame: frame.reason == "rate_too_high")
